"""Mistakes that inventors of a memory model make: ``check_memory`` finds each and says what to do.

Those of `test_passed_before` went through it without a word.
"""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models import (
    MemoryLawError,
    MemoryModule,
    check_memory,
    make_memory,
    make_network,
)
from arcade_torch.models.checks import law_results
from arcade_torch.models.law_subject import Subject
from arcade_torch.models.memory import replay_by_steps

WIDTH = 4


class Cell(nn.Module):
    """h_t = 0.9 h_{t-1} + tanh(W x_t), right as it stands; mistakes are overridden methods."""

    input_size = 3
    hidden_size = WIDTH

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(3, WIDTH)

    def read(self, x: Tensor) -> Tensor:
        """The inputs [B, T, H] of a chunk."""
        return torch.tanh(self.linear(x))

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        """The state before a step, [B, H]."""
        return torch.where(begins, torch.zeros_like(h), h)

    def written(self, y: Tensor) -> Tensor:
        """What is given out, [B, T, H]."""
        return y

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = state["h"]
        inputs = self.read(x)
        outputs = []
        for t in range(x.shape[1]):
            h = 0.9 * self.fresh(is_init[:, t, None], h) + inputs[:, t]
            outputs.append(h)
        y = torch.stack(outputs, 1)
        return self.written(y.real if y.is_complex() else y), self.state_of(h)

    def state_of(self, h: Tensor) -> TensorDict:
        return TensorDict({"h": h}, batch_size=[len(h)])

    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(self.linear.weight.new_zeros(batch_size, WIDTH))


class Dropout(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.1)

    def written(self, y: Tensor) -> Tensor:
        return self.dropout(y)


class BatchNorm(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(WIDTH)

    def written(self, y: Tensor) -> Tensor:
        return self.norm(y.transpose(1, 2)).transpose(1, 2)


class RunningMean(Cell):
    """Follows the inputs while it is trained."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(3))

    def read(self, x: Tensor) -> Tensor:
        if self.training:
            self.mean = 0.9 * self.mean + 0.1 * x.mean((0, 1)).detach()
        return super().read(x - self.mean)


class ComplexState(Cell):
    """Its primer is an error of TorchRL."""

    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(super().initial_state(batch_size)["h"] + 0j)


class MadeInForward(Cell):
    def written(self, y: Tensor) -> Tensor:
        if not hasattr(self, "out"):
            self.out = nn.Linear(WIDTH, WIDTH).to(y.dtype)
        return self.out(y)


class TrainableTensor(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.ones(WIDTH, requires_grad=True)

    def written(self, y: Tensor) -> Tensor:
        return y * self.scale


class WritesOnInput(Cell):
    def read(self, x: Tensor) -> Tensor:
        with torch.no_grad():
            x.clamp_(-1, 1)
        return super().read(x)


class WritesOnFlags(Cell):
    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        is_init[:, 0] = True
        return super().forward(x, state, is_init)


class WritesAtStarts(Cell):
    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        state["h"][is_init[:, 0]] = 0
        return super().forward(x, state, is_init)


class InList(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.layers = [nn.Linear(WIDTH, WIDTH)]

    def written(self, y: Tensor) -> Tensor:
        return self.layers[0](y)


class Noise(Cell):
    def written(self, y: Tensor) -> Tensor:
        return y + torch.randn_like(y)


class DropoutLeftOn(Cell):
    def written(self, y: Tensor) -> Tensor:
        return F.dropout(y, 0.1)


class StateInSelf(Cell):
    h: Tensor | None = None

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        carried = state if self.h is None else self.state_of(self.h)
        y, after = super().forward(x, carried, is_init)
        self.h = after["h"].detach()
        return y, after


class Float32State(Cell):
    def state_of(self, h: Tensor) -> TensorDict:
        return super().state_of(h.float())


class NoBatchSize(Cell):
    def state_of(self, h: Tensor) -> TensorDict:
        return TensorDict({"h": h})


class LayersFirst(Cell):
    """[layers, B, H], as torch.nn.LSTM has it."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        y, after = super().forward(x, super().state_of(state["h"][0]), is_init)
        return y, TensorDict({"h": after["h"][None]})

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": super().initial_state(batch_size)["h"][None]})


class WithoutGradient(Cell):
    @torch.no_grad()
    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        return super().forward(x, state, is_init)


class NotANumber(Cell):
    def written(self, y: Tensor) -> Tensor:
        return y / torch.zeros_like(y)


class RandomStart(Cell):
    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(torch.randn(batch_size, WIDTH, dtype=self.linear.weight.dtype))


class LazyLayer(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.late = nn.LazyLinear(WIDTH)

    def written(self, y: Tensor) -> Tensor:
        return self.late(y)


class ListOfTuples(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.layers = [(nn.Linear(WIDTH, WIDTH), nn.Identity())]

    def written(self, y: Tensor) -> Tensor:
        return self.layers[0][0].to(y.dtype)(y)


class AloneIsAnother(Cell):
    """A batch of one begins anew at every call, as a squeeze() makes it."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        return super().forward(x, state.apply(torch.zeros_like) if len(x) == 1 else state, is_init)


class MeanOfBefore(Cell):
    """A running mean that a call takes as it was, and moves in training mode."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(3))

    def read(self, x: Tensor) -> Tensor:
        mean = self.mean.clone()
        if self.training:
            self.mean.lerp_(x.detach().mean((0, 1)), 0.1)
        return super().read(x - mean)


class AsksForADevice(Cell):
    """A copy of it in a loss with a target network has no parameters of its own."""

    def initial_state(self, batch_size: int) -> TensorDict:
        return super().initial_state(batch_size).to(next(self.parameters()).device)


class Sparse(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.sign = nn.Embedding(2, WIDTH, sparse=True)

    def read(self, x: Tensor) -> Tensor:
        return super().read(x) + self.sign((x[..., 0] > 0).long())


class TakesTheFirst(Cell):
    def read(self, x: Tensor) -> Tensor:
        weights = list(self.parameters())
        return super().read(x).to(weights[0].dtype)


class KeepsTheCall(Cell):
    """A window of the steps of the last call, as many as those were."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, super().state_of(state["h"][:, -1]), is_init)
        return y, super().state_of(after["h"][:, None].expand(-1, x.shape[1], -1))

    def initial_state(self, batch_size: int) -> TensorDict:
        return super().state_of(super().initial_state(batch_size)["h"][:, None])


class TimeFirst(Cell):
    """A step of several rows is given out as several steps of one."""

    def written(self, y: Tensor) -> Tensor:
        return y.transpose(0, 1) if y.shape[1] == 1 else y


class NoBatchSizeAfter(Cell):
    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        return y, TensorDict({"h": after["h"]})


class NoBatchSizeBefore(Cell):
    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": super().initial_state(batch_size)["h"]})


class NoiseInState(Cell):
    """For the step behind; what is given out of this call has none."""

    always = True

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        if self.always or self.training:
            after = self.state_of(after["h"] + torch.randn_like(after["h"]))
        return y, after


class NoiseInStateOfTraining(NoiseInState):
    always = False


class MovesItsOutput(Cell):
    """A running mean of the outputs, taken as it was, moved in training mode."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(WIDTH))

    def moved(self, y: Tensor) -> Tensor:
        mean = self.mean.clone()
        if self.training:
            self.mean.lerp_(y.detach().mean((0, 1)), 0.1)
        return y - mean

    def written(self, y: Tensor) -> Tensor:
        return self.moved(y)


class MovesItsState(MovesItsOutput):
    def written(self, y: Tensor) -> Tensor:
        return y

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        return y, self.state_of(self.moved(after["h"][:, None])[:, 0])


class SeedsInForward(Cell):
    """A random projection that is drawn anew from the same seed."""

    def written(self, y: Tensor) -> Tensor:
        torch.manual_seed(0)
        return y @ torch.randn(WIDTH, WIDTH, dtype=y.dtype)


class StateOfTheFirstStep(Cell):
    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, _ = super().forward(x, state, is_init)
        return y, self.state_of(y[:, 0])


class CentredOverTime(Cell):
    def written(self, y: Tensor) -> Tensor:
        return y - y.mean(1, keepdim=True)


class Counts(Cell):
    """Right: a count of the episode's steps, whole numbers, is in the state."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        counts = []
        count = self.taken(state["count"], x)
        for t in range(x.shape[1]):
            count = torch.where(is_init[:, t], 0, count) + 1
            counts.append(count)
        after["count"] = count
        return y + torch.stack(counts, 1)[..., None] % 5, after

    def taken(self, count: Tensor, x: Tensor) -> Tensor:
        return count

    def initial_state(self, batch_size: int) -> TensorDict:
        count = torch.zeros(batch_size, dtype=torch.int64)
        return super().initial_state(batch_size).set("count", count)


class BeyondItsWindow(Counts):
    """A chunk that begins behind many steps is read as if they were five."""

    def taken(self, count: Tensor, x: Tensor) -> Tensor:
        return count if x.shape[1] == 1 else count.clamp(max=5)


class SignsOfBefore(Cell):
    """The signs of the last eight steps, of which a start clears none."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        signs = torch.cat([state["signs"], (x[..., 0] > 0).long()], dim=1)
        after["signs"] = signs[:, -8:].clone()
        return y + signs[:, :-8, None], after

    def initial_state(self, batch_size: int) -> TensorDict:
        signs = torch.zeros(batch_size, 8, dtype=torch.int64)
        return super().initial_state(batch_size).set("signs", signs)


class MasksWhatItReads(Cell):
    """At a start it does not read the state, which stays in place for the next step."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = state["h"]
        outputs = []
        for t, inputs in enumerate(self.read(x).unbind(1)):
            h = 0.9 * h + inputs
            outputs.append(torch.where(is_init[:, t, None], inputs, h))
        return torch.stack(outputs, 1), self.state_of(h)


class GradientOfBefore(Cell):
    """What is forgotten at a start counts nothing, and gets a gradient."""

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        return torch.where(begins, h - h.detach(), h)


class UnreadTrace(Cell):
    """A mean of the outputs that is kept and not read, multiplied by 0 at a start."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        trace = state["trace"]
        for t in range(x.shape[1]):
            trace = 0.9 * trace * ~is_init[:, t, None] + 0.1 * y[:, t]
        return y, after.set("trace", trace)

    def initial_state(self, batch_size: int) -> TensorDict:
        begin = super().initial_state(batch_size)
        return begin.set("trace", begin["h"].clone())


class ReadsTheStepBefore(Cell):
    """Gives out the state before as well, multiplied by 0 at a start."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        y, after = super().forward(x, state, is_init)
        before = torch.cat([state["h"][:, None], y[:, :-1]], dim=1)
        return y + before * ~is_init[..., None], after


class HasEmptySlots(StateOfTheFirstStep):
    """Keeps logarithms beside its state, those of slots that nothing has filled."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        return super().forward(x, super().state_of(state["h"][:, :WIDTH]), is_init)

    def state_of(self, h: Tensor) -> TensorDict:
        empty = h.new_full((len(h), 1), -torch.inf)
        return super().state_of(torch.cat([h[:, :WIDTH], empty], dim=1))


class ConstantOfNumpy(Cell):
    """Numbers of float64, which the weights of float32 are not."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.from_numpy(np.linspace(0.5, 1, WIDTH))

    def written(self, y: Tensor) -> Tensor:
        return y * self.scale


class BufferOfNumpy(Cell):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", torch.from_numpy(np.linspace(0.5, 1, WIDTH)))

    def written(self, y: Tensor) -> Tensor:
        return y * self.scale


class Float64State(Cell):
    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(torch.zeros(batch_size, WIDTH, dtype=torch.float64))


class DoubleInside(Cell):
    def read(self, x: Tensor) -> Tensor:
        return super().read(x.double())


class DetachesItsState(Cell):
    """The state is handed on without a gradient; within a call there is one."""

    def state_of(self, h: Tensor) -> TensorDict:
        return super().state_of(h.detach())


class DetachedStart(Cell):
    """Learns what an episode begins with, and takes it without a gradient."""

    def __init__(self) -> None:
        super().__init__()
        self.begins_with = nn.Parameter(torch.ones(WIDTH))

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        return torch.where(begins, self.begins_with.detach(), h)

    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(self.begins_with.expand(batch_size, WIDTH))


class DetachedWeight(Cell):
    def written(self, y: Tensor) -> Tensor:
        return F.linear(y, self.linear.weight.detach().T, None)[..., :1] + y


class DetachedInput(Cell):
    def read(self, x: Tensor) -> Tensor:
        return super().read(x) + super().read(x.detach() ** 2)


class AlmostRight(torch.autograd.Function):
    """A hand-written backward pass that is wrong by two per cent."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return 1.02 * gradient


class AlmostRightGradient(Cell):
    def read(self, x: Tensor) -> Tensor:
        return AlmostRight.apply(super().read(x))  # type: ignore[no-any-return]


class GuardedMean(Cell):
    """A mean of the episode, with so much in the denominator that it is none."""

    averages_values = True

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        total = state["h"]
        outputs = []
        for t, inputs in enumerate(self.read(x).unbind(1)):
            ones = torch.ones_like(inputs[:, :1])
            total = self.fresh(is_init[:, t, None], total) + torch.cat([inputs, ones], dim=1)
            outputs.append(total[:, :WIDTH] / (total[:, WIDTH:] + 0.01))
        return torch.stack(outputs, 1), self.state_of(total)

    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(self.linear.weight.new_zeros(batch_size, WIDTH + 1))


class DetachingReplay(Cell):
    """Right but for ``replay``, which hands states on without a gradient."""

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        return replay_by_steps(self.read_one, x, stored, is_init)

    def read_one(self, *inputs: Any) -> tuple[Tensor, TensorDict]:
        y, after = self(*inputs)
        return y, after.detach()


def refusal(model: type[Cell]) -> MemoryLawError:
    """What check_memory says of a model."""
    torch.manual_seed(0)
    with pytest.raises(MemoryLawError) as caught:
        check_memory(model())
    return caught.value


class MultipliesItsState(Cell):
    """Multiplies the state by a weight, where torch wants equal types."""

    def __init__(self) -> None:
        super().__init__()
        self.recurrent = nn.Linear(WIDTH, WIDTH)

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        return self.recurrent(super().fresh(begins, h))  # type: ignore[no-any-return]


class ZerosWithoutType(MultipliesItsState):
    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": torch.zeros(batch_size, WIDTH)}, batch_size=[batch_size])


class BatchOfFour(Cell):
    """Begins with four states, whatever it is asked for."""

    def initial_state(self, batch_size: int) -> TensorDict:
        return super().initial_state(4)


class RollsItsStateInPlace(Cell):
    """Writes into what an earlier step's gradient reads, in a copy of the state it was given."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = state["h"].clone()
        outputs = []
        for t, inputs in enumerate(self.read(x).unbind(1)):
            h.masked_fill_(is_init[:, t, None], 0)
            h.mul_(0.9).add_(inputs)
            outputs.append(torch.tanh(h * h))
        return torch.stack(outputs, 1), self.state_of(h)


def test_the_model_without_a_mistake_passes() -> None:
    assert max(check_memory(Cell()).values()) < 1e-12


@pytest.mark.parametrize(
    ("model", "law", "said"),
    [
        (Dropout, "equal calls give equal results", "take dropout=0"),
        (BatchNorm, "equal calls give equal results", "take dropout=0 and nn.LayerNorm"),
        (RunningMean, "equal calls give equal results", "training mode and evaluation mode differ"),
        (ComplexState, "shapes are fixed", "hold torch.view_as_real(h)"),
        (MadeInForward, "weights are registered", "new weights: out.bias, out.weight"),
        (TrainableTensor, "weights are registered", "scale of TrainableTensor"),
        (ListOfTuples, "weights are registered", "layers of ListOfTuples, a list"),
        (MeanOfBefore, "equal calls give equal results", "differs in training mode"),
        (AloneIsAnother, "batch rows are independent", "one row of a batch of four"),
        # numbers of float64 stopped the training; a memory that hands its state on without a
        # gradient, which is read a step at a time there, learned nothing over time
        (ConstantOfNumpy, "shapes are fixed", "torch.float32 inputs gave torch.float64"),
        (BufferOfNumpy, "shapes are fixed", "torch.float32 inputs gave torch.float64"),
        (Float64State, "shapes are fixed", "torch.float32 inputs gave torch.float64"),
        (DoubleInside, "shapes are fixed", "with weights of torch.float32 it fails, RuntimeError"),
        (DetachesItsState, "gradients are right", "a detach, also of the state that is returned"),
        (DetachingReplay, "replay loads stored states", "a state that replay detaches"),
        (SeedsInForward, "equal calls give equal results", "torch.manual_seed in forward"),
    ],
)
def test_passed_before(model: type[Cell], law: str, said: str) -> None:
    error = refusal(model)
    assert error.law == law
    assert said in str(error)
    assert str(error).count("Likely cause") == 1


@pytest.mark.parametrize(
    ("model", "law", "said"),
    [
        (WritesOnInput, "shapes are fixed", "changed the x"),
        (WritesOnFlags, "shapes are fixed", "changed the is_init"),
        (WritesAtStarts, "shapes are fixed", "changed the state"),
        (InList, "weights are registered", "layers of InList, a list"),
        (Noise, "equal calls give equal results", "random numbers"),
        (DropoutLeftOn, "equal calls give equal results", "training=self.training"),
        (StateInSelf, "equal calls give equal results", "the module keeps in itself"),
        (Float32State, "shapes are fixed", "h of the state is torch.float32"),
        (ZerosWithoutType, "shapes are fixed", "take weight.new_zeros(...)"),
        (BatchOfFour, "shapes are fixed", "initial_state(2) has batch_size [4], not [2]"),
        (NoBatchSize, "shapes are fixed", "has batch_size [], not [1]"),
        (LayersFirst, "shapes are fixed", "such as [layers, B, H]"),
        (WithoutGradient, "nothing leaks over a start", "torch.no_grad"),
        (NotANumber, "shapes are fixed", "NaN or infinite"),
        (RandomStart, "equal calls give equal results", "initial_state differ"),
        (LazyLayer, "weights are registered", "late.weight has no shape"),
        (
            AsksForADevice,
            "weights are registered",
            "keeps the parameters elsewhere, StopIteration.",
        ),
        (RollsItsStateInPlace, "nothing leaks over a start", "an in-place write"),
        (Sparse, "gradients are right", "nn.Embedding(..., sparse=True): leave sparse out"),
        (TakesTheFirst, "weights are registered", "elsewhere, IndexError list index out of range"),
    ],
)
def test_said_something_else_before(model: type[Cell], law: str, said: str) -> None:
    """An error of torch without a cause, or the law of scans with causes that were none."""
    error = refusal(model)
    assert error.law == law
    assert said in str(error)


@pytest.mark.parametrize(
    ("model", "law", "said"),
    [
        (KeepsTheCall, "shapes are fixed", "the state grows"),
        (NoBatchSizeAfter, "shapes are fixed", "the state of forward has batch_size []"),
        (NoBatchSizeBefore, "shapes are fixed", "the state of initial_state(1) has batch_size []"),
        (NoiseInState, "equal calls give equal results", "the same call twice differs"),
        (NoiseInStateOfTraining, "equal calls give equal results", "training mode and evaluation"),
        (MovesItsOutput, "equal calls give equal results", "differs in training mode"),
        (MovesItsState, "equal calls give equal results", "differs in training mode"),
        (TimeFirst, "shapes are fixed", "x [3, 1, 3] gave y [1, 3, 4]"),
        (StateOfTheFirstStep, "scan equals step by step", "not the one after the last step"),
        (HasEmptySlots, "scan equals step by step", "not the one after the last step"),
        (CentredOverTime, "scan equals step by step", "a look into the future"),
        (BeyondItsWindow, "several calls equal one", "11 steps in one call and in calls cut at"),
        (MasksWhatItReads, "packed equals apart", "does not restore initial_state"),
        (SignsOfBefore, "packed equals apart", "does not restore initial_state"),
        (UnreadTrace, "nothing leaks over a start", "a NaN in the carried state comes through"),
        (ReadsTheStepBefore, "nothing leaks over a start", "a NaN in the carried state comes"),
        (GradientOfBefore, "nothing leaks over a start", "gradients flow backward over a start"),
        (GuardedMean, "an average of equal values is that value", "do not sum to one"),
        (DetachedStart, "gradients are right", "finite differences disagree"),
        (DetachedWeight, "gradients are right", "finite differences disagree"),
        (DetachedInput, "gradients are right", "finite differences disagree"),
        (AlmostRightGradient, "gradients are right", "finite differences disagree"),
    ],
)
def test_each_part_of_a_law_is_looked_at(model: type[Cell], law: str, said: str) -> None:
    """Each breaks one part of one law: outputs alone, or states, one mode, later calls."""
    error = refusal(model)
    assert error.law == law
    assert said in str(error)


class ComplexWeight(Cell):
    """Right: a rotation that is one complex weight."""

    def __init__(self) -> None:
        super().__init__()
        self.rotation = nn.Parameter(torch.polar(torch.full([WIDTH], 0.9), torch.ones(WIDTH)))

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        given = super().state_of(torch.view_as_complex(state["h"]))
        return super().forward(x, given, is_init)

    def read(self, x: Tensor) -> Tensor:
        return super().read(x) * self.rotation

    def state_of(self, h: Tensor) -> TensorDict:
        return super().state_of(torch.view_as_real(h))

    def initial_state(self, batch_size: int) -> TensorDict:
        return self.state_of(self.rotation.new_zeros(batch_size, WIDTH))


class SumsInLogarithms(Cell):
    """Right: a sum of exponentials that is kept as its logarithm, at first that of zero."""

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        return torch.where(begins, torch.full_like(h, -torch.inf), h)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = state["h"]
        outputs = []
        for t, inputs in enumerate(self.read(x).unbind(1)):
            h = torch.logaddexp(self.fresh(is_init[:, t, None], h), inputs)
            outputs.append(h)
        return torch.stack(outputs, 1), self.state_of(h)

    def initial_state(self, batch_size: int) -> TensorDict:
        return super().initial_state(batch_size).apply(lambda h: torch.full_like(h, -torch.inf))


class Ordered(Cell):
    """Right: a list of layers that are registered as well."""

    def __init__(self) -> None:
        super().__init__()
        self.out = nn.Linear(WIDTH, WIDTH)
        self.order = [self.out, nn.Identity()]

    def written(self, y: Tensor) -> Tensor:
        return self.order[0](y)


class NoWeights(nn.Module):
    """Right: a running sum, whose state can take its dtype from no weight."""

    input_size = hidden_size = WIDTH

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        h = state["h"]
        outputs = []
        for t in range(x.shape[1]):
            h = torch.where(is_init[:, t, None], 0.0, h) / 2 + x[:, t]
            outputs.append(h)
        return torch.stack(outputs, 1), TensorDict({"h": h}, [len(x)])

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": torch.zeros(batch_size, WIDTH)}, [batch_size])


def test_a_memory_without_weights_is_checked_in_the_dtype_of_its_state() -> None:
    assert max(check_memory(NoWeights()).values()) < 1e-5
    assert all(result.passed for result in law_results(NoWeights()))


class KeepsItsOutput(Cell):
    """Right: the last output is kept, for a picture."""

    def written(self, y: Tensor) -> Tensor:
        self.seen = {"last": [y]}
        return y


class WeightNorm(Cell):
    """Right: a weight that is computed before each call, and no leaf of the graph."""

    def __init__(self) -> None:
        super().__init__()
        nn.utils.weight_norm(self.linear)


@pytest.mark.filterwarnings("ignore:.*weight_norm.*:FutureWarning")
@pytest.mark.parametrize("model", [KeepsItsOutput, WeightNorm])
def test_a_memory_that_has_learned_already_can_be_checked(model: type[Cell]) -> None:
    """Before: nobody could copy what hangs on a graph."""
    memory = model()
    x = torch.ones(2, 3, 3)
    y, _ = memory(x, memory.initial_state(2), torch.zeros(2, 3, dtype=torch.bool))
    y.sum().backward()
    assert max(check_memory(memory).values()) < 1e-7
    assert all(result.passed for result in law_results(memory))


def test_sizes_of_numpy_are_sizes() -> None:
    memory = Cell()
    memory.input_size = np.prod((1, 3))
    assert max(check_memory(memory, gradients=False).values()) < 1e-12
    state = make_memory("mingru", np.int64(3), np.int64(4)).initial_state(np.int64(2))
    assert state["h"].shape == (2, 4)


@pytest.mark.parametrize("model", [ComplexWeight, Counts, Ordered, SumsInLogarithms])
def test_what_is_right_passes(model: type[Cell]) -> None:
    """Complex weights lost their imaginary part in the check before, and two infinities that are
    equal were said to differ.
    """
    assert max(check_memory(model()).values()) < 1e-7


class AnyRowResets(Cell):
    """A flag of one row resets all."""

    def fresh(self, begins: Tensor, h: Tensor) -> Tensor:
        return super().fresh(begins.any(), h)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (AnyRowResets, "a flag of one row that resets others"),
        (WritesAtStarts, "forward changed the state"),
    ],
)
def test_no_draw_hides_what_goes_wrong_at_a_start(
    model: type[Cell], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: some seeds had no start of the other rows where the two compared had none."""
    drawn = Subject.inputs

    def without_starts(self: Subject, batch: int, steps: int, resets: float = 0.0) -> Any:
        return drawn(self, batch, steps)

    monkeypatch.setattr(Subject, "inputs", without_starts)
    with pytest.raises(MemoryLawError, match=said):
        check_memory(model())


class TupleState(Cell):
    def initial_state(self, batch_size: int) -> Any:
        return (super().initial_state(batch_size)["h"],)


@pytest.mark.parametrize(
    "use",
    [
        lambda memory: MemoryModule(memory),
        lambda memory: make_network("small", memory=lambda *_: memory),
    ],
    ids=["MemoryModule", "make_network"],
)
def test_a_module_that_is_no_memory_is_refused_where_it_is_handed_over(use: Any) -> None:
    """Before: an AttributeError from within, or a network with a tuple for a state."""
    with pytest.raises(TypeError, match=r"LSTM has no initial_state\(batch_size\).*own_memory"):
        use(nn.LSTM(3, WIDTH))
    with pytest.raises(TypeError, match="TupleState gives no TensorDict, but tuple"):
        use(TupleState())
    with pytest.raises(ValueError, match=r"BatchOfFour gives h as \[4, 4\], expected \[1, ...\]"):
        use(BatchOfFour())
