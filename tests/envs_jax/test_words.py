"""A GPU draws words of four bytes where a CPU draws bytes: the frames are equal, and the CPU's
program is what it is without the switch.
"""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import BatchedGame, MixedGames, env_keys, make
from arcade_torch.envs_jax.render import Layers, Slot, blank

N = 6
PICTURES = [
    ("AutoEncodeEasy", 128),
    ("CartPoleEasy", 128),
    ("CartPoleEasy", 256),
    ("MineSweeperHard", 256),
    ("TetrisEasy", 128),
]


def take_branch(monkeypatch: pytest.MonkeyPatch, platform: str) -> None:
    """Let what depends on the platform take the branch of one, on whatever it runs."""

    def taken(*arguments: Any, default: Any, **branches: Any) -> Any:
        return branches.get(platform, default)(*arguments)

    monkeypatch.setattr(jax.lax, "platform_dependent", taken)


def program(game: str, platform: str) -> str:
    """What JAX lowers for a platform that draws a batch of a game."""
    batched = BatchedGame(make(game))
    batch = jax.eval_shape(batched.init, env_keys(0, N), jnp.zeros(N, bool))
    lowered = batched.render.trace(batch).lower(lowering_platforms=(platform,))
    text: str = lowered.as_text()
    return text


def cpu_program(game: str) -> str:
    """The optimised program that draws a batch of a game on a CPU, without names and positions."""
    batched = BatchedGame(make(game))
    batch = jax.eval_shape(batched.init, env_keys(0, N), jnp.zeros(N, bool))
    text: str = batched.render.trace(batch).lower().compile().as_text()
    operations = "\n".join(line for line in text.splitlines() if "%" in line)
    without_places = re.sub(r", metadata=\{[^}]*\}", "", operations)
    return re.sub(r"%[\w.-]+", "%", without_places)  # names are numbered as they come


@pytest.mark.parametrize(("game", "size"), PICTURES)
def test_words_draw_the_frames_that_bytes_draw(
    game: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_bytes = BatchedGame(make(game, obs_size=size))
    by_words = BatchedGame(make(game, obs_size=size))
    batch = by_bytes.init(env_keys(3, N), jnp.arange(N) % 2 == 1)
    expected = by_bytes.render(batch)
    take_branch(monkeypatch, "cuda")
    frames = by_words.render(batch)
    assert frames.dtype == np.uint8 and np.array_equal(frames, expected)
    assert np.unique(frames.reshape(N, -1), axis=0).shape[0] > 1


def test_a_gpu_gets_words_and_a_cpu_bytes() -> None:
    words = f"tensor<{N}x128x96xui32>"
    lines = f"tensor<{N}x128x384xui8>"
    gpu = program("CartPoleEasy", "cuda")
    cpu = program("CartPoleEasy", "cpu")
    assert words in gpu and words not in cpu and lines in cpu


def test_the_program_of_a_cpu_is_the_one_of_bytes_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    switched = cpu_program("CartPoleEasy")
    take_branch(monkeypatch, "default")
    assert switched == cpu_program("CartPoleEasy") and "u8[" in switched
    take_branch(monkeypatch, "cuda")
    assert switched != cpu_program("CartPoleEasy")


def test_a_screen_whose_lines_are_no_whole_words_is_drawn_by_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lamp = Slot(np.stack([blank(2, 2, (1, 2, 3)), blank(2, 2, (255, 0, 7))]), 3, 1)
    take_branch(monkeypatch, "cuda")
    frame = Layers(blank(6, 6, (9, 9, 9)), lamp).draw(1)
    assert frame.shape == (6, 6, 3)
    assert frame[1].tolist() == [[9, 9, 9]] * 3 + [[255, 0, 7]] * 2 + [[9, 9, 9]]


def test_a_mixture_joins_words_to_the_frames_that_it_joins_of_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    games = [make(game) for game in ("CartPoleEasy", "MineSweeperEasy", "TetrisEasy")]
    by_bytes, by_words = MixedGames(games), MixedGames(games)
    batch = by_bytes.init(env_keys(3, N), jnp.arange(N) % 2 == 1)
    frames = np.asarray(by_bytes.render(batch))
    take_branch(monkeypatch, "cuda")
    assert np.array_equal(by_words.render(batch), frames)
    assert len({frame.tobytes() for frame in frames}) == N
