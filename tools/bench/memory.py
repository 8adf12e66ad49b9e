"""Memory models over whole sequences beside their own loops and ``torch.nn.GRU``; the scans alone;
saliency; costs.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from arcade_torch.models import linear_scan, make_memory, memory_names
from arcade_torch.models.scan import back_end
from arcade_torch.models.scan_triton import runs_triton
from arcade_torch.tools.bench.harness import Measure, interleaved
from arcade_torch.tools.bench.loops import LOOPS, unbind_loop
from arcade_torch.tools.bench.registry import BenchOptions
from arcade_torch.tools.machine import torch_threads
from arcade_torch.tools.options import at_least

TORCH_GRU = "torch.nn.GRU"
"""It knows no starts and ignores them."""
LOOP = "loop over unbind"
COPY = "copy of as many bytes"
# tensors [B, T, H] that a scan has to read or write
FORWARD_TENSORS = 3  # a, b, h
BACKWARD_TENSORS = 5  # a, h, the gradients of h, a and b
RESETS = 0.02
"""Share of the steps that open an episode."""
QUEUED = 10
"""Passes on a card between two looks at the clock, so that the device is timed and not the
launches.
"""
ACTING_ENVS = 16  # the paper's
MINIBATCH_STEPS = 132  # the paper's: 128, and 4 before them

Run = Callable[..., Tensor]
Key = TypeVar("Key")
T = TypeVar("T")


@dataclass
class Options(BenchOptions):
    """Time of the memory models, each scan beside its own loop and torch.nn.GRU; of the scans; and
    of saliency.

    Measures take turns; the best turn counts. The scans stand beside a copy of the bytes that they
    have to read and write, the least that any form of them could take.

    Example: arcade-torch bench memory lru gru --steps 132 --layers 1 --out runs/memory.csv
    """

    memories: tuple[str, ...] = ()
    """Memory models, which may stand first without this word; all of them by default."""
    steps: tuple[int, ...] = (132, 1024)  # Lengths of the sequences.
    layers: tuple[int, ...] = (1, 2)  # Cells one above the other.
    size: int = 512  # Width of input and output.
    batch: int = 16  # Sequences.
    frames: int = 64  # Of the episode whose last decision saliency explains.
    device: str = "cpu"  # Torch device.
    threads: int = 1  # Of torch.
    seconds: float = 0.3  # For each measure in each repeat, at least one pass.
    repeats: int = 3  # Turns.


def run(options: Options, log: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the tables ``models``, ``scans`` and ``saliency``."""
    batch = options.batch
    size = options.size
    at_least(options, steps=1, layers=1, size=1, batch=1, frames=1, threads=1, repeats=1)
    on_card = options.device.startswith("cuda") and torch.cuda.is_available()
    if options.device != "cpu" and not on_card:
        raise ValueError(
            f"device must be cpu, or cuda where torch finds a card, got {options.device!r}"
        )
    device = torch.device(options.device)
    timing = (options.seconds, options.repeats)
    with torch_threads(options.threads):
        for steps, layers in product(options.steps, options.layers):
            log(f"memory models, T = {steps}, layers: {layers}")
            compared = forms(options.memories or memory_names(), layers, size, device)
            inputs = (
                torch.randn(batch, steps, size, device=device),
                torch.rand(batch, steps, device=device) < RESETS,
            )
            for (model, form), measured in time_passes(compared, _learn, inputs, *timing).items():
                about = {"model": model, "form": form, "layers": layers, "steps": steps}
                yield "models", about | measured
        for steps in options.steps:
            log(f"scans, T = {steps}")
            for row in bench_scans(batch, steps, size, device, *timing):
                yield "scans", row
        log("saliency")
        for row in bench_saliency(options.frames, device, *timing):
            yield "saliency", row


def forms(
    names: Sequence[str], layers: int, size: int, device: torch.device | str = "cpu"
) -> dict[tuple[str, str], Run]:
    """What is compared: (model, "scan", "loop", "torch" or "own") -> (x [B, T, H], is_init [B, T])
    to y.

    A model is a number of cells one above the other and nothing between, as in ``torch.nn.GRU``.
    """

    compared: dict[tuple[str, str], Run] = {}
    for name in names:
        cells = _cells(partial(make_memory, name), layers, size, device)
        compared[name, "scan" if name in LOOPS else "own"] = partial(_through, cells)
        if name in LOOPS:
            loops = _cells(LOOPS[name], layers, size, device)
            loops.load_state_dict(cells.state_dict())
            compared[name, "loop"] = partial(_through, loops)
    gru = nn.GRU(size, size, num_layers=layers, batch_first=True).to(device)
    compared[TORCH_GRU, "torch"] = lambda x, is_init: gru(x)[0]
    return compared


def _cells(
    make: Callable[[int, int], nn.Module], layers: int, size: int, device: torch.device | str
) -> nn.ModuleList:
    """Cells of one model, as wide as they are told."""
    cells = [make(size, size) for _ in range(layers)]
    return nn.ModuleList(cells).to(device)


def _through(cells: Iterable[Any], x: Tensor, is_init: Tensor) -> Tensor:
    """The output of the last of some cells one above the other."""
    for cell in cells:
        x, _ = cell(x, cell.initial_state(len(x)), is_init)
    return x


def _repeated(work: Callable[[], object], device: torch.device) -> Measure:
    """A measure of some work; on a card of several passes in a row."""
    count = QUEUED if device.type == "cuda" else 1
    return Measure(lambda: [work() for _ in range(count)][-1], units=count)


def time_passes(
    runs: Mapping[Key, Run],
    backward: Callable[[Tensor], None],
    inputs: tuple[Tensor, ...],
    seconds: float,
    repeats: int,
    around: Callable[[Key, Callable[[], object]], Callable[[], object]] = lambda key, work: work,
) -> dict[Key, dict[str, float]]:
    """Best milliseconds of the forward pass alone and of both passes, measured in turns, each
    inside ``around``.
    """
    leaves = [x.clone().requires_grad_(x.dtype != torch.bool) for x in inputs]
    measures = dict[str, Measure]()

    def both(run: Run) -> None:
        for leaf in leaves:
            leaf.grad = None
        backward(run(*leaves))

    for key, run in runs.items():
        for part, work in (
            ("forward", torch.no_grad()(partial(run, *inputs))),
            ("both", partial(both, run)),
        ):
            measures[f"{key} {part}"] = _repeated(around(key, work), inputs[0].device)
    measured = interleaved(measures, seconds, repeats, warm_ups=1)
    return {
        key: {f"{part}_ms": measured[f"{key} {part}"].best_ms for part in ("forward", "both")}
        for key in runs
    }


def _learn(y: Tensor) -> None:
    y.square().mean().backward()


def scan_forms(device: torch.device) -> tuple[str, ...]:
    """Ways to solve h_t = a_t h_{t-1} + b_t: the back ends for the device, and a loop under
    autograd.
    """
    if device.type != "cuda":
        return "serial", "doubling", LOOP
    if runs_triton(torch.empty(0, device=device)):
        return "triton", "doubling", LOOP
    return "doubling", LOOP


def solve(form: str, work: Callable[[], T]) -> Callable[[], T]:
    """Some work whose scans are solved by a back end of that name."""
    return work if form == LOOP else back_end(form)(work)


def bench_scans(
    batch: int, steps: int, size: int, device: torch.device, seconds: float, repeats: int
) -> Iterator[dict[str, Any]]:
    """Every form in turns, one row each, real and complex, from zeros, starts folded in as a_t = 0;
    then a copy.
    """
    doubles = {torch.float32: torch.float64, torch.complex64: torch.complex128}
    for numbers, (dtype, exact) in zip(("real", "complex"), doubles.items(), strict=True):
        a = torch.randn(batch, steps, size, dtype=dtype, device=device)
        b = torch.randn(batch, steps, size, dtype=dtype, device=device)
        a = a / a.abs().clamp_min(1e-3) * torch.rand(batch, steps, size, device=device)
        a[torch.rand(batch, steps, device=device) < RESETS] = 0
        compared: dict[str, Run] = {
            name: unbind_loop if name == LOOP else linear_scan for name in scan_forms(device)
        }
        backward = partial(Tensor.backward, gradient=torch.randn_like(b))
        right = linear_scan(a.to(exact), b.to(exact))
        times = time_passes(compared, backward, (a, b), seconds, repeats, solve)
        for name, form in compared.items():
            error = float((solve(name, partial(form, a, b))() - right).abs().max())
            about = {"form": name, "steps": steps, "numbers": numbers}
            yield about | times[name] | {"error": error}
        # a copy reads and writes
        forward = FORWARD_TENSORS * b.numel() // 2
        both = (FORWARD_TENSORS + BACKWARD_TENSORS) * b.numel() // 2
        source = torch.zeros(both, dtype=dtype, device=device)
        target = torch.zeros(both, dtype=dtype, device=device)
        copies = {
            "forward_ms": _repeated(partial(target[:forward].copy_, source[:forward]), device),
            "both_ms": _repeated(partial(target.copy_, source), device),
        }
        measured = interleaved(copies, seconds, repeats)
        least = {name: result.best_ms for name, result in measured.items()}
        yield {"form": COPY, "steps": steps, "numbers": numbers} | least | {"error": 0.0}


def bench_saliency(
    frames: int, device: torch.device, seconds: float, repeats: int
) -> list[dict[str, Any]]:
    """Maps of one decision on the small network with LRU: two stages against the whole network
    action by action.
    """
    from arcade_torch.agents import preset
    from arcade_torch.agents.policy import build_network
    from arcade_torch.tools.measures.saliency.measure import saliency

    network: Any = build_network(preset("small", memory="lru", device=str(device))).eval()
    seen = torch.randint(0, 256, (frames, 128, 128, 3), dtype=torch.uint8, device=device)
    actions = torch.randint(0, 5, (frames,), device=device)
    starts = torch.arange(frames, device=device) == 0

    def whole() -> None:
        x = seen.float().requires_grad_()
        q, _ = network.remember(
            network.encode(x)[None], actions[None], starts[None], network.initial_state(1)
        )
        for value in q[0, -1]:
            torch.autograd.grad(value, x, retain_graph=True)[0].square().sum(-1)

    ways = {
        "two stages": Measure(partial(saliency, network, seen, actions, starts)),
        "whole network": Measure(whole),
    }
    measured = interleaved(ways, seconds, repeats, warm_ups=1)
    return [{"way": way, "frames": frames, "both_ms": measured[way].best_ms} for way in ways]


class MemoryCost(NamedTuple):
    """What one cell needs, whatever the machine."""

    parameters: int
    state_numbers: int  # numbers in the recurrent state of one env
    state_bytes: int
    products: int
    """Multiply-adds in matrix products of one acting step (forward, one env); elementwise work is
    left out.
    """


def memory_cost(memory: nn.Module, input_size: int) -> MemoryCost:
    """Count what a memory model needs."""
    state = memory.initial_state(1)  # type: ignore[operator]
    leaves = list(state.values(True, True))
    weight = next(memory.parameters(), torch.zeros(()))
    x = weight.new_zeros(1, 1, input_size)
    is_init = torch.zeros(1, 1, dtype=torch.bool, device=weight.device)
    with (
        warnings.catch_warnings(action="ignore"),  # mkldnn warns of GPUs that are not there
        torch.backends.mkldnn.flags(enabled=False),  # whose kernels of nn.LSTM count nothing
        FlopCounterMode(display=False) as counter,
        torch.no_grad(),
    ):
        memory(x, state, is_init)
    return MemoryCost(
        parameters=sum(p.numel() for p in memory.parameters()),
        state_numbers=sum(leaf.numel() for leaf in leaves),
        state_bytes=sum(leaf.nbytes for leaf in leaves),
        products=counter.get_total_flops() // 2,
    )


def time_memories(
    names: Sequence[str], size: int, *, seconds: float = 0.3, repeats: int = 3
) -> dict[str, tuple[float, float]]:
    """Microseconds of one cell for one step of one env, on one thread: acting (16 envs), learning
    (16 x 132 steps).
    """
    cells = {}
    for name in names:
        memory = make_memory(name, size, size)
        state = memory.initial_state(ACTING_ENVS)  # type: ignore[operator]
        cells[name] = lambda x, is_init, memory=memory, state=state: memory(x, state, is_init)[0]
    measured = []
    with torch_threads(1):
        for steps in (1, MINIBATCH_STEPS):
            inputs = (
                torch.randn(ACTING_ENVS, steps, size),
                torch.rand(ACTING_ENVS, steps) < RESETS,
            )
            measured.append(time_passes(cells, _learn, inputs, seconds, repeats))
    acting, learning = measured
    act = 1e3 / ACTING_ENVS
    learn = 1e3 / (ACTING_ENVS * MINIBATCH_STEPS)
    return {
        name: (act * acting[name]["forward_ms"], learn * learning[name]["both_ms"])
        for name in names
    }
