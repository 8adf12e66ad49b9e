"""One picture of all games: both twins at both sizes, side by side and pixel by pixel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.tools.files import write_bytes
from arcade_torch.tools.optional import need

Picture = npt.NDArray[np.uint8]
GAP = 8
PAPER = 255


def scene(id: str, obs_size: int, steps: int = 60, seed: int = 0) -> tuple[Picture, Picture]:
    """Both twins of one moment in the middle of a game, played by the scripted player that sees the state.

    Args:
        id: the game.
        obs_size: 128 or 256.
        steps: how far to play; at most a quarter of the time limit, and never past the end of the episode.
        seed: of the episode.

    Returns:
        The frames of the MDP and of the POMDP twin: uint8 [S, S, 3] each.
    """
    import jax

    from arcade_torch.envs_jax import BatchedGame, env_keys, make
    from arcade_torch.envs_jax.oracles import make_oracle

    game = make(id, obs_size=obs_size)
    batched, player = BatchedGame(game), make_oracle(game)
    batch = batched.init(env_keys(seed, 1), np.zeros(1, bool))
    for step in range(min(steps, game.max_steps // 4)):
        action = player.act(jax.tree.map(np.asarray, batch.state), np.array([step == 0]))
        after, outcome = batched.step(batch, action.astype(np.int32))
        if outcome.done[0]:
            break
        batch = after
    full, partial = (np.asarray(batched.render(batch._replace(partial=np.array([twin]))))[0] for twin in (False, True))
    return full, partial


def sheet(ids: Sequence[str], columns: int = 2) -> Picture:
    """All games on one picture; a game is four frames: both twins at 256 pixels, both at 128.

    Args:
        ids: the games, row by row.
        columns: games side by side.

    Returns:
        uint8 [height, width, 3].
    """
    cells = []
    for id in ids:
        frames = [frame for size in (256, 128) for frame in scene(id, size)]
        cell = np.full((256 + GAP, sum(f.shape[1] + GAP for f in frames), 3), PAPER, np.uint8)
        x = 0
        for frame in frames:
            cell[: frame.shape[0], x : x + frame.shape[1]] = frame
            x += frame.shape[1] + GAP
        cells.append(cell)
    cells += [np.full_like(cells[0], PAPER)] * (-len(cells) % columns)
    rows = [np.concatenate(cells[first : first + columns], 1) for first in range(0, len(cells), columns)]
    return np.concatenate(rows)


def write_png(picture: Picture, path: Path) -> Path:
    """Write a picture as PNG, atomically and without loss."""
    import io

    image: Any = need("PIL.Image").fromarray(picture)
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return write_bytes(path, buffer.getvalue())
