"""Arguments that broke something inside are refused in one line, and change nothing."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict

import arcade_torch


@pytest.fixture(scope="module")
def env() -> arcade_torch.ArcadeEnv:
    return arcade_torch.make("CartPoleEasy", num_envs=2)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"num_envs": 10**12}, ValueError, "num_envs is above 1048576"),
        ({"seed": "7"}, TypeError, "seed is '7', expected a whole number"),
        ({"seed": 0.5}, TypeError, "seed is 0.5, expected a whole number"),
        ({"debug": torch.zeros(0)}, TypeError, "debug is .*, allowed: True, False"),
        (
            {"categorical_actions": "no"},
            TypeError,
            "categorical_actions is 'no', allowed: True, False",
        ),
        (
            {"obs_size": torch.zeros(2, 2)},
            ValueError,
            r"obs_size is tensor\(\[\[0\., 0\.\], \[0\., 0\.\]\]\), allowed",
        ),
        ({"device": 10**30}, ValueError, "device is 1000.*, allowed: 'cpu', 'cuda'"),
    ],
)
def test_make_refuses_values_that_broke_inside(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as found:
        arcade_torch.make(**{"id": "CartPoleEasy", "num_envs": 2, **options})
    assert "\n" not in str(found.value)


def test_an_endless_name_is_cut_in_the_message() -> None:
    with pytest.raises(ValueError, match=r"xxx\.\.\. \(5002 characters\)"):
        arcade_torch.make("x" * 5000)


@pytest.mark.parametrize(
    ("entries", "error", "message"),
    [
        ({}, ValueError, "no entry 'action'; it has none"),
        ({"action": TensorDict({}, [2])}, TypeError, "'action' is a TensorDict, expected a tensor"),
        ({"action": torch.zeros(2).to_sparse()}, TypeError, "expected a dense one"),
        (
            {"action": torch.zeros(2).long(), "next": torch.zeros(2)},
            TypeError,
            "'next' is a Tensor, expected a TensorDict",
        ),
        (
            {"action": torch.zeros(2).long(), "_step": torch.zeros(2).bool()},
            ValueError,
            "'_step' is false in all envs",
        ),
        (
            {"action": torch.zeros(2).long(), "_step": torch.zeros(2)},
            TypeError,
            "'_step' has dtype torch.float32",
        ),
    ],
)
@pytest.mark.parametrize("way", ["step", "step_and_maybe_reset"])
def test_a_step_refuses_a_tensordict_it_cannot_use(
    env: arcade_torch.ArcadeEnv,
    way: str,
    entries: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    with pytest.raises(error, match=message):
        getattr(env, way)(TensorDict(entries, [2]))


def test_what_is_no_tensordict_is_no_step(env: arcade_torch.ArcadeEnv) -> None:
    for one in ({"action": torch.zeros(2)}, None, torch.zeros(2)):
        with pytest.raises(TypeError, match="expected a TensorDict of batch size"):
            env.step(one)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mask", "error", "message"),
    [
        (torch.zeros(2), TypeError, "'_reset' has dtype torch.float32"),
        (torch.tensor([-6, 0]), TypeError, "'_reset' has dtype torch.int64"),
        (torch.zeros(2, 0).bool(), ValueError, r"'_reset' has shape \(2, 0\)"),
        (TensorDict({}, [2]), TypeError, "'_reset' is a TensorDict"),
    ],
)
def test_reset_refuses_a_mask_that_is_none(
    env: arcade_torch.ArcadeEnv, mask: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        env.reset(TensorDict({"_reset": mask}, [2]))


def test_a_partial_reset_refuses_entries_that_cannot_stay(env: arcade_torch.ArcadeEnv) -> None:
    mask = torch.tensor([True, False])
    for wrong in (torch.zeros(2, 5), TensorDict({"x": torch.zeros(2)}, [2])):
        with pytest.raises(ValueError, match=r"entry 'pixels' is a .*, expected shape"):
            env.reset(TensorDict({"_reset": mask, "pixels": wrong}, [2]))
        with pytest.raises(ValueError, match=r"entry 'pixels' is a .*, expected shape"):
            env.step(
                TensorDict({"_step": mask, "pixels": wrong, "action": torch.zeros(2).long()}, [2])
            )
    with pytest.raises(TypeError, match=r"'x' is a torch\.sparse_coo tensor, expected a dense one"):
        env.reset(TensorDict({"_reset": mask, "x": torch.zeros(2, 5).to_sparse()}, [2]))


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        (
            "step_count",
            torch.zeros(2, dtype=torch.bfloat16),
            ValueError,
            r"'step_count' is bfloat16 \(2,\)",
        ),
        ("step_count", torch.zeros(2).to_sparse(), TypeError, "expected a dense one"),
        ("step_count", TensorDict({}, [2]), TypeError, "'step_count' is a TensorDict"),
        ("state", torch.zeros(2), ValueError, r"no entry 'state\."),
        ("game", torch.zeros(2, 5), ValueError, r"'game' is torch.float32 \(2, 5\)"),
    ],
)
def test_a_state_with_something_else_in_it_is_refused_whole(
    env: arcade_torch.ArcadeEnv, key: str, value: Any, error: type[Exception], message: str
) -> None:
    before = env.get_state()
    with pytest.raises(error, match=message):
        env.set_state(env.get_state().exclude(key).set(key, value))
    with pytest.raises(TypeError, match="the state is a Tensor: pass what"):
        env.set_state(torch.zeros(2))  # type: ignore[arg-type]
    after = env.get_state()
    assert all(torch.equal(before.get(name), after.get(name)) for name in before.keys(True, True))


def test_a_sparse_entry_cannot_stay_while_others_are_reset(env: arcade_torch.ArcadeEnv) -> None:
    seen = env.reset()
    seen["step_count"] = seen["step_count"].to_sparse()
    seen["_reset"] = torch.tensor([[True], [False]])
    with pytest.raises(TypeError, match=r"entry 'step_count' is a torch.sparse_coo tensor"):
        env.reset(seen)
