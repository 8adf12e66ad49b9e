"""Measures give the same numbers whatever torch's default type and default device are."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

import arcade_torch
from arcade_torch.tools import (
    beliefs,
    contamination,
    counterfactual,
    greedy_window,
    patching,
    recall_density,
    saliency,
    steering,
)

WIDTH = 6
SIZE = 128


class Encoder(nn.Module):
    """Every 16th pixel of frames [..., SIZE, SIZE, 3] to features [..., WIDTH]."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear((SIZE // 16) ** 2 * 3, WIDTH)

    def forward(self, frames: Tensor) -> Tensor:
        few = frames[..., ::16, ::16, :].float().flatten(-3)
        return self.linear(few / 255)


class Cell(nn.Module):
    """A cell that is handed its state."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(WIDTH, WIDTH)

    def forward(self, features: Tensor, hidden: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.cell(features, hidden * ~is_init)
        return hidden, hidden


def policy() -> Any:
    """A policy that is none of ours."""
    torch.manual_seed(0)
    cell_keys = ["remembered", ("next", "hidden")]
    return TensorDictSequential(
        TensorDictModule(Encoder(), ["pixels"], ["features"]),
        TensorDictModule(Cell(), ["features", "hidden", "is_init"], cell_keys),
        TensorDictModule(nn.Linear(WIDTH, 5), ["remembered"], ["action_value"]),
    )


def game(num_envs: int = 8) -> Any:
    """A game on the CPU."""
    return arcade_torch.make("SignpostEasy", num_envs, "partial", seed=0)


def of_saliency(model: Any, env: Any, **names: Any) -> Any:
    """Saliency of one episode."""
    seen = greedy_window(model, game(1), **names)
    return saliency(model, seen.frames, seen.last_action, seen.is_init, seen.state, **names).maps


MEASURES: dict[str, Callable[..., Any]] = {
    "saliency": of_saliency,
    "recall density": lambda *of, **names: recall_density(*of, episodes=4, **names).deltas,
    "counterfactual": lambda *of, **names: counterfactual(*of, episodes=6, **names).distance,
    "contamination": lambda *of, **names: contamination(*of, starts=6, **names).change,
    "feedback": lambda *of, **names: contamination(*of, starts=6, feedback=True, **names).change,
    "beliefs": lambda *of, **names: beliefs(*of, episodes=8, **names).state_loss,
    "patching": lambda *of, **names: patching(*of, episodes=8, **names).patched,
    "steering": lambda *of, **names: steering(*of, episodes=20, **names).moved,
}


@pytest.fixture(params=[torch.float64, torch.bfloat16, "meta"], ids=str)
def default(request: pytest.FixtureRequest) -> Iterator[Callable[[], None]]:
    """What sets another default type, or another default device, for the rest of a test."""
    before = torch.get_default_dtype()

    def change() -> None:
        if request.param == "meta":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(request.param)

    try:
        yield change
    finally:
        torch.set_default_dtype(before)
        torch.set_default_device(None)


@pytest.mark.parametrize("measure", MEASURES)
def test_a_measure_is_the_same_whatever_torch_takes_for_granted(
    measure: str, default: Callable[[], None]
) -> None:
    """Before: contamination drew other noise with double precision as the default, and every
    measure ended in an error of torch where the default device was not that of the policy.
    """
    model, env = policy(), game()
    start = {"initial_state": {"hidden": torch.zeros(WIDTH)}}
    wanted = MEASURES[measure](model, env, **start)
    default()
    again = MEASURES[measure](model, env, **start)
    np.testing.assert_allclose(again, wanted, rtol=1e-4, atol=1e-6)
    assert np.isfinite(np.asarray(wanted)).any()
