"""What Gymnasium's users expect of any env: copies, pickles, a time limit to read, numpy's numbers
as arguments.
"""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeAwareObservation

import arcade_torch
from arcade_torch import ArcadeCollector
from arcade_torch.envs_jax import make as make_game
from arcade_torch.gym.env import ArcadeGymEnv

ID = "arcade_torch/MineSweeperEasy-v0"
WAYS: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


def path(env: Any, actions: list[Any]) -> list[Any]:
    """What some steps give; begins anew after an end."""
    out = []
    for action in actions:
        frame, reward, terminated, truncated, info = env.step(action)
        out.append((frame.copy(), reward, terminated, truncated, info))
        if np.ndim(terminated) == 0 and (terminated or truncated):
            out.append(env.reset()[0])
    return out


@pytest.mark.parametrize("wrapped", [False, True], ids=["bare", "wrapped"])
@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_an_env_walks_the_same_path(way: str, wrapped: bool) -> None:
    """Before: ``cannot pickle 'Device' object``, and a shallow copy shared its state."""
    env = gymnasium.make(ID, observability="partial")
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    path(env, rng.integers(5, size=5).tolist())
    if way == "copy" and wrapped:
        pytest.skip("a shallow copy of a wrapper shares what it wraps, by its meaning")
    twin = WAYS[way](env if wrapped else env.unwrapped)
    actions = rng.integers(5, size=40).tolist()
    mine = path(env if wrapped else env.unwrapped, actions)
    theirs = path(twin, actions)
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_equal(one, other)
    assert twin.spec.id == env.spec.id


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_a_vector_env_walks_the_same_path(way: str, mode: str) -> None:
    envs = gymnasium.make_vec(ID, num_envs=3, autoreset_mode=mode, observability="partial")
    envs.reset(seed=3)
    rng = np.random.default_rng(0)
    path(envs, list(rng.integers(5, size=(5, 3))))
    twin = WAYS[way](envs)
    actions = list(rng.integers(5, size=(30, 3)))
    for one, other in zip(path(envs, actions), path(twin, actions), strict=True):
        np.testing.assert_equal(one[:4], other[:4])


def test_the_time_limit_can_be_read_and_wrappers_find_it() -> None:
    """Before: None, so that ``TimeAwareObservation`` refused the env."""
    env = gymnasium.make("arcade_torch/CartPoleEasy-v0")
    limit = make_game("CartPoleEasy").max_steps
    assert env.spec.max_episode_steps == limit
    aware = TimeAwareObservation(env, flatten=False)
    assert float(np.asarray(aware.reset(seed=0)[0]["time"]).item()) == 0
    envs = gymnasium.make_vec("arcade_torch/CartPoleEasy-v0", num_envs=2)
    assert envs.spec.max_episode_steps == limit


def test_a_spec_that_somebody_hands_over_is_not_written_to() -> None:
    spec = gymnasium.spec("arcade_torch/CartPoleEasy-v0")
    env = ArcadeGymEnv("CartPoleEasy")
    env.spec = spec
    assert env.spec.max_episode_steps == env.time_limit
    assert spec.max_episode_steps is None


def test_an_env_made_from_its_own_spec_ends_as_the_first() -> None:
    env = gymnasium.make("arcade_torch/AutoEncodeEasy-v0")
    again = gymnasium.make(env.spec)
    env.reset(seed=0), again.reset(seed=0)
    while True:
        mine, theirs = env.step(0), again.step(0)
        assert mine[2:4] == theirs[2:4]
        if mine[2] or mine[3]:
            break
    assert mine[3] and not mine[2]


def test_a_shorter_limit_is_kept() -> None:
    env = gymnasium.make("arcade_torch/AutoEncodeEasy-v0", max_episode_steps=5)
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(5)] == [False] * 4 + [True]
    with pytest.raises(
        ValueError, match="but episodes of AutoEncodeEasy-v0 have 260 steps at most"
    ):
        gymnasium.make_vec("arcade_torch/AutoEncodeEasy-v0", num_envs=2, max_episode_steps=5)
    envs = gymnasium.make_vec("arcade_torch/AutoEncodeEasy-v0", num_envs=2)
    assert (
        gymnasium.make_vec(envs.spec, num_envs=2).spec.max_episode_steps
        == envs.spec.max_episode_steps
    )


class Mine(ArcadeGymEnv):
    """Somebody's subclass with a constructor of its own."""

    def __init__(self, word: str) -> None:
        super().__init__("MineSweeperEasy")
        self.word = word


@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_a_subclass_keeps_what_its_user_put_there(way: str) -> None:
    env = Mine("mine")
    env.reset(seed=0)
    env.action_space.seed(3)
    env.note = [1]
    twin = WAYS[way](env)
    assert (twin.word, twin.note) == ("mine", [1]) and twin.note is not env.note
    assert [twin.action_space.sample() for _ in range(9)] == [
        env.action_space.sample() for _ in range(9)
    ]
    np.testing.assert_equal(twin.step(4), env.step(4))


def test_a_second_window_is_refused_and_the_first_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: closing one closed the other."""
    pytest.importorskip("pygame", reason="needs the play extra")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    first = gymnasium.make(ID, render_mode="human")
    second = gymnasium.make(ID, render_mode="human")
    first.reset(seed=0)
    with pytest.raises(
        RuntimeError, match=r"one window a process: close\(\) the env that has it first"
    ):
        second.reset(seed=0)
    first.step(0)
    first.close()
    second.reset(seed=0)
    second.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: arcade_torch.make(
            "CartPoleEasy", num_envs=np.int64(2), obs_size=np.int32(128), seed=np.uint32(3)
        ),
        lambda: arcade_torch.make(
            "CartPoleEasy", np.int16(2), partial_obs=np.True_, categorical_actions=np.False_
        ),
        lambda: arcade_torch.make("AutoEncodeEasy", 2, mdp_marker=np.False_, debug=np.True_),
        lambda: arcade_torch.make("MineSweeperEasy", 2, mine_reward=np.float64(-0.5)),
        lambda: gymnasium.make_vec(ID, num_envs=np.int64(2), obs_size=np.int64(128)),
        lambda: gymnasium.make(ID, obs_size=np.int64(128), partial_obs=np.True_),
        lambda: make_game("AutoEncodeEasy", obs_size=np.int64(128), mdp_marker=np.True_),
    ],
)
def test_numbers_and_bools_of_numpy_are_taken(make: Callable[[], Any]) -> None:
    env = make()
    if hasattr(env, "reset") and not hasattr(env, "levels"):
        env.reset()


def test_a_collector_takes_numbers_of_numpy() -> None:
    env = arcade_torch.make("CartPoleEasy", num_envs=2, seed=1)
    options = {"overlap": np.int32(1), "seed": np.int64(3), "return_same_td": np.True_}
    collector = ArcadeCollector(env, None, np.int64(8), np.int64(16), **options)
    assert collector.collect()["action"].shape == (2, 5)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"frames_per_batch": "8"}, "frames_per_batch is '8', expected an int"),
        ({"frames_per_batch": 8, "total_frames": "x"}, "total_frames is 'x', expected an int"),
        ({"frames_per_batch": 8, "overlap": True}, "overlap is True, expected an int"),
        (
            {"frames_per_batch": 8, "return_same_td": "no"},
            "return_same_td is 'no', allowed: True, False",
        ),
        ({"frames_per_batch": 8, "seed": "a"}, "seed is 'a', expected an int"),
    ],
)
def test_a_collector_refuses_other_things_in_one_line(options: dict[str, Any], says: str) -> None:
    with pytest.raises(TypeError, match=says):
        ArcadeCollector(arcade_torch.make("CartPoleEasy", num_envs=2, seed=1), None, **options)


def test_numbers_without_axes_are_numbers() -> None:
    env = arcade_torch.make(
        "CartPoleEasy", num_envs=torch.tensor(2), seed=np.array(3), obs_size=np.array(128)
    )
    assert env.num_envs == 2
