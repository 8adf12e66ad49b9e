"""CountRecall: the published counts and history follow from the cards and the turn."""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.countrecall.rules import CountRecallState
from tests.parity.translation import Array, Translation, number, small


def to_ours(game: Any, theirs: Any) -> CountRecallState:
    """Cards and counters."""
    counters = (theirs.timestep, theirs.default_action, theirs.score, theirs.alreadyMove)
    return CountRecallState(
        small(theirs.value_cards), small(theirs.query_cards), *map(number, counters)
    )


def to_theirs(game: Any, ours: CountRecallState) -> dict[str, Any]:
    """Counts and history are worked out."""
    dealt = jnp.arange(game.level.cards) < ours.timestep
    suit = jnp.arange(game.level.suits)[:, None]
    return {
        "timestep": ours.timestep,
        "value_cards": ours.cards,
        "query_cards": ours.queries,
        "running_count": ((ours.cards == suit) & dealt).sum(1),
        "history": jnp.where(dealt, ours.cards, 0),
        "default_action": ours.answer,
        "num_types": game.level.suits,
        "score": ours.score,
        "alreadyMove": ours.moves,
    }


def hasten(key: Array, game: Any, ours: CountRecallState) -> CountRecallState:
    """One of the last turns, the counter near its answer."""
    for_turn, for_answer, for_moves = jax.random.split(key, 3)
    turn = game.level.cards - jax.random.randint(for_turn, (), 1, 6)
    answer = turn // game.level.suits + jax.random.randint(for_answer, (), -2, 3)
    moves = turn + jax.random.randint(for_moves, (), 0, game.move_budget)
    return ours._replace(timestep=turn, answer=answer, moves=moves)


TRANSLATION = Translation(to_ours, to_theirs, "moves", hasten=hasten)
