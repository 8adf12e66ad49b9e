"""Breakout: clear a wall with a ball that the POMDP shows only on its way up."""

from typing import ClassVar

import jax.numpy as jnp

from arcade_torch.envs_jax.breakout import rules
from arcade_torch.envs_jax.breakout.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.breakout.renderer import TAILS, Screen, Tail
from arcade_torch.envs_jax.breakout.rules import LEVELS, MAX_STEPS, BreakoutState, Params
from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.validation import check_choice


class Breakout(LevelGame[BreakoutState]):
    """Keep a ball in play on a board of 20 x 10 cells until it has cleared a wall of 60 bricks.

    Actions 2 and 3 move the paddle to the left and right by one column, the others wait. Each brick
    pays by its row, from 1/120 in the lowest to 1/40 in the uppermost, 1 in sum; losing the ball
    costs 1/60 for each brick left and terminates, as does the last brick. 2000 steps truncate.
    Returns lie in [-1, 1].

    The MDP twin shows bricks, paddle, ball and a tail; the POMDP twin shows no tail, and no ball
    while it moves downwards.

    Args:
        rules: ``"reference"`` pays nothing for a brick touched right after another, and lets the
            widest paddle begin partly beyond the board.
        tail: ``"direction"`` puts the tail opposite to where the ball goes next; ``"previous"``
            where it was one step ago (as published), which after a bounce does not tell the
            direction.
        random_start: Let the ball begin in any column; otherwise it begins at either side wall.

    Source: POPGym Arcade (ICML 2026), after MinAtar (arXiv:1903.03176). Differs from popgym-arcade
        0.0.7 in: every brick pays, the paddle is always on the board, the picture tells the
        direction, the time limit does not terminate.

    Raises:
        ValueError: Unknown ``tail``.
        TypeError: ``random_start`` is not a bool.
    """

    levels = LEVELS
    memory_kind: ClassVar = "tracking"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self,
        level: Params,
        *,
        id: str,
        obs_size: int,
        rules: Rules,
        tail: Tail = "direction",
        random_start: bool = False,
    ) -> None:
        check_choice("tail", tail, TAILS)
        if not isinstance(random_start, bool):
            raise TypeError(f"random_start is {random_start!r}, allowed: True or False")
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.tail = tail
        self.random_start = random_start
        self.max_steps = MAX_STEPS
        self.return_range = (-1.0, 1.0)
        self.screen = Screen(obs_size, level, tail)

    def reset(self, key: Array) -> BreakoutState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules, self.random_start)

    def step(
        self, key: Array, state: BreakoutState, action: Array
    ) -> tuple[BreakoutState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(state, action, self.level, self.rules)

    def facts(self, state: BreakoutState) -> dict[str, Array]:
        """Column and row of the ball, and by how many it moves in a step (1 or -1), float32."""
        dx, dy = rules.velocity(state.ball_dir)
        return {
            "ball_x": state.ball_x.astype(jnp.float32),
            "ball_y": state.ball_y.astype(jnp.float32),
            "ball_dx": dx.astype(jnp.float32),
            "ball_dy": dy.astype(jnp.float32),
        }
