"""The laws of a memory model, each a function of a copy of the module that is put to the test."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from arcade_torch.models.law_subject import MemoryLawError, Subject, leaves, pairs_of
from arcade_torch.models.law_weights import weights_are_registered
from arcade_torch.models.memory import ReplayableMemory, replay_by_steps

__all__ = ["Law", "laws_of"]

GUARD = 1e-4  # what a small number in a denominator may cost the law of averages

Law = Callable[[Subject, str], float]
"""Called with the subject and the name of the law; gives the largest discrepancy."""


@torch.no_grad()
def _shapes(s: Subject, law: str) -> float:
    for batch, steps in ((1, 1), (3, 1), (2, 5)):
        _check_one_shape(s, law, batch, steps)
    copied = s.copied()
    x, state, flags = copied.inputs(2, 5, 0.3)
    flags[0, 0] = True
    given = (x.clone(), state.clone(), flags.clone())
    copied.module(x, state, flags)
    symptom = "forward changed the {} that it was given"
    cause = "an in-place write"
    return max(
        s.compare(law, symptom.format("state"), cause, *pairs_of(given[1], state)),
        s.compare(law, symptom.format("x"), cause, (given[0], x)),
        s.compare(law, symptom.format("is_init"), cause, (given[2], flags)),
    )


def _check_one_shape(s: Subject, law: str, batch: int, steps: int) -> None:
    """Types, shapes and dtypes of the outputs of ``batch`` sequences of ``steps`` steps."""
    x = s.random(batch, steps)
    begin = s.initial(batch)
    # a copy: what a module keeps of a call in itself is another law's
    module = s.copied().module
    out = module(x, begin, torch.zeros_like(x[..., 0], dtype=torch.bool))
    parts = (begin, *(out if isinstance(out, tuple) else (out,)))
    if [isinstance(part, TensorDictBase) for part in parts] != [True, False, True]:
        types = ", ".join(type(part).__name__ for part in parts)
        raise MemoryLawError(
            law,
            f"initial_state and forward gave {types}",
            "a state is no TensorDict, or forward does not return (y, state)",
        )

    y, after = out
    width = getattr(module, "hidden_size", None)
    fits = y.ndim == 3 and y.shape[:2] == (batch, steps)
    if not fits or (width is not None and y.shape[2] != width):
        raise MemoryLawError(
            law,
            f"x {list(x.shape)} gave y {list(y.shape)}, not [B, T, H]",
            "time and batch are exchanged, or hidden_size is not the width of y",
        )
    if y.dtype != s.dtype:
        raise MemoryLawError(
            law, f"{s.dtype} inputs gave {y.dtype}", "a constant or a cast in another dtype"
        )
    if not y.isfinite().all():
        raise MemoryLawError(
            law,
            "y has entries that are NaN or infinite",
            "a division by 0, the logarithm or the root of a number below 0, or weights of "
            "torch.empty that nothing has filled",
        )
    _check_states(s, law, batch, begin, after)


def _check_states(s: Subject, law: str, batch: int, begin: TensorDict, after: TensorDict) -> None:
    """Batch size, shapes and dtypes of the first state and of one that forward returned."""
    for source, state in ((f"initial_state({batch})", begin), ("forward", after)):
        if list(state.batch_size) != [batch]:
            raise MemoryLawError(
                law,
                f"the state of {source} has batch_size {list(state.batch_size)}, not [{batch}]",
                "TensorDict(..., batch_size=[B]) is missing, or a tensor does not have the batch "
                "as its first dimension, such as [layers, B, H] of torch.nn.LSTM",
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
    for path, (_, dtype) in expected.items():
        name = ".".join(path)
        if dtype.is_complex:
            raise MemoryLawError(
                law,
                f"{name} of the state is {dtype}, and specs of TorchRL know no complex numbers",
                "a state that is not taken apart: hold torch.view_as_real(h), and begin forward "
                "with torch.view_as_complex",
            )
        if dtype.is_floating_point and torch.finfo(dtype).eps > torch.finfo(s.dtype).eps:
            raise MemoryLawError(
                law,
                f"{name} of the state is {dtype} where the parameters are {s.dtype}",
                "zeros without a dtype, or a cast: take weight.new_zeros(...)",
            )


def _layout(state: TensorDict) -> dict[tuple[str, ...], tuple[list[int], torch.dtype]]:
    """Shape and dtype of the tensors of a state, by path."""
    layout = {}
    for path, tensor in leaves(state).items():
        layout[path] = (list(tensor.shape), tensor.dtype)
    return layout


@torch.no_grad()
def _calls_repeat(s: Subject, law: str) -> float:
    symptom = "two calls of initial_state differ"
    cause = "random numbers in it: an episode begins with zeros, a constant or an nn.Parameter"
    worst = s.compare(law, symptom, cause, *pairs_of(s.initial(3), s.initial(3)))
    copied = s.copied()
    x, state, flags = copied.inputs(3, 5, 0.3)
    y, after = copied.module(x, state, flags)
    again, after_again = copied.module(x, state, flags)
    repeated = s.compare(
        law,
        "the same call twice differs",
        "random numbers, such as F.dropout without training=self.training, or a state that the "
        "module keeps in itself: what is carried on belongs into the TensorDict that is returned",
        (y, again),
        *pairs_of(after, after_again),
    )
    training = s.copied().module.train()
    trained, after_trained = training(x, state, flags)
    once_more, after_once_more = training(x, state, flags)
    return max(
        worst,
        repeated,
        s.compare(
            law,
            "training mode and evaluation mode differ",
            "dropout (0.1 by default in nn.TransformerEncoderLayer), batch normalisation, or noise "
            "in training: acting and learning, which are both in training mode, would see other "
            "functions; take dropout=0 and nn.LayerNorm",
            (y, trained),
            *pairs_of(after, after_trained),
        ),
        s.compare(
            law,
            "the same call twice differs in training mode",
            "statistics or weights that forward moves, such as a running mean of the inputs or "
            "spectral_norm: a sequence that is learned from would not be the one that was acted",
            (trained, once_more),
            *pairs_of(after_trained, after_once_more),
        ),
    )


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
                "a given state that is not used, a returned one that is not the one after the last "
                "step, a look into the future, time and batch exchanged in a reshape, an operator "
                "that is not associative, or a scan that mishandles lengths that are no power of "
                "two"
            )
            if resets:
                cause = (
                    "start flags applied one step late or early, or only at index 0; otherwise: "
                    + cause
                )
            worst = max(
                worst, s.compare(law, symptom, cause, (y, stepped), *pairs_of(after, stepped_after))
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
                *pairs_of(after, carried),
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
                "the start flag does not restore initial_state (linear_scan restores zeros), or "
                "restores it after reading the first step",
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
    carried = [v.requires_grad_() for v in leaves(state).values() if v.is_floating_point()]
    x.requires_grad_()
    y, _ = s.module(x, state, flags)
    if not y.requires_grad:
        raise MemoryLawError(
            law, "no gradient comes from y to x", "torch.no_grad, a detach or .data in forward"
        )
    grads = _gradients_of(law, y[:, 4:].sum(), [x, *carried])
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
        compared = ((clean, survived), *pairs_of(after_clean, after_poison))
        return max(worst, s.compare(law, symptom, cause, *compared))


@torch.no_grad()
def _rows_independent(s: Subject, law: str) -> float:
    x, state, flags = s.inputs(4, 5, 0.3)
    flags[:, 3] = torch.tensor([True, False, False, True])  # a start of the others alone
    y, after = s.module(x, state, flags)
    worst = 0.0
    for rows, are in (
        (slice(1, 3), "two rows"),
        (slice(0, 1), "one row"),
        (slice(1, 2), "one row"),
    ):
        alone, alone_after = s.module(x[rows], state[rows], flags[rows])
        measured = s.compare(
            law,
            f"{are} of a batch of four and the same alone differ",
            "batch statistics, a reshape that mixes batch and time, a squeeze() that takes a batch "
            "of one for none, or a flag of one row that resets others",
            (y[rows], alone),
            *pairs_of(after[rows], alone_after),
        )
        worst = max(worst, measured)
    return worst


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
        *pairs_of(states, stepped_states),
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


def _gradients_of(law: str, number: Tensor, inputs: list[Tensor]) -> tuple[Tensor, ...]:
    """The gradient of a number, zeros where an input has no part in it."""
    try:
        return torch.autograd.grad(number, inputs, allow_unused=True, materialize_grads=True)
    except RuntimeError as error:
        raise MemoryLawError(
            law,
            f"torch cannot compute the gradient ({' '.join(str(error).split())})",
            "an in-place write (h.mul_(), h[:] = ..., copy_()) into a tensor that the gradient of "
            "an earlier step reads: make a new one at every step, or write to a clone()",
        ) from error


def _gradients(s: Subject, law: str) -> float:
    x, state, flags = s.inputs(2, 5)
    flags[0, 2] = True
    keys = [k for k, v in leaves(state).items() if v.is_floating_point()]
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
        gradients.append(_gradients_of(law, (weight * y).sum(), [given, *parameters]))
    pairs = zip(*gradients, strict=True)
    symptom = "the gradients of one call and of a call a step differ"
    return s.compare(
        law, symptom, "a hand-written backward pass, a detach, a .data or an in-place write", *pairs
    )


def laws_of(module: nn.Module, dtype: torch.dtype, gradients: bool) -> dict[str, Law]:
    """The laws that a module has to keep, by name."""
    laws: dict[str, Law] = {
        "weights are registered": weights_are_registered,
        "shapes are fixed": _shapes,
        "equal calls give equal results": _calls_repeat,
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
        if any(getattr(part, "surrogate_gradients", False) for part in module.modules()):
            laws["gradients of one call are those of its steps"] = _gradients_of_steps
        else:
            laws["gradients are right"] = _gradients if exact else _gradients_of_steps
    return laws
