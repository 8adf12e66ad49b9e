"""Scores of runs and of tables, with one name for every agent and every game."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.tools.comparable import Runs, check_comparable, find_runs
from arcade_torch.tools.names import AgentKey, agent_names, bare_name, game_names
from arcade_torch.tools.run_folders import RunFolders
from arcade_torch.tools.runs import Run, Score, described

METRICS = ("eval_final", "train_max_ewm")
"""``eval_final``: mean of the final greedy evaluation. ``train_max_ewm``: the paper's, best
smoothed training score.
"""
Source = str | Path | Sequence[str | Path] | Iterable[Score]
Played = dict[tuple[str, str], tuple[str, str]]
"""Game and setting, ``rules`` or ``options`` -> its value, and where that stands."""
NamedScore = tuple[AgentKey, Score]
"""A score, and the agent that it belongs to; the name in the score is not filled in yet."""

_BOM = "\ufeff"  # what some programs write in front of a table
_COLUMNS: dict[str, tuple[str, ...]] = {
    "agent": ("agent", "memory", "model"),
    "game": ("game", "env", "task"),
    "observability": ("observability",),
    "seed": ("seed",),
    "score": ("score", "return", "value"),
}
"""What a table has to tell -> names of the column that tells it, the first counts."""
_TASK_COLUMNS = {"model", "env", "mdp_mean", "pomdp_mean"}
"""Columns of a table with one task a line."""


def read_scores(runs: Source, metric: str = "eval_final") -> list[Score]:
    """Scores from wherever they stand.

    Args:
        runs: a study's folder, a run's folder, a CSV file, several of these, or scores (which are
            passed through). A CSV file has one run a line with columns agent (or memory), game (or
            env), observability, seed and score (or ``eval_mean`` and ``train_max_ewm``), optionally
            algorithm and player; or one task a line with model, env, difficulty, mdp_mean and
            pomdp_mean.
        metric: one of `METRICS`.

    Returns:
        One score a run: those that were given, those of runs, those of tables. Unfinished runs are
        left out.

    Raises:
        FileNotFoundError: a path does not exist.
        ValueError: the metric is unknown, a folder holds no finished run, runs may not be compared,
            a table lacks a column, or a run appears twice.
        TypeError: ``runs`` is none of these.
    """
    require(metric in METRICS, "metric", metric, f"one of {', '.join(METRICS)}")
    parts = _parts_of(runs)
    named: list[NamedScore] = []
    settings: list[Run] = []  # of the runs behind the scores, as far as they are known
    folders: list[Path] = []
    tables: dict[Path, Path] = {}
    played: Played = {}
    for part in parts:
        if isinstance(part, Score):
            named.append((AgentKey("", part.agent), part))
            continue
        table = table_of(Path(part))
        if table is None:
            folders.append(Path(part))
        else:
            tables[Path(part)] = table
    if folders:
        finished = find_runs(folders)
        settings += finished.runs
        for run, score in zip(finished.runs, finished.scores(metric), strict=True):
            named.append((run.key, score))
            _check_played(played, run.game, str(run.path), _played_by(run))
    for table in tables.values():
        named += _read_table(table, metric, played)
        settings += _runs_of_table(table)
    scores = _with_one_name(named)
    _check_cells(scores)
    check_comparable(Runs(tuple(settings)))
    return scores


def _parts_of(runs: Any) -> list[str | Path | Score]:
    """One path, or several, or scores, as a list; anything else is refused (TypeError)."""
    parts = [runs] if isinstance(runs, str | Path) or not isinstance(runs, Iterable) else list(runs)
    for part in parts:
        if not isinstance(part, str | Path | Score):
            raise TypeError(
                f"runs must be paths of runs, studies or tables, or scores; got {kind_of(part)}"
            )
    return parts


def _with_one_name(named: Sequence[NamedScore]) -> list[Score]:
    """The scores, with one name for every agent and every game."""
    for key, score in named:
        for name in (key.memory, score.game):
            if name.splitlines() != [name]:
                raise ValueError(
                    f"names of agents and games are one line, not {key.memory!r} and {score.game!r}"
                )
    agents = agent_names(key for key, _ in named)
    games = game_names(score.game for _, score in named)
    return [replace(score, agent=agents[key], game=games[score.game]) for key, score in named]


def _check_cells(scores: Sequence[Score]) -> None:
    """Refuse two scores of one agent, game, twin, seed and player."""
    cells: set[Score] = set()
    for score in scores:
        cell = replace(score, value=0.0)
        if cell in cells:
            raise ValueError(
                f"two scores for {score.agent} on {score.game} ({score.observability}), seed "
                f"{score.seed}"
            )
        cells.add(cell)


def table_of(path: Path) -> Path | None:
    """The table of scores that a path is: a file, or the ``results.csv`` of a study that has lost
    its runs.
    """
    if path.is_file():
        return path
    table = path / "results.csv"
    has_runs = next(RunFolders().below(path), None) is not None
    return table if table.is_file() and not has_runs else None


def _runs_of_table(table: Path) -> list[Run]:
    """The finished runs in the table of a study, from the configs that the study keeps beside
    it.
    """
    configs = table.parent / "configs"
    if table.name != "results.csv" or not configs.is_dir():
        return []
    runs = []
    for row in read_csv(table):
        name = row.get("run", "")
        is_file_name = Path(name).name == name
        config = f"{name}.json"
        if row.get("status") == "finished" and is_file_name and (configs / config).exists():
            runs.append(described(Run(configs, config)))
    return runs


def _played_by(run: Run) -> dict[str, str]:
    """By what rules and options of its game a run was made, as a table says it."""
    options = run.config.get("env_options") or {}
    return {
        "rules": str(run.config.get("rules", TrainConfig.rules)),
        "options": json.dumps(options, sort_keys=True),
    }


def _check_played(played: Played, game: str, source: str, settings: Mapping[str, str]) -> None:
    """Refuse scores of a game that was played by other rules or options elsewhere; what a table
    does not say is not compared, nor the size of frames, which is another for people.
    """
    for name, value in settings.items():
        if not value:
            continue
        before, where = played.setdefault((bare_name(game), name), (value, source))
        if value != before:
            raise ValueError(
                f"{game} was played with {name} {before} in {where} and with {value} in {source}: "
                "give scores with one of them"
            )


def _read_table(path: Path, metric: str, played: Played) -> list[NamedScore]:
    """The scores in a table, with the agents that it names."""
    rows = _rows(path)
    columns = _columns(path, list(rows[0]) if rows else [], metric)
    named: list[NamedScore] = []
    first: dict[str, list[str | None]] = {}
    for row in rows:
        if not row[columns["score"]]:
            continue
        game = row[columns["game"]]
        settings = [row.get("rules"), row.get("obs_size"), row.get("options")]
        before = first.setdefault(game, settings)
        if before != settings:
            raise ValueError(
                f"{path}: {game} has scores of rules, obs_size and options {before} and "
                f"{settings}: keep one"
            )
        _check_played(
            played,
            game,
            str(path),
            {"rules": row.get("rules") or "", "options": row.get("options") or ""},
        )
        key = AgentKey(row.get("algorithm") or "", row[columns["agent"]])
        named.append((key, _score(path, row, columns)))
    return named


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a table, one score each.

    Of a table with one task a line, each line gives two rows: means over seeds count as one seed.
    """
    lines = []
    for line in read_csv(path):
        lines.append({name.removeprefix(_BOM): value for name, value in line.items()})
    if not lines or not set(lines[0]) >= _TASK_COLUMNS:
        return lines
    rows = []
    for line in lines:
        game = line["env"] + line.get("difficulty", "").capitalize()
        task = {"model": line["model"], "game": game, "seed": "0"}
        rows.append(task | {"observability": "full", "score": line["mdp_mean"]})
        rows.append(task | {"observability": "partial", "score": line["pomdp_mean"]})
    return rows


def _columns(path: Path, header: Sequence[str], metric: str) -> dict[str, str]:
    """What a table has to tell -> its column."""
    of_metric = "eval_mean" if metric == "eval_final" else metric
    choices = dict(_COLUMNS)
    choices["score"] = (of_metric, metric, *_COLUMNS["score"])
    columns = {}
    missing = []
    for role, names in choices.items():
        present = [name for name in names if name in header]
        if present:
            columns[role] = present[0]
        else:
            missing.append(role)
    if missing:
        raise ValueError(
            f"{path} has no column for {', '.join(missing)}; it has {', '.join(header) or 'none'}"
        )
    return columns


def _score(path: Path, row: Mapping[str, str], columns: Mapping[str, str]) -> Score:
    """The score in a row."""
    game = row[columns["game"]]
    twin = row[columns["observability"]]
    seed = row[columns["seed"]]
    value = row[columns["score"]]
    try:
        return Score("", game, twin, int(seed), float(value), row.get("player") or "")
    except ValueError:
        raise ValueError(f"{path}: seed {seed!r} or score {value!r} is not a number") from None
