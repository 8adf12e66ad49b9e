"""AutoEncode: all fields are shared."""

from typing import Any

import jax

from arcade_torch.envs_jax.autoencode.rules import AutoEncodeState
from tests.parity.translation import Array, Translation, number, small


def to_ours(game: Any, theirs: Any) -> AutoEncodeState:
    """Field by field."""
    counters = (theirs.timestep, theirs.count, theirs.default_action, theirs.score)
    return AutoEncodeState(small(theirs.cards), *map(number, counters))


def to_theirs(game: Any, ours: AutoEncodeState) -> dict[str, Any]:
    """Field by field."""
    return {
        "timestep": ours.timestep,
        "cards": ours.cards,
        "score": ours.score,
        "count": ours.given,
        "default_action": ours.selected,
    }


def reported(
    game: Any, ours: AutoEncodeState, terminated: Array, truncated: Array
) -> tuple[Array, Array]:
    """A3: both flags are up one step before the end."""
    return ours.given >= game.level.cards, ours.timestep >= game.max_steps


def hasten(key: Array, game: Any, ours: AutoEncodeState) -> AutoEncodeState:
    """Somewhere in the answers, a few of them left."""
    for_time, for_given = jax.random.split(key)
    timestep = jax.random.randint(for_time, (), game.level.cards - 2, game.max_steps)
    left = jax.random.randint(for_given, (), 1, 4)
    return ours._replace(timestep=timestep, given=game.level.cards - left)


TRANSLATION = Translation(to_ours, to_theirs, "timestep", reported=reported, hasten=hasten)
