"""The parameters of AutoEncode."""

from dataclasses import dataclass

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
