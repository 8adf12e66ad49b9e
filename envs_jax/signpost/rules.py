"""The rules of Signpost: read the sign, walk to the gate, press what the sign said."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.game import RIGHT, UNSET, Array


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    corridor: int  # cells to walk before the gate; the sign has to be remembered for as many steps

    @property
    def cells(self) -> int:
        """Cells of the corridor and the gate."""
        return self.corridor + 1

    @property
    def max_steps(self) -> int:
        """Steps of every episode: the walk and the answer."""
        return self.cells


LEVELS = {"SignpostEasy": Params(4), "SignpostMedium": Params(6), "SignpostHard": Params(9)}

SIGNS = 4  # up, down, left, right, numbered like the actions


class SignpostState(NamedTuple):
    """A sign, a walker, and what became of the answer."""

    sign: Array  # int32 in 0..3, the action that opens the gate
    x: Array  # int32, cells walked; the gate is the last
    score: Array  # int32, 1 once the gate is open
    timestep: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def reset(key: Array) -> SignpostState:
    """Any of the four signs, the walker at the beginning."""
    zero = jnp.int32(0)
    return SignpostState(jax.random.randint(key, (), 0, SIGNS, dtype=jnp.int32), zero, zero, zero)


def step(
    state: SignpostState, action: Array, level: Params
) -> tuple[SignpostState, Array, Array, Array]:
    """Walk one cell; at the gate, answer.

    Every action walks on, and every action but right stumbles, which costs ``1 / corridor``. Agents
    are told their last action, so a player without memory could carry the sign to the gate by
    repeating it; stumbling all the way costs as much as the gate pays, so that nobody without
    memory can expect more than 1/4. Nothing truncates.
    """
    at_gate = state.x == level.corridor
    opened = at_gate & (action == state.sign)
    stumbled = ~at_gate & (action != RIGHT)
    new = SignpostState(
        state.sign, state.x + ~at_gate, opened.astype(jnp.int32), state.timestep + 1
    )
    return new, opened - stumbled / jnp.float32(level.corridor), at_gate, jnp.bool_(False)
