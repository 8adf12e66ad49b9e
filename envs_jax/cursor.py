"""A cursor on a square board, shared by the games that have one; boards are indexed [x, y]."""

import jax.numpy as jnp

from arcade_torch.envs_jax.game import DOWN, LEFT, RIGHT, UP, Array


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
