"""Scores of runs, read from run folders, study folders or CSV files."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arcade_torch.tools.files import read_csv
from arcade_torch.tools.studies.folder import RunFolder

METRICS = ("eval_final", "train_max_ewm")
"""``eval_final``: mean of the final greedy evaluation. ``train_max_ewm``: the paper's, best smoothed training score."""

_AGENT, _GAME, _SCORE = ("agent", "memory", "model"), ("game", "env", "task"), ("score", "return", "value")


@dataclass(frozen=True)
class Score:
    """The raw return of one run.

    Attributes:
        agent: what is compared, usually the name of the memory model.
        game: environment id.
        observability: ``full`` or ``partial``.
        seed: of the run.
        value: undiscounted return, not normalised.
    """

    agent: str
    game: str
    observability: str
    seed: int
    value: float


Runs = str | Path | Sequence[str | Path] | Iterable[Score]


def read_scores(runs: Runs, metric: str = "eval_final") -> list[Score]:
    """Scores from wherever they stand.

    Args:
        runs: a study's folder, a run's folder, a CSV file, several of these, or scores (which are passed through).
            A CSV file has one run a line with columns agent (or memory), game (or env), observability, seed and score
            (or ``eval_mean`` and ``train_max_ewm``); or one task a line with model, env, difficulty, mdp_mean and
            pomdp_mean.
        metric: one of `METRICS`.

    Returns:
        One score a run, in the order found. Unfinished runs are left out.

    Raises:
        FileNotFoundError: a path does not exist or holds no run.
        ValueError: the metric is unknown, a table lacks a column, or a run appears twice.
    """
    if metric not in METRICS:
        raise ValueError(f"unknown metric {metric!r}: allowed are {', '.join(METRICS)}")
    parts: list[Any] = [runs] if isinstance(runs, str | Path) else list(runs)
    scores: list[Score] = []
    for part in parts:
        scores += [part] if isinstance(part, Score) else _read(Path(part), metric)
    scores = _one_name_a_game(scores)
    seen: set[tuple[str, str, str, int]] = set()
    for score in scores:
        for name in (score.agent, score.game):
            if name.splitlines() != [name]:
                raise ValueError(f"names of agents and games are one line, not {name!r}")
        key = (score.agent, score.game, score.observability, score.seed)
        if key in seen:
            raise ValueError(f"two scores for {score.agent} on {score.game} ({score.observability}), seed {score.seed}")
        seen.add(key)
    return scores


def _one_name_a_game(scores: list[Score]) -> list[Score]:
    """Where a game stands both bare and with its version, as the newest version that is there."""
    full: dict[str, str] = {}
    for name in sorted({score.game for score in scores if re.search(r"-v\d+$", score.game)}, key=len):
        bare = name.rpartition("-v")[0]
        full[bare] = max(full.get(bare, name), name, key=lambda item: int(item.rpartition("-v")[2]))
    return [replace(score, game=full.get(score.game, score.game)) for score in scores]


def _read(path: Path, metric: str) -> list[Score]:
    if path.is_file():
        return _read_table(path, metric)
    if (path / "results.csv").is_file():
        return _read_table(path / "results.csv", metric)
    if (path / "config.json").is_file():
        return _read_run(path, metric)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    raise FileNotFoundError(f"{path} holds neither a study (results.csv) nor a run (config.json)")


def _read_run(path: Path, metric: str) -> list[Score]:
    folder = RunFolder(path)
    final, config = folder.final(), folder.config()
    if final is None:
        return []
    value = final.get("mean" if metric == "eval_final" else "train_max_ewm")
    seed = config.get("seed", 0)
    if value is None or type(seed) is not int or not {"memory", "env"} <= set(config):
        raise ValueError(f"{path} does not say what was trained, with which seed, or how it scored ({metric})")
    twin = str(config.get("observability", "full"))
    return [Score(str(config["memory"]), str(config["env"]), twin, seed, float(value))]


def _read_table(path: Path, metric: str) -> list[Score]:
    rows = read_csv(path)
    header = set(rows[0]) if rows else set()
    if {"mdp_mean", "pomdp_mean"} <= header:
        if missing := sorted({"env", "model"} - header):
            raise ValueError(f"{path} has no column for {', '.join(missing)}; it has {', '.join(sorted(header))}")
        try:
            return [score for row in rows for score in _wide(row)]
        except ValueError as error:
            raise ValueError(f"{path}: a mean is not a number ({error})") from None
    names = {role: next((name for name in choice if name in header), None) for role, choice in _roles(metric).items()}
    missing = [role for role, name in names.items() if name is None]
    if missing:
        raise ValueError(f"{path} has no column for {', '.join(missing)}; it has {', '.join(sorted(header)) or 'none'}")
    several = len({row.get("algorithm") for row in rows}) > 1
    scores = []
    for row in rows:
        cell = {role: row[str(name)] for role, name in names.items()}
        if cell["score"] == "":
            continue
        agent = f"{row['algorithm']}-{cell['agent']}" if several else cell["agent"]
        try:
            scores.append(Score(agent, cell["game"], cell["observability"], int(cell["seed"]), float(cell["score"])))
        except ValueError:
            raise ValueError(f"{path}: seed {cell['seed']!r} or score {cell['score']!r} is not a number") from None
    return scores


def _roles(metric: str) -> dict[str, tuple[str, ...]]:
    own = "eval_mean" if metric == "eval_final" else "train_max_ewm"
    return {
        "agent": _AGENT,
        "game": _GAME,
        "observability": ("observability",),
        "seed": ("seed",),
        "score": (own, metric, *_SCORE),
    }


def _wide(row: dict[str, str]) -> list[Score]:
    """A line of a published table: means over seeds only, so each counts as a single seed."""
    game = row["env"] + row.get("difficulty", "").capitalize()
    pairs = (("full", "mdp_mean"), ("partial", "pomdp_mean"))
    return [Score(row["model"], game, twin, 0, float(row[column])) for twin, column in pairs]
