"""The screen of CountRecall: the card dealt, the suit asked for, the counter, and the cards dealt
before.
"""

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.countrecall.rules import CountRecallState, Params
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    DIGITS,
    PATTERN,
    TEXT,
    Layers,
    Slot,
    bitmap,
    blank,
    centred,
    number_slot,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.palette import AZURE, CRIMSON, PALE_GREEN, SLATE_BLUE, SMOKE
from arcade_torch.envs_jax.render.suits import (
    FIELD,
    NO_CARD,
    corner_slot,
    history_codes,
    history_grid,
)

MINUS = ("00000", "00000", "11111", "00000", "00000")
COUNTER_X = {128: (68, 123), 256: (136, 246)}  # columns in which the counter is centred
SHORTER = 6  # rows by which black suits end above the others, at both sizes


def counter_slot(size: int, lowest: int, highest: int) -> Slot:
    """The counter to the right of the score, for values ``lowest`` to ``highest``; code 0 is
    ``lowest``.

    The place is as wide as the widest value, not as the whole field, which reaches into that of the
    score.
    """
    layout = TEXT[size]
    across, down = layout.digit_scale
    step = PATTERN * across + layout.digit_gap
    texts = [str(value) for value in range(lowest, highest + 1)]
    low, high = COUNTER_X[size]
    starts = [low + centred(high - low, len(text) * step - layout.digit_gap) for text in texts]
    left = min(starts)
    width = (
        max(
            start + len(text) * step - layout.digit_gap
            for start, text in zip(starts, texts, strict=True)
        )
        - left
    )
    pictures = []
    for start, text in zip(starts, texts, strict=True):
        picture = blank(PATTERN * down, width, SMOKE)
        for place, sign in enumerate(text):
            rows = MINUS if sign == "-" else DIGITS[int(sign)]
            bitmap(picture, rows, start - left + place * step, 0, across, down, PALE_GREEN)
        pictures.append(picture)
    return Slot(np.stack(pictures), left, layout.digit_y)


class Screen:
    """Everything on the screen of one CountRecall configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
        counter: Lowest and highest value shown; what lies beyond is shown as the nearer of the two.
    """

    def __init__(self, size: int, level: Params, counter: tuple[int, int]) -> None:
        self.level = level
        self.counter_range = counter
        unit = size // 128
        offset = FIELD[0] * unit
        side = FIELD[1] * unit
        background = titled_background(size, "COUNTRECALL", SMOKE, AZURE)
        rectangle(background, offset, offset, offset + side, offset + side, SLATE_BLUE)
        self.score = number_slot(size, level.cards, SMOKE, CRIMSON)
        self.counter = counter_slot(size, *counter)
        self.card = corner_slot(size, False, SMOKE, SHORTER)
        self.query = corner_slot(size, True, SMOKE, SHORTER)
        self.history = history_grid(size, SLATE_BLUE)
        self.layers = Layers(
            background, self.score, self.counter, self.card, self.query, self.history
        )

    def draw(self, state: CountRecallState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows no cards dealt before."""
        index = jnp.arange(self.level.cards)
        now = index == state.timestep
        lowest, highest = self.counter_range
        answer = jnp.clip(state.answer, lowest, highest) - lowest
        card = jnp.where(now, 1 + state.cards, NO_CARD).sum()
        query = jnp.where(now, 1 + state.queries, NO_CARD).sum()
        history = history_codes(state.cards, (index < state.timestep) & ~jnp.asarray(partial))
        return self.layers.draw(state.score, answer, card, query, history)
