"""What a saliency map costs: the two stages against differentiating the whole network, one action after the other.

An episode of random pixels is enough: the time does not depend on what is seen. All ways give the same maps, which is
checked in the same run.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from arcade_torch.agents import preset
from arcade_torch.agents.agent import build_network
from arcade_torch.tools.analysis.pixel_saliency import saliency
from arcade_torch.tools.bench.memory import peak_bytes
from arcade_torch.tools.bench.timing import torch_threads

NETWORKS = ("small", "paper")


@dataclass(frozen=True)
class SaliencyRow:
    """One way on one network.

    Attributes:
        network: preset of the network.
        way: how the maps were made.
        seconds: for all maps of the episode, the fastest turn.
        ratio: seconds of the two stages divided into these, in the same run.
        peak_mib: most memory that torch's allocator had handed out at once.
        difference: largest difference to the two stages, as a share of the largest value.
    """

    network: str
    way: str
    seconds: float
    ratio: float
    peak_mib: float
    difference: float


def bench_saliency(
    networks: Sequence[str] = NETWORKS,
    memory: str = "lru",
    steps: int = 128,
    chunk: int = 8,
    repeats: int = 3,
    threads: int = 1,
    tell: Callable[[str], None] = lambda _: None,
) -> Iterator[SaliencyRow]:
    """Measure every way, in turns, network by network.

    Args:
        networks: presets with a network each.
        memory: memory model.
        steps: frames of the episode; the decision at the last one is explained.
        chunk: frames pushed through the encoder at once by the two stages.
        repeats: turns.
        threads: of torch.
        tell: is told what is being measured.

    Yields:
        Rows; that of the two stages comes first.
    """
    with torch_threads(threads):
        for name in networks:
            tell(name)
            yield from _measure(name, _ways(name, memory, steps, chunk), repeats)


def _measure(name: str, ways: dict[str, Callable[[], Tensor]], repeats: int) -> Iterator[SaliencyRow]:
    best = dict.fromkeys(ways, float("inf"))
    maps: dict[str, Tensor] = {}
    for _ in range(repeats):
        for way, work in ways.items():
            start = time.perf_counter()
            maps[way] = work()
            best[way] = min(best[way], time.perf_counter() - start)
    ours = next(iter(ways))
    for way, work in ways.items():
        difference = float((maps[way] - maps[ours]).abs().max() / maps[ours].abs().max())
        yield SaliencyRow(name, way, best[way], best[way] / best[ours], peak_bytes(work) / 2**20, difference)


def _ways(name: str, memory: str, steps: int, chunk: int) -> dict[str, Callable[[], Tensor]]:
    """Name -> function that gives the maps [T, H, W] of one episode."""
    network = build_network(preset(name, memory=memory)).eval()
    draw = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (steps, 128, 128, 3), dtype=torch.uint8, generator=draw)
    last_action = torch.randint(0, 5, (steps,), generator=draw)
    is_init = torch.arange(steps) == 0

    def forward(x: Tensor) -> Tensor:
        features = network.encode(x)
        q, _ = network.remember(features[None], last_action[None], is_init[None], network.initial_state(1))
        return q[0, -1]

    def end_to_end(passes: int) -> Tensor:
        maps = torch.zeros(frames.shape[:-1])
        x = frames.float().requires_grad_()
        q = forward(x)
        for action in range(len(q)):
            if action and passes > 1:
                q = forward(x)
            (gradient,) = torch.autograd.grad(q[action], x, retain_graph=passes == 1)
            maps += gradient.square().sum(-1)
        return maps

    def as_usually_written() -> Tensor:
        maps = torch.zeros(frames.shape[:-1])
        for action in range(5):
            x = frames.float().requires_grad_()
            forward(x)[action].backward()
            assert x.grad is not None
            maps += x.grad.square().sum(-1)
        network.zero_grad()
        return maps

    def two_stages() -> Tensor:
        return torch.from_numpy(saliency(network, frames, last_action, is_init, chunk=chunk).maps)

    return {
        f"two stages, {chunk} frames at once": two_stages,
        "end to end, q[a].backward() for each action, weights too": as_usually_written,
        "end to end, forward and backward for each action": lambda: end_to_end(5),
        "end to end, one forward, backward for each action": lambda: end_to_end(1),
    }
