"""Frames per second of the games: bare compiled step, bridge, collector, against what the machine can write.

Every frame is consumed. Frames are results of the compiled call, so they must be written; then a checksum outside it
reads every byte. The checksum has a clock of its own: rates are given without it and with it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

import arcade_torch
from arcade_torch.envs_jax import make, registered_ids
from arcade_torch.envs_jax.batch import BatchedGame, env_keys
from arcade_torch.tools.bench.harness import Measure, Measured, interleaved

WINDOW_BYTES = 2**27
"""Pixels in a collector's window, at most, unless 4 steps need more."""

NAMES = {
    "step+draw": "compiled step, auto-reset, drawing",
    "step": "the same without drawing",
    "env": "ArcadeEnv.step_and_maybe_reset",
    "collector": "ArcadeCollector.collect, random actions",
    "fill": "plain fill of the same bytes",
    "copy": "plain copy of the same bytes",
}


@dataclass
class Options:
    """Frames per second of games at several batch sizes, every frame consumed by a checksum.

    Beside frames/s stand GB/s and the share of a plain fill and of a plain copy of the same bytes in the same run.

    Example: arcade-torch bench envs --games MineSweeperEasy --batches 16 128 --out runs/bench.csv
    """

    games: tuple[str, ...] = ()
    """Environment ids; every registered Easy game by default."""
    sizes: tuple[int, ...] = (128,)
    """Sides of the frames, 128 or 256."""
    batches: tuple[int, ...] = (1, 16, 128, 512)
    """Numbers of envs."""
    seconds: float = 0.5
    """For each measure in each repeat."""
    repeats: int = 5
    """Turns; medians are shown."""
    out: Path | None = None
    """File for the numbers, .csv or .json; overwritten."""


SIZES: dict[str, dict[str, Any]] = {
    "tiny": {"games": ("SignpostEasy",), "batches": (2,), "seconds": 0.01, "repeats": 1},
    "quick": {"batches": (16, 128), "seconds": 0.2, "repeats": 3},
    "full": {"sizes": (128, 256)},
}


def run(options: Options, tell: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``envs``."""
    games = options.games or tuple(name for name in registered_ids() if "Easy" in name)
    for row in bench_envs(games, options.sizes, options.batches, options.seconds, options.repeats, tell):
        yield "envs", asdict(row)


@dataclass(frozen=True)
class Row:
    """One line of the result.

    Attributes:
        game: environment id.
        obs_size: side of the frames, pixels.
        num_envs: batch size.
        measure: key of `NAMES`.
        frames: frames made and consumed.
        frames_per_s: median over repeats, checksum left out.
        frames_per_s_with_check: the same with the checksum inside the clock.
        gb_per_s: bytes of frames per second / 1e9 (0 where nothing is drawn).
        share_of_fill: gb_per_s over that of the plain fill.
        share_of_copy: gb_per_s over that of the plain copy.
        checksum: over every byte of every frame (of every reward, where nothing is drawn), modulo 2**64.
    """

    game: str
    obs_size: int
    num_envs: int
    measure: str
    frames: int
    frames_per_s: float
    frames_per_s_with_check: float
    gb_per_s: float
    share_of_fill: float
    share_of_copy: float
    checksum: int


def bench_envs(
    games: Sequence[str],
    sizes: Sequence[int] = (128,),
    batches: Sequence[int] = (1, 16, 128, 512),
    seconds: float = 0.5,
    repeats: int = 5,
    tell: Callable[[str], None] = lambda text: None,
) -> list[Row]:
    """Measure games at batch and picture sizes."""
    for count in batches:
        if count < 1:
            raise ValueError(f"a batch holds at least 1 env, got {count}")
    for game in games:
        for size in sizes:
            make(game, obs_size=size)
    rows: list[Row] = []
    for game in games:
        for size in sizes:
            for count in batches:
                tell(f"{game}, {size} px, {count} envs")
                rows += _configuration(game, size, count, seconds, repeats)
    return rows


def _configuration(game: str, size: int, count: int, seconds: float, repeats: int) -> list[Row]:
    frame_bytes = size * size * 3
    measures = {**_bare(game, size, count), **_bridge(game, size, count), **_plain(size, count)}
    found = interleaved(measures, seconds, repeats)
    rate = {name: frame_bytes * result.rate / 1e9 for name, result in found.items()}
    return [_row(game, size, count, name, found[name], rate) for name in NAMES]


def _row(game: str, size: int, count: int, name: str, result: Measured, rate: dict[str, float]) -> Row:
    drawn = rate[name] if name != "step" else 0.0
    return Row(
        game,
        size,
        count,
        name,
        result.units,
        result.rate,
        result.rate_with_check,
        drawn,
        drawn / rate["fill"],
        drawn / rate["copy"],
        result.checksum,
    )


def read_all(frames: Any) -> int:
    """Read every byte of an array and return a sum over it, modulo 2**64."""
    tensor = frames if isinstance(frames, torch.Tensor) else torch.utils.dlpack.from_dlpack(frames)
    return int(tensor.detach().reshape(-1).view(torch.int64).sum()) % 2**64


def _bare(game: str, size: int, count: int) -> dict[str, Measure]:
    """The compiled functions of the game alone."""
    batched = BatchedGame(make(game, obs_size=size))
    partial = jnp.arange(count) % 2 == 1
    state = {name: batched.init(env_keys(0, count), partial) for name in ("step+draw", "step")}
    actions = _actions(count)

    @jax.jit
    def step(batch: Any, action: Any) -> Any:
        stepped, outcome = batched.step(batch, action)
        return batched.reset_where(stepped, outcome.done), outcome.reward

    def draw_work() -> Any:
        state["step+draw"], _, _, pixels = batched.step_auto(state["step+draw"], next(actions))
        return pixels.block_until_ready()

    def step_work() -> Any:
        state["step"], reward = step(state["step"], next(actions))
        return reward.block_until_ready()

    return {
        "step+draw": Measure(draw_work, read_all, count),
        "step": Measure(step_work, lambda reward: int(np.asarray(reward).view(np.int32).astype(np.int64).sum()), count),
    }


def _actions(count: int) -> Any:
    """Endless random actions, int32 [N]; made ahead, so that making them is not timed."""
    rng = np.random.default_rng(0)
    made = [jnp.asarray(rng.integers(0, 5, count), jnp.int32) for _ in range(64)]
    while True:
        yield from made


def window_steps(size: int, count: int) -> int:
    """Steps in a collector's window: 32, or as many powers of two as `WINDOW_BYTES` hold, but at least 4.

    Example:
        >>> window_steps(128, 16), window_steps(128, 128), window_steps(128, 512)
        (32, 16, 4)
    """
    fitting = max(1, WINDOW_BYTES // (count * size * size * 3))
    return int(min(32, max(4, 2 ** int(np.log2(fitting)))))


def _bridge(game: str, size: int, count: int) -> dict[str, Measure]:
    """The TorchRL environment and our collector."""
    env = arcade_torch.make(game, num_envs=count, obs_size=size)
    other = arcade_torch.make(game, num_envs=count, obs_size=size)
    steps = window_steps(size, count)
    collector = arcade_torch.ArcadeCollector(other, None, frames_per_batch=count * steps)
    generator = torch.Generator().manual_seed(0)
    actions = [torch.randint(5, (count,), generator=generator).to(env.device) for _ in range(64)]
    kept: dict[str, Any] = {"td": env.reset(), "step": 0}

    def env_work() -> Any:
        kept["step"] += 1
        _, kept["td"] = env.step_and_maybe_reset(kept["td"].set("action", actions[kept["step"] % 64]))
        return kept["td"].get("pixels")

    return {
        "env": Measure(env_work, read_all, count),
        "collector": Measure(lambda: collector.collect().get("pixels"), read_all, count * steps),
    }


def _plain(size: int, count: int) -> dict[str, Measure]:
    """What writing the same bytes costs: one constant, and a copy from elsewhere in memory."""
    device = "cuda" if torch.cuda.is_available() and jax.default_backend() == "gpu" else "cpu"
    target = torch.zeros(count, size, size, 3, dtype=torch.uint8, device=device)
    source = torch.randint(256, target.shape, dtype=torch.uint8, device=device)
    value = iter(range(10**12))
    return {
        "fill": Measure(lambda: target.fill_(next(value) % 256), read_all, count),
        "copy": Measure(lambda: target.copy_(source), read_all, count),
    }
