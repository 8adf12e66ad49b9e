"""A cursor on a square board, and how scripted players steer it; boards are indexed [x, y].

``TileGrid`` takes codes [row, column], so a board is drawn with a transpose.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import DOWN, FIRE, LEFT, RIGHT, UP, Array

Cells = npt.NDArray[Any]


def move_cursor(x: Array, y: Array, action: Array, side: int) -> tuple[Array, Array]:
    """Move by one cell, not beyond the border; actions that are no directions leave it where it is.

    Args:
        x: int32, column.
        y: int32, row.
        action: int32 in 0..4.
        side: Cells per side.

    Returns:
        The new column and row, int32.

    Example:
        >>> [int(v) for v in move_cursor(jnp.int32(0), jnp.int32(3), jnp.int32(RIGHT), 4)]
        [1, 3]
    """
    dx = (action == RIGHT).astype(jnp.int32) - (action == LEFT)
    dy = (action == DOWN).astype(jnp.int32) - (action == UP)
    return jnp.clip(x + dx, 0, side - 1), jnp.clip(y + dy, 0, side - 1)


def cell_mask(x: Array, y: Array, side: int) -> Array:
    """Where the cursor is: bool [side, side]."""
    cells = jnp.arange(side)
    return (cells[:, None] == x) & (cells == y)


def towards(x: Cells, y: Cells, goal_x: Cells, goal_y: Cells) -> npt.NDArray[np.int32]:
    """The moves that bring cursors nearer to their goals, first sideways; on the host.

    Args:
        x: int [N], columns.
        y: int [N], rows.
        goal_x: int [N], columns of the goals.
        goal_y: int [N], rows of the goals.

    Returns:
        int32 [N], ``FIRE`` where a cursor is at its goal.
    """
    sideways = np.where(goal_x > x, RIGHT, LEFT)
    along = np.where(goal_y > y, DOWN, UP)
    at_column = np.where(goal_y != y, along, FIRE)
    return np.where(goal_x != x, sideways, at_column).astype(np.int32)
