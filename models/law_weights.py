"""The law of the weights of a memory model: registered, made early, and taken by name."""

from contextlib import suppress
from dataclasses import replace
from types import FunctionType
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from arcade_torch.models.law_subject import MemoryLawError, Subject, check_state, held_by

__all__ = ["weights_are_registered"]


@torch.no_grad()
def weights_are_registered(s: Subject) -> float:
    """All weights are parameters, there before the first call, and taken by name.

    Args:
        s: what is checked.

    Returns:
        0: it is no law of numbers.

    Raises:
        MemoryLawError: one of the three is not so.
    """
    for name, weight in (*s.module.named_parameters(), *s.module.named_buffers()):
        if is_lazy(weight):
            symptom = f"{name} has no shape before the first call"
            raise MemoryLawError(s.law, symptom, "nn.LazyLinear: take nn.Linear, with its sizes")
    registered = {id(weight) for weight in s.module.parameters()}
    for part in s.module.modules():
        for name, value in vars(part).items():
            if all(id(weight) in registered for weight in _weights_in(value)):
                continue
            cause = (
                "it would not be trained, saved or moved: take nn.ModuleList, nn.ModuleDict, "
                "nn.ParameterList or nn.Parameter"
            )
            if isinstance(value, FunctionType):
                cause = (
                    "a function that names a module itself: a copy of the memory, such as a target "
                    "network, would still read the first one's weights; take the module that the "
                    "function is given"
                )
            raise MemoryLawError(
                s.law,
                f"parameters() does not list what is in {name} of {type(part).__name__}, a "
                f"{type(value).__name__}",
                cause,
            )
    module = s.copied().module
    before = set(module.state_dict())
    x = s.random(2, 3)
    begin = s.initial(2)
    try:
        module(x, begin, torch.zeros_like(x[..., 0], dtype=torch.bool))
    except Exception:
        if isinstance(begin, TensorDictBase):  # forward may have failed by it
            check_state(replace(s, law="shapes are fixed"), 2, "initial_state(2)", begin)
        raise
    if new := set(module.state_dict()) - before:
        raise MemoryLawError(
            s.law,
            f"the first call makes new weights: {', '.join(sorted(new))}",
            "a layer made in forward, which the optimiser does not know: make it in __init__",
        )
    _check_taken_by_name(s, x)
    return 0.0


def _weights_in(value: Any) -> list[Tensor]:
    """The weights that an attribute of a module is, or holds in plain lists and dictionaries."""
    if isinstance(value, Tensor):
        return [value] if value.requires_grad and value.is_leaf else []
    weights = list[Tensor]()
    for held in held_by(value):
        things = _named_by(held) if isinstance(held, FunctionType) else [held]
        for thing in things:
            if isinstance(thing, nn.Module) and thing is not value:
                weights += thing.parameters()
            elif isinstance(thing, nn.Parameter):
                weights.append(thing)
    return weights


def _named_by(function: FunctionType) -> list[Any]:
    """What a function names that is not given to it."""
    things = []
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # of a name that has no value yet
            things.append(cell.cell_contents)
    for name in function.__code__.co_names:
        things.append(function.__globals__.get(name))
    return things


def _check_taken_by_name(s: Subject, x: Tensor) -> None:
    """Call it with ``parameters()`` empty and the numbers there by their names, as a loss with
    target networks does.
    """
    bare = s.copied().module
    for part in bare.modules():
        for name, weight in list(part.named_parameters(recurse=False)):
            delattr(part, name)
            part.register_buffer(name, weight.detach())
    begin = s.initial(len(x))
    try:
        bare(x, begin, torch.zeros_like(x[..., 0], dtype=torch.bool))
        bare.initial_state(len(x))  # type: ignore[operator]
    except Exception as error:
        raise MemoryLawError(
            s.law,
            "it fails where a loss with target networks keeps the parameters elsewhere, "
            f"{type(error).__name__} {error}".rstrip(),
            "self.parameters() in forward or initial_state: take weights by name, such as "
            "self.cell.weight",
        ) from error
