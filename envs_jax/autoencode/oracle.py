"""Scripted players of AutoEncode: both name the top of the stack; one is shown the stack, one
remembers it.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.autoencode.rules import SUITS
from arcade_torch.envs_jax.game import FIRE, LEFT, RIGHT, UP
from arcade_torch.envs_jax.render.suits import NO_CARD


def turn(selected: npt.NDArray[Any], wanted: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """The shorter way round from one suit to another; ``FIRE`` where they are equal."""
    ahead = (wanted - selected) % SUITS
    return np.select([ahead == 0, ahead == SUITS - 1], [FIRE, RIGHT], LEFT).astype(np.int32)


class StateOracle:
    """Sees the cards; answers every one of them in at most three steps, and always reaches the
    highest return.

    It turns the selector to the last card during the watch, which the reference's forced first
    answer needs.
    """

    def __init__(self, game: Any) -> None:
        self.cards = game.level.cards

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        asked = np.maximum(self.cards - 1 - seen.given, 0)
        wanted = seen.cards[np.arange(len(is_init)), asked].astype(np.int32)
        action = turn(seen.selected, wanted)
        return np.where((action == FIRE) & (seen.timestep < self.cards), UP, action).astype(
            np.int32
        )


class FramesOracle:
    """Sees the POMDP's frames: pushes every card it is shown, pops one with every answer; loses
    nothing.
    """

    def __init__(self, game: Any) -> None:
        self.screen = game.screen
        self.cards = game.level.cards
        self.rules = game.rules
        self.stack: npt.NDArray[np.int64] = np.zeros((0, 0), np.int64)
        self.seen: npt.NDArray[np.int64] = np.zeros(0, np.int64)  # cards shown so far
        self.left: npt.NDArray[np.int64] = np.zeros(0, np.int64)  # cards shown and not yet named

    def act(
        self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        envs = np.arange(len(seen))
        if len(self.stack) != len(seen):
            self.stack = np.zeros((len(seen), self.cards), np.int64)
            self.seen = np.zeros_like(envs)
            self.left = np.zeros_like(envs)
        self.seen[is_init] = 0
        self.left[is_init] = 0
        card = self.screen.card.read(seen)
        selected = self.screen.selector.read(seen) - 1
        watching = card != NO_CARD
        self.stack[envs[watching], self.seen[watching]] = card[watching] - 1
        self.seen += watching
        self.left += watching

        action = turn(selected, self.stack[envs, np.maximum(self.left - 1, 0)])
        action = np.where(watching & (action == FIRE), UP, action)
        answers = ~watching & (action == FIRE)
        if self.rules == "reference":  # the first step without a card answers, whatever the action
            answers |= ~watching & (self.left == self.cards)
        self.left -= answers
        return action.astype(np.int32)
