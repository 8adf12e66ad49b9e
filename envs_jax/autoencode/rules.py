"""The rules of AutoEncode: watch a row of cards, then name their suits from the last to the
first.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp

from arcade_torch.envs_jax.cards import deal
from arcade_torch.envs_jax.game import FIRE, LEFT, RIGHT, UNSET, Array, Rules

SUITS = 4


@dataclass(frozen=True)
class Params:
    """One difficulty.

    Attributes:
        cards: Cards to watch and to give back; a right answer pays ``1 / cards``.
    """

    cards: int

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 10 * self.cards


LEVELS = {
    "AutoEncodeEasy": Params(26),
    "AutoEncodeMedium": Params(52),
    "AutoEncodeHard": Params(78),
}


class AutoEncodeState(NamedTuple):
    """The cards, and how far the player is."""

    cards: Array  # int8 [cards], suits 0..3 in the order they are shown
    timestep: Array  # int32, steps taken; card `timestep` is on the table while there is one
    given: Array  # int32, answers given
    selected: Array  # int32, suit 0..3 that the selector points at
    score: Array  # int32, right answers
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def reset(key: Array, level: Params) -> AutoEncodeState:
    """Suits as even as can be, in uniformly random order; the selector on hearts."""
    zero = jnp.int32(0)
    return AutoEncodeState(deal(key, 1, level.cards, SUITS)[0], zero, zero, zero, zero)


def step(
    state: AutoEncodeState, action: Array, level: Params, rules: Rules
) -> tuple[AutoEncodeState, Array, Array, Array]:
    """Turn the selector, or answer with the suit it points at.

    By default only action 4 answers, and the game ends with the last answer or at the time limit.
    With ``rules="reference"`` the first step after the last card always answers, and both ends are
    judged on the state before the step: one more step follows the last answer, in which the first
    card can be paid twice.
    """
    is_late = rules == "reference"
    selected = (state.selected + (action == LEFT) - (action == RIGHT)) % SUITS
    confirm = action == FIRE
    if is_late:
        confirm |= state.timestep == level.cards
    answers = confirm & (state.timestep >= level.cards)
    asked = level.cards - 1 - state.given  # below 0 when all are answered: no card
    if is_late:
        asked = jnp.where(state.given == level.cards, 0, asked)
    right = answers & ((jnp.arange(level.cards) == asked) & (state.cards == selected)).any()

    new = AutoEncodeState(
        state.cards, state.timestep + 1, state.given + answers, selected, state.score + right
    )
    judged = state if is_late else new
    reward = jnp.where(right, jnp.float32(1 / level.cards), jnp.float32(0))
    return new, reward, judged.given >= level.cards, judged.timestep >= level.max_steps


def asked_suit(state: AutoEncodeState, level: Params) -> Array:
    """The suit that an answer has to name now: int32 0..3, -1 where no card is asked for."""
    asked = level.cards - 1 - state.given
    suit = jnp.where(jnp.arange(level.cards) == asked, state.cards, 0).sum(dtype=jnp.int32)
    is_asked = (state.timestep >= level.cards) & (asked >= 0)
    return jnp.where(is_asked, suit, -1)
