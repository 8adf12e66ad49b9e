"""Digits, letters, and where the number and the name stand on a screen."""

from dataclasses import dataclass

import numpy as np

from arcade_torch.envs_jax.render.canvas import Picture, bitmap, blank
from arcade_torch.envs_jax.render.palette import Colour
from arcade_torch.envs_jax.validation import check_choice, format_value

PATTERN = 5  # digits and letters are 5 x 5 patterns

_DIGITS = (
    "11111 10001 10001 10001 11111",
    "00100 01100 00100 00100 01110",
    "11111 00001 11111 10000 11111",
    "11111 00001 11111 00001 11111",
    "10001 10001 11111 00001 00001",
    "11111 10000 11111 00001 11111",
    "11111 10000 11111 10001 11111",
    "11111 00001 00001 00001 00001",
    "11111 10001 11111 10001 11111",
    "11111 10001 11111 00001 11111",
)
_LETTERS = {
    "A": "01110 10001 11111 10001 10001",
    "B": "11110 10001 11110 10001 11110",
    "C": "01111 10000 10000 10000 01111",
    "D": "11110 10001 10001 10001 11110",
    "E": "11111 10000 11110 10000 11111",
    "F": "11111 10000 11110 10000 10000",
    "G": "01111 10000 10011 10001 01111",
    "H": "10001 10001 11111 10001 10001",
    "I": "01110 00100 00100 00100 01110",
    "J": "00111 00010 00010 10010 01100",
    "K": "10010 10100 11000 10100 10010",
    "L": "10000 10000 10000 10000 11111",
    "M": "10001 11011 10101 10001 10001",
    "N": "10001 11001 10101 10011 10001",
    "O": "01110 10001 10001 10001 01110",
    "P": "11110 10001 11110 10000 10000",
    "Q": "01110 10001 10101 10010 01101",
    "R": "11110 10001 11110 10010 10001",
    "S": "01111 10000 01110 00001 11110",
    "T": "11111 00100 00100 00100 00100",
    "U": "10001 10001 10001 10001 01110",
    "V": "10001 10001 01010 01010 00100",
    "W": "10001 10001 10101 11011 10001",
    "X": "10001 01010 00100 01010 10001",
    "Y": "10001 01010 00100 00100 00100",
    "Z": "11111 00010 00100 01000 11111",
}
DIGITS: tuple[tuple[str, ...], ...] = tuple(tuple(rows.split()) for rows in _DIGITS)
LETTERS: dict[str, tuple[str, ...]] = {
    letter: tuple(rows.split()) for letter, rows in _LETTERS.items()
}

_BLANK = ("0" * PATTERN,) * PATTERN
# all that a title may hold
_CHARACTERS = {**LETTERS, **{str(digit): rows for digit, rows in enumerate(DIGITS)}, " ": _BLANK}


@dataclass(frozen=True)
class TextLayout:
    """Where text stands on a screen of one size, in pixels."""

    field_x: tuple[int, int]  # columns of the number field
    field_y: tuple[int, int]  # rows of the number field
    digit_y: int  # first row of the digits
    digit_scale: tuple[int, int]  # pixels per pattern cell (across, down)
    digit_gap: int
    letter_y: int  # first row of the name
    letter_scale: int  # pixels per pattern cell, both ways
    letter_gap: int

    @property
    def letter_step(self) -> int:
        """Distance between neighbouring letters."""
        return PATTERN * self.letter_scale + self.letter_gap

    @property
    def digit_step(self) -> int:
        """Distance between neighbouring digits."""
        return PATTERN * self.digit_scale[0] + self.digit_gap

    @property
    def most_digits(self) -> int:
        """Digits that the number field takes."""
        width = self.field_x[1] - self.field_x[0]
        return (width + self.digit_gap) // self.digit_step


TEXT = {
    128: TextLayout((43, 85), (1, 15), 2, (2, 2), 2, 116, 2, 1),
    256: TextLayout((86, 171), (2, 30), 3, (3, 5), 2, 233, 4, 3),
}


def centred(total: int, length: int) -> int:
    """First coordinate of something ``length`` long centred in ``total``, rounded down."""
    return (total - length) // 2


def draw_name(picture: Picture, name: str, colour: Colour) -> Picture:
    """Write the game's name in the band at the bottom, in place; returns the picture.

    Args:
        picture: uint8 [S, S, 3], S in {128, 256}.
        name: Up to 11 letters, digits and spaces; written in capitals.
        colour: Their colour.

    Raises:
        ValueError: A picture of another size, a name that is too long, or another character.
    """
    size = picture.shape[1]
    check_size(size)
    layout = TEXT[size]
    _check_name(name, most=(size + layout.letter_gap) // layout.letter_step)
    step = layout.letter_step
    x = centred(size, len(name) * step - layout.letter_gap)
    for character in name.upper():
        bitmap(
            picture,
            _CHARACTERS[character],
            x,
            layout.letter_y,
            layout.letter_scale,
            layout.letter_scale,
            colour,
        )
        x += step
    return picture


def _check_name(name: str, most: int) -> None:
    """Refuse a name that cannot be written."""
    for character in name:
        if character.upper() not in _CHARACTERS:
            raise ValueError(
                f"the title {name!r} holds {character!r}, allowed: letters A to Z, digits, spaces"
            )
    if len(name) > most:
        raise ValueError(f"the title {name!r} has {len(name)} characters, a screen takes {most}")


def check_size(size: int) -> None:
    """Raise ValueError unless there is a screen of this side."""
    check_choice("size", size, tuple(TEXT))


def number_pictures(size: int, highest: int, background: Colour, colour: Colour) -> Picture:
    """The number field for every value.

    Args:
        size: Side of the screen, 128 or 256.
        highest: Largest value.
        background: Colour behind the digits.
        colour: Colour of the digits.

    Returns:
        uint8 [highest + 1, field height, field width, 3].

    Raises:
        ValueError: Another size, or a number that the field does not take.
    """
    check_size(size)
    layout = TEXT[size]
    most = 10**layout.most_digits - 1
    if not isinstance(highest, int) or not 0 <= highest <= most:
        raise ValueError(
            f"highest is {format_value(highest)}, a screen of {size} pixels takes 0 to {most}"
        )
    across, down = layout.digit_scale
    height = layout.field_y[1] - layout.field_y[0]
    width = layout.field_x[1] - layout.field_x[0]
    step = layout.digit_step
    pictures = []
    for value in range(highest + 1):
        field = blank(height, width, background)
        digits = str(value)
        x = centred(width, len(digits) * step - layout.digit_gap)
        for digit in digits:
            bitmap(
                field,
                DIGITS[int(digit)],
                x,
                layout.digit_y - layout.field_y[0],
                across,
                down,
                colour,
            )
            x += step
        pictures.append(field)
    return np.stack(pictures)
