"""Policies of which a measure would give a wrong number that looks right: refused in one line."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from arcade_torch.tools import (
    Policy,
    beliefs,
    contamination,
    counterfactual,
    greedy_window,
    patching,
    recall_density,
    saliency,
)
from arcade_torch.tools.measures.recall_density.measure import density_of_windows
from tests.tools.measures.toys import SIZE, ToyEnv, linear_policy, window

WIDTH = 8


class KnownEnv(ToyEnv):
    """Episodes side by side, with a fact of their states."""

    def facts(self) -> dict[str, Tensor]:
        """Half of the steps done."""
        return {"half": self.steps // 2}


MEASURES: dict[str, Callable[..., Any]] = {
    "saliency": lambda policy, **names: saliency(policy, window(6).frames, **names),
    "recall density": lambda policy, **names: recall_density(
        policy, ToyEnv([5]), episodes=1, **names
    ),
    "counterfactual": lambda policy, **names: counterfactual(
        policy, ToyEnv([5, 6]), episodes=2, donors=1, **names
    ),
    "contamination": lambda policy, **names: contamination(
        policy, ToyEnv([5]), sigmas=(1.0,), delays=(0, 1), starts=1, **names
    ),
}

OF_STATES: dict[str, Callable[..., Any]] = {
    "beliefs": lambda policy: beliefs(policy, KnownEnv([5] * 8), episodes=8),
    "patching": lambda policy: patching(policy, KnownEnv([5] * 8), episodes=8),
}


class Encoder(nn.Module):
    """Frames [..., SIZE, SIZE, 3] to features [..., WIDTH]."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(SIZE * SIZE * 3, WIDTH)

    def forward(self, frames: Tensor) -> Tensor:
        return torch.tanh(self.linear(frames.float().flatten(-3) / 255))


class KeepsItsState(nn.Module):
    """A recurrent network whose state is an attribute; start flags begin it anew."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(WIDTH, WIDTH)
        self.state = torch.zeros(1, WIDTH)

    def forward(self, features: Tensor, is_init: Tensor) -> Tensor:
        if len(self.state) != len(features):
            self.state = torch.zeros(len(features), WIDTH)
        before = torch.where(is_init, 0.0, self.state)
        self.state = self.cell(features, before).detach()
        return self.state


class Drops(nn.Module):
    """Dropout that evaluation mode does not turn off."""

    def forward(self, features: Tensor) -> Tensor:
        return nn.functional.dropout(features, 0.5)


class MixesItsBatch(nn.Module):
    """An LSTM that takes a batch for a sequence."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = nn.LSTM(WIDTH, WIDTH)

    def forward(self, features: Tensor) -> Tensor:
        return self.lstm(features)[0]


class Cell(nn.Module):
    """A cell that is handed its state, and detaches it as one that only acts may."""

    def __init__(self, detaches: bool) -> None:
        super().__init__()
        self.cell = nn.GRUCell(WIDTH, WIDTH)
        self.detaches = detaches

    def forward(self, features: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.cell(features, hidden.detach() if self.detaches else hidden)
        return hidden, hidden


class Frozen(Encoder):
    """An encoder that runs without gradients."""

    def forward(self, frames: Tensor) -> Tensor:
        with torch.no_grad():
            return super().forward(frames)


def sequence(*memory: TensorDictModuleBase, encoder: nn.Module | None = None) -> Any:
    """Encoder, memory and head."""
    return TensorDictSequential(
        TensorDictModule(encoder or Encoder(), ["pixels"], ["features"]),
        *memory,
        TensorDictModule(nn.Linear(WIDTH, 3), ["remembered"], ["action_value"]),
    )


def plain(module: nn.Module, *also: str) -> Any:
    """A policy with a module between encoder and head."""
    return sequence(TensorDictModule(module, ["features", *also], ["remembered"]))


def with_cell(detaches: bool) -> Any:
    """A policy with a cell whose state is in its keys."""
    keys = ["remembered", ("next", "hidden")]
    return sequence(TensorDictModule(Cell(detaches), ["features", "hidden"], keys))


START = {"initial_state": TensorDict({"hidden": torch.zeros(WIDTH)}, [])}


@pytest.mark.parametrize("measure", [*MEASURES, *OF_STATES])
@pytest.mark.parametrize(
    "policy",
    [
        lambda: plain(KeepsItsState(), "is_init"),
        lambda: plain(Drops()),
        lambda: plain(MixesItsBatch()),
    ],
    ids=["state in an attribute", "dropout", "batch as sequence"],
)
def test_a_policy_that_cannot_be_replayed_as_it_acts_is_refused(
    policy: Callable[[], Any], measure: str
) -> None:
    torch.manual_seed(0)
    with pytest.raises(ValueError, match=r"^the policy must say of frames in one go what it says"):
        (MEASURES | OF_STATES)[measure](policy())


@pytest.mark.parametrize("measure", OF_STATES)
def test_a_policy_whose_state_is_in_its_keys_is_measured(measure: str) -> None:
    torch.manual_seed(0)
    OF_STATES[measure](sequence(*lstm()))


def test_a_memory_that_sees_later_frames_is_refused() -> None:
    causal = linear_policy(0.5, dtype=torch.float32)

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        out, state = causal.remember(features, *rest)
        return out + out.mean(1, keepdim=True), state

    policy = Policy(causal.encode, remember, causal.initial_state)
    with pytest.raises(ValueError, match="in one go"):
        saliency(policy, window(5).frames)
    assert saliency(causal, window(5).frames).shares()[0] > 0


def test_a_policy_is_tried_once_and_not_in_every_window() -> None:
    causal = linear_policy(0.5, dtype=torch.float32)
    asked = list[int]()

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        asked.append(features.shape[1])
        return causal.remember(features, *rest)

    policy = Policy(causal.encode, remember, causal.initial_state)

    def calls(steps: int) -> int:
        asked.clear()
        seen = window(steps)
        policy.check(seen.frames, seen.last_action, seen.is_init, seen.state)
        return len(asked)

    assert calls(2) > 0
    assert calls(5) > 0, "two frames are too few to go by"
    assert calls(5) == 0


@pytest.mark.parametrize("measure", ["saliency", "recall density"])
def test_a_gradient_that_is_cut_is_no_zero(measure: str) -> None:
    torch.manual_seed(0)
    MEASURES[measure](with_cell(False), **START)
    with pytest.raises(ValueError, match=r"^the outputs change with \d of \d frames by which they"):
        MEASURES[measure](with_cell(True), **START)
    with pytest.raises(ValueError, match="no gradient"):
        MEASURES[measure](sequence(*lstm(), encoder=Frozen()))
    counterfactual(with_cell(True), ToyEnv([5, 6]), episodes=2, donors=1, **START)


def lstm() -> list[TensorDictModuleBase]:
    """TorchRL's memory."""
    return [LSTMModule(WIDTH, WIDTH, in_key="features", out_key="remembered")]


def test_a_zero_at_a_kink_is_right() -> None:
    """The largest of equal frames: all but one have no gradient, though raising them counts."""
    encode = linear_policy(0.0, dtype=torch.float32).encode

    def remember(features: Tensor, action: Any, is_init: Any, state: Any) -> tuple[Tensor, Any]:
        most = features if state is None else torch.cat([state[:, None], features], 1)
        most = most.cummax(1).values
        return most[:, -features.shape[1] :], most[:, -1]

    same = window(1).frames.expand(5, SIZE, SIZE, 3)
    assert saliency(Policy(encode, remember), same).shares().max() == 1


@pytest.mark.parametrize("steps", [160, 250])
@pytest.mark.parametrize("norm", ["l1", "l2", "l2sq"])
def test_a_gradient_too_small_for_its_type_is_no_cut(steps: int, norm: Any) -> None:
    """Before: a memory that forgets by halves was refused after some 130 steps, its gradients
    being below what single precision holds.
    """
    policy = linear_policy(0.5, dtype=torch.float64)
    shares = density_of_windows(policy, [window(steps)], norm=norm).shares[0]
    halves = 0.25 if norm == "l2sq" else 0.5
    wanted = halves ** np.arange(steps)[::-1] * (1 - halves)
    np.testing.assert_allclose(shares, wanted, rtol=1e-5, atol=1e-30)


def test_inference_mode_measures_what_is_measured_outside_of_it() -> None:
    torch.manual_seed(0)
    policy = sequence(*lstm())
    outside = recall_density(policy, ToyEnv([5]), episodes=1)
    with torch.inference_mode():
        inside = recall_density(policy, ToyEnv([5]), episodes=1)
        seen = greedy_window(policy, ToyEnv([5]), seed=1)
    assert (inside.deltas == outside.deltas).all() and inside.deltas[0] > 0
    assert saliency(policy, seen.frames, seen.last_action, seen.is_init, seen.state).shares()[0] > 0


class NanAtLast(nn.Module):
    """Outputs that are no numbers from the seventh frame of an episode on: its first pixel counts
    steps.
    """

    def forward(self, frames: Tensor) -> Tensor:
        pixels = frames.float().flatten(-3)
        return torch.where(pixels[..., :1] < 6, pixels[..., :3], torch.nan)


def nan_functions() -> Any:
    """A policy of two functions that gives NaN late."""
    return Policy(NanAtLast(), lambda features, action, is_init, state: (features, state))


def nan_module() -> Any:
    """A TensorDict policy that does, and chooses by itself."""
    choose = TensorDictModule(lambda out: out.argmax(-1), ["action_value"], ["action"])
    values = TensorDictModule(NanAtLast(), ["pixels"], ["action_value"])
    return TensorDictSequential(values, choose)


class NanAgent:
    """What acts as an agent does, with outputs beside its actions."""

    network = nan_functions()

    def initial_state(self, size: int) -> None:
        """None: it has no memory."""

    def act(self, obs: Any, state: Any) -> tuple[Tensor, dict[str, Tensor], Any]:
        out = NanAtLast()(obs["pixels"])
        return out.argmax(-1), {"q_value": out}, state


@pytest.mark.parametrize("policy", [nan_functions, nan_module, NanAgent])
@pytest.mark.parametrize("measure", ["patching", "beliefs", "greedy window"])
def test_outputs_that_become_nan_late_are_no_decisions(
    policy: Callable[[], Any], measure: str
) -> None:
    play = {
        "patching": lambda steps: patching(policy(), KnownEnv([steps] * 8), episodes=8),
        "beliefs": lambda steps: beliefs(policy(), KnownEnv([steps] * 8), episodes=8),
        "greedy window": lambda steps: greedy_window(policy(), ToyEnv([steps])),
    }[measure]
    play(6)
    with pytest.raises(ValueError, match="outputs must be numbers, got NaN"):
        play(8)
