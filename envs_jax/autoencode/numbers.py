"""The numbers of AutoEncode."""

from dataclasses import dataclass

SUITS = 4


@dataclass(frozen=True)
class Level:
    """One difficulty.

    Attributes:
        cards: Cards to watch and to give back; a right answer pays ``1 / cards``.
    """

    cards: int

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 10 * self.cards


LEVELS = {"AutoEncodeEasy": Level(26), "AutoEncodeMedium": Level(52), "AutoEncodeHard": Level(78)}
