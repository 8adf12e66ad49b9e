"""Memory models over whole sequences: time and memory of every scan beside its own loop and ``torch.nn.GRU``."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile

from arcade_torch.models import fast_weights, lru, make_memory, matrix_scan_loop, mingru
from arcade_torch.tools.bench.scans import unbind_loop
from arcade_torch.tools.bench.timing import Measure, interleaved, no_check, torch_threads

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
    **{name: (fast_weights, "matrix_scan", _matrix_loop) for name in ("fart", "gdn", "ttt")},
}
"""Models that scan, and the plain loop over time in place of their scan: module, name, loop."""


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


def peak_bytes(work: Callable[[], object]) -> int:
    """Most bytes that torch's CPU allocator handed out at a time while ``work`` ran, above what stood before.

    Read from the memory events of torch's profiler: exact and the same on every machine, whatever else runs. Scratch
    space inside a matrix library is not in it.
    """
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        work()
    events = [event for event in run.profiler.kineto_results.events() if event.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    held = most = 0
    for event in events:
        held += event.nbytes()
        most = max(most, held)
    return most


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
    """Measure models over whole sequences, in turns.

    Args:
        names: of the models.
        steps: lengths T.
        layers: numbers of cells.
        size: D and H.
        batch: B.
        threads: of torch.
        seconds: for each measure in each repeat, at least one pass.
        repeats: turns; the best counts.
        tell: called with a line before each configuration.

    Yields:
        A row a model, form, number of layers and length.
    """
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
