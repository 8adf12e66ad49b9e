"""A thousand steps of many envs in one compiled call: pure JAX, and nothing leaves the device
before the end.

    python examples/jax_scan.py

Half of the envs show the MDP twin and half the POMDP twin of the same game. Actions are random;
every frame is drawn and read (its mean goes into the result), so that the compiler cannot leave one
out.
"""

import sys
import time
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import Game, make

STEPS = 1000
NUM_ENVS = 64


class Result(NamedTuple):
    """Sums over all steps of one env."""

    reward: jax.Array  # float32
    episodes: jax.Array  # int32, how many ended
    brightness: jax.Array  # float32, mean of all frames, 0..255


def walk(game: Game, key: jax.Array, hides: jax.Array, steps: int = STEPS) -> Result:
    """One env for ``steps`` steps; a new episode begins where one ends."""

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        state, result = carry
        frame = game.render(state, hides)
        to_act, to_step = jax.random.split(key)
        action = jax.random.randint(to_act, (), 0, game.num_actions)
        state, _, (reward, terminated, truncated) = game.step_autoreset(to_step, state, action)
        brightness = result.brightness + frame.mean(dtype=jnp.float32) / steps
        episodes = result.episodes + (terminated | truncated)
        return (state, Result(result.reward + reward, episodes, brightness)), None

    keys = jax.random.split(key, steps + 1)
    begin = game.reset(keys[0]), Result(jnp.float32(0), jnp.int32(0), jnp.float32(0))
    (_, result), _ = jax.lax.scan(step, begin, keys[1:])
    return result


def main(id: str = "MineSweeperEasy", steps: int = STEPS, num_envs: int = NUM_ENVS) -> Result:
    """Walk all envs, print the rate, and give the sums of each env, leaves [num_envs]."""
    run = jax.jit(jax.vmap(partial(walk, make(id), steps=steps)))
    keys = jax.random.split(jax.random.PRNGKey(0), num_envs)
    hides = jnp.arange(num_envs) % 2 == 1
    compiled = run.lower(keys, hides).compile()
    with jax.transfer_guard("disallow"):
        start = time.perf_counter()
        result = jax.block_until_ready(compiled(keys, hides))
        rate = steps * num_envs / (time.perf_counter() - start)
    print(
        f"{id}: {rate:,.0f} frames/s, {int(result.episodes.sum())} episodes, mean return "
        f"{float(result.reward.sum() / result.episodes.sum()):.3f}"
    )
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
