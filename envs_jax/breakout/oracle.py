"""Scripted players of Breakout: one follows the ball, one follows where it must be."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.breakout import rules
from arcade_torch.envs_jax.breakout.renderer import BALL, KINDS
from arcade_torch.envs_jax.breakout.rules import (
    COLUMNS,
    PADDLE_ROW,
    ROWS,
    WALL_ROWS,
    WALL_TOP,
    Params,
)
from arcade_torch.envs_jax.game import LEFT, RIGHT, UP
from arcade_torch.envs_jax.settings import compiled, fixed


def follow(ball_x: Any, pos: Any, level: Params) -> npt.NDArray[np.int32]:
    """The move that brings the paddle's middle under the ball: int32 [N]."""
    goal = np.clip(np.asarray(ball_x) - level.paddle // 2, 0, level.right)
    return np.where(goal > pos, RIGHT, np.where(goal < pos, LEFT, UP)).astype(np.int32)


class StateOracle:
    """Sees the ball and keeps the paddle under it, which clears the wall."""

    def __init__(self, game: Any) -> None:
        self.level = game.level

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        return follow(seen.ball_x, seen.pos, self.level)


class FramesOracle:
    """Sees the POMDP's frames: carries the ball on by the known rules while it is hidden.

    Bricks and paddle are always seen. The ball is seen on its way up, the first of it in the first
    frame, so that two frames tell all there is to know.
    """

    def __init__(self, game: Any) -> None:
        self.level = game.level
        self.board = game.screen.board
        self.belief: Any = None  # a BreakoutState with numpy leaves
        self.action = np.zeros(0, np.int32)

        def carry_on(state: rules.BreakoutState, action: jax.Array) -> rules.BreakoutState:
            return rules.step(state, action, game.level, game.rules)[0]

        self._carry_on = compiled(jax.vmap(carry_on))

    @fixed
    def act(
        self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        codes = self.board.read(seen, ROWS, COLUMNS)
        kinds = codes % KINDS
        marks = codes // KINDS
        ball = (marks == BALL).reshape(len(seen), -1)
        visible = ball.any(1)
        cell = ball.argmax(1)
        x = cell % COLUMNS
        y = cell // COLUMNS
        pos = (kinds[:, PADDLE_ROW] > 0).argmax(1)
        bricks = kinds[:, WALL_TOP : WALL_TOP + WALL_ROWS] > 0

        if self.belief is None or len(self.action) != len(seen):
            zero = np.zeros(len(seen), np.int32)
            no = zero > 0
            entries = [zero] * 6 + [bricks, no, zero, zero, no, no]
            self.belief = rules.BreakoutState._make(entries)
        else:
            self.belief = jax.tree.map(
                np.asarray, self._carry_on(self.belief, jnp.asarray(self.action))
            )
        belief = self.belief
        # At first sight the ball is taken to make for the nearer wall; the second tells.
        guess = np.where(x * 2 >= COLUMNS, rules.UP_RIGHT, rules.UP_LEFT)
        wrong = visible & ((x != belief.ball_x) | (y != belief.ball_y))
        seen_to_move = np.where(x > belief.last_x, rules.UP_RIGHT, rules.UP_LEFT)
        turned = np.where(is_init, guess, np.where(wrong, seen_to_move, belief.ball_dir))
        self.belief = belief._replace(
            ball_x=np.where(visible, x, belief.ball_x).astype(np.int32),
            ball_y=np.where(visible, y, belief.ball_y).astype(np.int32),
            ball_dir=turned.astype(np.int32),
            pos=pos.astype(np.int32),
            bricks=bricks,
            strike=belief.strike & ~is_init,
        )
        self.action = follow(self.belief.ball_x, pos, self.level)
        return self.action
