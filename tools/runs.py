"""What a run is, which agent it is, how it scored, and which runs are seeds of one agent.

Whatever pools seeds (report, figures, gap and bias, curves, measures of checkpoints) asks here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig, differing_values, flatten, require
from arcade_torch.agents.runs.files import is_final, read_csv, read_json
from arcade_torch.tools.names import AgentKey as AgentKey
from arcade_torch.tools.names import agent_names as agent_names
from arcade_torch.tools.names import bare_name, game_names, plain_number
from arcade_torch.tools.run_folders import RunFolders

METRICS = ("eval_final", "train_max_ewm")
"""``eval_final``: mean of the final greedy evaluation. ``train_max_ewm``: the paper's, best
smoothed training score.
"""
_BOM = "\ufeff"  # what some programs write in front of a table
FREE = {
    "device",
    "threads",
    "checkpoint_every",
    "eval_every",
    "eval_episodes",
    "logger",
    "compile",
    "cuda_graphs",
}
"""Settings that may differ among runs that are compared."""
_CELL = {
    "env",
    "observability",
    "memory",
    "seed",
    "algorithm",
    "network",
    "network_options",
    "rules",
    "obs_size",
}


@dataclass(frozen=True)
class Score:
    """The raw return of one run, not normalised; of people also who played, for their episodes
    share seeds.
    """

    agent: str
    game: str
    observability: str
    seed: int
    value: float
    player: str = ""


@dataclass(frozen=True)
class Run:
    """The folder of a run, to read from; a missing file means "not yet"."""

    path: Path
    settings_file: str = "config.json"  # ``meta.json`` of a single checkpoint
    # the environment id among others, if it was written otherwise; see `game_names`
    game_name: str = ""

    @cached_property
    def record(self) -> dict[str, Any]:
        """All of ``config.json``: settings, versions, command."""
        return read_record(self.path / self.settings_file)

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved settings, flat or nested as the trainer wrote them."""
        inner = self.record.get("config", self.record)
        return dict(inner) if isinstance(inner, dict) else {}

    @cached_property
    def final(self) -> dict[str, Any] | None:
        """The content of ``eval.json`` if the run has finished, else None; a damaged file counts as
        none.
        """
        try:
            values = read_json(self.path / "eval.json")
        except (OSError, ValueError):
            return None
        return values if is_final(values, ("mean", "returns")) else None

    def progress(self) -> tuple[int, int, str]:
        """Frames done, frames wanted, and status, of ``progress.json``; zeros if there is none to
        read.
        """
        try:
            values = read_json(self.path / "progress.json")
            return (
                int(values["frames"]),
                int(values["total_frames"]),
                str(values.get("status", "running")),
            )
        except (OSError, ValueError, KeyError, TypeError, OverflowError):  # it may just be replaced
            return 0, 0, ""

    def table(self, name: str) -> list[dict[str, str]]:
        """Rows of ``metrics.csv`` or ``eval.csv``; none if there is no such file."""
        return read_csv(file, strict=False) if (file := self.path / name).exists() else []

    @cached_property
    def key(self) -> AgentKey:
        """Which agent it is."""
        return AgentKey.of(self.config)

    @property
    def game(self) -> str:
        """Environment id."""
        return self.game_name or str(self.config["env"])

    @property
    def twin(self) -> str:
        """``full`` or ``partial``."""
        return str(self.config.get("observability", "full"))

    @property
    def seed(self) -> int:
        """Of the training."""
        return int(self.config.get("seed", 0))

    def value(self, metric: str) -> float:
        """The score of the run."""
        value = (self.final or {}).get("mean" if metric == "eval_final" else metric)
        if value is None:
            raise ValueError(f"{self.path} has no {metric}: choose another metric")
        return float(value)


def read_record(file: Path) -> dict[str, Any]:
    """A JSON file that holds a table of names and values; a damaged one is refused."""
    values = read_json(file)
    if not isinstance(values, dict):
        raise ValueError(f"{file} is damaged: it holds no table of names and values")
    return values


def open_run(path: Path) -> Run | None:
    """A run from its folder, None if it has not finished; refuses damaged settings by the name of
    the file.
    """
    run = described(Run(path))
    return run if run.final is not None else None


def described(run: Run) -> Run:
    """The same run, if its settings say which agent learned which game from which seed; else a
    ``ValueError``.
    """
    file = run.path / run.settings_file
    if (
        not all(run.config.get(name) for name in ("env", "memory"))
        or type(run.config.get("seed", 0)) is not int
    ):
        raise ValueError(
            f"{file} does not describe a run: it needs an env, a memory and a seed, a whole number"
        )
    try:
        run.key  # noqa: B018  (refuses damaged options)
        flatten(run.config)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    return run


@dataclass(frozen=True)
class Runs:
    """Finished runs that may be compared, and what to say about those that were left out."""

    runs: tuple[Run, ...]
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = game_names(run.game for run in self.runs)
        named = (
            run if names[run.game] == run.game else replace(run, game_name=names[run.game])
            for run in self.runs
        )
        object.__setattr__(self, "runs", tuple(named))

    @cached_property
    def names(self) -> dict[AgentKey, str]:
        """Name of every agent."""
        return agent_names(run.key for run in self.runs)

    def groups(self) -> dict[tuple[str, str, str], list[Run]]:
        """(agent, game, twin) -> runs by seed."""
        found: dict[tuple[str, str, str], list[Run]] = {}
        for run in sorted(self.runs, key=lambda run: run.seed):
            found.setdefault((self.names[run.key], run.game, run.twin), []).append(run)
        return found

    def scores(self, metric: str) -> list[Score]:
        """One score a run."""
        return [
            Score(self.names[r.key], r.game, r.twin, r.seed, r.value(metric)) for r in self.runs
        ]

    def single_seeds(self) -> list[str]:
        """A note on cells with a single seed; empty if there are none."""
        alone = [
            f"{agent} on {game} ({twin})"
            for (agent, game, twin), runs in self.groups().items()
            if len(runs) < 2
        ]
        return [f"no interval, a single seed: {listed(alone)}"] if alone else []


def listed(names: Sequence[str], most: int = 3) -> str:
    """Some names, and how many more: ``a, b, c and 2 more``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def find_runs(paths: Sequence[Path]) -> Runs:
    """All finished runs below some folders, which have to be comparable."""
    if not paths:
        raise ValueError("name the folder with the runs: --runs DIR")
    search = RunFolders()
    opened = {folder: open_run(folder) for path in paths for folder in _folders(path, search)}
    runs = [run for run in opened.values() if run is not None]
    if not runs:
        raise ValueError(
            f"none of the {len(opened)} runs below {listed([str(p) for p in paths])} has finished"
        )
    check_comparable(Runs(tuple(runs)))
    unfinished = [folder.name for folder, run in opened.items() if run is None]
    notes = [f"left out, not finished: {listed(unfinished)}"] if unfinished else []
    notes += search.notes
    made = [run.record.get("versions") for run in runs]
    several = sorted(
        {str(each.get("arcade_torch", "")) for each in made if isinstance(each, dict)} - {""}
    )
    if len(several) > 1:
        notes.append(
            f"the runs were made with several versions of arcade_torch: {', '.join(several)}"
        )
    return Runs(tuple(runs), notes)


def _folders(path: Path, search: RunFolders) -> list[Path]:
    """Run folders below a path: those of a study in the order of its grid."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if not path.is_dir():
        raise ValueError(f"{path} is a file: give a folder with runs")
    if (path / "meta.json").is_file():
        raise ValueError(
            f"{path} is a single checkpoint: give its run folder, {path.parent.parent}"
        )
    again = search.has_seen(path)
    folders = list(search.below(path))
    if not folders and not again:
        raise ValueError(f"{path} holds no run: a run folder has a config.json")
    order: dict[Path, dict[str, int]] = {}
    for study in {folder.absolute().parent.parent for folder in folders}:
        table = study / "results.csv"
        rows = read_csv(table) if table.is_file() else []
        order[study] = {row.get("run", ""): place for place, row in enumerate(rows)}

    def place(folder: Path) -> tuple[Path, int, Path]:
        study = folder.absolute().parent.parent
        return study, order[study].get(folder.name, len(order[study])), folder

    return sorted(folders, key=place)


def check_comparable(found: Runs) -> None:
    """Refuse several versions or rules of a game, a run that stands there twice, and seeds that are
    none.
    """
    games = sorted({run.game for run in found.runs})
    for old, new in pairwise(games):
        if bare_name(old) == bare_name(new):
            raise ValueError(
                f"runs of {old} and {new} cannot be compared: give one version of a game"
            )
    for name, default in (("rules", TrainConfig.rules), ("obs_size", TrainConfig.obs_size)):
        values = sorted({str(plain_number(run.config.get(name, default))) for run in found.runs})
        if len(values) > 1:
            raise ValueError(
                f"runs with {name} {' and '.join(values)} cannot be compared: give runs with one "
                "of them"
            )
    first: dict[str, Run] = {}
    for run in found.runs:
        same = first.setdefault(run.game, run)
        own = run.config.get("env_options") or {}
        before = same.config.get("env_options") or {}
        if own != before:
            raise ValueError(
                f"{run.game} was played with env_options {before} and {own}: give runs with one of "
                "them"
            )
    for (agent, game, twin), runs in found.groups().items():
        for one, run in pairwise(runs):  # by seed
            if one.seed == run.seed:
                raise ValueError(f"{one.path} and {run.path} are the same cell: give one of them")
            if differ := differing_values(one.config, run.config, _CELL | FREE):
                what = ", ".join(
                    f"{name}: {this} and {that}" for name, (this, that) in differ.items()
                )
                raise ValueError(
                    f"seeds of {agent} on {game} ({twin}) differ in {what}; give runs with one of "
                    "them"
                )


Source = str | Path | Sequence[str | Path] | Iterable[Score]
_COLUMNS: dict[str, tuple[str, ...]] = {
    "agent": ("agent", "memory", "model"),
    "game": ("game", "env", "task"),
}
_COLUMNS |= {
    "observability": ("observability",),
    "seed": ("seed",),
    "score": ("score", "return", "value"),
}


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
    """
    require(metric in METRICS, "metric", metric, f"one of {', '.join(METRICS)}")
    parts = [runs] if isinstance(runs, str | Path) else list(runs)
    paths = [Path(part) for part in parts if not isinstance(part, Score)]
    tables = {path: table for path in paths if (table := table_of(path))}
    # agents without names yet
    found = [(AgentKey("", part.agent), part) for part in parts if isinstance(part, Score)]
    stated = list[Run]()  # the runs behind the scores, as far as their settings are known
    if folders := [path for path in paths if path not in tables]:
        opened = find_runs(folders)
        stated += opened.runs
        found += zip((run.key for run in opened.runs), opened.scores(metric), strict=True)
    for table in tables.values():
        found += _read_table(table, metric)
        stated += _runs_of_table(table)
    for key, score in found:
        if any(name.splitlines() != [name] for name in (key.memory, score.game)):
            raise ValueError(
                f"names of agents and games are one line, not {key.memory!r} and {score.game!r}"
            )
    names = agent_names(key for key, _ in found)
    games = game_names(score.game for _, score in found)
    scores = [replace(score, agent=names[key], game=games[score.game]) for key, score in found]
    seen: set[Score] = set()
    for score in scores:
        cell = replace(score, value=0.0)
        if cell in seen:
            raise ValueError(
                f"two scores for {score.agent} on {score.game} ({score.observability}), seed "
                f"{score.seed}"
            )
        seen.add(cell)
    check_comparable(Runs(tuple(stated)))
    return scores


def table_of(path: Path) -> Path | None:
    """The table of scores that a path is: a file, or the ``results.csv`` of a study that has lost
    its runs.
    """
    bare = (path / "results.csv").is_file() and next(RunFolders().below(path), None) is None
    return path if path.is_file() else path / "results.csv" if bare else None


def _runs_of_table(table: Path) -> list[Run]:
    """The finished runs in the table of a study, from the configs that the study keeps beside
    it.
    """
    configs = table.parent / "configs"
    if table.name != "results.csv" or not configs.is_dir():
        return []
    names = [row.get("run", "") for row in read_csv(table) if row.get("status") == "finished"]
    files = [configs / f"{name}.json" for name in names if Path(name).name == name]
    return [described(Run(configs, file.name)) for file in files if file.exists()]


def _read_table(path: Path, metric: str) -> list[tuple[AgentKey, Score]]:
    """The scores in a table, with the agents that it names."""
    rows = [
        {name.removeprefix(_BOM): value for name, value in row.items()} for row in read_csv(path)
    ]
    found = list[tuple[AgentKey, Score]]()
    # means over seeds count as a single seed
    if rows and {"model", "env", "mdp_mean", "pomdp_mean"} <= set(rows[0]):
        rows = [
            {
                "model": row["model"],
                "game": row["env"] + row.get("difficulty", "").capitalize(),
                "seed": "0",
            }
            | {"observability": twin, "score": row[column]}
            for row in rows
            for twin, column in (("full", "mdp_mean"), ("partial", "pomdp_mean"))
        ]
    header = list(rows[0]) if rows else []
    roles = _COLUMNS | {
        "score": ("eval_mean" if metric == "eval_final" else metric, metric, *_COLUMNS["score"])
    }
    columns = {
        role: next((name for name in names if name in header), "") for role, names in roles.items()
    }
    if missing := [role for role, name in columns.items() if not name]:
        raise ValueError(
            f"{path} has no column for {', '.join(missing)}; it has {', '.join(header) or 'none'}"
        )
    played = dict[str, list[str | None]]()
    for row in rows:
        agent, game, twin, seed, score = (row[name] for name in columns.values())
        if not score:
            continue
        how = [row.get(name) for name in ("rules", "obs_size", "options")]
        if (first := played.setdefault(game, how)) != how:
            raise ValueError(
                f"{path}: {game} has scores of rules, obs_size and options {first} and {how}: keep "
                "one"
            )
        try:
            made = Score("", game, twin, int(seed), float(score), row.get("player") or "")
        except ValueError:
            raise ValueError(f"{path}: seed {seed!r} or score {score!r} is not a number") from None
        found.append((AgentKey(row.get("algorithm") or "", agent), made))
    return found
