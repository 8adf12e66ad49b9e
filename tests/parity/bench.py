"""How fast the published games and ours are in the same run: ``make bench-parity``.

Both step a batch of the Easy level with auto-reset and draw every frame. Frames are results of the
compiled call, so they must be written; a checksum outside it then reads every byte. Measures take
turns, so that a slow minute hits both. The published AutoEncode is compiled without folding of
constants, with which XLA was not done after 20 minutes.
"""

import argparse
from functools import partial
from importlib.metadata import version
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax import BatchedGame, env_keys, make
from arcade_torch.envs_jax.registry import GAMES
from arcade_torch.tools.bench.envs import read_all
from arcade_torch.tools.bench.harness import Measure, Measured, interleaved
from arcade_torch.tools.files import Table
from arcade_torch.tools.machine import machine
from tests.parity.reference import PACKAGE, missing, published, resets, without_picture

ENVS, SIZE = 128, 128
UNFOLDED = {"AutoEncode": {"xla_disable_hlo_passes": "constant_folding"}}
COLUMNS = (
    "game",
    "published, frames/s",
    "ours, frames/s",
    "ratio",
    "ratio with checksum",
    "frames",
    "checksums",
)


def actions() -> Any:
    """Endless random actions, int32 [ENVS]; made ahead, so that making them is not timed."""
    rng = np.random.default_rng(0)
    made = [jnp.asarray(rng.integers(0, 5, ENVS), jnp.int32) for _ in range(64)]
    while True:
        yield from made


def theirs(game: str, partial_obs: bool) -> Measure:
    """The published step, which resets by itself, vectorised and compiled as its users do."""
    env, params = published(f"{game}Easy", partial_obs=partial_obs, obs_size=SIZE)
    bare, _ = without_picture(
        f"{game}Easy"
    )  # the same first states, without minutes of compiling their pictures
    state = resets(bare, jax.random.PRNGKey(0), ENVS, params)
    action = actions()

    @partial(jax.jit, compiler_options=UNFOLDED.get(game))
    def step(key: Any, state: Any, action: Any) -> Any:
        key, now = jax.random.split(key)
        many = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        pixels, state, reward, done, _ = many(jax.random.split(now, ENVS), state, action, params)
        return key, state, pixels, reward, done

    carry = [jax.random.PRNGKey(1), state]

    def work() -> Any:
        carry[0], carry[1], pixels, _, _ = step(*carry, next(action))
        return pixels.block_until_ready()

    return Measure(work, read_all, ENVS)


def ours(game: str, partial_obs: bool) -> Measure:
    """Our step with auto-reset and drawing, default rules."""
    batched = BatchedGame(make(f"{game}Easy", obs_size=SIZE))
    carry = [batched.init(env_keys(0, ENVS), jnp.full(ENVS, partial_obs))]
    action = actions()

    def work() -> Any:
        carry[0], _, _, pixels = batched.step_autoreset(carry[0], next(action))
        return pixels.block_until_ready()

    return Measure(work, read_all, ENVS)


def line(game: str, found: dict[str, Measured]) -> list[str]:
    """One row of the table."""
    them, us = found["theirs"], found["ours"]
    rates = [f"{them.rate:,.0f}", f"{us.rate:,.0f}"]
    ratios = [
        f"{us.rate / them.rate:.1f}",
        f"{median(us.rates_with_check) / median(them.rates_with_check):.1f}",
    ]
    return [
        game,
        *rates,
        *ratios,
        f"{them.units:,} / {us.units:,}",
        f"{them.checksum:016x} / {us.checksum:016x}",
    ]


def main() -> int:
    """Measure and print; exit code 2 where the published package is missing."""
    parser = argparse.ArgumentParser(prog="make bench-parity", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--games", nargs="+", choices=GAMES, default=GAMES, help="which games, Easy level"
    )
    parser.add_argument(
        "--partial", action="store_true", help="the POMDP twins instead of the MDP twins"
    )
    parser.add_argument(
        "--seconds", type=float, default=1.0, help="for each measure in each repeat"
    )
    parser.add_argument("--repeats", type=int, default=5, help="the median counts")
    options = parser.parse_args()
    if reason := missing():
        parser.error(reason)
    rows = []
    for game in options.games:
        measures = {"theirs": theirs(game, options.partial), "ours": ours(game, options.partial)}
        rows.append(line(game, interleaved(measures, options.seconds, options.repeats)))
        print(" | ".join(rows[-1]), flush=True)
    twin = "POMDP" if options.partial else "MDP"
    made = ", ".join(
        f"{name} {value}" for name, value in {**machine(), PACKAGE: version(PACKAGE)}.items()
    )
    caption = f"published {', '.join(UNFOLDED)} compiled without constant folding; {made}"
    Table(
        f"{twin} twins, Easy, {ENVS} envs, {SIZE} px, every frame consumed", COLUMNS, rows, caption
    ).show()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
