"""Drawing primitives and text."""

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
    number_pictures,
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
