"""Memory models over whole sequences beside their own loops and ``torch.nn.GRU``; the scans alone; saliency."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from arcade_torch.models import fast_weights, lru, make_memory, matrix_scan_loop, memory_names, mingru
from arcade_torch.tools.bench.back_ends import bench_back_ends
from arcade_torch.tools.bench.harness import Measure, interleaved, no_check, peak_bytes, torch_threads
from arcade_torch.tools.bench.scans import bench_scans, unbind_loop

TORCH_GRU = "torch.nn.GRU"
RESETS = 0.02
"""Share of the steps that open an episode (``torch.nn.GRU`` knows no starts and ignores them)."""

Runs = Callable[[Tensor, Tensor], Tensor]


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
class Options:
    """Time and memory of the memory models, each scan beside its own loop and torch.nn.GRU; of the scans; of saliency.

    Measures take turns; the best turn counts. Peak memory is what torch's allocator had handed out, the same on every
    machine. With a CUDA device, a further table has the back ends of the scan there, as shares of the speed of a copy.

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
    out: Path | None = None
    """File for the numbers: .json, or .csv with the name of the table added; overwritten."""


SIZES: dict[str, dict[str, Any]] = {
    "tiny": {
        **{"memories": ("gru",), "steps": (8,), "layers": (1,), "size": 8, "batch": 2},
        **{"frames": 4, "seconds": 0.01, "repeats": 1},
    },
    "quick": {"steps": (132,), "layers": (1,), "seconds": 0.2, "repeats": 2},
    "full": {},
}


def run(options: Options, tell: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the tables ``models``, ``scans``, ``saliency`` and, with CUDA, ``back_ends``."""
    if min((1, *options.steps, *options.layers, options.size, options.batch, options.threads, options.frames)) < 1:
        raise ValueError("steps, layers, size, batch, frames and threads must be at least 1")
    how: dict[str, Any] = {"threads": options.threads, "seconds": options.seconds, "repeats": options.repeats}
    names = options.memories or tuple(memory_names())
    for row in bench_memory(names, options.steps, options.layers, options.size, options.batch, tell=tell, **how):
        yield "models", asdict(row)
    for scan in bench_scans(options.steps, options.batch, options.size, tell=tell, **how):
        yield "scans", asdict(scan)
    tell("saliency")
    with torch_threads(options.threads):
        yield from (("saliency", row) for row in bench_saliency(options.frames, options.seconds, options.repeats))
    if torch.cuda.is_available():
        for back_end in bench_back_ends(torch.device("cuda"), options.steps, options.batch, options.size, tell=tell):
            yield "back_ends", asdict(back_end)


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
    found = interleaved({way: Measure(work, no_check, 1) for way, work in ways.items()}, seconds, repeats, warm_ups=1)
    return [
        {"way": way, "frames": frames, "both_ms": 1e3 / max(found[way].rates), "peak_mib": peak_bytes(work) / 2**20}
        for way, work in ways.items()
    ]


@dataclass(frozen=True)
class Row:
    """What one model costs over a whole sequence.

    Attributes:
        model: name.
        form: "scan" or "loop" for models that have both, "torch" for ``torch.nn.GRU``, else "own".
        layers: cells one above the other.
        steps: T.
        forward_ms: milliseconds of the forward pass alone, best turn.
        both_ms: of forward and backward pass.
        peak_mib: most memory that torch's allocator had handed out at a time in both passes, above what stood before
            (weights and input), MiB; see `peak_bytes`.
    """

    model: str
    form: str
    layers: int
    steps: int
    forward_ms: float
    both_ms: float
    peak_mib: float


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


@contextmanager
def looped(name: str) -> Iterator[None]:
    """Inside, the model's scan is its plain loop."""
    module, attribute, loop = LOOPS[name]
    scan = getattr(module, attribute)
    setattr(module, attribute, loop)
    try:
        yield
    finally:
        setattr(module, attribute, scan)


def forms(names: Sequence[str], layers: int, size: int) -> dict[tuple[str, str], Runs]:
    """What is compared: (model, form) -> (x [B, T, H], is_init [B, T]) to y."""
    found: dict[tuple[str, str], Runs] = {}
    for name in names:
        stack = Stack(name, layers, size)
        found[name, "scan" if name in LOOPS else "own"] = stack
        if name in LOOPS:
            found[name, "loop"] = _in_a_loop(name, stack)
    gru = nn.GRU(size, size, num_layers=layers, batch_first=True)
    found[TORCH_GRU, "torch"] = lambda x, is_init: gru(x)[0]
    return found


def _in_a_loop(name: str, stack: Stack) -> Runs:
    def run(x: Tensor, is_init: Tensor) -> Tensor:
        with looped(name):
            y: Tensor = stack(x, is_init)
            return y

    return run


def bench_memory(
    names: Sequence[str],
    steps: Sequence[int] = (132, 1024),
    layers: Sequence[int] = (1, 2),
    size: int = 512,
    batch: int = 16,
    *,
    threads: int = 1,
    seconds: float = 0.3,
    repeats: int = 3,
    tell: Callable[[str], None] = lambda text: None,
) -> Iterator[Row]:
    """Measure models over whole sequences, in turns."""
    with torch_threads(threads):
        for length in steps:
            x, is_init = torch.randn(batch, length, size), torch.rand(batch, length) < RESETS
            for count in layers:
                tell(f"memory models, T = {length}, layers: {count}")
                compared = forms(names, count, size)
                measures = {}
                for key, run in compared.items():
                    measures[f"{key} forward"] = Measure(_forward(run, x, is_init), no_check, 1)
                    measures[f"{key} both"] = Measure(_both(run, x, is_init), no_check, 1)
                found = interleaved(measures, seconds, repeats, warm_ups=1)
                best = {key: 1e3 / max(measured.rates) for key, measured in found.items()}
                for key, run in compared.items():
                    peak = peak_bytes(_both(run, x, is_init)) / 2**20
                    yield Row(*key, count, length, best[f"{key} forward"], best[f"{key} both"], peak)


def _forward(run: Runs, x: Tensor, is_init: Tensor) -> Callable[[], object]:
    @torch.no_grad()
    def work() -> object:
        return run(x, is_init)

    return work


def _both(run: Runs, x: Tensor, is_init: Tensor) -> Callable[[], object]:
    x = x.clone().requires_grad_()

    def work() -> object:
        x.grad = None
        run(x, is_init).square().mean().backward()
        return x.grad

    return work
