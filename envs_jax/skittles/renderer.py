"""The screen of Skittles: coloured blocks and a white agent on black, without grid lines."""

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    TileGrid,
    blank,
    grid_layout,
    lined_board,
    number_slot,
    titled_background,
)
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    BLUE,
    CANARY,
    GREEN,
    ORANGE,
    RED,
    SKY,
    SPRING_GREEN,
    ULTRAVIOLET,
    WHITE,
    YELLOW,
)
from arcade_torch.envs_jax.skittles.rules import CELLS, MAX_STEPS, SkittlesState, visible_rows

BLOCKS = (RED, ORANGE, YELLOW, GREEN, BLUE, SKY, ULTRAVIOLET)
AGENT = 1 + len(BLOCKS)  # tile codes: empty, then the blocks by colour, then the agent


class Screen:
    """Everything on the screen of Skittles.

    Args:
        size: Side of the picture, 128 or 256.
    """

    board: TileGrid

    def __init__(self, size: int) -> None:
        layout = grid_layout(size, CELLS)
        tiles = [blank(layout.tile, layout.tile, colour) for colour in (BLACK, *BLOCKS, WHITE)]
        background = titled_background(size, "SKITTLES", BLACK, CANARY)
        background, self.board = lined_board(background, layout, tiles, BLACK)
        self.score = number_slot(size, MAX_STEPS, BLACK, SPRING_GREEN)
        self.layers = Layers(background, self.score, self.board)

    def draw(self, state: SkittlesState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows each block in about half of
        the frames.
        """
        visible = visible_rows(state) | ~jnp.asarray(partial)
        columns = np.arange(CELLS)
        block = (columns == state.column[:, None]) & visible[:, None]
        codes = jnp.where(block, 1 + state.colour[:, None], 0)
        agent = (columns[:, None] == CELLS - 1) & (columns == state.x)
        return self.layers.draw(state.time, jnp.where(agent, AGENT, codes))
