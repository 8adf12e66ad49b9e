"""The parameters of CountRecall."""

from dataclasses import dataclass

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
