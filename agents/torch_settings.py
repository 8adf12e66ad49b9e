"""The settings of torch that a run computes under, whatever the process or the caller has set, and
the device that somebody names.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

from arcade_torch.models.generators import ONE_AT_A_TIME

__all__ = ["Settings", "device_of", "given_back", "plain_torch"]

Settings = dict[Callable[[Any], object], Any]
"""What sets a setting of the process -> its value before."""

_OPEN: list[Settings] = []
"""What the runs in this process have to give back, in the order in which they began."""


def device_of(device: Any) -> torch.device:
    """The device of a name.

    Raises:
        ValueError: there is none of this name, or not here.

    Example:
        >>> device_of("cpu")
        device(type='cpu')
    """
    try:
        named = torch.device(device)
        torch.empty(0, device=named)
    except (RuntimeError, AssertionError, TypeError, ValueError, OverflowError) as error:
        reason = str(error).partition("\n")[0][:120]
        raise ValueError(
            f"device is {device!r}, expected one that is here, such as 'cpu' ({reason})"
        ) from error
    return named


@contextmanager
def plain_torch() -> Iterator[None]:
    """Torch as a fresh process has it: new tensors in single precision, gradients recorded, neither
    inference mode nor autocast.

    A run then draws and computes the same numbers in anybody's process. The default dtype belongs
    to the whole process: it comes back in the end, but meanwhile other threads see this one.

    Example:
        >>> with torch.autocast("cpu"), torch.no_grad(), plain_torch():
        ...     torch.is_grad_enabled(), torch.is_autocast_enabled("cpu")
        (True, False)
    """
    dtype = torch.get_default_dtype()
    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if dtype != torch.float32:
            stack.callback(torch.set_default_dtype, dtype)
            torch.set_default_dtype(torch.float32)
        yield


@contextmanager
def given_back(settings: Settings) -> Iterator[None]:
    """In the end settings that belong to the whole process are as they were found.

    A run that ends while a later one, in another thread, goes on leaves them to that one, with
    the values to give back.

    Args:
        settings: what sets a setting -> its value before.

    Example:
        >>> threads = torch.get_num_threads()
        >>> with given_back({torch.set_num_threads: threads}):
        ...     torch.set_num_threads(threads + 1)
        >>> torch.get_num_threads() == threads
        True
    """
    with ONE_AT_A_TIME:
        _OPEN.append(settings)
    try:
        yield
    finally:
        with ONE_AT_A_TIME:
            place = next(i for i, other in enumerate(_OPEN) if other is settings)
            later = _OPEN[place + 1 :]
            del _OPEN[place]
            for set_back, value in settings.items():
                heir = next((other for other in later if set_back in other), None)
                if heir is None:
                    set_back(value)
                else:
                    heir[set_back] = value
