"""A game of your own in one file: Pairs, the card game, as a pair of MDP and POMDP.

Sixteen cards lie face down on a 4 x 4 board, eight faces twice each. Actions 0 to 3 move the
cursor, 4 turns the card under it. Two equal cards turned one after the other stay up and pay 1/8;
others are turned back by the next action. The MDP twin shows the faces of all cards, the POMDP twin
those that are up: there the player has to remember.

Importing this file registers the game, and every tool knows it; run as a script it is
``arcade-torch train`` itself:

    arcade-torch train --import examples/own_game.py --preset small --env PairsEasy
    python examples/own_game.py --preset small --observability partial
"""

import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import Game, register
from arcade_torch.envs_jax import render as draw
from arcade_torch.envs_jax.boards import cell_mask, move_cursor
from arcade_torch.envs_jax.game import FIRE, Array, Rules
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    GREY,
    MIST,
    NAVY,
    ORANGE,
    SILVER,
    WHITE,
    Colour,
)

SIDE = 4
FACES = 8
# tile codes
DOWN = 0  # a card face down
KNOWN = 1  # face down, and shown by the MDP twin; one code a face
UP = 1 + FACES  # face up; one code a face
LOOKS: list[tuple[Colour, int | None]] = [
    (NAVY, None),
    *((c, face) for c in (SILVER, WHITE) for face in range(FACES)),
]


class PairsState(NamedTuple):
    """All that is true of the game; cards are numbered row by row."""

    cards: Array  # int32 [16], the face of each card, 0..7
    found: Array  # bool [16], whether its pair was found
    turned: Array  # int32 [2], the cards turned in this try, -1 for none yet
    x: Array  # int32, column of the cursor
    y: Array  # int32, row of the cursor
    time: Array  # int32, steps taken


def card(side: int, colour: Colour, face: int | None, cursor: bool) -> Picture:
    """The picture of one card: uint8 [side, side, 3]."""
    picture = draw.blank(side, side, ORANGE if cursor else colour)
    draw.rectangle(picture, 2, 2, side - 2, side - 2, colour)
    scale = (side - 4) // draw.PATTERN
    start = draw.centred(side, draw.PATTERN * scale)
    return (
        picture
        if face is None
        else draw.bitmap(picture, draw.DIGITS[face], start, start, scale, scale, BLACK)
    )


class Pairs(Game[PairsState]):
    """Find the eight pairs in 200 steps. Returns lie in [0, 1]."""

    max_steps = 200
    return_range = (0.0, 1.0)

    def __init__(self, *, id: str, obs_size: int, rules: Rules) -> None:
        self.id = id
        self.obs_size = obs_size
        self.rules = rules
        layout = draw.grid_layout(obs_size, SIDE)
        background = draw.titled_background(obs_size, "PAIRS", MIST, NAVY)
        tiles = [
            card(layout.tile, colour, face, cursor)
            for cursor in (False, True)
            for colour, face in LOOKS
        ]
        background, self.board = draw.lined_board(background, layout, tiles, GREY)
        self.score = draw.number_slot(obs_size, FACES, MIST, NAVY)
        self.layers = draw.Layers(background, self.score, self.board)

    def reset(self, key: Array) -> PairsState:
        """Shuffle the cards; the cursor begins in the upper left corner."""
        zero = jnp.int32(0)
        size = SIDE * SIDE
        cards = jax.random.permutation(key, jnp.arange(size, dtype=jnp.int32) % FACES)
        return PairsState(
            cards, jnp.zeros(size, bool), jnp.full(2, -1, jnp.int32), zero, zero, zero
        )

    def step(
        self, key: Array, state: PairsState, action: Array
    ) -> tuple[PairsState, Array, Array, Array]:
        """Turn back what did not match, then move or turn."""
        first = jnp.where(state.turned[1] >= 0, -1, state.turned[0])
        x, y = move_cursor(state.x, state.y, action, SIDE)
        here = y * SIDE + x
        turns = (action == FIRE) & ~state.found[here] & (here != first)
        second = jnp.where(turns & (first >= 0), here, -1)
        turned = jnp.stack([jnp.where(turns & (first < 0), here, first), second])
        pair = (second >= 0) & (state.cards[first] == state.cards[second])
        found = state.found | (pair & jnp.isin(jnp.arange(SIDE * SIDE), turned))
        new = PairsState(state.cards, found, turned, x, y, state.time + 1)
        return new, pair / jnp.float32(FACES), found.all(), new.time >= self.max_steps

    def render(self, state: PairsState, partial: Array | bool) -> Array:
        """Faces that are up, or all; a card face down in the MDP twin looks different from one that
        is up.
        """
        up = state.found | jnp.isin(jnp.arange(SIDE * SIDE), state.turned)
        codes = jnp.where(up, UP + state.cards, jnp.where(partial, DOWN, KNOWN + state.cards))
        cursor = cell_mask(state.x, state.y, SIDE).T  # boards are [x, y], pictures [row, column]
        codes = codes.reshape(SIDE, SIDE) + len(LOOKS) * cursor
        return self.layers.draw(state.found.sum() // 2, codes)


register("PairsEasy-v0", Pairs)

if __name__ == "__main__":
    from arcade_torch.tools.cli import main

    sys.exit(main(["train", "--env", "PairsEasy", *sys.argv[1:]]))
