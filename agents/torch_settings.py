"""The settings of torch that a run computes under, whatever the process or the caller has set, and
the device that somebody names.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

__all__ = ["device_of", "plain_torch"]


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
