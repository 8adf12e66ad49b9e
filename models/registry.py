"""Memory models by name: one dictionary, open to models of your own."""

import difflib
import inspect
from collections.abc import Callable
from typing import Any

from torch import nn

from arcade_torch.models.attention import Attention
from arcade_torch.models.bmru import BMRU
from arcade_torch.models.deltaproduct import DeltaProduct
from arcade_torch.models.ffm import FFM
from arcade_torch.models.frame_stack import FrameStack
from arcade_torch.models.gdn import GatedDeltaNet
from arcade_torch.models.gru import GRU
from arcade_torch.models.gtrxl import GTrXL
from arcade_torch.models.linear_transformer import LinearTransformer
from arcade_torch.models.lru import LRU
from arcade_torch.models.lstm import LSTM
from arcade_torch.models.mamba import Mamba
from arcade_torch.models.mingru import MinGRU
from arcade_torch.models.mlstm import MLSTM
from arcade_torch.models.rtu import RTU
from arcade_torch.models.rwkv7 import RWKV7
from arcade_torch.models.s5 import S5
from arcade_torch.models.shm import StableHadamardMemory
from arcade_torch.models.slstm import SLSTM
from arcade_torch.models.stateless import Stateless
from arcade_torch.models.ttt import TTTLinear

__all__ = ["ALIASES", "make_memory", "memory_names", "register_memory"]

MemoryFactory = Callable[..., nn.Module]

_FACTORIES: dict[str, MemoryFactory] = {
    "lru": LRU,
    "mingru": MinGRU,
    "gru": GRU,
    "mlp": Stateless,
    "linear_transformer": LinearTransformer,
    "attention": Attention,
    "gdn": GatedDeltaNet,
    "ttt": TTTLinear,
    "lstm": LSTM,
    "frame_stack": FrameStack,
    "ffm": FFM,
    "shm": StableHadamardMemory,
    "rtu": RTU,
    "deltaproduct": DeltaProduct,
    "rwkv7": RWKV7,
    "s5": S5,
    "mamba": Mamba,
    "slstm": SLSTM,
    "mlstm": MLSTM,
    "gtrxl": GTrXL,
    "bmru": BMRU,
}

ALIASES = {"fart": "linear_transformer"}
"""Other names that :func:`make_memory` accepts: what the paper calls a model."""


def memory_names() -> list[str]:
    """All names that :func:`make_memory` knows, in the order of registration.

    Example:
        >>> memory_names()[:8]
        ['lru', 'mingru', 'gru', 'mlp', 'linear_transformer', 'attention', 'gdn', 'ttt']
    """
    return list(_FACTORIES)


def make_memory(name: str, input_size: int, hidden_size: int, **options: Any) -> nn.Module:
    """Make a memory model.

    Args:
        name: one of :func:`memory_names`, or ``"fart"``, the paper's name of the linear
            transformer.
        input_size: D, features of an input step.
        hidden_size: H, features of an output step.
        **options: those of the model, such as ``candidate="linear"`` of MinGRU.

    Returns:
        ``nn.Module`` with ``forward(x [B, T, D], state, is_init [B, T]) -> (y [B, T, H], state)``
        and ``initial_state(batch_size)``; see ``MemoryContract``.

    Raises:
        ValueError: unknown name; the message has the nearest match and the list.
        TypeError: an option that the model does not have.

    Example:
        >>> import torch
        >>> memory = make_memory("mingru", input_size=3, hidden_size=4)
        >>> is_init = torch.zeros(2, 5, dtype=torch.bool)
        >>> y, state = memory(torch.zeros(2, 5, 3), memory.initial_state(2), is_init)
        >>> y.shape, state["h"].shape
        (torch.Size([2, 5, 4]), torch.Size([2, 4]))
    """
    name = ALIASES.get(name, name)
    if name not in _FACTORIES:
        near = difflib.get_close_matches(str(name).lower(), _FACTORIES, n=1)
        names = ", ".join(_FACTORIES)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(
            f"unknown memory {name!r}: {hint}known are {names}; register_memory or --import adds "
            "others"
        )
    try:
        inspect.signature(_FACTORIES[name]).bind(input_size, hidden_size, **options)
    except TypeError as error:
        if options:
            raise TypeError(f"memory {name!r} has other options: {error}") from error
        raise TypeError(
            f"memory {name!r} cannot be made from (input_size, hidden_size) alone: {error}"
        ) from error
    return _FACTORIES[name](input_size, hidden_size, **options)


def is_built_in(name: str) -> bool:
    """Whether a name, such as ``"lru"``, means a memory model of this package, not one of yours.

    Example:
        >>> is_built_in("lru"), is_built_in("no_such_memory")
        (True, False)
    """
    factory = _FACTORIES.get(ALIASES.get(name, name))
    return str(getattr(factory, "__module__", "")).startswith("arcade_torch.models.")


def register_memory(name: str, factory: MemoryFactory, *, overwrite: bool = False) -> None:
    """Make a model of your own available by name, here and on the command line.

    Args:
        name: what to call it; a Python identifier in lower case.
        factory: called as ``factory(input_size, hidden_size, **options)``, returns a module that
            keeps the contract of ``MemoryContract`` (run ``check_memory`` on one).
        overwrite: allow replacing a registered name.

    Raises:
        ValueError: the name is taken, or not a lower-case identifier.
        TypeError: ``factory`` cannot be called.
    """
    if not isinstance(name, str) or not name.isidentifier() or name != name.lower():
        raise ValueError(
            f"a memory's name must be a lower-case identifier such as 'my_memory', got {name!r}"
        )
    if not callable(factory) or isinstance(factory, nn.Module):
        kind = type(factory).__name__
        is_module = isinstance(factory, nn.Module)
        got = f"an instance of {kind}: give {kind}" if is_module else repr(factory)
        raise TypeError(
            "factory must be a class or function of (input_size, hidden_size, **options), got "
            f"{got}"
        )
    if (name in _FACTORIES or name in ALIASES) and not overwrite:
        raise ValueError(
            f"memory {name!r} is registered already; choose another name or pass overwrite=True"
        )
    _FACTORIES[ALIASES.get(name, name)] = factory
