"""What a saliency map costs: the two stages against differentiating the whole network, one action after the other.

An episode of random pixels is enough: the time does not depend on what is seen. All ways give the same maps, which is
checked in the same run. The paper's network is also differentiated as its table is written, without what
:class:`PaperEncoder` does to be fast: that is what maps cost whoever builds it from torch's layers.
"""

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from arcade_torch.agents import preset
from arcade_torch.agents.agent import build_network
from arcade_torch.models.encoders import Encoder, PaperEncoder
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.tools.analysis.pixel_saliency import saliency
from arcade_torch.tools.analysis.policy import Encode
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


@dataclass(frozen=True)
class _Episode:
    """A network and what it saw; each method makes the maps [T, H, W] of the last decision, all actions summed."""

    network: MemoryNetwork
    frames: Tensor
    last_action: Tensor
    is_init: Tensor

    @classmethod
    def random(cls, name: str, memory: str, steps: int) -> "_Episode":
        network = build_network(preset(name, memory=memory)).eval()
        assert isinstance(network, MemoryNetwork)
        draw = torch.Generator().manual_seed(0)
        frames = torch.randint(0, 256, (steps, 128, 128, 3), dtype=torch.uint8, generator=draw)
        return cls(network, frames, torch.randint(0, 5, (steps,), generator=draw), torch.arange(steps) == 0)

    def two_stages(self, chunk: int) -> Tensor:
        return torch.from_numpy(saliency(self.network, self.frames, self.last_action, self.is_init, chunk=chunk).maps)

    def backward_each(self, encode: Encode) -> Tensor:
        maps = torch.zeros(self.frames.shape[:-1])
        for action in range(5):
            x = self.frames.float().requires_grad_()
            self._values(x, encode)[action].backward()
            assert x.grad is not None
            maps += x.grad.square().sum(-1)
        self.network.zero_grad()
        return maps

    def gradients_only(self, encode: Encode, keep_forward: bool) -> Tensor:
        maps = torch.zeros(self.frames.shape[:-1])
        x = self.frames.float().requires_grad_()
        q = self._values(x, encode)
        for action in range(len(q)):
            if action and not keep_forward:
                q = self._values(x, encode)
            (gradient,) = torch.autograd.grad(q[action], x, retain_graph=keep_forward)
            maps += gradient.square().sum(-1)
        return maps

    def _values(self, x: Tensor, encode: Encode) -> Tensor:
        start = self.network.initial_state(1)
        q, _ = self.network.remember(encode(x)[None], self.last_action[None], self.is_init[None], start)
        return q[0, -1]


def _ways(network: str, memory: str, steps: int, chunk: int) -> dict[str, Callable[[], Tensor]]:
    """Name -> function that gives the maps [T, H, W] of one episode."""
    episode = _Episode.random(network, memory, steps)
    ours, table = episode.network.encode, written_out(episode.network.encoder)
    ways: dict[str, Callable[[], Tensor]] = {f"two stages, {chunk} frames at once": partial(episode.two_stages, chunk)}
    for name, encode in {"end to end": ours, "table's layers": table}.items():
        if encode is not None:
            ways |= {
                f"{name}, q[a].backward() for each action, weights too": partial(episode.backward_each, encode),
                f"{name}, forward and backward for each action": partial(episode.gradients_only, encode, False),
                f"{name}, one forward, backward for each action": partial(episode.gradients_only, encode, True),
            }
    return ways


def written_out(encoder: Encoder) -> Encode | None:
    """The paper's encoder as its table has it, with the same weights: convolution, LeakyReLU, pool, channels first.

    Args:
        encoder: of a network.

    Returns:
        Frames float [N, S, S, 3] to features [N, 512], or None if the encoder is not the paper's.
    """
    if not isinstance(encoder, PaperEncoder):
        return None
    layers: list[nn.Module] = []
    for layer in copy.deepcopy(encoder.layers).to(memory_format=torch.contiguous_format):  # type: ignore[call-overload]
        behind_pool = isinstance(layer, nn.LeakyReLU) and isinstance(layers[-1], nn.MaxPool2d)
        layers.insert(len(layers) - behind_pool, layer)
    net = nn.Sequential(*layers)
    return lambda x: net(x.permute(0, 3, 1, 2).contiguous() / 255).flatten(1)
