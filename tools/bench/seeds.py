"""Frames per second of several seeds trained together, against the same seeds trained one after the other."""

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from arcade_torch.agents.presets import preset
from arcade_torch.agents.seed_trainer import SeedTrainer
from arcade_torch.agents.trainer import Trainer
from arcade_torch.tools.bench.timing import Measure, interleaved, no_check


@dataclass(frozen=True)
class SeedSpeed:
    """What so many seeds cost.

    Attributes:
        network: preset of network and learner.
        memory: name of the memory model.
        seeds: how many.
        together_fps: frames per second of all seeds together, in one process.
        alone_fps: frames per second of the same number of runs, one after the other.
        gain: the first by the second.
    """

    network: str
    memory: str
    seeds: int
    together_fps: float
    alone_fps: float
    gain: float


def bench_seeds(
    counts: Sequence[int] = (1, 2, 5),
    networks: Sequence[str] = ("small",),
    memories: Sequence[str] = ("mingru", "gru"),
    env: str = "MineSweeperEasy",
    device: str = "cpu",
    seconds: float = 5.0,
    repeats: int = 3,
    tell: Callable[[str], None] = lambda text: None,
) -> list[SeedSpeed]:
    """Time whole updates of PQN, collecting and learning, of groups and of a run alone, in turns.

    Args:
        counts: numbers of seeds.
        networks: presets, "small" (64 envs x 32 steps a seed) and "paper" (16 x 128).
        memories: names of memory models.
        env: game; its POMDP twin is played.
        device: of the network.
        seconds: time for each measure in each repeat; at least one update is made.
        repeats: turns; the median counts.
        tell: called with a line before each network.

    Returns:
        One result for every network, memory and number of seeds.

    Raises:
        ValueError: an unknown name, or a number that is not positive.
    """
    if not counts or min(counts) < 1:
        raise ValueError(f"the numbers of seeds must be 1 or more, got {list(counts)}")
    found = []
    for network, memory in itertools.product(networks, memories):
        config = preset(network, env=env, memory=memory, observability="partial", device=device)
        tell(f"{network} network, {memory}")
        with contextlib.ExitStack() as stack:
            alone = stack.enter_context(_closing(Trainer(config)))
            groups = {n: stack.enter_context(_closing(SeedTrainer(config, range(n)))) for n in counts}
            frames = config.pqn.frames_per_update
            measures = {"alone": Measure(alone.update, no_check, frames)}
            measures |= {str(n): Measure(group.update, no_check, n * frames) for n, group in groups.items()}
            rates = {name: measured.rate for name, measured in interleaved(measures, seconds, repeats, 1).items()}
        for n in counts:  # an update ends with reading its metrics, so a device has been waited for
            together, one = rates[str(n)], rates["alone"]
            found.append(SeedSpeed(network, memory, n, together, one, together / one))
    return found


@contextlib.contextmanager
def _closing(trainer: Any) -> Iterator[Any]:
    try:
        trainer.warm_up()
        yield trainer
    finally:
        trainer.close()


def as_rows(speeds: Sequence[SeedSpeed]) -> list[dict[str, Any]]:
    """Plain rows, for a file."""
    return [dataclasses.asdict(speed) for speed in speeds]
