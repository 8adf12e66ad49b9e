"""Golden walks: what every game did when ``golden.json`` was written, as hashes.

    python -m tests.envs_jax.golden            compares
    python -m tests.envs_jax.golden --write    writes the file anew, after a change that was meant

A walk is 32 steps in 4 envs, two of each twin, with ends and resets as they come. Integers, and
frames of games whose state has no floats, are hashed: they are equal on every machine. Floats, and
the frames that depend on them, differ in the last bits between processors: their means are kept
instead. The flags of an end count once, as outcomes.
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax import BatchedGame, env_keys, make, registered_ids

FILE = Path(__file__).with_name("golden.json")
COMMAND = "python -m tests.envs_jax.golden --write"
STEPS, ENVS, SEED = 32, 4, 20
RULES, SIZES = ("default", "reference"), (128, 256)


def actions() -> np.ndarray:
    """The same on every machine and for ever: int32 [STEPS, ENVS] in 0..4."""
    drawn = hashlib.shake_256(b"golden walk").digest(STEPS * ENVS)
    return (np.frombuffer(drawn, np.uint8) % 5).astype(np.int32).reshape(STEPS, ENVS)


def walk(id: str, rules: str) -> tuple[Any, dict[int, jax.Array]]:
    """States, outcomes and counts of all steps (leaves [STEPS, ENVS, ...]), and the frames by
    size.
    """
    games = {size: BatchedGame(make(id, obs_size=size, rules=rules)) for size in SIZES}
    batched = games[SIZES[0]]

    def advance(batch: Any, action: jax.Array) -> Any:
        stepped, outcome = batched.step(batch, action)
        root = batched.reset_where(stepped, outcome.done)
        return root, (stepped, outcome)

    def run(keys: jax.Array, partial: jax.Array, taken: jax.Array) -> Any:
        first = batched.init(keys, partial)
        _, (stepped, outcome) = jax.lax.scan(advance, first, taken)
        seen = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, stepped)
        frames = {size: jax.lax.map(game.render, seen) for size, game in games.items()}
        return (seen, outcome), frames

    partial = jnp.arange(ENVS) % 2 == 1
    result: tuple[Any, dict[int, jax.Array]] = jax.jit(run)(
        env_keys(SEED, ENVS), partial, actions()
    )
    return result


def digest(arrays: list[Any]) -> str:
    """A short hash of arrays with their shapes and types."""
    total = hashlib.sha256()
    for array in map(np.asarray, arrays):
        total.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def record(id: str, rules: str) -> dict[str, Any]:
    """What is kept of a walk."""
    tree, frames = walk(id, rules)
    leaves = {
        jax.tree_util.keystr(path): np.asarray(x)
        for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]
    }
    for name in [
        name
        for name in leaves
        if name.startswith("[0]") and name.endswith((".terminated", ".truncated"))
    ]:
        del leaves[name]  # states and batches keep the outcomes of their last step
    floats = {name: leaf for name, leaf in leaves.items() if leaf.dtype == np.float32}
    out: dict[str, Any] = {
        "integers": digest([leaf for name, leaf in leaves.items() if name not in floats])
    }
    out["floats"] = {
        name: round(float(leaf.astype(np.float64).mean()), 5) for name, leaf in floats.items()
    }
    inexact = any(".state" in name for name in floats)
    for size, drawn in frames.items():
        out[f"frames {size}"] = (
            round(float(np.asarray(drawn).mean()), 2) if inexact else digest([drawn])
        )
    return out


def random_numbers() -> str:
    """Hash of numbers from ``jax.random``, which a version of JAX may change."""
    key = jax.random.PRNGKey(5)
    draws = [
        jax.random.bits(key, (9,)),
        jax.random.permutation(key, 9),
        jax.random.randint(key, (9,), 0, 1000),
    ]
    draws += [
        jax.random.uniform(key, (9,)) < 0.5,
        jax.random.split(key, 3),
        jax.random.fold_in(key, 7),
    ]
    return digest(draws)


def differences(expected: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """Where two records differ, by name; floats may differ by what a processor may do to them."""
    wrong = sorted(set(expected) ^ set(found))
    for name in sorted(set(expected) & set(found)):
        one, two = expected[name], found[name]
        if isinstance(one, dict) and isinstance(two, dict):
            wrong += [f"{name}{key}" for key in differences(one, two)]
        elif isinstance(one, float) and isinstance(two, float):
            wrong += [name] if abs(one - two) > 1e-3 + 1e-3 * abs(one) else []
        elif one != two:
            wrong.append(name)
    return wrong


def load() -> dict[str, Any]:
    """The file."""
    stored: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return stored


def write() -> None:
    """Write the file anew."""
    walks = {f"{id} {rules}": record(id, rules) for id in registered_ids() for rules in RULES}
    stored = {
        "written by": COMMAND,
        "jax": jax.__version__,
        "jax.random": random_numbers(),
        "walks": walks,
    }
    FILE.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Compare, or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write golden.json anew")
    if parser.parse_args().write:
        write()
        return 0
    wrong = {
        name: differences(kept, record(*name.split())) for name, kept in load()["walks"].items()
    }
    for name, what in wrong.items():
        print(f"{name}: {', '.join(what) or 'equal'}")
    return int(any(wrong.values()))


if __name__ == "__main__":
    sys.exit(main())
