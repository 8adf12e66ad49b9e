"""Frames per second of the games: bare compiled step, bridge, collector, against what the machine
can write.

Every frame is consumed. Frames are results of the compiled call, so they must be written; then a
checksum outside it reads every byte. The checksum has a clock of its own: rates are given without
it and with it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle, product
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

import arcade_torch
from arcade_torch.envs_jax import make, registered_ids
from arcade_torch.envs_jax.batch import BatchedGame, env_keys
from arcade_torch.tools.bench.harness import Measure, interleaved
from arcade_torch.tools.bench.registry import BenchOptions
from arcade_torch.tools.options import at_least, at_most

WINDOW_BYTES = 2**27  # of the frames in a collector's window, at most, unless 4 steps need more
LARGEST_BATCH = 2**20


@dataclass
class Options(BenchOptions):
    """Frames per second of games at several batch sizes, every frame consumed by a checksum.

    Measured are the compiled step with auto-reset (step+draw; step: without drawing),
    ArcadeEnv.step_and_maybe_reset (env), ArcadeCollector.collect with random actions, every frame
    stored once as in training (collector), and a plain fill and a plain copy of the same bytes.
    Beside frames/s stand GB/s and the share of that fill and that copy in the same run.

    Example: arcade-torch bench envs --games MineSweeperEasy --batches 16 128 --out runs/bench.csv
    """

    games: tuple[str, ...] = ()  # Environment ids; every registered Easy game by default.
    sizes: tuple[int, ...] = (128,)  # Sides of the frames, 128 or 256.
    batches: tuple[int, ...] = (1, 16, 128, 512)  # Numbers of envs.
    seconds: float = 0.5  # For each measure in each repeat.
    repeats: int = 5  # Turns; medians are shown.


def run(options: Options, log: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``envs``."""
    games = options.games or tuple(name for name in registered_ids() if "Easy" in name)
    at_most(options, batches=LARGEST_BATCH)
    at_least(options, batches=1, repeats=1, seconds=0)
    for game, size in product(games, options.sizes):
        make(game, obs_size=size)  # refuse what does not exist before anything is measured
    for game, size, count in product(games, options.sizes, options.batches):
        log(f"{game}, {size} px, {count} envs")
        measures = {**_bare(game, size, count), **_bridge(game, size, count), **_plain(size, count)}
        measured = interleaved(measures, options.seconds, options.repeats)
        drawn = {name: size * size * 3 * result.rate / 1e9 for name, result in measured.items()}
        drawn["step"] = 0.0
        for name, result in measured.items():
            row = {
                "game": game,
                "obs_size": size,
                "num_envs": count,
                "measure": name,
                "frames": result.units,
                "frames_per_s": result.rate,
                "frames_per_s_with_check": median(result.rates_with_check),
                "gb_per_s": drawn[name],
                "share_of_fill": drawn[name] / drawn["fill"],
                "share_of_copy": drawn[name] / drawn["copy"],
                "checksum": result.checksum,
            }
            yield "envs", row


def read_all(frames: Any) -> int:
    """Read every byte of an array and return a sum over it, modulo 2**64."""
    tensor = frames if isinstance(frames, torch.Tensor) else torch.utils.dlpack.from_dlpack(frames)
    return int(tensor.detach().reshape(-1).view(torch.int64).sum()) % 2**64


def _bare(game: str, size: int, count: int) -> dict[str, Measure]:
    """The compiled functions of the game alone."""
    batched = BatchedGame(make(game, obs_size=size))
    partial = jnp.arange(count) % 2 == 1
    state = {name: batched.init(env_keys(0, count), partial) for name in ("step+draw", "step")}
    rng = np.random.default_rng(0)
    # made outside the clock
    actions = cycle([jnp.asarray(rng.integers(0, 5, count), jnp.int32) for _ in range(64)])

    @jax.jit
    def step(batch: Any, action: Any) -> Any:
        stepped, outcome = batched.step(batch, action)
        return batched.reset_where(stepped, outcome.done), outcome.reward

    def draw_work() -> Any:
        state["step+draw"], _, _, pixels = batched.step_autoreset(state["step+draw"], next(actions))
        return pixels.block_until_ready()

    def step_work() -> Any:
        state["step"], reward = step(state["step"], next(actions))
        return reward.block_until_ready()

    def read_rewards(reward: Any) -> int:
        return int(np.asarray(reward).view(np.int32).astype(np.int64).sum())

    return {
        "step+draw": Measure(draw_work, read_all, count),
        "step": Measure(step_work, read_rewards, count),
    }


def window_steps(size: int, count: int) -> int:
    """Steps in a collector's window: 32, or as many powers of two as `WINDOW_BYTES` hold, but at
    least 4.

    Example:
        >>> window_steps(128, 16), window_steps(128, 128), window_steps(128, 512)
        (32, 16, 4)
    """
    fitting = max(1, WINDOW_BYTES // (count * size * size * 3))
    return int(min(32, max(4, 2 ** int(np.log2(fitting)))))


def _bridge(game: str, size: int, count: int) -> dict[str, Measure]:
    """The TorchRL environment and our collector."""
    env, other = (arcade_torch.make(game, num_envs=count, obs_size=size) for _ in range(2))
    steps = window_steps(size, count)
    collector = arcade_torch.ArcadeCollector(
        other, None, frames_per_batch=count * steps, final_frames="truncated"
    )
    generator = torch.Generator().manual_seed(0)
    actions = cycle(
        [torch.randint(5, (count,), generator=generator).to(env.device) for _ in range(64)]
    )
    now = [env.reset()]

    def env_work() -> Any:
        _, now[0] = env.step_and_maybe_reset(now[0].set("action", next(actions)))
        return now[0].get("pixels")

    return {
        "env": Measure(env_work, read_all, count),
        "collector": Measure(lambda: collector.collect().get("pixels"), read_all, count * steps),
    }


def _plain(size: int, count: int) -> dict[str, Measure]:
    """What writing the same bytes costs: one constant, and a copy from elsewhere in memory."""
    device = "cuda" if torch.cuda.is_available() and jax.default_backend() == "gpu" else "cpu"
    target = torch.zeros(count, size, size, 3, dtype=torch.uint8, device=device)
    source = torch.randint(256, target.shape, dtype=torch.uint8, device=device)
    value = cycle(range(256))
    return {
        "fill": Measure(lambda: target.fill_(next(value)), read_all, count),
        "copy": Measure(lambda: target.copy_(source), read_all, count),
    }
