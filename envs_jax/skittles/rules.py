"""The rules of Skittles: at every step a new row with one block falls in at the top; the agent
dodges at the bottom.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.game import LEFT, RIGHT, UNSET, Array, Rules

CELLS = 10  # rows and columns of the grid
MAX_STEPS = 100  # time limit; each step pays 1 / MAX_STEPS
COLOURS = 7  # blocks take turns through as many colours


@dataclass(frozen=True)
class Params:
    """One difficulty: the lane, where blocks fall and the agent may stand."""

    width: int  # columns of the lane
    first: int  # its leftmost column

    @property
    def last(self) -> int:
        """Rightmost column of the lane."""
        return self.first + self.width - 1


LEVELS = {
    "SkittlesEasy": Params(8, 1),
    "SkittlesMedium": Params(7, 2),
    "SkittlesHard": Params(6, 2),
}

NO_BLOCK = -1


class SkittlesState(NamedTuple):
    """The falling rows, the agent, and what decides how the POMDP flickers."""

    # int32 [CELLS], column of the block in each row from the top, NO_BLOCK in an empty row
    column: Array
    colour: Array  # int32 [CELLS], 0 to COLOURS - 1
    x: Array  # int32, column of the agent; it stands in the bottom row
    # bool [width], columns of the lane a survivor can be in when the newest row arrives at the
    # bottom
    safe: Array
    flicker_key: Array  # uint32 [2], with the time it decides which cells the POMDP hides
    time: Array  # int32, steps taken, which is the score
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def reset(key: Array, level: Params, rules: Rules) -> SkittlesState:
    """An empty grid, the agent anywhere in the lane; with ``rules="reference"`` all episodes
    flicker alike.
    """
    for_agent, flicker_key = jax.random.split(key)
    if rules == "reference":
        flicker_key = jnp.zeros_like(flicker_key)
    x = level.first + jax.random.randint(for_agent, (), 0, level.width, dtype=jnp.int32)
    empty = jnp.full(CELLS, NO_BLOCK, jnp.int32)
    zeros = jnp.zeros(CELLS, jnp.int32)
    return SkittlesState(empty, zeros, x, jnp.ones(level.width, bool), flicker_key, jnp.int32(0))


def reachable(safe: Array, newest: Array, level: Params) -> Array:
    """Where a survivor can be one step on, when the block of the newest row (or ``NO_BLOCK``)
    leaves: bool [width].

    ``safe``, bool [width], is where survivors can be when that row arrives.
    """
    beside = jnp.pad(safe, 1)
    lane = level.first + jnp.arange(level.width)
    return (beside[:-2] | safe | beside[2:]) & (lane != newest)


def draw_block(key: Array, reach: Array, level: Params, rules: Rules) -> Array:
    """The column of a new block: int32, uniform among those that leave a survivor somewhere to be.

    These are never none, as a lane has at least two columns. ``rules="reference"`` draws among all
    of the lane.
    """
    if rules == "reference":
        return level.first + jax.random.randint(key, (), 0, level.width, dtype=jnp.int32)
    allowed = (reach.sum() - reach) > 0
    pick = jax.random.randint(key, (), 0, allowed.sum(), dtype=jnp.int32)
    return level.first + (jnp.cumsum(allowed) <= pick).sum(dtype=jnp.int32)


def step(
    key: Array, state: SkittlesState, action: Array, level: Params, rules: Rules, hit_reward: float
) -> tuple[SkittlesState, Array, Array, Array]:
    """Move the agent, then let all rows fall by one.

    The agent is hit by the block it walks into and by the block that falls on it. Every step pays
    ``1 / MAX_STEPS``, also the one in which the agent is hit, which pays ``hit_reward`` on top.
    """
    sideways = (action == RIGHT).astype(jnp.int32) - (action == LEFT)
    x = jnp.clip(state.x + sideways, level.first, level.last)
    hit = (state.column[-1] == x) | (state.column[-2] == x)

    reach = reachable(state.safe, state.column[0], level)
    block = draw_block(key, reach, level, rules)
    time = state.time + 1
    column = jnp.concatenate([block[None], state.column[:-1]])
    colour = jnp.concatenate([(state.colour[:1] + 1) % COLOURS, state.colour[:-1]])
    safe = reach & (level.first + jnp.arange(level.width) != block)
    new = SkittlesState(column, colour, x, safe, state.flicker_key, time)
    reward = 1.0 / MAX_STEPS + jnp.where(hit, jnp.float32(hit_reward), 0.0)
    return new, reward, hit, time >= MAX_STEPS


def visible_rows(state: SkittlesState) -> Array:
    """Which blocks the POMDP shows: bool [CELLS], one for each row.

    At every time each cell of the grid is shown with probability 1/2, as a function of
    ``flicker_key`` and time; a row holds one block, so only the cell of that block is looked up.
    Nothing is hidden at time 0.
    """
    cells = jax.random.bits(jax.random.fold_in(state.flicker_key, state.time), (CELLS,))
    bit = (cells >> jnp.maximum(state.column, 0).astype(jnp.uint32)) & 1
    return (bit == 1) | (state.time == 0)
