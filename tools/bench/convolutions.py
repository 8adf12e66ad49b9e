"""What the machine makes of the convolutions of an encoder alone: same shapes, same memory layout, nothing around."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Shape:
    """One convolution on one input.

    Attributes:
        module: the convolution.
        size: of its input, [N, C, H, W].
        first: whether its input needs no gradient.
        flops: floating-point operations of one pass forwards and backwards, a multiplication and an addition each.
    """

    module: nn.Conv2d
    size: torch.Size
    first: bool
    flops: int


def convolutions_of(encoder: nn.Module, frames: Tensor) -> list[Shape]:
    """The convolutions that an encoder runs on some frames.

    Args:
        encoder: with ``nn.Conv2d`` inside.
        frames: what it reads, uint8 [N, S, S, 3].
    """
    found: list[Shape] = []

    def note(module: nn.Module, args: tuple[Tensor], out: Tensor) -> None:
        assert isinstance(module, nn.Conv2d)
        products = out.numel() * module.weight[0].numel()
        found.append(Shape(module, args[0].shape, not found, 2 * products * (2 if not found else 3)))

    modules = [module for module in encoder.modules() if isinstance(module, nn.Conv2d)]
    hooks = [module.register_forward_hook(note) for module in modules]
    try:
        with torch.no_grad():
            encoder(frames)
    finally:
        for hook in hooks:
            hook.remove()
    return found


def plain_pass(shapes: list[Shape]) -> Callable[[], float]:
    """A function that runs the convolutions once, forwards and backwards, and returns the seconds it took.

    Args:
        shapes: from :func:`convolutions_of`.
    """
    prepared = [_prepare(shape) for shape in shapes]
    cuda = bool(shapes) and shapes[0].module.weight.is_cuda

    def work() -> float:
        seconds = 0.0
        for run in prepared:
            began = time.perf_counter()
            run()
            if cuda:
                torch.cuda.synchronize()
            seconds += time.perf_counter() - began
        return seconds

    return work


def _prepare(shape: Shape) -> Callable[[], Any]:
    conv = shape.module
    weight = conv.weight.detach()
    last = weight.is_contiguous(memory_format=torch.channels_last) and not weight.is_contiguous()
    layout = torch.channels_last if last else torch.contiguous_format
    x = torch.rand(shape.size, dtype=weight.dtype, device=weight.device).contiguous(memory_format=layout)
    bias = None if conv.bias is None else conv.bias.detach()
    stride, padding, dilation = conv.stride, cast(tuple[int, ...], conv.padding), conv.dilation

    def run() -> Any:
        out = torch.nn.functional.conv2d(x, weight, bias, stride, padding, dilation, conv.groups)
        sizes = None if bias is None else list(bias.shape)
        wanted = [not shape.first, True, bias is not None]
        return torch.ops.aten.convolution_backward(
            out, x, weight, sizes, stride, padding, dilation, False, [0, 0], conv.groups, wanted
        )

    return run
