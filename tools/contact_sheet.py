"""Pictures of games pixel by pixel: all of them at both sizes, or some moments of one, always both twins."""

import io
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.optional import need

Picture = npt.NDArray[np.uint8]
Moment = Callable[[], list[Picture]]
GAP = 8
PAPER = 255


def scene(id: str, obs_size: int, steps: int = 60, seed: int = 0) -> list[Picture]:
    """Both twins of one moment in the middle of a game, played by the scripted player that sees the state."""
    from arcade_torch.envs_jax import make

    *_, last = _walk(id, obs_size, seed, min(steps, make(id, obs_size=obs_size).max_steps // 4))
    return last()


def strip(id: str, steps: Sequence[int], obs_size: int = 256, seed: int = 0) -> Picture:
    """Some moments of one episode side by side, the MDP twin above the POMDP twin."""
    if not steps or steps[0] < 0 or any(a >= b for a, b in pairwise(steps)):
        raise ValueError(f"steps must be whole numbers that rise from 0 or more, got {list(steps)}")
    moments = list(_walk(id, obs_size, seed, steps[-1]))
    if len(moments) <= steps[-1]:
        raise ValueError(f"the scripted episode of {id} with seed {seed} ends after {len(moments)} steps: stay below")
    return _joined([_joined(moments[step](), 0) for step in steps], 1)


def _walk(id: str, obs_size: int, seed: int, steps: int) -> Iterator[Moment]:
    """What draws both twins of each state of an episode, from the first to that after `steps` or before the end."""
    import jax

    from arcade_torch.envs_jax import BatchedGame, env_keys, make
    from arcade_torch.envs_jax.oracles import RandomPlayer, make_oracle

    game = make(id, obs_size=obs_size)
    batched, player = BatchedGame(game), make_oracle(game) if "state" in game.oracles else RandomPlayer(seed)

    def draw(batch: Any) -> list[Picture]:
        return [np.asarray(batched.render(batch._replace(partial=np.array([hides]))))[0] for hides in (False, True)]

    batch = batched.init(env_keys(seed, 1), np.zeros(1, bool))
    yield partial(draw, batch)
    for step in range(steps):
        action = player.act(jax.tree.map(np.asarray, batch.state), np.array([step == 0]))
        batch, outcome = batched.step(batch, action.astype(np.int32))
        if outcome.done[0]:
            return
        yield partial(draw, batch)


def sheet(ids: Sequence[str], columns: int = 2) -> Picture:
    """All games on one picture; a game is four frames: both twins at 256 pixels, both at 128."""
    cells = []
    for id in ids:
        frames = [frame for size in (256, 128) for frame in scene(id, size)]
        below = [((0, 256 + GAP - len(frame)), (0, GAP), (0, 0)) for frame in frames]
        padded = [np.pad(frame, pad, constant_values=PAPER) for frame, pad in zip(frames, below, strict=True)]
        cells.append(np.concatenate(padded, 1))
    cells += [np.full_like(cells[0], PAPER)] * (-len(cells) % columns)
    rows = [np.concatenate(cells[first : first + columns], 1) for first in range(0, len(cells), columns)]
    return np.concatenate(rows)


def write_png(picture: Picture, path: Path) -> Path:
    """Write a picture as PNG, atomically and without loss."""
    buffer = io.BytesIO()
    need("PIL.Image").fromarray(picture).save(buffer, format="PNG", optimize=True)
    return write_atomic(path, buffer.getvalue())


def _joined(pictures: Sequence[Picture], axis: int) -> Picture:
    """The pictures one after another along an axis, with a gap between each two."""
    pad = [(GAP if i == axis else 0, 0) for i in range(3)]
    rest = [np.pad(picture, pad, constant_values=PAPER) for picture in pictures[1:]]
    return np.concatenate([pictures[0], *rest], axis)
