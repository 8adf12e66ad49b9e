"""What the first call of a game costs: tracing, compiling, and the memory that a compiled step works in."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.batch import BatchedGame, env_keys


@dataclass(frozen=True)
class FirstCall:
    """The cost of ``BatchedGame.step_auto`` before its first result.

    Attributes:
        game: environment id.
        obs_size: side of the frames, pixels.
        num_envs: batch size.
        build_s: seconds for the pictures on the host.
        compile_s: seconds to trace and compile, nothing taken from a cache on disk.
        work_bytes: memory that the compiled call needs beside its arguments and results.
        share_of_frames: ``work_bytes`` over the bytes of the frames it draws.
    """

    game: str
    obs_size: int
    num_envs: int
    build_s: float
    compile_s: float
    work_bytes: int
    share_of_frames: float


def first_call(game: str, obs_size: int = 128, num_envs: int = 128) -> FirstCall:
    """Measure the first call of a game.

    Args:
        game: environment id.
        obs_size: side of the frames, 128 or 256.
        num_envs: batch size.

    Example:
        >>> first_call("SignpostEasy", num_envs=2).compile_s > 0
        True
    """
    started = time.perf_counter()
    batched = BatchedGame(make(game, obs_size=obs_size))
    built = time.perf_counter()
    batch = jax.eval_shape(batched.init, env_keys(0, num_envs), jnp.zeros(num_envs, bool))
    with _no_cache_on_disk():
        begun = time.perf_counter()
        compiled = batched.step_auto.lower(batch, jax.ShapeDtypeStruct((num_envs,), jnp.int32)).compile()
        ready = time.perf_counter()
    analysis = compiled.memory_analysis()
    if analysis is None:
        raise RuntimeError(f"JAX does not say on {jax.default_backend()} how much memory a compiled call works in")
    work = int(analysis.temp_size_in_bytes)
    frames = num_envs * obs_size * obs_size * 3
    return FirstCall(game, obs_size, num_envs, built - started, ready - begun, work, work / frames)


@contextmanager
def _no_cache_on_disk() -> Iterator[None]:
    before = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
