"""The rules of Navigator: an agent walks to a treasure among blocks of TNT; boards are indexed [x,
y].
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.boards import cell_mask, move_cursor
from arcade_torch.envs_jax.game import FIRE, UNSET, Array, Rules

TNTS = 7  # blocks on every map
DEATH_REWARD = -0.5
TREASURE_REWARD = 1.0


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the map
    usual_place: tuple[int, int]
    """Places in the list of free cells (x-major) from which the reference takes the treasure's x
    and y in every episode. They are inferred from the measured distribution of its treasures.
    """

    @property
    def cells(self) -> int:
        """Cells of the map."""
        return self.side**2

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return self.cells

    @property
    def step_reward(self) -> float:
        """Reward of a step that neither opens the treasure nor ends on TNT."""
        return -0.5 / self.cells


LEVELS = {
    "NavigatorEasy": Params(8, (18, 38)),
    "NavigatorMedium": Params(10, (45, 56)),
    "NavigatorHard": Params(12, (112, 79)),
}

FREE = 0
TNT = 1
TREASURE = 2


class NavigatorState(NamedTuple):
    """A map, an agent, and a clock."""

    x: Array  # int32, column of the agent
    y: Array  # int32, row of the agent
    board: Array  # int8 [side, side], FREE, TNT or TREASURE
    timestep: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def draw_distinct(key: Array, count: int, cells: int) -> Array:
    """A uniformly random set of cells, by Floyd's algorithm: int32 [count], in no useful order.

    The remainder that maps 32 random bits to so few favours some cells by less than one in ten
    million.
    """
    draws = jax.random.bits(key, (count,))
    chosen: list[Array] = []
    for draw, last in zip(draws, range(cells - count, cells), strict=True):
        cell = (draw % jnp.uint32(last + 1)).astype(jnp.int32)
        taken = jnp.any(jnp.stack(chosen) == cell) if chosen else jnp.bool_(False)
        chosen.append(jnp.where(taken, last, cell))
    return jnp.stack(chosen)


def reset(key: Array, level: Params, rules: Rules) -> NavigatorState:
    """A fresh map; see :func:`place_apart` and, for the reference, :func:`place_as_published`."""
    place = place_apart if rules == "default" else place_as_published
    tnt, treasure, agent = place(key, level)
    cell = jnp.arange(level.cells)
    board = jnp.where(
        cell == treasure, TREASURE, jnp.where((cell == tnt[:, None]).any(0), TNT, FREE)
    )
    board = board.astype(jnp.int8).reshape(level.side, level.side)
    return NavigatorState(agent // level.side, agent % level.side, board, jnp.int32(0))


def place_apart(key: Array, level: Params) -> tuple[Array, Array, Array]:
    """Blocks, treasure and agent on distinct cells, all ways with equal chance.

    Returns:
        Cells ``x * side + y``: TNT int32 [TNTS], treasure and agent int32.
    """
    for_cells, for_roles = jax.random.split(key)
    cells = draw_distinct(for_cells, TNTS + 2, level.cells)
    draw = jax.random.bits(for_roles, (2,))
    index = jnp.arange(TNTS + 2)
    treasure = (draw[0] % jnp.uint32(TNTS + 2)).astype(jnp.int32)
    agent = (treasure + 1 + (draw[1] % jnp.uint32(TNTS + 1)).astype(jnp.int32)) % (TNTS + 2)
    treasure_cell = jnp.sum(jnp.where(index == treasure, cells, 0))
    agent_cell = jnp.sum(jnp.where(index == agent, cells, 0))
    # What is neither treasure nor agent is TNT; their own places in the list are filled with a
    # block's cell.
    spare = (index != treasure) & (index != agent)
    some_block = jnp.max(jnp.where(spare, cells, -1))
    return jnp.where(spare, cells, some_block), treasure_cell, agent_cell


def place_as_published(key: Array, level: Params) -> tuple[Array, Array, Array]:
    """The reference: x and y of the treasure, and of the agent, are taken from two free cells each.

    The treasure's are always the same two entries of the list of free cells, so that it hardly
    moves from one episode to the next. It may replace a block of TNT, and the agent may start on a
    block or on the treasure.

    Returns:
        As :func:`place_apart`.
    """
    for_tnt, for_agent = jax.random.split(key)
    tnt = draw_distinct(for_tnt, TNTS, level.cells)
    free = level.cells - TNTS
    entries = jax.random.randint(for_agent, (2,), 0, free)
    cell = jnp.arange(level.cells)
    is_tnt = (cell == tnt[:, None]).any(0)
    rank = cell - (tnt[:, None] < cell).sum(0)

    def free_cell(entry: Array | int) -> Array:
        return jnp.sum(jnp.where(~is_tnt & (rank == entry), cell, 0))

    def compose(for_x: Array | int, for_y: Array | int) -> Array:
        x = free_cell(for_x) // level.side
        y = free_cell(for_y) % level.side
        return x * level.side + y

    return tnt, compose(*level.usual_place), compose(entries[0], entries[1])


def step(
    state: NavigatorState, action: Array, level: Params, rules: Rules
) -> tuple[NavigatorState, Array, Array, Array]:
    """Move the agent, or open what it stands on.

    A move that ends on TNT kills, also one against the border; opening the treasure wins; either
    ends the game. With ``rules="reference"`` the step that reaches the time limit pays nothing,
    whatever happened.
    """
    x, y = move_cursor(state.x, state.y, action, level.side)
    new = NavigatorState(x, y, state.board, state.timestep + 1)

    at_agent = cell_mask(x, y, level.side)
    cell = jnp.sum(jnp.where(at_agent, state.board, 0))
    fire = action == FIRE
    dead = ~fire & (cell == TNT)
    won = fire & (cell == TREASURE)
    time_limit = new.timestep >= level.max_steps
    reward = jnp.where(won, TREASURE_REWARD, jnp.where(dead, DEATH_REWARD, level.step_reward))
    if rules == "reference":
        reward = jnp.where(time_limit, 0.0, reward)
    return new, reward.astype(jnp.float32), dead | won, time_limit
