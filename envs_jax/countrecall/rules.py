"""The rules of CountRecall: in every turn say how often a suit has been dealt before."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp

from arcade_torch.envs_jax.cards import deal
from arcade_torch.envs_jax.game import DOWN, FIRE, UNSET, UP, Array, Rules

MOVE_BUDGET = 100  # counter moves that fit in an episode: one step a card is spent on confirming it


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    cards: int  # turns of an episode; a right answer pays ``1 / cards``
    suits: int  # how many suits there are

    @property
    def most(self) -> int:
        """Cards of the most frequent suit, an upper bound of every answer."""
        return -(-self.cards // self.suits)


LEVELS = {
    "CountRecallEasy": Params(26, 2),
    "CountRecallMedium": Params(52, 2),
    "CountRecallHard": Params(78, 4),
}


class CountRecallState(NamedTuple):
    """Two packs of cards, a counter, and how far the player is."""

    cards: Array  # int8 [cards], suits in the order they are dealt
    queries: Array  # int8 [cards], suit asked for in each turn
    # int32, turns confirmed; card and query `timestep` are on the table while there are any
    timestep: Array
    answer: Array  # int32, what the counter shows
    score: Array  # int32, right answers
    moves: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def reset(key: Array, level: Params) -> CountRecallState:
    """Two independent uniformly random orders of a pack with suits as even as can be; the counter
    at 0.
    """
    cards, queries = deal(key, 2, level.cards, level.suits)
    zero = jnp.int32(0)
    return CountRecallState(cards, queries, zero, zero, zero, zero)


def step(
    state: CountRecallState, action: Array, level: Params, max_steps: int, rules: Rules
) -> tuple[CountRecallState, Array, Array, Array]:
    """Move the counter, or confirm what it shows.

    The card on the table does not count yet: the right answer of the first turn is 0. By default
    the counter stays between 0 and the size of the largest suit; with ``rules="reference"`` it goes
    anywhere.
    """
    answer = state.answer + (action == UP) - (action == DOWN)
    if rules == "default":
        answer = jnp.clip(answer, 0, level.most)

    confirm = action == FIRE
    index = jnp.arange(level.cards)
    now = index == state.timestep
    query = jnp.where(now, state.queries, 0).sum()
    dealt = ((index < state.timestep) & (state.cards == query)).sum()
    right = confirm & now.any() & (answer == dealt)

    turn = state.timestep + confirm
    score = state.score + right
    new = CountRecallState(state.cards, state.queries, turn, answer, score, state.moves + 1)
    reward = jnp.where(right, jnp.float32(1 / level.cards), jnp.float32(0))
    return new, reward, new.timestep >= level.cards, new.moves >= max_steps


def dealt(state: CountRecallState, level: Params) -> tuple[Array, Array]:
    """What is asked for in this turn, and what is to be counted.

    Returns:
        The suit asked for, int32, -1 after the last turn; and how many cards of each suit were
        dealt before this turn, float32 [suits].
    """
    index = jnp.arange(level.cards)
    now = index == state.timestep
    query = jnp.where(now, state.queries, 0).sum(dtype=jnp.int32)
    is_before = index < state.timestep
    suits = jnp.arange(level.suits)
    counts = (is_before & (state.cards == suits[:, None])).sum(1)
    return jnp.where(now.any(), query, -1), counts.astype(jnp.float32)
