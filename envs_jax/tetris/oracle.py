"""Scripted players of Tetris: one sees the pile, one remembers every piece that it saw come to
lie.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import DOWN, FIRE, LEFT, RIGHT, UP
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer
from arcade_torch.envs_jax.tetris.renderer import BAND
from arcade_torch.envs_jax.tetris.rules import (
    BOX,
    COLUMNS,
    ROTATIONS,
    ROWS,
    SHAPES,
    SPAWN_X,
    SPAWN_Y,
)

Ints = npt.NDArray[np.int64]

BORDER = 3  # columns that a box may stand beyond the board
LONGEST = 24  # actions a plan holds: a piece falls at least one row at each
COST = {"holes": 7.0, "covered": 0.5, "breaks": 1.0, "height": 2.0, "wells": 1.0, "full": -2.0}


class Plans(NamedTuple):
    """For each of M boards, what K players of one piece would do and where the piece would lie."""

    actions: npt.NDArray[np.int8]  # [M, K, LONGEST], FIRE where the piece already lies
    rot: Ints  # [M, K]
    px: Ints  # [M, K]
    py: Ints  # [M, K]


def room(pile: Bools, piece: Ints) -> Bools:
    """Where a piece fits: bool [M, rotation, row, BORDER + column] for piles [M, 20, 10] and pieces
    [M].
    """
    blocks = np.pad(pile, ((0, 0), (0, 2 * BOX), (BORDER, 2 * BORDER)), constant_values=True)
    height = ROWS + BOX
    width = COLUMNS + BORDER + 2
    hits = np.zeros((len(pile), ROTATIONS, height, width), bool)
    for row in range(BOX):
        for column in range(BOX):
            part = blocks[:, None, row : row + height, column : column + width]
            hits |= SHAPES[piece, :, row, column][:, :, None, None] & part
    return ~hits


def plan(pile: Bools, piece: Ints, fall: int, drop: int, tunnels: bool) -> Plans:
    """Try each way to turn a new piece, shift it, and drop it, obeying gravity from the first
    action on.

    Args:
        pile: bool [M, 20, 10].
        piece: int [M], the piece that appears at the next step.
        fall: Cells that gravity pulls at each step.
        drop: Cells of a soft drop.
        tunnels: Whether long falls look at their last cell alone.
    """
    free = room(pile, piece)
    goals = np.array([(rot, px) for rot in range(ROTATIONS) for px in range(-BORDER, COLUMNS)])
    shape = (len(pile), len(goals))
    goal_rot = np.broadcast_to(goals[:, 0], shape)
    goal_px = np.broadcast_to(goals[:, 1], shape)
    rot = np.zeros(shape, np.int64)
    px = np.full(shape, SPAWN_X)
    py = np.full(shape, SPAWN_Y)
    lies = np.zeros(shape, bool)
    actions = np.full((*shape, LONGEST), FIRE, np.int8)
    board = np.arange(len(pile))[:, None]

    def fits(rot: Ints, px: Ints, py: Ints) -> Bools:
        fit: Bools = free[board, rot, py, px + BORDER]
        return fit

    for step in range(LONGEST):
        sideways = np.where(px < goal_px, RIGHT, LEFT)
        action = np.where(rot != goal_rot, UP, np.where(px != goal_px, sideways, DOWN))
        actions[:, :, step] = np.where(lies, FIRE, action)
        turned = (rot + (action == UP)) % ROTATIONS
        shifted = px + (action == RIGHT) - (action == LEFT)
        moves = fits(turned, shifted, py) & ~lies
        rot = np.where(moves, turned, rot)
        px = np.where(moves, shifted, px)
        length = np.where(action == DOWN, 1 if step == 0 else drop, fall)
        free_below = np.stack([fits(rot, px, np.minimum(py + down, ROWS)) for down in range(1, 4)])
        if tunnels:
            whole = np.take_along_axis(free_below, length[None] - 1, 0)[0]
        else:
            whole = (free_below | (np.arange(1, 4)[:, None, None] > length)).all(0)
        py = py + np.where(lies, 0, np.where(whole, length, free_below[0]))
        lies = lies | ~fits(rot, px, np.minimum(py + 1, ROWS))
        if lies.all():
            break
    return Plans(actions, rot, px, py)


def drop_rows(pile: Bools, gone: Bools) -> Bools:
    """Remove rows ``gone`` (bool [..., 20]) of piles [..., 20, 10]; those above fall straight
    down.
    """
    order = np.argsort(~gone, axis=-1, kind="stable")
    return np.take_along_axis(pile & ~gone[..., None], order[..., None], -2)


def put(pile: Bools, piece: Ints, plans: Plans) -> Bools:
    """The piles after each plan, complete rows still in them: bool [M, K, 20, 10]."""
    row = np.arange(ROWS)[:, None] - plans.py[..., None, None]
    column = np.arange(COLUMNS) - plans.px[..., None, None]
    in_box = (row >= 0) & (row < BOX) & (column >= 0) & (column < BOX)
    shape = SHAPES[piece[:, None], plans.rot].reshape(*plans.rot.shape, BOX * BOX)
    index = np.where(in_box, row * BOX + column, 0).reshape(*plans.rot.shape, -1)
    cells = np.take_along_axis(shape, index, -1).reshape(in_box.shape) & in_box
    merged: Bools = pile[:, None] | cells
    return merged


def cost(pile: Bools) -> npt.NDArray[np.float64]:
    """How bad piles [..., 20, 10] are: holes, broken rows and columns, height and wells; complete
    rows are good.
    """
    full: Bools = np.asarray(pile.all(-1))
    left = drop_rows(pile, full)
    roofed: Bools = np.logical_or.accumulate(left, -2)
    holes = roofed & ~left
    above = (np.cumsum(left, -2) * holes).sum((-2, -1))
    height = roofed.sum(-2)  # [..., 10]
    sides = np.pad(left, [(0, 0)] * (left.ndim - 1) + [(1, 1)], constant_values=True)
    breaks = (np.not_equal(sides[..., 1:], sides[..., :-1]) & left.any(-1, keepdims=True)).sum(
        (-2, -1)
    )
    edges = np.pad(height, [(0, 0)] * (height.ndim - 1) + [(1, 1)], constant_values=ROWS)
    depth = np.maximum(np.minimum(edges[..., :-2], edges[..., 2:]) - height, 0)
    return np.asarray(
        COST["holes"] * holes.sum((-2, -1))
        + COST["covered"] * above
        + COST["breaks"] * breaks
        + COST["height"] * (height**2).mean(-1) ** 0.5
        + COST["wells"] * (depth * (depth + 1) / 2).sum(-1)
        + COST["full"] * full.sum(-1)
    )


class Planner:
    """Chooses a plan when a piece is about to appear, and carries it out blindly."""

    def __init__(self, game: Any) -> None:
        self.level = game.level
        self.tunnels = game.rules == "reference"
        self.actions = np.zeros((0, LONGEST), np.int8)
        self.step = np.zeros(0, np.int64)

    def act(self, pile: Bools, piece: Ints, appears: Bools) -> npt.NDArray[np.int32]:
        """The next action in every env.

        Args:
            pile: bool [N, 20, 10], without complete rows.
            piece: int [N], the piece that appears.
            appears: bool [N], true where the next action is the first that this piece obeys.
        """
        if len(self.step) != len(appears):
            self.actions = np.full((len(appears), LONGEST), FIRE, np.int8)
            self.step = np.zeros(len(appears), np.int64)
        rows = np.flatnonzero(appears)
        if len(rows):
            plans = plan(pile[rows], piece[rows], self.level.fall, self.level.drop, self.tunnels)
            best = cost(put(pile[rows], piece[rows], plans)).argmin(1)
            self.actions[rows] = plans.actions[np.arange(len(rows)), best]
            self.step[rows] = 0
        action = self.actions[np.arange(len(appears)), np.minimum(self.step, LONGEST - 1)]
        self.step += 1
        return action.astype(np.int32)


class StateOracle:
    """Sees the pile: looks where the coming piece can be brought, and takes the place that leaves
    the best pile.
    """

    def __init__(self, game: Any) -> None:
        self.planner = Planner(game)

    def act(self, seen: Any, is_init: Bools) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        pile = seen.board > 0
        pile = drop_rows(pile, pile.all(-1))
        piece = np.where(seen.just_locked, seen.next[:, 0], seen.piece)
        return self.planner.act(pile, piece, is_init | seen.just_locked)


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: adds every piece to a remembered pile when it comes to lie, and
    plays as if it saw it.

    Nothing is lost: a piece lies when its cells have the floor or the remembered pile below them,
    or when a band shows; the rows under a band are known to vanish, and the rest of the piece is
    drawn around it.
    """

    def __init__(self, game: Any) -> None:
        super().__init__(game)
        self.planner = Planner(game)

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        self.pile = np.zeros((num_envs, ROWS, COLUMNS), bool)

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        self.pile[is_init] = False
        codes = read_board(frames, self.screen)
        band = (codes == BAND).all(-1)
        cells = (codes > 0) & (codes < BAND)
        floor = np.ones((len(frames), 1, COLUMNS), bool)
        below = np.concatenate([self.pile[:, 1:], floor], 1)
        lies = band.any(-1) | (cells & below).any((1, 2))
        self.pile = np.where(lies[:, None, None], drop_rows(self.pile | cells, band), self.pile)
        piece = np.where(lies, read_preview(frames, self.screen), codes.max((1, 2)) - 1)
        return self.planner.act(self.pile, piece, is_init | lies)


def read_board(frames: npt.NDArray[np.uint8], screen: Any) -> Ints:
    """Which tile each cell of frames [N, S, S, 3] shows: int64 [N, 20, 10], -1 for none; one pixel
    of a cell tells.
    """
    grid = screen.board
    cell = screen.cell
    y = grid.y + cell // 2
    x = grid.x + cell // 2
    middle = frames[:, y : y + ROWS * cell : cell, x : x + COLUMNS * cell : cell]
    codes = np.full(middle.shape[:3], -1, np.int64)
    for code, colour in enumerate(grid.atlas[:, cell // 2, cell // 2]):
        codes[(middle == colour).all(-1)] = code
    return codes


def read_preview(frames: npt.NDArray[np.uint8], screen: Any, which: int = 0) -> Ints:
    """Which piece a preview (0: the nearest) of frames [N, S, S, 3] shows: int64 [N]."""
    slot = screen.previews[which]
    height, width = slot.pictures.shape[1:3]
    cutout = frames[:, None, slot.y : slot.y + height, slot.x : slot.x + width]
    which_piece: Ints = (cutout == slot.pictures).all((2, 3, 4)).argmax(1)
    return which_piece
