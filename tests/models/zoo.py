"""What the tests of single memory models share."""

import itertools

import torch
from torch import Tensor, nn

F64 = torch.float64


def starts(*rows: tuple[int, ...], length: int) -> Tensor:
    """Start flags bool [B, T], one tuple of steps a row."""
    flags = torch.zeros(len(rows), length, dtype=torch.bool)
    for row, steps in enumerate(rows):
        flags[row, list(steps)] = True
    return flags


def episodes(flags: Tensor) -> list[tuple[int, int, int]]:
    """(row, first step, last step + 1) of the episodes in start flags."""
    parts = []
    for row, marks in enumerate(flags):
        borders = sorted({0, *marks.nonzero().flatten().tolist(), len(marks)})
        for begin, end in itertools.pairwise(borders):
            parts.append((row, begin, end))
    return parts


def assert_each_episode(memory: nn.Module, oracle: object, tolerance: float = 1e-10) -> None:
    """``memory`` over two rows with starts gives what ``oracle(x [T, D]) -> y [T, H]`` gives on
    each episode alone.
    """
    size = next(memory.parameters())
    x = torch.randn(2, 13, memory.input_size, dtype=size.dtype)
    flags = starts((0, 5), (9,), length=13)
    with torch.no_grad():
        y, _ = memory(x, memory.initial_state(2), flags)
        for row, begin, end in episodes(flags):
            wanted = oracle(x[row, begin:end])  # type: ignore[operator]
            torch.testing.assert_close(y[row, begin:end], wanted, rtol=tolerance, atol=tolerance)


@torch.no_grad()
def pinned_pass(memory: nn.Module) -> Tensor:
    """y [3, 2] of a memory of width 2 whose parameters and inputs are sines and cosines."""
    memory = memory.double()
    for number, parameter in enumerate(memory.parameters(), 1):
        places = torch.arange(parameter.numel(), dtype=F64)
        parameter.copy_(torch.sin(number + places).view_as(parameter))
    x = torch.cos(torch.arange(6, dtype=F64)).view(1, 3, 2)
    y, _ = memory(x, memory.initial_state(1), torch.zeros(1, 3, dtype=torch.bool))
    return y[0]  # type: ignore[no-any-return]
