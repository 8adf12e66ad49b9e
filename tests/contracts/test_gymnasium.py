"""Gymnasium's own checker: a cover of all games, difficulties, sizes and twins by default, all 120
when asked.
"""

import importlib.util
import re
import warnings

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

from arcade_torch import registered_ids
from arcade_torch.envs_jax.registry import DIFFICULTIES, GAMES

SIZES, TWINS = (128, 256), ("full", "partial")
HAS_PYGAME = importlib.util.find_spec("pygame") is not None
# Every game once; difficulties and sizes take turns.
COVER = [(f"{game}{DIFFICULTIES[i % 3]}-v0", SIZES[i % 2]) for i, game in enumerate(GAMES)]
# All of them with `make test-slow`: of a twin each game, of both half of them.
CASES = [
    pytest.param(*case, twin, marks=[] if i % 2 == TWINS.index(twin) else [pytest.mark.slow])
    for i, case in enumerate(COVER)
    for twin in TWINS
]


def check(id: str, obs_size: int, observability: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The checker without a warning; without pygame it cannot try the window."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make(
        f"arcade_torch/{id}",
        obs_size=obs_size,
        observability=observability,
        render_mode="rgb_array",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=not HAS_PYGAME)


@pytest.mark.parametrize(("id", "obs_size", "observability"), CASES)
def test_gymnasium_s_checker_passes(
    id: str, obs_size: int, observability: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check(id, obs_size, observability, monkeypatch)


def test_the_cover_has_every_game_difficulty_and_size() -> None:
    split = [re.fullmatch(r"(\w+?)(Easy|Medium|Hard)-v0", id).groups() for id, _ in COVER]
    assert {game for game, _ in split} == set(GAMES)
    assert {difficulty for _, difficulty in split} == set(DIFFICULTIES)
    assert {size for _, size in COVER} == set(SIZES)


@pytest.mark.slow
@pytest.mark.parametrize("observability", TWINS)
@pytest.mark.parametrize("obs_size", SIZES)
@pytest.mark.parametrize("id", registered_ids())
def test_gymnasium_s_checker_passes_on_all_configurations(
    id: str, obs_size: int, observability: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check(id, obs_size, observability, monkeypatch)


def test_the_checker_would_notice_a_broken_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gymnasium.make("arcade_torch/CartPoleEasy-v0").unwrapped
    original = type(env)._look
    monkeypatch.setattr(
        type(env), "_look", lambda self, frames: original(self, frames).astype("float32")
    )
    with pytest.raises(AssertionError):
        check_env(env, skip_render_check=True)
