"""Tetris: the same stream of pieces, indexed in another way.

The published queue is read ``previews - 1`` places behind its index and shuffled by the step that
needs the first piece of the new order; our bag is read at its index and shuffled as soon as it is
empty, one spawn earlier. In between the new order exists in our state alone: it is left out of the
comparison, and put right when the published step has drawn it.
"""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.tetris.rules import COLUMNS, PIECES, ROWS, TetrisState
from tests.parity.translation import Array, Translation, any_flag, number, small


def to_ours(game: Any, theirs: Any) -> TetrisState:
    """Field by field, but for the index."""
    return TetrisState(
        board=small(theirs.board),
        piece=number(theirs.current_piece),
        px=number(theirs.current_x),
        py=number(theirs.current_y),
        rot=number(theirs.current_rotation),
        next=number(theirs.next_pieces),
        bag=number(theirs.piece_queue),
        bag_index=number((theirs.queue_index + game.level.previews) % PIECES),
        lines=number(theirs.lines_cleared),
        time=number(theirs.time),
        just_locked=jnp.asarray(theirs.just_locked, bool),
        frames_since_spawn=number(theirs.frames_since_spawn),
        terminal=jnp.zeros((), bool),
    )


def to_theirs(game: Any, ours: TetrisState) -> dict[str, Any]:
    """The two timers are not used; ``terminal`` is false in mid-episode."""
    return {
        "board": ours.board,
        "current_piece": ours.piece,
        "current_x": ours.px,
        "current_y": ours.py,
        "current_rotation": ours.rot,
        "next_pieces": ours.next,
        "piece_queue": ours.bag,
        "queue_index": (ours.bag_index - game.level.previews) % PIECES,
        "lines_cleared": ours.lines,
        "score": ours.lines,
        "time": ours.time,
        "terminal": False,
        "drop_timer": 0,
        "lock_timer": 0,
        "just_locked": ours.just_locked,
        "frames_since_spawn": ours.frames_since_spawn,
    }


def inject(game: Any, ours: TetrisState, theirs: Any, then: Any) -> TetrisState:
    """The order that the published step has just drawn."""
    drawn = (theirs.queue_index == PIECES - 1) & (then.queue_index == 0)
    return ours._replace(bag=jnp.where(drawn, number(then.piece_queue), ours.bag))


def adopt(game: Any, ours: TetrisState, then: Any) -> TetrisState:
    """The order that the published step has not drawn yet, and colours that nobody sees.

    Where a piece that tops out overlaps the pile, the published board keeps the higher colour
    number and ours the piece's. That board is in no published frame: the next episode's takes its
    place. ``terminal`` stands in its flag.
    """
    ahead = then.queue_index == PIECES - 1
    bag = jnp.where(ahead, number(then.piece_queue), ours.bag)
    overlap = ours.terminal & (ours.board > 0) & (then.board > 0)
    board = jnp.where(overlap, small(then.board), ours.board)
    return ours._replace(bag=bag, board=board, terminal=jnp.zeros((), bool))


def hasten(key: Array, game: Any, ours: TetrisState) -> TetrisState:
    """A pile of any height, in each row a gap that is often above the last one, and one to five
    lines to go.
    """
    for_height, for_gap, for_jump, for_lines = jax.random.split(key, 4)
    height = jax.random.randint(for_height, (), 0, ROWS - 1)
    jumps = jax.random.bernoulli(for_jump, 0.3, (ROWS,))
    first, others = jnp.split(jax.random.randint(for_gap, (ROWS + 1,), 0, COLUMNS), [1])
    gap = jnp.where(jumps, others, first)
    filled = (jnp.arange(ROWS)[:, None] >= ROWS - height) & (jnp.arange(COLUMNS) != gap[:, None])
    lines = 10 - jax.random.randint(for_lines, (), 1, 6)
    return ours._replace(board=small(filled), lines=lines)


TRANSLATION = Translation(
    to_ours, to_theirs, "time", inject=inject, adopt=adopt, reported=any_flag, hasten=hasten
)
