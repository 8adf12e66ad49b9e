"""The laws of the gradients of a memory model: finite differences, or a call a step."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from arcade_torch.models.law_subject import MemoryLawError, Subject, leaves

__all__ = ["compare_gradients", "gradients_are_right", "gradients_of", "gradients_of_steps"]

CAUSE = (
    "a hand-written backward pass, a detach, also of the state that is returned, a .data or an "
    "in-place write"
)


def gradients_of(s: Subject, number: Tensor, inputs: list[Tensor]) -> tuple[Tensor, ...]:
    """The gradient of a number, zeros where an input has no part in it."""
    if not number.requires_grad:
        raise MemoryLawError(
            s.law, "no gradient comes from y to x", "torch.no_grad, a detach or .data"
        )
    try:
        return torch.autograd.grad(number, inputs, allow_unused=True, materialize_grads=True)
    except RuntimeError as error:
        raise MemoryLawError(
            s.law,
            f"torch cannot compute the gradient ({' '.join(str(error).split())})",
            "an in-place write (h.mul_(), h[:] = ..., copy_()) into a tensor that the gradient of "
            "an earlier step reads: make a new one at every step, or write to a clone()",
        ) from error


def gradients_are_right(s: Subject) -> float:
    """Gradients equal finite differences, and a call a step, through the states that are returned,
    has those of one call.
    """
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

    _refuse_sparse(s, gradients_of(s, outputs(*arguments).sum(), arguments))
    try:
        torch.autograd.gradcheck(outputs, arguments, fast_mode=True, atol=1e-5, rtol=1e-3)
    except RuntimeError as error:  # gradcheck's own error class derives from it
        raise MemoryLawError(
            s.law,
            "autograd and finite differences disagree in float64 "
            f"({str(error).strip().splitlines()[0]})",
            CAUSE,
        ) from error
    return gradients_of_steps(s)


def _refuse_sparse(s: Subject, gradients: Sequence[Tensor]) -> None:
    """Refuse weights whose gradients are sparse."""
    if any(gradient.is_sparse for gradient in gradients):
        raise MemoryLawError(
            s.law,
            "the gradient of a weight is sparse, which learners can neither clip nor go by",
            "nn.Embedding(..., sparse=True): leave sparse out",
        )


def gradients_of_steps(s: Subject) -> float:
    """The gradient of one call is that of a call a step, as far as rounding lets them agree."""
    x, state, flags = s.inputs(2, 9)
    flags[0, 4] = True
    reads = [
        lambda x: s.module(x, state, flags)[0],
        lambda x: s.read_steps(x, state, flags)[0],
    ]
    symptom = "the gradients of one call and of a call a step differ"
    return compare_gradients(s, symptom, CAUSE, x, reads)


def compare_gradients(
    s: Subject,
    symptom: str,
    cause: str,
    x: Tensor,
    reads: Sequence[Callable[[Tensor], Tensor]],
) -> float:
    """Largest difference of the gradients, with respect to inputs and weights, of two ways to
    compute the same y from x.
    """
    weight = x[:, :1, :1]  # another one for each row
    parameters = [p for p in s.module.parameters() if p.requires_grad]
    gradients = []
    for read in reads:
        given = x.clone().requires_grad_()
        number = (weight * read(given)).sum()
        gradients.append(gradients_of(s, number, [given, *parameters]))
    return s.compare(symptom, cause, *zip(*gradients, strict=True))
