"""Reference lines: what the random policy and the scripted oracles earn."""

from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from arcade_torch.tools.files import read_json, write_json

KINDS = ("random", "state", "frames")
"""Random policy; oracle that sees the hidden state; oracle that sees only what the POMDP's frames have shown."""


def reference_returns(
    game: str, episodes: int = 256, seed: int = 0, rules: str = "default"
) -> dict[str, dict[str, float]]:
    """Mean returns of the random policy and the oracles of a game.

    Args:
        game: environment id.
        episodes: of each.
        seed: of the episodes.
        rules: law of the game.

    Returns:
        kind -> ``mean``, ``std``, ``n``; a game without an oracle lacks that kind.
    """
    from arcade_torch.envs_jax import make
    from arcade_torch.envs_jax.oracles import oracle_return, random_return

    made = make(game, rules=rules)
    found: dict[str, dict[str, float]] = {"random": _summary(random_return(made, episodes, seed))}
    for kind in KINDS[1:]:
        try:
            found[kind] = _summary(oracle_return(made, cast(Literal["state", "frames"], kind), episodes, seed))
        except ValueError:  # this game has no such oracle
            continue
    return found


def cached_references(
    game: str, folder: Path, episodes: int = 256, rules: str = "default"
) -> dict[str, dict[str, float]]:
    """`reference_returns`, kept in ``folder/references-GAME.json``."""
    file = folder / f"references-{game}-{rules}.json"
    if file.exists():
        kept: dict[str, Any] = read_json(file)
        if kept.get("episodes") == episodes:
            return dict(kept["returns"])
    returns = reference_returns(game, episodes, rules=rules)
    write_json(file, {"game": game, "rules": rules, "episodes": episodes, "seed": 0, "returns": returns})
    return returns


def _summary(returns: Any) -> dict[str, float]:
    values = np.asarray(returns, dtype=np.float64)
    return {
        "mean": float(values.mean()),
        "std": float(values.std(ddof=1)) if values.size > 1 else 0.0,
        "n": values.size,
    }
