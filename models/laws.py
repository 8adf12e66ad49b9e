"""The laws of a memory model, each a function of a copy of the module that is put to the test."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from arcade_torch.models.memory import ReplayableMemory, replay_by_steps

__all__ = ["Law", "MemoryLawError", "Subject", "laws_of", "subject_of"]

GUARD = 1e-4  # what a small number in a denominator may cost the law of averages

# Largest difference allowed between two ways to compute the same thing; see ``_difference``.
TOLERANCES = {
    torch.float64: 1e-7,
    torch.float32: 1e-4,
    torch.bfloat16: 0.1,
    torch.float16: 0.01,
}


class MemoryLawError(AssertionError):
    """A memory model breaks one of the laws.

    Attributes:
        law: name of the law, as in the keys that :func:`check_memory` returns.
        discrepancy: largest absolute difference found, NaN if the law is not about numbers.
    """

    def __init__(
        self, law: str, symptom: str, cause: str, discrepancy: float = float("nan")
    ) -> None:
        super().__init__(f"law {law!r} is broken: {symptom}. Likely cause: {cause}.")
        self.law = law
        self.discrepancy = discrepancy


@dataclass
class Subject:
    """The copy under test and what the laws need to poke it."""

    module: nn.Module
    input_size: int
    dtype: torch.dtype
    tolerance: float

    def random(self, batch: int, steps: int) -> Tensor:
        """Random x [batch, steps, D] where the parameters are."""
        weight = next(self.module.parameters(), torch.zeros(0))
        return torch.randn(batch, steps, self.input_size, dtype=torch.float64).to(
            weight.device, self.dtype
        )

    def inputs(
        self, batch: int, steps: int, resets: float = 0.0
    ) -> tuple[Tensor, TensorDict, Tensor]:
        """Random x, a state that some steps have led to, and start flags."""
        x = self.random(batch, steps)
        warm = self.random(batch, 3)
        with torch.no_grad():
            _, state = self.module(
                warm, self.initial(batch), torch.zeros_like(warm[..., 0], dtype=torch.bool)
            )
        return x, state, (torch.rand(batch, steps) < resets).to(x.device)

    def initial(self, batch: int) -> TensorDict:
        """The state at the start of an episode, TensorDict [batch]."""
        return self.module.initial_state(batch)  # type: ignore[operator]

    def compare(
        self,
        law: str,
        symptom: str,
        cause: str,
        *pairs: tuple[Tensor, Tensor],
        tolerance: float | None = None,
    ) -> float:
        """Largest difference of the pairs; raises if above the tolerance or not a number."""
        worst = max((_difference(p, q) for p, q in pairs if p.numel()), default=0.0)
        if not worst <= (self.tolerance if tolerance is None else tolerance):
            raise MemoryLawError(law, f"{symptom} (largest difference {worst:.2g})", cause, worst)
        return worst


def subject_of(
    module: nn.Module, input_size: int | None, dtype: torch.dtype, tolerance: float | None
) -> Subject:
    """The copy of a module that is checked."""
    size = getattr(module, "input_size", None) if input_size is None else input_size
    if not isinstance(size, int):
        raise ValueError(
            "input size unknown: pass check_memory(module, input_size=...) or set module.input_size"
        )
    if not hasattr(module, "initial_state"):
        raise TypeError(
            f"{type(module).__name__} has no initial_state(batch_size), which gives a TensorDict"
        )
    if dtype not in TOLERANCES:
        allowed = ", ".join(map(str, TOLERANCES))
        raise ValueError(f"dtype is {dtype}, allowed: {allowed}")
    if tolerance is None:
        tolerance = TOLERANCES[dtype]
    return Subject(copy.deepcopy(module).to(dtype).eval(), size, dtype, tolerance)


Law = Callable[[Subject, str], float]
"""Called with the subject and the name of the law; gives the largest discrepancy."""


def _difference(p: Tensor, q: Tensor) -> float:
    """Largest difference, as a share of the largest entry where that is above 1: sums over many
    steps are large, and so is their rounding. Computed in float64.
    """
    wide = torch.complex128 if p.is_complex() else torch.float64
    p = p.to(wide)
    q = q.to(wide)
    size = q.abs().max().clamp_min(1.0)
    return float((p - q).abs().max() / size)


def _leaves(state: TensorDict) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a state, by path."""
    return {
        key if isinstance(key, tuple) else (key,): state.get(key) for key in state.keys(True, True)
    }


def _pairs(p: TensorDict, q: TensorDict) -> list[tuple[Tensor, Tensor]]:
    """Tensors of two states side by side."""
    return [(leaf, q.get(key)) for key, leaf in _leaves(p).items()]


def _shapes(s: Subject, law: str) -> float:
    for batch, steps in ((1, 1), (3, 1), (2, 5)):
        _check_one_shape(s, law, batch, steps)
    x, state, flags = s.inputs(2, 5, 0.3)
    before = state.clone()
    s.module(x, state, flags)
    return s.compare(
        law,
        "forward changed the state that it was given",
        "an in-place write",
        *_pairs(before, state),
    )


def _check_one_shape(s: Subject, law: str, batch: int, steps: int) -> None:
    """Types, shapes and dtypes of the outputs of ``batch`` sequences of ``steps`` steps."""
    x = s.random(batch, steps)
    begin = s.initial(batch)
    out = s.module(x, begin, torch.zeros_like(x[..., 0], dtype=torch.bool))
    parts = (begin, *(out if isinstance(out, tuple) else (out,)))
    if [isinstance(part, TensorDictBase) for part in parts] != [True, False, True]:
        types = ", ".join(type(part).__name__ for part in parts)
        raise MemoryLawError(
            law,
            f"initial_state and forward gave {types}",
            "a state is no TensorDict, or forward does not return (y, state)",
        )

    y, after = out
    width = getattr(s.module, "hidden_size", None)
    fits = y.ndim == 3 and y.shape[:2] == (batch, steps)
    if not fits or (width is not None and y.shape[2] != width):
        raise MemoryLawError(
            law,
            f"x {list(x.shape)} gave y {list(y.shape)}, not [B, T, H]",
            "time and batch are exchanged, or hidden_size is not the width of y",
        )

    expected = _layout(begin)
    returned = _layout(after)
    if expected != returned:
        raise MemoryLawError(
            law,
            f"initial_state({batch}) has {expected} but forward returned {returned}",
            "the state grows, lacks the batch dimension, or does not take dtype and device "
            "from the parameters",
        )
    if y.dtype != s.dtype:
        raise MemoryLawError(
            law, f"{s.dtype} inputs gave {y.dtype}", "a constant or a cast in another dtype"
        )


def _layout(state: TensorDict) -> dict[tuple[str, ...], tuple[list[int], torch.dtype]]:
    """Shape and dtype of the tensors of a state, by path."""
    layout = {}
    for path, tensor in _leaves(state).items():
        layout[path] = (list(tensor.shape), tensor.dtype)
    return layout


def _steps(s: Subject, x: Tensor, state: TensorDict, flags: Tensor) -> tuple[Tensor, TensorDict]:
    """The same chunk, one call a step."""
    outputs = []
    for t in range(x.shape[1]):
        y, state = s.module(x[:, t : t + 1], state, flags[:, t : t + 1])
        outputs.append(y)
    return torch.cat(outputs, dim=1), state


@torch.no_grad()
def _scan_equals_steps(s: Subject, law: str) -> float:
    worst = 0.0
    for steps in (1, 2, 3, 7, 12, 17, 150):  # past the chunks of common scans
        for resets in (0.0, 0.3):
            x, state, flags = s.inputs(3, steps, resets)
            y, after = s.module(x, state, flags)
            stepped, stepped_after = _steps(s, x, state, flags)
            symptom = (
                f"one call over T={steps} steps {'with' if resets else 'without'} resets and T "
                "calls of one differ"
            )
            cause = (
                "an operator that is not associative, a scan that mishandles lengths that are no "
                "power of two, "
                "a look into the future, or acting and learning in different code"
            )
            if resets:
                cause = (
                    "start flags applied one step late or early, or only at index 0; otherwise: "
                    + cause
                )
            worst = max(
                worst, s.compare(law, symptom, cause, (y, stepped), *_pairs(after, stepped_after))
            )
    return worst


@torch.no_grad()
def _calls_equal_one(s: Subject, law: str) -> float:
    worst = 0.0
    x, state, flags = s.inputs(3, 11, 0.2)
    y, after = s.module(x, state, flags)
    for cuts in ((5,), (1, 4, 10), (3, 6)):
        parts = []
        carried = state
        for begin, end in zip((0, *cuts), (*cuts, 11), strict=True):
            part, carried = s.module(x[:, begin:end], carried, flags[:, begin:end])
            parts.append(part)
        worst = max(
            worst,
            s.compare(
                law,
                f"11 steps in one call and in calls cut at {cuts} differ",
                "the returned state is not the one after the last step, or the given state is not "
                "used",
                (y, torch.cat(parts, dim=1)),
                *_pairs(after, carried),
            ),
        )
    return worst


@torch.no_grad()
def _packed_equals_apart(s: Subject, law: str) -> float:
    worst = 0.0
    starts = [0, 1, 5, 7]
    x, state, flags = s.inputs(2, 13)
    flags[:, starts] = True
    y, _ = s.module(x, state, flags)
    for begin, end in zip(starts, (*starts[1:], 13), strict=True):
        alone, _ = s.module(x[:, begin:end], s.initial(2), torch.zeros_like(flags[:, begin:end]))
        worst = max(
            worst,
            s.compare(
                law,
                f"an episode of {end - begin} steps packed behind others at index {begin} and run "
                "on its own differ",
                "the start flag does not restore initial_state, or restores it after reading the "
                "first step",
                (y[:, begin:end], alone),
            ),
        )
    return worst


def _no_leak(s: Subject, law: str) -> float:
    cause = (
        "the state is multiplied by 0 (0 * inf = NaN) or left in place at a start; select with "
        "torch.where"
    )
    x, state, flags = s.inputs(2, 9)
    flags[:, 4] = True
    leaves = [v.requires_grad_() for v in _leaves(state).values() if v.is_floating_point()]
    x.requires_grad_()
    y, _ = s.module(x, state, flags)
    after = y[:, 4:].sum()
    grads = torch.autograd.grad(after, [x, *leaves], allow_unused=True, materialize_grads=True)
    earlier = [grads[0][:, :4], *grads[1:]]
    worst = s.compare(
        law,
        "gradients flow backward over a start",
        cause,
        *[(g, torch.zeros_like(g)) for g in earlier],
    )
    with torch.no_grad():
        other, other_state, _ = s.inputs(2, 9)
        changed, _ = s.module(torch.cat([other[:, :4], x[:, 4:]], 1), other_state, flags)
        symptom = "outputs after a start depend on what was before it"
        worst = max(worst, s.compare(law, symptom, cause, (y[:, 4:], changed[:, 4:])))
        flags[:, 0] = True
        poisoned = state.apply(
            lambda v: torch.full_like(v, torch.nan) if v.is_floating_point() else v
        )
        clean, after_clean = s.module(x, s.initial(2), flags)
        survived, after_poison = s.module(x, poisoned, flags)
        symptom = "a NaN in the carried state comes through a start at index 0"
        pairs = ((clean, survived), *_pairs(after_clean, after_poison))
        return max(worst, s.compare(law, symptom, cause, *pairs))


@torch.no_grad()
def _rows_independent(s: Subject, law: str) -> float:
    x, state, flags = s.inputs(4, 5, 0.3)
    y, after = s.module(x, state, flags)
    alone, alone_after = s.module(x[1:3], state[1:3], flags[1:3])
    return s.compare(
        law,
        "two rows of a batch of four and the same two alone differ",
        "batch statistics, a reshape that mixes batch and time, or a flag of one row that resets "
        "others",
        (y[1:3], alone),
        *_pairs(after[1:3], alone_after),
    )


@torch.no_grad()
def _replay_loads(s: Subject, law: str) -> float:
    x, _, flags = s.inputs(3, 9, 0.3)
    stored = torch.stack([s.inputs(3, 1)[1] for _ in range(9)], dim=1)
    y, states = s.module.replay(x, stored, flags)  # type: ignore[operator]
    stepped, stepped_states = replay_by_steps(s.module, x, stored, flags)
    return s.compare(
        law,
        "replay and a loop that loads stored states by hand differ",
        "replay must start from stored[:, t] at t = 0 and wherever is_init is set, and return the "
        "states after "
        "each step",
        (y, stepped),
        *_pairs(states, stepped_states),
    )


@torch.no_grad()
def _averages(s: Subject, law: str) -> float:
    steps = 12
    x = s.random(3, 1).expand(-1, steps, -1)
    flags = torch.zeros(3, steps, dtype=torch.bool, device=x.device)
    flags[0, 5] = True
    y, _ = s.module(x, s.initial(3), flags)
    return s.compare(
        law,
        f"{steps} equal inputs from the start of an episode do not give {steps} equal outputs",
        "weights that do not sum to one: a normaliser that is not accumulated with the values (the "
        "last key alone, or "
        "one that is not reset with them)",
        (y, y[:, :1].expand_as(y)),
        tolerance=max(s.tolerance, GUARD),
    )


def _gradients(s: Subject, law: str) -> float:
    x, state, flags = s.inputs(2, 5)
    flags[0, 2] = True
    keys = [k for k, v in _leaves(state).items() if v.is_floating_point()]
    names = [name for name, p in s.module.named_parameters() if p.requires_grad]
    parameters = [s.module.get_parameter(name).detach().clone() for name in names]
    arguments = [
        v.detach().clone().requires_grad_() for v in (x, *(state.get(k) for k in keys), *parameters)
    ]

    def outputs(x: Tensor, *rest: Tensor) -> Tensor:
        given = state.clone()
        for key, leaf in zip(keys, rest[: len(keys)], strict=True):
            given.set(key, leaf)
        weights = dict(zip(names, rest[len(keys) :], strict=True))
        y: Tensor = torch.func.functional_call(s.module, weights, (x, given, flags))[0]
        return y

    try:
        torch.autograd.gradcheck(outputs, arguments, fast_mode=True, atol=1e-5, rtol=1e-3)
    except RuntimeError as error:  # gradcheck's own error class derives from it
        raise MemoryLawError(
            law,
            "autograd and finite differences disagree in float64 "
            f"({str(error).strip().splitlines()[0]})",
            "a hand-written backward pass, a detach, a .data or an in-place write",
        ) from error
    return 0.0


def _gradients_of_steps(s: Subject, law: str) -> float:
    """The gradient of one call is that of a call a step, as far as rounding lets them agree."""
    x, state, flags = s.inputs(2, 9)
    flags[0, 4] = True
    weight = s.random(2, 1)[..., :1]
    parameters = [p for p in s.module.parameters() if p.requires_grad]
    gradients = []
    for read in (s.module, lambda *inputs: _steps(s, *inputs)):
        given = x.clone().requires_grad_()
        y, _ = read(given, state, flags)
        arguments = [given, *parameters]
        gradients.append(torch.autograd.grad((weight * y).sum(), arguments, materialize_grads=True))
    pairs = zip(*gradients, strict=True)
    symptom = "the gradients of one call and of a call a step differ"
    return s.compare(
        law, symptom, "a hand-written backward pass, a detach, a .data or an in-place write", *pairs
    )


def laws_of(module: nn.Module, dtype: torch.dtype, gradients: bool) -> dict[str, Law]:
    """The laws that a module has to keep, by name."""
    laws: dict[str, Law] = {
        "shapes are fixed": _shapes,
        "scan equals step by step": _scan_equals_steps,
        "several calls equal one": _calls_equal_one,
        "packed equals apart": _packed_equals_apart,
        "nothing leaks over a start": _no_leak,
        "batch rows are independent": _rows_independent,
    }
    if isinstance(module, ReplayableMemory):
        laws["replay loads stored states"] = _replay_loads
    if getattr(module, "averages_values", False):
        laws["an average of equal values is that value"] = _averages
    if gradients:
        # less precise numbers are too coarse for finite differences
        exact = dtype == torch.float64
        laws["gradients are right"] = _gradients if exact else _gradients_of_steps
    return laws
