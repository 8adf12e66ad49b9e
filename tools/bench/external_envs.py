"""Frames per second of other packages, for comparison; measured only where they are installed.

Every observation is a result of the timed call and is read to the last byte, as in ``envs``.
"""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.bench.harness import Measure, interleaved
from arcade_torch.tools.optional import need

PACKAGES = {"gymnax": ("CartPole-v1", "Breakout-MinAtar"), "ale_py": ("ALE/Pong-v5",)}
"""Import name -> which of its environments are measured."""


class Other(NamedTuple):
    """One environment of another package: its name, whether it draws, frames per second by number of envs."""

    name: str
    pixels: bool
    rates: list[float]


def installed() -> list[str]:
    """Which of `PACKAGES` are installed."""
    return [name for name in PACKAGES if find_spec(name) is not None]


def bench_others(
    packages: Sequence[str], batches: Sequence[int], seconds: float = 0.5, repeats: int = 3
) -> Iterator[Other]:
    """Measure the environments of installed packages."""
    for package in packages:
        make = _gymnax if package == "gymnax" else _gymnasium
        for name in PACKAGES[package]:
            measures = {str(count): Measure(make(name, count), _read, count) for count in batches}
            found = interleaved(measures, seconds, repeats)
            rates = [measured.rate_with_check for measured in found.values()]
            yield Other(f"{package} {name.removeprefix('ALE/')}", package == "ale_py", rates)


def _read(observation: Any) -> int:
    """A sum over every byte of an array."""
    return int(np.asarray(observation).view(np.uint8).astype(np.int64).sum())


def _gymnax(name: str, count: int) -> Any:
    """A vectorised and compiled step with auto-reset; new random actions and keys every step."""
    import jax

    env, params = need("gymnax").make(name)

    @jax.jit
    def step(key: Any, state: Any) -> Any:
        key, choose, go = jax.random.split(key, 3)
        action = jax.random.randint(choose, (count,), 0, env.num_actions)
        many = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        observation, state, reward, *_ = many(jax.random.split(go, count), state, action, params)
        return key, state, observation, reward

    keys = jax.random.split(jax.random.PRNGKey(0), count)
    carry = [jax.random.PRNGKey(1), jax.vmap(env.reset, in_axes=(0, None))(keys, params)[1]]

    def work() -> Any:
        carry[0], carry[1], observation, _ = step(*carry)
        return observation.block_until_ready()

    return work


def _gymnasium(name: str, count: int) -> Any:
    """Gymnasium's synchronous vector of environments, as the paper ran Atari."""
    gymnasium = need("gymnasium")
    gymnasium.register_envs(need("ale_py"))
    env = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make(name)] * count)
    env.reset(seed=0)
    env.action_space.seed(0)
    return lambda: env.step(env.action_space.sample())[0]
