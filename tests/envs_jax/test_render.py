"""Drawing primitives and text."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.registry import DIFFICULTIES
from arcade_torch.envs_jax.render import (
    DIGITS,
    LETTERS,
    TEXT,
    Layers,
    Slot,
    TileGrid,
    arc,
    bitmap,
    blank,
    disc,
    draw_name,
    grid_layout,
    lined_board,
    number_pictures,
    number_slot,
    polygon,
    rectangle,
)

BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def ink(picture):
    return (picture == 255).all(-1)


def test_every_digit_and_letter_is_a_five_by_five_pattern_of_its_own():
    patterns = [*DIGITS, *LETTERS.values()]
    assert all(
        len(rows) == 5 and all(len(row) == 5 and set(row) <= {"0", "1"} for row in rows)
        for rows in patterns
    )
    assert len(set(DIGITS)) == 10 and len(set(LETTERS.values())) == 26


def test_a_rectangle_is_exclusive_at_its_far_edges():
    assert np.argwhere(ink(rectangle(blank(6, 6, BLACK), 1, 2, 3, 4, WHITE))).tolist() == [
        [2, 1],
        [2, 2],
        [3, 1],
        [3, 2],
    ]


def test_shapes_have_the_area_they_ought_to_have():
    assert ink(disc(blank(100, 100, BLACK), 50, 50, 30, WHITE)).sum() == pytest.approx(
        np.pi * 900, rel=0.01
    )
    square = [(20, 20), (80, 20), (80, 80), (20, 80)]
    assert ink(polygon(blank(100, 100, BLACK), square, WHITE)).sum() == 3600
    assert np.array_equal(
        polygon(blank(100, 100, BLACK), square[::-1], WHITE),
        polygon(blank(100, 100, BLACK), square, WHITE),
    )
    quarter = ink(arc(blank(100, 100, BLACK), 50, 50, 20, 40, 0, np.pi / 2, WHITE))
    assert quarter.sum() == pytest.approx(np.pi * (1600 - 400) / 4, rel=0.02)
    assert quarter[:50, 50:].sum() == quarter.sum(), "from the right to the top"


def test_bitmaps_are_enlarged_both_ways():
    picture = bitmap(blank(4, 6, BLACK), ("10", "01"), 0, 0, 3, 2, WHITE)
    assert ink(picture)[:2, :3].all() and ink(picture)[2:, 3:].all() and ink(picture).sum() == 12


@pytest.mark.parametrize("size", [128, 256])
def test_the_longest_name_fits_and_is_centred(size):
    shown = ink(draw_name(blank(size, size, BLACK), "MINESWEEPER", WHITE))
    columns, rows = np.flatnonzero(shown.any(0)), np.flatnonzero(shown.any(1))
    assert abs(columns[0] - (size - 1 - columns[-1])) <= 1
    assert (rows[0], rows[-1]) == {128: (116, 125), 256: (233, 252)}[size]


@pytest.mark.parametrize("size", [128, 256])
def test_numbers_are_centred_distinct_and_inside_their_field(size):
    pictures = number_pictures(size, 601, BLACK, WHITE)
    layout = TEXT[size]
    assert pictures.shape[1:3] == (
        layout.field_y[1] - layout.field_y[0],
        layout.field_x[1] - layout.field_x[0],
    )
    assert len(np.unique(pictures.reshape(602, -1), axis=0)) == 602
    columns = np.flatnonzero(ink(pictures[600]).any(0))
    width = 3 * {128: 10, 256: 15}[size] + 2 * 2
    assert len(range(columns[0], columns[-1] + 1)) == width
    assert columns[0] == (pictures.shape[2] - width) // 2


HIGHEST = {
    "AutoEncode": (27, 53, 79),  # the reference pays one card twice
    "BattleShip": (12,) * 3,
    "Breakout": (60,) * 3,
    "CartPole": (200, 400, 600),
    "CountRecall": (26, 52, 78),
    "MineSweeper": (14, 30, 54),
    "NoisyCartPole": (200,) * 3,
    "Skittles": (100,) * 3,
    "Tetris": (10 + 3,) * 3,  # nine lines, then four at once
}


@pytest.mark.parametrize("name", HIGHEST)
def test_the_highest_number_of_a_game_can_be_shown(name):
    """It is seen in final frames alone."""
    for difficulty, highest in zip(DIFFICULTIES, HIGHEST[name], strict=True):
        assert len(make(name + difficulty, rules="reference").screen.score.pictures) > highest


@pytest.mark.parametrize(
    ("size", "cells", "side", "tile", "offset"),
    [
        (256, 4, 186, 44, 35),
        (128, 4, 94, 21, 17),
        (256, 6, 182, 28, 37),
        (128, 6, 92, 13, 18),
        (256, 8, 186, 21, 35),
        (128, 8, 90, 9, 19),
        (256, 10, 192, 17, 32),
        (128, 10, 92, 7, 18),
        (256, 12, 182, 13, 37),
        (128, 12, 98, 6, 15),
    ],
)
def test_boards_stand_where_the_published_ones_do(size, cells, side, tile, offset):
    layout = grid_layout(size, cells)
    assert (layout.side, layout.tile, layout.offset) == (side, tile, offset)


@pytest.mark.parametrize(("size", "most"), [(128, 32), (256, 64)])
def test_a_board_of_any_number_of_cells_fits_between_number_and_title(size, most):
    for cells in range(1, most + 1):
        layout = grid_layout(size, cells)
        assert layout.tile >= 1
        assert layout.offset >= TEXT[size].field_y[1]
        assert layout.offset + layout.side <= TEXT[size].letter_y


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((128, 33), "cells is 33, a screen of 128 pixels takes 1 to 32"),
        ((256, 0), "cells is 0, a screen of 256 pixels takes 1 to 64"),
        ((128, 4.0), "cells is 4.0, a screen of 128 pixels takes 1 to 32"),
        ((64, 4), "size is 64, allowed: 128, 256"),
    ],
)
def test_a_board_that_no_screen_takes_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        grid_layout(*arguments)


def test_a_title_may_hold_spaces_and_digits():
    title = ink(draw_name(blank(128, 128, BLACK), "LEVEL 2", WHITE))
    solid = ink(draw_name(blank(128, 128, BLACK), "LEVELX2", WHITE))
    columns = np.flatnonzero((title != solid).any(0))
    assert 0 < len(columns) <= 10  # the place of the space, and no other
    assert not title[:, columns].any()


@pytest.mark.parametrize(
    ("size", "name", "message"),
    [
        (128, "TWELVE WORDS", "the title 'TWELVE WORDS' has 12 characters, a screen takes 11"),
        (256, "TWELVE WORDS", "the title 'TWELVE WORDS' has 12 characters, a screen takes 11"),
        (128, "P_IRS", "the title 'P_IRS' holds '_', allowed: letters A to Z, digits, spaces"),
    ],
)
def test_a_title_that_cannot_be_written_is_refused_in_one_line(size, name, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        draw_name(blank(size, size, BLACK), name, WHITE)


@pytest.mark.parametrize(
    ("size", "highest", "message"),
    [
        (128, 1000, "highest is 1000, a screen of 128 pixels takes 0 to 999"),
        (256, 100_000, "highest is 100000, a screen of 256 pixels takes 0 to 99999"),
        (128, -1, "highest is -1, a screen of 128 pixels takes 0 to 999"),
        (128, 2.5, "highest is 2.5, a screen of 128 pixels takes 0 to 999"),
    ],
)
def test_a_number_that_does_not_fit_its_field_is_refused_in_one_line(size, highest, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        number_slot(size, highest, BLACK, WHITE)


def test_the_highest_number_of_three_digits_fits():
    assert len(number_slot(128, 999, BLACK, WHITE).pictures) == 1000


def test_a_tile_of_another_size_is_refused_in_one_line():
    layout = grid_layout(128, 3)
    tiles = [blank(layout.tile, layout.tile, BLACK), blank(4, 5, WHITE)]
    message = f"tile 1 is uint8 [4, 5, 3], the layout wants [{layout.tile}, {layout.tile}, 3]"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        lined_board(blank(128, 128, BLACK), layout, tiles, WHITE)


LAMP = np.stack([blank(2, 2, BLACK), blank(2, 2, WHITE)])


@pytest.mark.parametrize(
    ("codes", "message"),
    [
        ((2, [[0, 1]]), "place 0 (Slot at x 3, y 1) has no picture 2: codes are 0 to 1"),
        ((-1, [[0, 1]]), "place 0 (Slot at x 3, y 1) has no picture -1: codes are 0 to 1"),
        (
            (0, [[0, 1], [7, 0]]),
            "place 1 (TileGrid at x 0, y 4), row 1, column 0, has no picture 7: codes are 0 to 1",
        ),
        ((0,), "got 1 codes for 2 places"),
        (([0, 0], [[0, 1]]), "place 0 (Slot at x 3, y 1) wants a single code, got shape [2]"),
        (
            (0, [0, 1]),
            "place 1 (TileGrid at x 0, y 4) wants codes [rows, columns], got shape [2]",
        ),
        (
            (0, [[0], [0], [0]]),
            "place 1 (TileGrid at x 0, y 4) does not fit the screen: it reaches to x 2, y 10, of 8",
        ),
    ],
)
def test_codes_that_a_screen_cannot_show_are_refused_in_one_line(codes, message):
    layers = Layers(blank(8, 8, BLACK), Slot(LAMP, 3, 1), TileGrid(LAMP, 0, 4))
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        layers.draw(*(jnp.asarray(code) for code in codes))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), places=st.integers(0, 5))
def test_layers_draw_what_one_place_after_the_other_draws(seed, places):
    """Places may overlap, and reach over the same lines; a grid and a slot may have the same
    pictures.
    """
    rng, size = np.random.default_rng(seed), 24
    background = rng.integers(0, 256, (size, size, 3), np.uint8)
    made, codes = [], []
    for number in range(places):
        kinds, height, width = rng.integers(1, 5, 3)
        pictures = rng.integers(0, 256, (kinds, height, width, 3), np.uint8)
        shape = tuple(rng.integers(1, 4, 2)) if number % 2 else ()
        x, y = rng.integers(0, size - 12, 2)
        made.append((TileGrid if shape else Slot)(pictures, int(x), int(y)))
        codes.append(rng.integers(0, kinds, (3, *shape)).astype(np.int8))
    layers = Layers(background, *made)
    frames = jax.jit(jax.vmap(layers.draw, axis_size=3))(*codes)
    for env, frame in enumerate(frames):
        expected = background.copy()
        for place, code in zip(made, codes, strict=True):
            pictures = place.atlas if isinstance(place, TileGrid) else place.pictures
            height, width = pictures.shape[1:3]
            for row, column in np.ndindex(*np.atleast_2d(code[env]).shape):
                y, x = place.y + height * row, place.x + width * column
                expected[y : y + height, x : x + width] = pictures[
                    np.atleast_2d(code[env])[row, column]
                ]
        assert np.array_equal(frame, expected)


def test_mixed_places_change_what_lies_below_them():
    below = Slot(np.stack([blank(2, 4, BLACK), blank(2, 4, WHITE)]), 1, 1)
    mixed = TileGrid(
        np.array([0, 255, 15], np.uint8).reshape(3, 1, 1, 1).repeat(3, -1), 2, 1, mixed=True
    )
    layers = Layers(blank(8, 8, BLACK), below, mixed)
    assert layers.draw(1, jnp.array([[0, 1, 2]]))[1, :, 0].tolist() == [
        0,
        255,
        255,
        0,
        240,
        0,
        0,
        0,
    ]
    assert layers.draw(0, jnp.array([[1, 2, 0]]))[1, :, 0].tolist() == [0, 0, 255, 15, 0, 0, 0, 0]


def test_a_drawing_writes_each_frame_once():
    """No scatter, no update in place, no loop, however many places there are."""
    tiles = TileGrid(np.zeros((3, 4, 4, 3), np.uint8), 0, 0)
    layers = Layers(blank(64, 64, WHITE), tiles)
    board = jnp.zeros((128, 12, 12), jnp.int32)
    text = jax.jit(jax.vmap(layers.draw)).lower(board).as_text()
    assert "scatter" not in text and "dynamic_update_slice" not in text and "while" not in text
