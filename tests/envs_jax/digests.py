"""Digests of what all configurations of the games do, to be compared between settings of JAX.

    python -m tests.envs_jax.digests                    all ids, in this process's settings: JSON
    python -m tests.envs_jax.digests CartPoleEasy-v0    one of them
    python -m tests.envs_jax.digests --compare          all ids in every setting of ``SETTINGS``,
                                                        each in a process

A walk is 32 steps in 4 envs, with ends and new episodes as they come, through ``BatchedGame`` and
in pure JAX. All bits of states, outcomes and frames count, those of floats too: the processes run
on one machine.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax import OBS_SIZES, BatchedGame, env_keys, make, registered_ids

from . import golden

SETTINGS = {
    "x64": {"JAX_ENABLE_X64": "1"},
    "threefry": {"JAX_THREEFRY_PARTITIONABLE": "0"},
    "rbg": {"JAX_DEFAULT_PRNG_IMPL": "rbg", "JAX_RANDOM_SEED_OFFSET": "7"},
    "strict": {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"},
    "keys": {
        "JAX_LEGACY_PRNG_KEY": "error",
        "JAX_ENABLE_CUSTOM_PRNG": "1",
        "JAX_DEBUG_KEY_REUSE": "1",
    },
    "debug": {
        "JAX_DEBUG_NANS": "1",
        "JAX_DEBUG_INFS": "1",
        "JAX_DEFAULT_MATMUL_PRECISION": "highest",
    },
}
TWINS = {"full": False, "partial": True}


def leaves(tree: Any) -> list[np.ndarray]:
    """All leaves but the flags of an end that stand in states and batches: the outcomes have them
    too.
    """
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [
        np.asarray(leaf)
        for path, leaf in pairs
        if "inated" not in str(path[-1]) and "uncated" not in str(path[-1])
    ]


def batched_walk(game: Any, partial: bool) -> str:
    """The digest of a walk of ``BatchedGame``."""
    batched = BatchedGame(game)
    batch = batched.init(env_keys(golden.SEED, golden.ENVS), np.full(golden.ENVS, partial))
    arrays = leaves(batch)
    for action in golden.actions():
        batch, stepped, outcome, frames = batched.step_autoreset(batch, action)
        arrays += [*leaves((batch, stepped)), *map(np.asarray, outcome), np.asarray(frames)]
    return golden.digest(arrays)


def pure_walk(game: Any, partial: bool) -> str:
    """The digest of a walk of ``game.step_autoreset`` under a ``jit`` and ``vmap`` of the
    caller.
    """
    reset, step = jax.jit(jax.vmap(game.reset)), jax.jit(jax.vmap(game.step_autoreset))
    render = jax.jit(jax.vmap(game.render, in_axes=(0, None)))
    numbers = np.arange(4 * golden.ENVS * (golden.STEPS + 1), dtype=np.uint32) * np.uint32(
        2654435761
    )
    keys = numbers.reshape(golden.STEPS + 1, golden.ENVS, 4)[..., :2]
    state = reset(keys[0])
    arrays = leaves(state)
    for key, action in zip(keys[1:], golden.actions().tolist(), strict=True):
        state, stepped, outcome = step(
            key, state, jnp.asarray(action)
        )  # int64 where the caller has x64
        arrays += [
            *leaves((state, stepped)),
            *map(np.asarray, outcome),
            np.asarray(render(stepped, partial)),
        ]
    return golden.digest(arrays)


def digests(ids: Sequence[str], sizes: Sequence[int] = OBS_SIZES) -> dict[str, str]:
    """The digests of ids, by id, size and twin."""
    out = {}
    for id in ids:
        for size in sizes:
            game = make(id, obs_size=size)
            for twin, partial in TWINS.items():
                out[f"{id} {size} {twin}"] = batched_walk(game, partial)
                if size == OBS_SIZES[0] and "Easy" in id:
                    out[f"{id} pure {twin}"] = pure_walk(game, partial)
    return out


def in_process(
    settings: dict[str, str], ids: Sequence[str], cache: str, sizes: Sequence[int] = OBS_SIZES
) -> dict[str, str]:
    """The digests of ids in a new process with these settings of JAX."""
    shared = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-m", "tests.envs_jax.digests", *ids, "--sizes", *map(str, sizes)]
    run = subprocess.run(
        command, env={**os.environ, **shared, **settings}, capture_output=True, text=True
    )
    if run.returncode:
        raise RuntimeError(f"{settings}: {run.stderr[-2000:]}")
    found: dict[str, str] = json.loads(run.stdout.splitlines()[-1])
    return found


def compare(ids: Sequence[str], cache: str | None = None) -> int:
    """Print for each setting how many digests differ from those without any; returns 1 if some do.

    Compiled programs are kept in ``cache``: where a setting changes a program, it is compiled anew.
    """
    wrong = 0
    with tempfile.TemporaryDirectory() as spare:
        cache = cache or spare
        expected = in_process({}, ids, cache)
        for name, settings in SETTINGS.items():
            found = in_process(settings, ids, cache)
            differing = [key for key in expected if expected[key] != found.get(key)]
            wrong += len(differing)
            words = " ".join(f"{key}={value}" for key, value in settings.items())
            rest = f": {', '.join(differing)}" if differing else ""
            print(f"{name} ({words}): {len(differing)} of {len(expected)} differ{rest}", flush=True)
    return int(wrong > 0)


def main() -> int:
    """Print digests, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=registered_ids())
    parser.add_argument(
        "--sizes", nargs="*", type=int, default=OBS_SIZES, help="sides of the pictures in pixels"
    )
    parser.add_argument(
        "--compare", action="store_true", help="compare all settings, each in a process of its own"
    )
    parser.add_argument("--cache", help="a folder for compiled programs")
    arguments = parser.parse_args()
    if arguments.compare:
        return compare(arguments.ids, arguments.cache)
    print(json.dumps(digests(arguments.ids, arguments.sizes)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
