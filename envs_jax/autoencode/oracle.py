"""Scripted players of AutoEncode: both name the top of the stack; one is shown the stack, one
remembers it.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.autoencode.rules import SUITS
from arcade_torch.envs_jax.game import FIRE, LEFT, RIGHT, UP
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer
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


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: pushes every card it is shown, pops one with every answer; loses
    nothing.
    """

    def __init__(self, game: Any) -> None:
        super().__init__(game)
        self.cards = game.level.cards
        self.rules = game.rules

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        self.stack = np.zeros((num_envs, self.cards), np.int64)
        self.seen = np.zeros(num_envs, np.int64)  # cards shown so far
        self.left = np.zeros(num_envs, np.int64)  # cards shown and not yet named

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        envs = np.arange(len(frames))
        self.seen[is_init] = 0
        self.left[is_init] = 0
        card = self.screen.card.read(frames)
        selected = self.screen.selector.read(frames) - 1
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
        return action
