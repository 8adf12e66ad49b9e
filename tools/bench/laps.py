"""Where the time of a training goes: a stopwatch that modules, parameters and functions press as they are passed."""

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn


class Laps:
    """Adds the time since the last press to the part that was just finished.

    Args:
        device: a CUDA device is waited for at every press, so that its work is counted where it was asked for.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._cuda = torch.device(device).type == "cuda"
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def start(self) -> None:
        """Forget all laps; the next one begins now."""
        self.seconds.clear()
        self.press("")
        self.seconds.clear()

    def press(self, part: str) -> None:
        """Everything since the last press belongs to ``part``."""
        if self._cuda:
            torch.cuda.synchronize()
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now

    @contextlib.contextmanager
    def around(self, owner: Any, name: str, part: str, before: str) -> Iterator[None]:
        """Press before and after every call of a method, as long as the context is open.

        Args:
            owner: the object whose method it is; others of its class are left alone.
            name: of the method.
            part: what the call belongs to.
            before: what the time before the call belongs to.
        """
        method: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self.press(before)
            result = method(*args, **kwargs)
            self.press(part)
            return result

        owner.__dict__[name] = timed
        try:
            yield
        finally:
            del owner.__dict__[name]

    @contextlib.contextmanager
    def through(self, module: nn.Module, part: str, before: str, behind: str) -> Iterator[None]:
        """Press where a module begins and ends, forwards and backwards, as long as the context is open.

        Gradients arrive in the reverse order, so the one of a module's output ends what lies behind it, and those of
        its parameters end the module itself.

        Args:
            module: gives one tensor, or a tuple that begins with one.
            part: what the module belongs to.
            before: what the time before a call belongs to.
            behind: what lies between the module's output and the loss, up to the next module that is watched.
        """

        def begin(module: nn.Module, args: Any) -> None:
            self.press(before)

        def end(module: nn.Module, args: Any, out: Any) -> None:
            self.press(part)
            y: Tensor = out[0] if isinstance(out, tuple) else out
            if y.requires_grad:
                y.register_hook(lambda gradient: self.press(behind))

        hooks: list[Any] = [module.register_forward_pre_hook(begin), module.register_forward_hook(end)]
        trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
        hooks += [p.register_post_accumulate_grad_hook(lambda p: self.press(part)) for p in trained]
        try:
            yield
        finally:
            for hook in hooks:
                hook.remove()
