"""What random play and the scripted players earn in a game: the yardstick of tables and reports."""

import math
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import arcade_torch
from arcade_torch.agents.checked import require
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
    actor: Any = RandomPlayer(0)
    if player != "random":
        actor = make_oracle(game, "state" if player == "state" else "frames")
    played = play(
        game,
        actor,
        episodes,
        0,
        frames=player == "frames",
        block=min(episodes, block),
        seconds=seconds,
    )
    returns = played.returns.astype(np.float64)
    return Baseline(
        id=game.id,
        player=player,
        episodes=returns.size,
        mean=round(float(returns.mean()), 5),
        half_width=round(float(student_half_width(returns)), 5),
        steps=round(float(played.lengths.mean()), 5),
        seconds=round(time.monotonic() - started, 1),
    )


def references(
    game: str,
    folder: Path,
    rules: str = "default",
    options: Mapping[str, Any] | None = None,
    episodes: int = EPISODES,
    imports: Mapping[str, str] | None = None,
) -> dict[str, Baseline]:
    """What the players earn under the rules and options of a study, kept in
    ``folder/references-GAME-RULES.json`` for this version and these ``imports``, the files of the
    user and their hashes.

    A game without an oracle lacks that player.
    """
    file = folder / f"references-{game}-{rules}.json"
    settings: dict[str, Any] = {"episodes": episodes, "options": dict(options or {})}
    settings["imports"] = dict(imports or {})
    settings["version"] = arcade_torch.__version__
    try:
        return _kept_references(file, settings)
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        pass  # there is none, or it is damaged or older: it is made anew
    of_game = {"rules": rules} | settings["options"]
    baselines = dict[str, Baseline]()
    for player in players_of(game, **of_game):
        baselines[player] = measure(game, player, episodes, block=EPISODES, **of_game)
    rows = [baseline._asdict() for baseline in baselines.values()]
    try:
        write_json(file, {"how": settings, "players": rows})
    except OSError as error:  # the folder of somebody else: the numbers are of use all the same
        warnings.warn(f"what the players earn could not be kept: {error}", stacklevel=2)
    return baselines


def _kept_references(file: Path, settings: Mapping[str, Any]) -> dict[str, Baseline]:
    """The baselines that a file holds; a ``ValueError`` if they were measured otherwise."""
    kept = read_json(file)
    if kept["how"] != settings:
        raise ValueError("other settings")
    baselines = [Baseline(**row) for row in kept["players"]]
    return {baseline.player: baseline for baseline in baselines}


def players_of(game: str, **settings: Any) -> list[str]:
    """Those of `PLAYERS` that a game has: a game of your own may lack an oracle."""
    oracles = make(game, **settings).oracles
    return [player for player in PLAYERS if player == "random" or player in oracles]


def measure_all(ids: Sequence[str], episodes: int, seconds: float, out: Path) -> Iterator[Baseline]:
    """Every player in every game, one row after another; rows that ``out`` holds already are not
    measured again.
    """

    def measure_row(id: str, player: str) -> Baseline:
        return measure(id, player, episodes, seconds)

    return measured_rows(out, Baseline, _games_and_players(ids), measure_row)


def _games_and_players(ids: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Every player of every game."""
    for id in ids:
        for player in players_of(id):
            yield id, player


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
        returns = list[str]()
        steps = list[str]()
        episodes = dict[str, None]()
        for player in PLAYERS:
            baseline = by_player.get(player)
            returns.append(_mean_cell(baseline))
            steps.append("" if baseline is None else f"{baseline.steps:.0f}")
            if baseline is not None:
                episodes[f"{baseline.episodes}"] = None
        highest = f"{make(id).return_range[1]:.4g}"
        lines.append([f"`{id}`", *returns, highest, ", ".join(steps), ", ".join(episodes)])
    return markdown_table(columns, lines)
