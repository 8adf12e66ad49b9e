"""Every wrong argument gets one clear line that says what arrived and what is allowed."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.factory import make
from tests.arcade_torch.stub import GAME


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"id": "CartPolEasy"},
            ValueError,
            "unknown env id 'CartPolEasy': did you mean 'CartPoleEasy'?",
        ),
        ({"num_envs": 0}, ValueError, "num_envs is 0, expected 1 or more"),
        ({"num_envs": -3}, ValueError, "num_envs is -3, expected 1 or more"),
        ({"num_envs": 2.5}, TypeError, "num_envs is 2.5, expected an int"),
        ({"num_envs": True}, TypeError, "num_envs is True, expected an int"),
        (
            {"observability": "half"},
            ValueError,
            "observability is 'half', allowed: 'full', 'partial', or bools",
        ),
        (
            {"observability": [True, [], None]},
            ValueError,
            "observability is object (), expected bool (3,): allowed",
        ),
        (
            {"observability": [True]},
            ValueError,
            "observability is bool (1,), expected bool (3,): allowed",
        ),
        (
            {"observability": torch.ones(3)},
            ValueError,
            "observability is float32 (3,), expected bool (3,)",
        ),
        (
            {"observability": torch.ones(2, dtype=torch.bool)},
            ValueError,
            "observability is bool (2,), expected bool",
        ),
        (
            {"observability": "full", "partial_obs": True},
            ValueError,
            "observability and partial_obs are given: keep",
        ),
        ({"partial_obs": "yes"}, TypeError, "partial_obs is 'yes', allowed: True, False"),
        ({"device": "tpu"}, ValueError, "device is 'tpu', allowed: 'cpu', 'cuda'"),
        ({"device": "meta"}, ValueError, "device is 'meta', allowed: 'cpu', 'cuda'"),
        ({"obs_size": 64}, ValueError, "obs_size is 64, allowed: 128, 256"),
        ({"rules": "new"}, ValueError, "rules is 'new', allowed"),
        ({"seed": -1}, ValueError, "seed is -1, allowed"),
        ({"colour": 1}, TypeError, "has no option 'colour'"),
    ],
)
def test_make_explains_a_wrong_argument(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        make(**{"id": "CartPoleEasy", "num_envs": 3, **options})


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without CUDA")
def test_cuda_without_a_gpu_is_explained() -> None:
    with pytest.raises(ValueError, match="torch sees no GPU"):
        ArcadeEnv(GAME, 3, device="cuda")


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (torch.zeros(3), TypeError, "action has dtype torch.float32, expected integers"),
        (
            torch.zeros(3, dtype=torch.bool),
            TypeError,
            "action has dtype torch.bool, expected integers",
        ),
        (
            torch.zeros(3, 1, dtype=torch.int64),
            ValueError,
            "action has shape (3, 1), expected (3,)",
        ),
        (torch.zeros(2, dtype=torch.int64), ValueError, "action has shape (2,), expected (3,)"),
        (torch.tensor([0, 5, 1]), ValueError, "actions range from 0 to 5, allowed: 0 to 4"),
        (torch.tensor([0, -1, 1]), ValueError, "actions range from -1 to 1, allowed: 0 to 4"),
        (
            torch.tensor([0, 2**32, 1]),
            ValueError,
            "actions range from 0 to 4294967296, allowed: 0 to 4",
        ),
    ],
)
def test_a_wrong_action_is_explained_and_changes_nothing(
    action: torch.Tensor, error: type[Exception], message: str
) -> None:
    env = ArcadeEnv(GAME, 3)
    env.reset()
    before = env.get_state()
    with pytest.raises(error, match=re.escape(message)):
        env.step_raw(action)
    assert (env.get_state() == before).all()


def test_a_wrong_one_hot_action_is_explained() -> None:
    with pytest.raises(ValueError, match=re.escape("expected one-hot (3, 5)")):
        ArcadeEnv(GAME, 3, categorical_actions=False).step_raw(torch.zeros(3, dtype=torch.int64))


def test_a_tensordict_of_another_batch_size_is_refused() -> None:
    env = ArcadeEnv(GAME, 3)
    env.reset()
    td = TensorDict({"action": torch.zeros(2, dtype=torch.int64)}, [2])
    for step in (env.step, env.step_and_maybe_reset):
        with pytest.raises(ValueError, match="batch_size"):
            step(td.clone())


def broken(change: Any) -> TensorDict:
    state = ArcadeEnv(GAME, 3).get_state()
    change(state)
    return state


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (
            lambda: ArcadeEnv(GAME, 4).get_state(),
            "the state is of batch size [4], this env has 3 envs",
        ),
        (
            lambda: make("CartPoleEasy", 3).get_state(),
            "the state of env 0 is one of CartPoleEasy-v0, this env plays",
        ),
        (lambda: broken(lambda s: s.pop("game")), "the state has no entry 'game'"),
        (lambda: broken(lambda s: s["state"].pop("total")), "the state has no entry 'state.total'"),
        (
            lambda: broken(
                lambda s: s.set(("state", "dice"), torch.zeros(3, 1, dtype=torch.int32))
            ),
            "state entry 'state.dice' is int32 (3, 1), StubEasy-v0 with 3 envs expects int32 (3, "
            "2)",
        ),
        (
            lambda: broken(lambda s: s.set("step_count", torch.zeros(3))),
            "state entry 'step_count' is float32 (3,), StubEasy-v0 with 3 envs expects int32 (3,)",
        ),
    ],
)
def test_a_wrong_state_is_explained_and_not_loaded(state: Any, message: str) -> None:
    env = ArcadeEnv(GAME, 3)
    before = env.get_state()
    with pytest.raises(ValueError, match=re.escape(message)):
        env.set_state(state())
    assert (env.get_state() == before).all()


def test_a_rollout_fills_what_is_in_out_and_refuses_an_empty_one() -> None:
    env = make("CartPoleEasy", num_envs=2, seed=1)
    first = env.rollout(3, break_when_any_done=False)
    with pytest.raises(
        ValueError, match=r"^out must be a batch of the same rollout.*leave out away"
    ):
        env.rollout(3, break_when_any_done=False, out=TensorDict(batch_size=[2, 3]))
    pixels = first.select("pixels").clone()
    env.set_seed(2)
    assert env.rollout(3, break_when_any_done=False, out=pixels) is pixels
    assert not torch.equal(pixels["pixels"], first["pixels"])


def test_none_is_no_twin_to_change_to() -> None:
    """Before: it was the MDP, though nobody had asked for that."""
    env = ArcadeEnv(GAME, 3, observability="partial")
    with pytest.raises(ValueError, match=r"^observability is None, allowed: 'full', 'partial'"):
        env.set_observability(None)  # type: ignore[arg-type]
    assert env.observability.all()


def test_a_seed_may_be_a_number_of_numpy_or_torch() -> None:
    """One of torch was refused by numpy, after it had been set."""
    env = make("CartPoleEasy", num_envs=2)
    following = env.set_seed(3)
    for seed in (torch.tensor(3), np.int64(3)):
        assert env.set_seed(seed) == following
    assert env.set_seed(torch.tensor(3), static_seed=True) == 3
    assert env.set_seed(None) is None
    collector = ArcadeCollector(env, None, frames_per_batch=4)
    assert collector.set_seed(torch.tensor(3)) == following
