"""The laws of a memory model, each a function of a copy of the module that is put to the test."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from arcade_torch.models.generators import kept_generators
from arcade_torch.models.law_gradients import (
    compare_gradients,
    gradients_are_right,
    gradients_of,
    gradients_of_steps,
)
from arcade_torch.models.law_subject import (
    MemoryLawError,
    Subject,
    check_state,
    layout_of,
    leaves,
    pairs_of,
)
from arcade_torch.models.law_weights import weights_are_registered
from arcade_torch.models.memory import ReplayableMemory, replay_by_steps

__all__ = ["Law", "laws_of"]

GUARD = 1e-4  # what a small number in a denominator may cost the law of averages

Law = Callable[[Subject], float]
"""Gives the largest discrepancy; raises ``MemoryLawError`` if the law is broken."""


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
            laws["gradients of one call are those of its steps"] = gradients_of_steps
        else:
            laws["gradients are right"] = gradients_are_right if exact else gradients_of_steps
    return laws


@torch.no_grad()
def _shapes(s: Subject) -> float:
    for batch, steps in ((1, 1), (3, 1), (2, 5)):
        _check_one_shape(s, batch, steps)
    _check_original(s)
    copied = s.copied()
    x, state, flags = copied.inputs(2, 5, 0.3)
    flags[0, 0] = True
    given = (x.clone(), state.clone(), flags.clone())
    copied.module(x, state, flags)
    symptom = "forward changed the {} that it was given"
    cause = "an in-place write"
    return max(
        s.compare(symptom.format("state"), cause, *pairs_of(given[1], state)),
        s.compare(symptom.format("x"), cause, (given[0], x)),
        s.compare(symptom.format("is_init"), cause, (given[2], flags)),
    )


def _check_one_shape(s: Subject, batch: int, steps: int) -> None:
    """Types, shapes and dtypes of the outputs of ``batch`` sequences of ``steps`` steps."""
    x = s.random(batch, steps)
    begin = s.initial(batch)
    if isinstance(begin, TensorDictBase):  # before forward, which may fail by it
        check_state(s, batch, f"initial_state({batch})", begin)
    # a copy: what a module keeps of a call in itself is another law's
    module = s.copied().module
    out = module(x, begin, torch.zeros_like(x[..., 0], dtype=torch.bool))
    parts = (begin, *(out if isinstance(out, tuple) else (out,)))
    if [isinstance(part, TensorDictBase) for part in parts] != [True, False, True]:
        types = ", ".join(type(part).__name__ for part in parts)
        raise MemoryLawError(
            s.law,
            f"initial_state and forward gave {types}",
            "a state is no TensorDict, or forward does not return (y, state)",
        )

    y, after = out
    width = getattr(module, "hidden_size", None)
    fits = y.ndim == 3 and y.shape[:2] == (batch, steps)
    if not fits or (width is not None and y.shape[2] != width):
        raise MemoryLawError(
            s.law,
            f"x {list(x.shape)} gave y {list(y.shape)}, not [B, T, H]",
            "time and batch are exchanged, or hidden_size is not the width of y",
        )
    if y.dtype != s.dtype:
        raise MemoryLawError(
            s.law, f"{s.dtype} inputs gave {y.dtype}", "a constant or a cast in another dtype"
        )
    if not y.isfinite().all():
        raise MemoryLawError(
            s.law,
            "y has entries that are NaN or infinite",
            "a division by 0, the logarithm or the root of a number below 0, or weights of "
            "torch.empty that nothing has filled",
        )
    _check_states(s, batch, begin, after)


def _check_original(s: Subject) -> None:
    """The same in the type that the weights came in: float64 hides constants of float64."""
    original = s.unconverted()
    if s.dtype != torch.float64 or original.dtype == s.dtype:
        return
    try:
        with kept_generators():  # the numbers that later laws draw stay what they are
            _check_one_shape(original, 2, 5)
    except MemoryLawError:
        raise
    except Exception as error:
        raise MemoryLawError(
            s.law,
            f"with weights of {original.dtype} it fails, {type(error).__name__} "
            f"{' '.join(str(error).split())}",
            "numbers of float64 in it, such as a constant of numpy or a .double(): give them the "
            "type of x or of the weights",
        ) from error


def _check_states(s: Subject, batch: int, begin: TensorDict, after: TensorDict) -> None:
    """Refuse a state of forward that is no state, or has another layout than the first one."""
    check_state(s, batch, "forward", after)
    expected = layout_of(begin)
    returned = layout_of(after)
    if expected != returned:
        raise MemoryLawError(
            s.law,
            f"initial_state({batch}) has {expected} but forward returned {returned}",
            "the state grows, lacks the batch dimension, or does not take dtype and device "
            "from the parameters",
        )


@torch.no_grad()
def _calls_repeat(s: Subject) -> float:
    symptom = "two calls of initial_state differ"
    cause = "random numbers in it: an episode begins with zeros, a constant or an nn.Parameter"
    worst = s.compare(symptom, cause, *pairs_of(s.initial(3), s.initial(3)))
    copied = s.copied()
    x, state, flags = copied.inputs(3, 5, 0.3)
    generator = torch.get_rng_state()
    y, after = copied.module(x, state, flags)
    again, after_again = copied.module(x, state, flags)
    moves_generator = not torch.equal(generator, torch.get_rng_state())
    repeated = s.compare(
        "the same call twice differs",
        "random numbers, such as F.dropout without training=self.training, or a state that the "
        "module keeps in itself: what is carried on belongs into the TensorDict that is returned",
        (y, again),
        *pairs_of(after, after_again),
    )
    if moves_generator:
        raise MemoryLawError(
            s.law,
            "a call changes the state of torch's random generator",
            "torch.manual_seed in forward, after which exploration draws the same numbers at every "
            "step, or numbers that are drawn for nothing: draw in __init__, into a buffer",
        )
    training = s.copied().module.train()
    trained, after_trained = training(x, state, flags)
    once_more, after_once_more = training(x, state, flags)
    return max(
        worst,
        repeated,
        s.compare(
            "training mode and evaluation mode differ",
            "dropout (0.1 by default in nn.TransformerEncoderLayer), batch normalisation, or noise "
            "in training: acting and learning, which are both in training mode, would see other "
            "functions; take dropout=0 and nn.LayerNorm",
            (y, trained),
            *pairs_of(after, after_trained),
        ),
        s.compare(
            "the same call twice differs in training mode",
            "statistics or weights that forward moves, such as a running mean of the inputs or "
            "spectral_norm: a sequence that is learned from would not be the one that was acted",
            (trained, once_more),
            *pairs_of(after_trained, after_once_more),
        ),
    )


@torch.no_grad()
def _scan_equals_steps(s: Subject) -> float:
    worst = 0.0
    for steps in (1, 2, 3, 7, 12, 17, 150):  # past the chunks of common scans
        for resets in (0.0, 0.3):
            x, state, flags = s.inputs(3, steps, resets)
            y, after = s.module(x, state, flags)
            stepped, stepped_after = s.read_steps(x, state, flags)
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
                worst, s.compare(symptom, cause, (y, stepped), *pairs_of(after, stepped_after))
            )
    return worst


@torch.no_grad()
def _calls_equal_one(s: Subject) -> float:
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
                f"11 steps in one call and in calls cut at {cuts} differ",
                "the returned state is not the one after the last step, or the given state is not "
                "used",
                (y, torch.cat(parts, dim=1)),
                *pairs_of(after, carried),
            ),
        )
    return worst


@torch.no_grad()
def _packed_equals_apart(s: Subject) -> float:
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
                f"an episode of {end - begin} steps packed behind others at index {begin} and run "
                "on its own differ",
                "the start flag does not restore initial_state (linear_scan restores zeros), or "
                "restores it after reading the first step",
                (y[:, begin:end], alone),
            ),
        )
    return worst


def _no_leak(s: Subject) -> float:
    cause = (
        "the state is multiplied by 0 (0 * inf = NaN) or left in place at a start; select with "
        "torch.where"
    )
    x, state, flags = s.inputs(2, 9)
    flags[:, 4] = True
    carried = [v.requires_grad_() for v in leaves(state).values() if v.is_floating_point()]
    x.requires_grad_()
    y, _ = s.module(x, state, flags)
    grads = gradients_of(s, y[:, 4:].sum(), [x, *carried])
    earlier = [grads[0][:, :4], *grads[1:]]
    worst = s.compare(
        "gradients flow backward over a start",
        cause,
        *[(g, torch.zeros_like(g)) for g in earlier],
    )
    with torch.no_grad():
        other, other_state, _ = s.inputs(2, 9)
        changed, _ = s.module(torch.cat([other[:, :4], x[:, 4:]], 1), other_state, flags)
        symptom = "outputs after a start depend on what was before it"
        worst = max(worst, s.compare(symptom, cause, (y[:, 4:], changed[:, 4:])))
        flags[:, 0] = True
        poisoned = state.apply(
            lambda v: torch.full_like(v, torch.nan) if v.is_floating_point() else v
        )
        clean, after_clean = s.module(x, s.initial(2), flags)
        survived, after_poison = s.module(x, poisoned, flags)
        symptom = "a NaN in the carried state comes through a start at index 0"
        compared = ((clean, survived), *pairs_of(after_clean, after_poison))
        return max(worst, s.compare(symptom, cause, *compared))


@torch.no_grad()
def _rows_independent(s: Subject) -> float:
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
            f"{are} of a batch of four and the same alone differ",
            "batch statistics, a reshape that mixes batch and time, a squeeze() that takes a batch "
            "of one for none, or a flag of one row that resets others",
            (y[rows], alone),
            *pairs_of(after[rows], alone_after),
        )
        worst = max(worst, measured)
    return worst


def _replay_loads(s: Subject) -> float:
    x, _, flags = s.inputs(3, 9, 0.3)
    stored = torch.stack([s.inputs(3, 1)[1] for _ in range(9)], dim=1)

    def replayed(x: Tensor) -> tuple[Tensor, TensorDict]:
        return s.module.replay(x, stored, flags)  # type: ignore[operator, no-any-return]

    def stepped(x: Tensor) -> tuple[Tensor, TensorDict]:
        return replay_by_steps(s.module, x, stored, flags)

    with torch.no_grad():
        y, states = replayed(x)
        expected, expected_states = stepped(x)
    values = s.compare(
        "replay and a loop that loads stored states by hand differ",
        "replay must start from stored[:, t] at t = 0 and wherever is_init is set, and return the "
        "states after each step",
        (y, expected),
        *pairs_of(states, expected_states),
    )
    gradients = compare_gradients(
        s,
        "the gradients of replay and of a loop that loads stored states by hand differ",
        "a state that replay detaches from step to step, or its hand-written backward pass",
        x,
        [lambda x: replayed(x)[0], lambda x: stepped(x)[0]],
    )
    return max(values, gradients)


@torch.no_grad()
def _averages(s: Subject) -> float:
    steps = 12
    x = s.random(3, 1).expand(-1, steps, -1)
    flags = torch.zeros(3, steps, dtype=torch.bool, device=x.device)
    flags[0, 5] = True
    y, _ = s.module(x, s.initial(3), flags)
    return s.compare(
        f"{steps} equal inputs from the start of an episode do not give {steps} equal outputs",
        "weights that do not sum to one: a normaliser that is not accumulated with the values (the "
        "last key alone, or one that is not reset with them)",
        (y, y[:, :1].expand_as(y)),
        tolerance=max(s.tolerance, GUARD),
    )
