"""Human scores in a CSV file: one line an episode, with the seed and the actions that repeat it.

The columns model, env, difficulty and observability are those of the paper's table; model, game,
observability, seed and return are what ``arcade-torch analyze gap-bias`` reads. An episode that was
abandoned has no return.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import read_csv, read_text
from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax import ACTION_NAMES, Game
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.measures.gap_bias.measure import game_of
from arcade_torch.tools.options import name_and_value
from arcade_torch.tools.play.session import QUIT, Attempt, Session
from arcade_torch.tools.text import csv_cell

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
_WHOLE = re.compile(r"[0-9]{1,10}")


def score_row(
    attempt: Attempt, game: Game[Any], options: Mapping[str, Any], player: str
) -> dict[str, Any]:
    """One line of the table."""
    env = game_of(game.id)
    return {
        "model": "human",
        "env": env,
        "difficulty": game.id.removeprefix(env).partition("-")[0].lower(),
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
    """The lines of a table; none if the file does not exist."""
    if not path.exists():
        return []
    rows = read_csv(path)
    if read_text(path).partition("\n")[0].strip() != ",".join(COLUMNS):
        raise ValueError(
            f"{path} is no table of human scores, and adding one would lose what it holds"
        )
    for row in rows:
        is_whole = _WHOLE.fullmatch(row["seed"]) is not None
        require(is_whole, f"{path}: the seed", row["seed"], "a whole number")
    return rows


def append_score(path: Path, row: Mapping[str, Any]) -> None:
    """Add a line; a reader sees the old table or the new one."""
    write_csv(path, [*read_scores_file(path), row], COLUMNS)


def next_seed(rows: list[dict[str, str]], game_id: str, player: str) -> int:
    """The first seed above all that a player has met in a game; 0 for the first."""
    written = csv_cell(player)
    seeds = [-1]
    for row in rows:
        if (row["game"], row["player"]) == (game_id, written):
            seeds.append(int(row["seed"]))
    return max(seeds) + 1


def replay(row: Mapping[str, Any]) -> Attempt:
    """Play a line of the table, as it was written or as it was read, again by the game's own rules.

    Raises:
        ValueError: the actions go on after the end, or the line is damaged.
    """
    attempts = list[Attempt]()
    actions = row["actions"]
    are_digits = re.fullmatch(r"[0-4]+", actions) is not None
    require(are_digits, "actions", actions, "digits from 0 to 4, one a step")
    for name in ("seed", "obs_size"):
        require(_WHOLE.fullmatch(str(row[name])) is not None, name, row[name], "a whole number")
    _, options = name_and_value(f"options={row['options']}")
    require(isinstance(options, dict), "options", row["options"], "a JSON object")
    game = compiled_game(row["game"], int(row["obs_size"]), row["rules"], options)
    session = Session(
        game,
        seed=int(row["seed"]),
        partial=row["observability"] == "partial",
        on_attempt=attempts.append,
    )
    for number, action in enumerate(actions):
        if session.end is not None:
            raise ValueError(f"{len(actions)} actions, but the episode ends after {number}")
        session.press(ACTION_NAMES[int(action)])
    session.press(QUIT)
    return attempts[0]
