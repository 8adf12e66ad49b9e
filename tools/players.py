"""What random play and the scripted players earn in a game: the yardstick of tables and reports."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.agents.config import require
from arcade_torch.agents.metrics import student_half_width
from arcade_torch.agents.runs.files import read_json, write_json
from arcade_torch.envs_jax import make
from arcade_torch.tools.files import markdown_table, measured_rows

PLAYERS = ("random", "state", "frames")
"""Uniformly random; the oracle that sees the state; the oracle that remembers what the POMDP's
frames have shown.
"""
BEGIN = "<!-- baselines -->"
END = "<!-- end of baselines -->"
EPISODES = 256
"""Of each player, for the reference lines of a report."""


class Baseline(NamedTuple):
    """What one player earned in one game: mean undiscounted return, half its 95 % interval
    (Student's; NaN of one episode), mean length of an episode, and the seconds it took, compilation
    included.
    """

    id: str
    player: str
    episodes: int
    mean: float
    half_width: float
    steps: float
    seconds: float


def measure(
    id: str,
    player: str,
    episodes: int = EPISODES,
    seconds: float = math.inf,
    block: int = 250,
    **options: Any,
) -> Baseline:
    """Let one of `PLAYERS` play a game, ``block`` episodes side by side, until ``seconds`` are
    over.

    Raises:
        ValueError: unknown game or player, or the game has no such oracle.
    """
    from arcade_torch.envs_jax.oracles import RandomPlayer, make_oracle, play

    require(player in PLAYERS, "player", player, f"one of {', '.join(PLAYERS)}")
    started = time.monotonic()
    game = make(id, **options)
    who = (
        RandomPlayer(0)
        if player == "random"
        else make_oracle(game, "state" if player == "state" else "frames")
    )
    played = play(
        game,
        who,
        episodes,
        0,
        frames=player == "frames",
        block=min(episodes, block),
        seconds=seconds,
    )
    returns = played.returns.astype(np.float64)
    half_width = student_half_width(returns)
    mean, half_width, steps = (
        round(float(each), 5) for each in (returns.mean(), half_width, played.lengths.mean())
    )
    return Baseline(
        game.id, player, returns.size, mean, half_width, steps, round(time.monotonic() - started, 1)
    )


def references(
    game: str,
    folder: Path,
    rules: str = "default",
    options: Mapping[str, Any] | None = None,
    episodes: int = EPISODES,
) -> dict[str, Baseline]:
    """What the players earn under the rules and options of a study, kept in
    ``folder/references-GAME-RULES.json``.

    A game without an oracle lacks that player.
    """
    file = folder / f"references-{game}-{rules}.json"
    how: dict[str, Any] = {"episodes": episodes, "options": dict(options or {})}
    try:
        kept = read_json(file)
        if kept["how"] == how:
            return {row["player"]: Baseline(**row) for row in kept["players"]}
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        pass  # there is none, or it is damaged or older: it is made anew
    settings = {"rules": rules, **how["options"]}
    there = players_of(game, **settings)
    found = {
        player: measure(game, player, episodes, block=EPISODES, **settings) for player in there
    }
    write_json(file, {"how": how, "players": [row._asdict() for row in found.values()]})
    return found


def players_of(game: str, **settings: Any) -> list[str]:
    """Those of `PLAYERS` that a game has: a game of your own may lack an oracle."""
    return [player for player in PLAYERS if player in ("random", *make(game, **settings).oracles)]


def measure_all(ids: Sequence[str], episodes: int, seconds: float, out: Path) -> Iterator[Baseline]:
    """Every player in every game, one row after another; rows that ``out`` holds already are not
    measured again.
    """
    keys = ((id, player) for id in ids for player in players_of(id))
    return measured_rows(
        out, Baseline, keys, lambda id, player: measure(id, player, episodes, seconds)
    )


def _mean_cell(row: Baseline | None) -> str:
    """A mean return with its interval, if it has one."""
    if row is None:
        return ""
    if math.isnan(row.half_width):
        return f"{row.mean:.3f}"
    return f"{row.mean:.3f} ± {row.half_width:.3f}"


def markdown(rows: Iterable[Baseline]) -> str:
    """The rows as a Markdown table, one line a game."""
    games: dict[str, dict[str, Baseline]] = {}
    for row in rows:
        games.setdefault(row.id, {})[row.player] = row
    columns = (
        "id",
        "random",
        "state oracle",
        "frames oracle",
        "highest",
        "steps: random, state, frames",
        "episodes",
    )
    lines = []
    for id, by_player in games.items():
        found = [by_player.get(player) for player in PLAYERS]
        returns = [_mean_cell(row) for row in found]
        steps = ", ".join(f"{r.steps:.0f}" if r else "" for r in found)
        count = ", ".join(dict.fromkeys(f"{r.episodes}" for r in found if r))
        lines.append([f"`{id}`", *returns, f"{make(id).return_range[1]:.4g}", steps, count])
    return markdown_table(columns, lines)
