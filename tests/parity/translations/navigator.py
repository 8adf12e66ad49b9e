"""Navigator: all fields are shared but the score, which is 0 until an episode is over."""

from typing import Any

import jax

from arcade_torch.envs_jax.navigator.rules import NavigatorState
from tests.parity.translation import Array, Translation, number, small


def to_ours(game: Any, theirs: Any) -> NavigatorState:
    """Field by field."""
    return NavigatorState(
        number(theirs.action_x),
        number(theirs.action_y),
        small(theirs.board),
        number(theirs.timestep),
    )


def to_theirs(game: Any, ours: NavigatorState) -> dict[str, Any]:
    """The score is 0 in mid-episode."""
    return {
        "action_x": ours.x,
        "action_y": ours.y,
        "timestep": ours.timestep,
        "board": ours.board,
        "score": 0,
    }


def hasten(key: Array, game: Any, ours: NavigatorState) -> NavigatorState:
    """The agent on any cell, TNT and treasure included."""
    x, y = jax.random.randint(key, (2,), 0, game.level.side)
    return ours._replace(x=x, y=y)


TRANSLATION = Translation(to_ours, to_theirs, "timestep", hasten=hasten)
