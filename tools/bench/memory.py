"""Memory models over whole sequences beside their own loops and ``torch.nn.GRU``; the scans alone; saliency; costs."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from arcade_torch.models import fast_weights, lru, make_memory, matrix_scan_loop, memory_names, mingru
from arcade_torch.tools.bench.back_ends import bench_back_ends
from arcade_torch.tools.bench.harness import Measure, interleaved, peak_bytes, torch_threads
from arcade_torch.tools.bench.registry import BenchOptions
from arcade_torch.tools.bench.scans import RESETS, Run, bench_scans, both_passes, time_passes, unbind_loop

TORCH_GRU = "torch.nn.GRU"
"""It knows no starts and ignores them."""
ACTING_ENVS, MINIBATCH_STEPS = 16, 132
"""The paper's envs, and the steps of its minibatch of them all: 128 and 4 before them."""


def _matrix_loop(*args: Any) -> tuple[Tensor, Tensor]:
    out, states = matrix_scan_loop(*args)
    return out, states[:, -1]


LOOPS: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "lru": (lru, "linear_scan", unbind_loop),
    "mingru": (mingru, "linear_scan", unbind_loop),
    **{name: (fast_weights, "matrix_scan", _matrix_loop) for name in ("linear_transformer", "gdn", "ttt")},
}
"""Models that scan, and the plain loop over time in place of their scan: module, name, loop."""


@dataclass
class Options(BenchOptions):
    """Time and memory of the memory models, each scan beside its own loop and torch.nn.GRU; of the scans; of saliency.

    Measures take turns; the best turn counts. Peak memory is what torch's allocator had handed out in both passes above
    what stood before (weights and input), the same on every machine. With a CUDA device, a further table has the back
    ends of the scan there, as shares of the speed of a copy.

    Example: arcade-torch bench memory lru gru --steps 132 --layers 1 --out runs/memory.csv
    """

    memories: tuple[str, ...] = ()
    """Memory models; all of them by default."""
    steps: tuple[int, ...] = (132, 1024)
    """Lengths of the sequences."""
    layers: tuple[int, ...] = (1, 2)
    """Cells one above the other."""
    size: int = 512
    """Width of input and output."""
    batch: int = 16
    """Sequences."""
    frames: int = 64
    """Of the episode whose last decision saliency explains."""
    threads: int = 1
    """Of torch."""
    seconds: float = 0.3
    """For each measure in each repeat, at least one pass."""
    repeats: int = 3
    """Turns."""


SIZES: dict[str, dict[str, Any]] = {
    "tiny": {
        **{"memories": ("gru",), "steps": (8,), "layers": (1,), "size": 8, "batch": 2},
        **{"frames": 4, "seconds": 0.01, "repeats": 1},
    },
    "quick": {"steps": (132,), "layers": (1,), "seconds": 0.2, "repeats": 2},
    "full": {},
}


def run(options: Options, log: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the tables ``models``, ``scans``, ``saliency`` and, with CUDA, ``back_ends``."""
    batch, size, how = options.batch, options.size, (options.seconds, options.repeats)
    if min((1, *options.steps, *options.layers, size, batch, options.threads, options.frames)) < 1:
        raise ValueError("steps, layers, size, batch, frames and threads must be at least 1")
    with torch_threads(options.threads):
        for steps in options.steps:
            for layers in options.layers:
                log(f"memory models, T = {steps}, layers: {layers}")
                compared = forms(options.memories or memory_names(), layers, size)
                yield from (("models", row) for row in bench_models(compared, layers, (batch, steps, size), *how))
        for steps in options.steps:
            log(f"scans, T = {steps}")
            yield from (("scans", row) for row in bench_scans(batch, steps, size, *how))
        log("saliency")
        yield from (("saliency", row) for row in bench_saliency(options.frames, *how))
    if torch.cuda.is_available():
        log("back ends on CUDA")
        for row in bench_back_ends(torch.device("cuda"), options.steps, batch, size):
            yield "back_ends", row._asdict()


class Stack(nn.Module):
    """Cells one above the other and nothing between, from their initial states: what ``torch.nn.GRU`` does too."""

    def __init__(self, name: str, layers: int, size: int) -> None:
        super().__init__()
        self.cells = nn.ModuleList(make_memory(name, size, size) for _ in range(layers))

    def forward(self, x: Tensor, is_init: Tensor) -> Tensor:
        """[B, T, H] to [B, T, H]."""
        for cell in self.cells:
            x, _ = cell(x, cell.initial_state(len(x)), is_init)  # type: ignore[operator]
        return x


def forms(names: Sequence[str], layers: int, size: int) -> dict[tuple[str, str], Run]:
    """What is compared: (model, "scan", "loop", "torch" or "own") -> (x [B, T, H], is_init [B, T]) to y."""
    found: dict[tuple[str, str], Run] = {}
    for name in names:
        stack = Stack(name, layers, size)
        found[name, "scan" if name in LOOPS else "own"] = stack
        if name in LOOPS:
            found[name, "loop"] = patch.object(*LOOPS[name])(stack.forward)
    gru = nn.GRU(size, size, num_layers=layers, batch_first=True)
    found[TORCH_GRU, "torch"] = lambda x, is_init: gru(x)[0]
    return found


def _learn(y: Tensor) -> None:
    y.square().mean().backward()


def bench_models(
    compared: dict[tuple[str, str], Run], layers: int, shape: tuple[int, int, int], seconds: float, repeats: int
) -> Iterator[dict[str, Any]]:
    """Models over whole sequences [B, T, H] in turns, one row each."""
    inputs = (torch.randn(shape), torch.rand(shape[:2]) < RESETS)
    times = time_passes(compared, _learn, inputs, seconds, repeats)
    for (model, form), work in compared.items():
        peak = peak_bytes(both_passes(work, _learn, inputs)) / 2**20
        about = {"model": model, "form": form, "layers": layers, "steps": shape[1]}
        yield about | times[model, form] | {"peak_mib": peak}


def bench_saliency(frames: int, seconds: float, repeats: int) -> list[dict[str, Any]]:
    """Maps of one decision on the small network with LRU: two stages against the whole network action by action."""
    from arcade_torch.agents import preset
    from arcade_torch.agents.policy import build_network
    from arcade_torch.tools.analysis.pixel_saliency import saliency

    network: Any = build_network(preset("small", memory="lru")).eval()
    seen = torch.randint(0, 256, (frames, 128, 128, 3), dtype=torch.uint8)
    actions, starts = torch.randint(0, 5, (frames,)), torch.arange(frames) == 0

    def whole() -> Tensor:
        x = seen.float().requires_grad_()
        q, _ = network.remember(network.encode(x)[None], actions[None], starts[None], network.initial_state(1))
        rows = (torch.autograd.grad(value, x, retain_graph=True)[0].square().sum(-1) for value in q[0, -1])
        return sum(rows, torch.zeros(seen.shape[:3]))

    ways: dict[str, Callable[[], object]] = {
        "two stages": partial(saliency, network, seen, actions, starts),
        "whole network": whole,
    }
    found = interleaved({way: Measure(work) for way, work in ways.items()}, seconds, repeats, warm_ups=1)
    return [
        {"way": way, "frames": frames, "both_ms": found[way].best_ms, "peak_mib": peak_bytes(work) / 2**20}
        for way, work in ways.items()
    ]


class MemoryCost(NamedTuple):
    """What one cell needs, whatever the machine."""

    parameters: int
    state_numbers: int
    """Numbers in the recurrent state of one env."""
    state_bytes: int
    products: int
    """Multiply-adds in matrix products of one acting step (forward, one env); elementwise work is left out."""


def memory_cost(memory: nn.Module, input_size: int) -> MemoryCost:
    """Count what a memory model needs."""
    state = memory.initial_state(1)  # type: ignore[operator]
    leaves = list(state.values(True, True))
    like = next(memory.parameters())
    x, is_init = like.new_zeros(1, 1, input_size), torch.zeros(1, 1, dtype=torch.bool, device=like.device)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        memory(x, state, is_init)
    numbers, size_in_bytes = sum(leaf.numel() for leaf in leaves), sum(leaf.nbytes for leaf in leaves)
    return MemoryCost(
        sum(p.numel() for p in memory.parameters()), numbers, size_in_bytes, counter.get_total_flops() // 2
    )


def time_memories(
    names: Sequence[str], size: int, *, seconds: float = 0.3, repeats: int = 3
) -> dict[str, tuple[float, float]]:
    """Microseconds of one cell for one step of one env, on one thread: acting (16 envs), learning (16 x 132 steps)."""
    cells = {}
    for name in names:
        memory = make_memory(name, size, size)
        state = memory.initial_state(ACTING_ENVS)  # type: ignore[operator]
        cells[name] = lambda x, is_init, memory=memory, state=state: memory(x, state, is_init)[0]
    found = []
    with torch_threads(1):
        for steps in (1, MINIBATCH_STEPS):
            inputs = (torch.randn(ACTING_ENVS, steps, size), torch.rand(ACTING_ENVS, steps) < RESETS)
            found.append(time_passes(cells, _learn, inputs, seconds, repeats))
    acting, learning = found
    act, learn = 1e3 / ACTING_ENVS, 1e3 / (ACTING_ENVS * MINIBATCH_STEPS)
    return {name: (act * acting[name]["forward_ms"], learn * learning[name]["both_ms"]) for name in names}
