"""What the laws of a memory model are put to, a copy of the module; the error of a broken law."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.arguments import check_numbers, is_whole

__all__ = ["MemoryLawError", "Subject", "copy_of", "held_by", "leaves", "pairs_of", "subject_of"]

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
    original: nn.Module
    """A copy in evaluation mode whose weights and buffers are of the types that they came in."""
    law: str = ""
    """Name of the law that is checked now."""

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

    def copied(self) -> "Subject":
        """The same, with a copy of the module, for calls that may leave something in it."""
        return replace(self, module=copy_of(self.module))

    def unconverted(self) -> "Subject":
        """The same in the type that the weights came in."""
        for weight in (*self.original.parameters(), *self.original.buffers()):
            if weight.is_floating_point() or weight.is_complex():
                return replace(self, module=self.original, dtype=weight.dtype.to_real())
        return self

    def read_steps(self, x: Tensor, state: TensorDict, flags: Tensor) -> tuple[Tensor, TensorDict]:
        """What the module gives of a chunk, one call a step."""
        outputs = []
        for t in range(x.shape[1]):
            y, state = self.module(x[:, t : t + 1], state, flags[:, t : t + 1])
            outputs.append(y)
        return torch.cat(outputs, dim=1), state

    def initial(self, batch: int) -> TensorDict:
        """The state at the start of an episode, TensorDict [batch]."""
        return self.module.initial_state(batch)  # type: ignore[operator]

    def compare(
        self,
        symptom: str,
        cause: str,
        *pairs: tuple[Tensor, Tensor],
        tolerance: float | None = None,
    ) -> float:
        """Largest difference of the pairs; raises if above the tolerance or not a number."""
        differences = [_difference(p, q) for p, q in pairs if p.numel()]
        # torch's maximum is NaN where one of them is, unlike Python's
        worst = float(torch.tensor([0.0, *differences], dtype=torch.float64).max())
        if not worst <= (self.tolerance if tolerance is None else tolerance):
            measured = f"{symptom} (largest difference {worst:.2g})"
            raise MemoryLawError(self.law, measured, cause, worst)
        return worst


def subject_of(
    module: Any, input_size: int | None, dtype: torch.dtype, tolerance: float | None
) -> Subject:
    """The copy of a module that is checked."""
    if not isinstance(module, nn.Module):
        is_class = isinstance(module, type)
        got = f"the class {module.__name__}: make one of it" if is_class else repr(module)
        raise TypeError(f"a memory model must be an nn.Module, got {got}")
    size = _input_size(module, input_size)
    if not hasattr(module, "initial_state"):
        raise TypeError(
            f"{type(module).__name__} has no initial_state(batch_size), which gives a TensorDict"
        )
    for name, part in module.named_modules():
        if type(part).__module__.startswith("torch.ao.nn.quantized"):
            raise TypeError(
                f"{name or 'it'} of {type(module).__name__} is quantised, and rounds what it reads "
                "by the largest entry of a call, so that no law holds: check it before it is "
                "quantised"
            )
    if dtype not in TOLERANCES:
        allowed = ", ".join(map(str, TOLERANCES))
        raise ValueError(f"dtype is {dtype}, allowed: {allowed}")
    weights = [*module.parameters(), *module.buffers()]
    if not any(weight.is_floating_point() or weight.is_complex() for weight in weights):
        dtype = torch.float32  # there is nothing to convert, so its states are what they are
    if tolerance is None:
        tolerance = TOLERANCES[dtype]
    check_numbers(tolerance=tolerance)
    if tolerance < 0:
        raise ValueError(f"tolerance must be a number from 0, got {tolerance}")
    # not ``.to(dtype)``, which takes the imaginary part away from complex weights
    convert = partial(_in_precision, dtype=dtype)
    checked = copy_of(module, convert).eval()
    checked._apply(convert)
    return Subject(checked, size, dtype, tolerance, original=copy_of(module).eval())


def _input_size(module: nn.Module, given: int | None) -> int:
    """D, as given or as the module has it."""
    if given is not None:
        if not is_whole(given) or given < 1:
            raise ValueError(f"input_size must be a whole number from 1, got {given!r}")
        return int(given)
    size: Any = getattr(module, "input_size", None)
    if not is_whole(size):
        raise ValueError(
            "input size unknown: pass check_memory(module, input_size=...) or set module.input_size"
        )
    return int(size)


def copy_of(module: nn.Module, convert: Callable[[Tensor], Tensor] = torch.detach) -> nn.Module:
    """A copy of a module that has been at work: what it keeps of a call, its attention for a
    picture or the weight of ``weight_norm``, is converted without the graph, which nobody can copy.
    """
    memo = dict[int, Any]()
    for part in module.modules():
        for value in vars(part).values():
            for thing in held_by(value):
                if isinstance(thing, Tensor) and not thing.is_leaf:
                    memo[id(thing)] = convert(thing.detach().clone())
    return copy.deepcopy(module, memo)


def held_by(value: Any) -> Iterator[Any]:
    """What an attribute of a module is, or holds in plain lists, tuples, sets and dictionaries,
    those inside of each other too.
    """
    waiting = [value]
    opened = set[int]()
    while waiting:
        thing = waiting.pop()
        if not isinstance(thing, dict | list | tuple | set):
            yield thing
        elif id(thing) not in opened:
            opened.add(id(thing))
            waiting += thing.values() if isinstance(thing, dict) else thing


def _in_precision(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """A weight or a buffer as numbers of this precision, complex ones as complex ones."""
    if tensor.is_complex():
        return tensor.to(dtype.to_complex())
    return tensor.to(dtype) if tensor.is_floating_point() else tensor


def _difference(p: Tensor, q: Tensor) -> float:
    """Largest difference, as a share of the largest finite entry where that is above 1: sums over
    many steps are large, and so is their rounding. Equal infinities do not differ. Computed in
    float64.
    """
    wide = torch.complex128 if p.is_complex() else torch.float64
    p = p.to(wide)
    q = q.to(wide)
    difference = (p - q).abs().masked_fill(p == q, 0)
    sizes = q.abs()
    size = sizes.masked_fill(~sizes.isfinite(), 0).max().clamp_min(1.0)
    return float(difference.max() / size)


def leaves(state: TensorDict) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a state, by path."""
    return {
        key if isinstance(key, tuple) else (key,): state.get(key) for key in state.keys(True, True)
    }


def pairs_of(p: TensorDict, q: TensorDict) -> list[tuple[Tensor, Tensor]]:
    """Tensors of two states side by side."""
    return [(leaf, q.get(key)) for key, leaf in leaves(p).items()]


def check_state(s: Subject, batch: int, source: str, state: TensorDict) -> None:
    """Refuse a state from ``source`` whose batch size, or the type of a tensor, is wrong."""
    if list(state.batch_size) != [batch]:
        raise MemoryLawError(
            s.law,
            f"the state of {source} has batch_size {list(state.batch_size)}, not [{batch}]",
            "TensorDict(..., batch_size=[B]) is missing, or a tensor does not have the batch "
            "as its first dimension, such as [layers, B, H] of torch.nn.LSTM",
        )
    for path, (_, dtype) in layout_of(state).items():
        name = ".".join(path)
        if dtype.is_complex:
            raise MemoryLawError(
                s.law,
                f"{name} of the state is {dtype}, and specs of TorchRL know no complex numbers",
                "a state that is not taken apart: hold torch.view_as_real(h), and begin forward "
                "with torch.view_as_complex",
            )
        if dtype.is_floating_point and torch.finfo(dtype).eps > torch.finfo(s.dtype).eps:
            raise MemoryLawError(
                s.law,
                f"{name} of the state is {dtype} where the parameters are {s.dtype}",
                "zeros without a dtype, or a cast: take weight.new_zeros(...)",
            )


def layout_of(state: TensorDict) -> dict[tuple[str, ...], tuple[list[int], torch.dtype]]:
    """Shape and dtype of the tensors of a state, by path."""
    layout = {}
    for path, tensor in leaves(state).items():
        layout[path] = (list(tensor.shape), tensor.dtype)
    return layout
