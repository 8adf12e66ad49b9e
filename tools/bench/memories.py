"""What a memory model costs: parameters, state, arithmetic of a step, and time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import nn

from arcade_torch.tools.bench.harness import Measure, interleaved, no_check, torch_threads

__all__ = ["MemoryCost", "MemoryTime", "memory_cost", "time_memories"]

BATCH, STEPS = 16, 132  # the paper's minibatch of all its envs: 128 steps and 4 before them


@dataclass(frozen=True)
class MemoryCost:
    """What one cell needs, whatever the machine."""

    parameters: int
    state_numbers: int
    """numbers in the recurrent state of one env"""
    state_bytes: int
    products: int
    """multiply-adds in matrix products of one acting step (forward, one env); elementwise work is left out"""


@dataclass(frozen=True)
class MemoryTime:
    """How long one cell takes on this machine, in microseconds for one step of one env."""

    acting: float
    """forward, one step at a time, 16 envs together"""
    learning: float
    """forward and backward, 16 sequences of 132 steps"""


def memory_cost(memory: nn.Module, input_size: int) -> MemoryCost:
    """Count what a memory model needs."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    state = memory.initial_state(1)  # type: ignore[operator]
    leaves = list(state.values(True, True))
    like = next(memory.parameters())
    x, is_init = like.new_zeros(1, 1, input_size), torch.zeros(1, 1, dtype=torch.bool, device=like.device)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        memory(x, state, is_init)
    return MemoryCost(
        parameters=sum(p.numel() for p in memory.parameters()),
        state_numbers=sum(leaf.numel() for leaf in leaves),
        state_bytes=sum(leaf.nbytes for leaf in leaves),
        products=counter.get_total_flops() // 2,
    )


def time_memories(names: Sequence[str], size: int, *, seconds: float = 0.3, repeats: int = 5) -> dict[str, MemoryTime]:
    """Time memory models in turns, on one thread, so that a slow minute of the machine hits all of them."""
    measures = {}
    with torch_threads(1):
        for name in names:
            measures[f"act {name}"] = Measure(_work(name, size, 1, False), no_check, BATCH)
            measures[f"learn {name}"] = Measure(_work(name, size, STEPS, True), no_check, BATCH * STEPS)
        found = interleaved(measures, seconds, repeats)
    best = {key: 1e6 / max(measured.rates) for key, measured in found.items()}
    return {name: MemoryTime(best[f"act {name}"], best[f"learn {name}"]) for name in names}


def _work(name: str, size: int, steps: int, learn: bool) -> Callable[[], object]:
    """A function that acts one step or learns from one batch."""
    import torch

    from arcade_torch.models import make_memory

    memory = make_memory(name, size, size)
    x, is_init = torch.randn(BATCH, steps, size), torch.rand(BATCH, steps) < 0.02
    x.requires_grad_(learn)
    state = memory.initial_state(BATCH)  # type: ignore[operator]

    def work() -> object:
        with torch.set_grad_enabled(learn):
            y, _ = memory(x, state, is_init)
            if learn:
                y.square().mean().backward()
        return y

    return work
