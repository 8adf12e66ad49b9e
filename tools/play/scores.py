"""Human scores in a CSV file: one line an episode, with the seed and the actions that repeat it.

The columns model, env, difficulty and observability are those of the paper's table; model, game, observability, seed
and return are what ``arcade-torch analyze gap-bias`` reads. An episode that was abandoned has no return.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax import ACTION_NAMES, Game
from arcade_torch.tools.files import read_csv, write_csv
from arcade_torch.tools.play.session import Attempt, Session

COLUMNS = (
    "model",
    "env",
    "difficulty",
    "observability",
    "return",
    "steps",
    "end",
    "attempt",
    "seed",
    "actions",
    "game",
    "obs_size",
    "rules",
    "options",
    "player",
)
_ID = re.compile(r"(?P<env>\w+?)(?P<difficulty>Easy|Medium|Hard)?-v\d+")


def score_row(attempt: Attempt, game: Game[Any], options: Mapping[str, Any], player: str = "") -> dict[str, Any]:
    """One line of the table.

    Args:
        attempt: the episode.
        game: what was played.
        options: of the game, beside size and rules.
        player: who played.
    """
    match = _ID.fullmatch(game.id)
    return {
        "model": "human",
        "env": match["env"] if match else game.id,
        "difficulty": (match["difficulty"] or "").lower() if match else "",
        "observability": attempt.observability,
        "return": None if attempt.end == "abandoned" else attempt.total,
        "steps": attempt.steps,
        "end": attempt.end,
        "attempt": attempt.attempt,
        "seed": attempt.seed,
        "actions": attempt.actions,
        "game": game.id,
        "obs_size": game.obs_size,
        "rules": game.rules,
        "options": json.dumps(dict(options), sort_keys=True),
        "player": player,
    }


def read_scores_file(path: Path) -> list[dict[str, str]]:
    """The lines of a table; none if the file does not exist.

    Raises:
        ValueError: the file is no table of human scores.
    """
    if not path.exists():
        return []
    rows = read_csv(path)
    if rows and tuple(rows[0]) != COLUMNS:
        raise ValueError(f"{path} is no table of human scores: its columns are {', '.join(rows[0])}")
    return rows


def append_score(path: Path, row: Mapping[str, Any]) -> None:
    """Add a line; a reader sees the old table or the new one."""
    write_csv(path, [*read_scores_file(path), row], COLUMNS)


def next_seed(rows: list[dict[str, str]], game_id: str, player: str) -> int:
    """The first seed above all that a player has met in a game; 0 for the first."""
    met = [int(row["seed"]) for row in rows if (row["game"], row["player"]) == (game_id, player)]
    return max(met, default=-1) + 1


def replay(row: Mapping[str, Any]) -> Attempt:
    """Play a line of the table again.

    Args:
        row: the line, as it was written or as it was read.

    Returns:
        The episode, from the game's own rules.

    Raises:
        ValueError: the actions go on after the end.
    """
    found: list[Attempt] = []
    game = compiled_game(row["game"], int(row["obs_size"]), row["rules"], json.loads(row["options"]))
    session = Session(game, seed=int(row["seed"]), partial=row["observability"] == "partial", on_attempt=found.append)
    for number, action in enumerate(row["actions"]):
        if session.end is not None:
            raise ValueError(f"{len(row['actions'])} actions, but the episode ends after {number}")
        session.press(ACTION_NAMES[int(action)])
    session.press("quit")
    return found[0]
