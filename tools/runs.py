"""What a run is, which agent it is, how it scored, and which runs are seeds of one agent.

Whatever pools seeds (report, figures, gap and bias, curves, measures of checkpoints) asks here.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import flatten, require
from arcade_torch.agents.runs.files import is_final, read_csv, read_json

METRICS = ("eval_final", "train_max_ewm")
"""``eval_final``: mean of the final greedy evaluation. ``train_max_ewm``: the paper's, best smoothed training score."""
_SIZE = ("layers", "hidden_size")
_VERSION = re.compile(r"-v\d+$")
FREE = {"device", "threads", "checkpoint_every", "eval_every", "eval_episodes", "logger", "compile", "cuda_graphs"}
"""Settings that may differ among runs that are compared."""
_CELL = {"env", "observability", "memory", "seed", "algorithm", "network", "network_options", "rules", "obs_size"}


@dataclass(frozen=True)
class AgentKey:
    """What makes two runs seeds of the same agent."""

    algorithm: str  # name of the learner; empty in tables that do not say
    memory: str  # name of the memory model, or of the agent in such a table
    network: str = ""  # preset of the network
    size: str = ""  # of the memory block, ``LAYERSxWIDTH``; empty for that of the preset
    options: tuple[tuple[str, str], ...] = ()  # other options of the network, (name, value), sorted

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "AgentKey":
        """The key of a run, from its resolved settings."""
        options = config.get("network_options") or {}
        if not isinstance(options, Mapping) or not isinstance(config.get("memory"), str):
            raise ValueError("its memory or its network_options are of no use")
        flat, network, size = flatten(options), str(config.get("network", "paper")), ""
        if any(name in flat for name in _SIZE):
            default = preset_size(network)
            chosen = "x".join(str(flat.get(name, base)) for name, base in zip(_SIZE, default.split("x"), strict=True))
            size = "" if chosen == default else chosen
        rest = tuple(sorted((name, str(value)) for name, value in flat.items() if name not in _SIZE))
        return cls(str(config.get("algorithm", "pqn")), config["memory"], network, size, rest)


def preset_size(network: str) -> str:
    """Layers and width of the memory block of a network preset, ``2x512``."""
    from arcade_torch.models.presets import preset_of

    preset = preset_of(network)
    return f"{preset.layers}x{preset.hidden_size}"


def agent_names(keys: Iterable[AgentKey], sized: bool = False) -> dict[AgentKey, str]:
    """The shortest names that tell agents apart: the memory, and whatever else differs among those that share it.

    Example:
        >>> list(agent_names([AgentKey("pqn", "lru"), AgentKey("ppo", "lru")]).values())
        ['pqn-lru', 'ppo-lru']
    """
    every = list(dict.fromkeys(keys))
    algorithms = {key.algorithm for key in every if key.algorithm}
    networks = {key.network for key in every if key.network}
    found = {}
    for key in every:
        same = [other for other in every if other.memory == key.memory]
        name = f"{key.algorithm}-{key.memory}" if len(algorithms) > 1 and key.algorithm else key.memory
        several = sized or len({other.size for other in same}) > 1
        parts = [key.size or preset_size(key.network or "paper")] if several else []
        parts += [key.network] if len(networks) > 1 and key.network else []
        shared = set.intersection(*(set(other.options) for other in same))
        parts += [f"{option}={value}" for option, value in key.options if (option, value) not in shared]
        found[key] = " ".join([name, *parts])
    return found


def memory_free(agent: str, baseline: str) -> re.Match[str] | None:
    """Whether an agent is the memory-free one, in any case and size; group 1 is its algorithm, ``ppo-``, or empty."""
    return re.fullmatch(rf"(|\S*-){re.escape(baseline)}( .*)?", agent, re.IGNORECASE)


def find_baselines(agents: Sequence[str], baseline: str) -> dict[str, str]:
    """Agent -> the memory-free agent of its algorithm, where there is one; that of the very name or of PQN is first."""
    algorithm = {agent: found[1].lower() for agent in agents if (found := memory_free(agent, baseline))}
    free = sorted(algorithm, key=lambda agent: (agent.lower() != baseline.lower(), algorithm[agent] != "pqn-"))
    first = {algorithm[agent]: agent for agent in reversed(free)}
    own = {agent: [start for start in first if agent.lower().startswith(start)] for agent in (*free, *agents)}
    return {agent: first[max(starts, key=len)] for agent, starts in own.items() if starts}


@dataclass(frozen=True)
class Score:
    """The raw return of one run, not normalised; of people also who played, for their episodes share seeds."""

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

    @cached_property
    def record(self) -> dict[str, Any]:
        """All of ``config.json``: settings, versions, command."""
        return read_record(self.path / "config.json")

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved settings, flat or nested as the trainer wrote them."""
        inner = self.record.get("config", self.record)
        return dict(inner) if isinstance(inner, dict) else {}

    @cached_property
    def final(self) -> dict[str, Any] | None:
        """The content of ``eval.json`` if the run has finished, else None; a damaged file counts as none."""
        try:
            values = read_json(self.path / "eval.json")
        except (OSError, ValueError):
            return None
        return values if is_final(values, ("mean", "returns")) else None

    def progress(self) -> tuple[int, int, str]:
        """Frames done, frames wanted, and status, of ``progress.json``; zeros if there is none to read."""
        try:
            values = read_json(self.path / "progress.json")
            return int(values["frames"]), int(values["total_frames"]), str(values.get("status", "running"))
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
        return str(self.config["env"])

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
    """A run from its folder, None if it has not finished; refuses damaged settings by the name of the file."""
    run, file = Run(path), path / "config.json"
    if not {"env", "memory"} <= set(run.config) or type(run.config.get("seed", 0)) is not int:
        raise ValueError(f"{file} does not describe a run: it needs an env, a memory and a seed, a whole number")
    try:
        run.key  # noqa: B018  (refuses damaged options)
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    return run if run.final is not None else None


@dataclass(frozen=True)
class Runs:
    """Finished runs that may be compared, and what to say about those that were left out."""

    runs: tuple[Run, ...]
    notes: list[str] = field(default_factory=list)

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
        return [Score(self.names[r.key], r.game, r.twin, r.seed, r.value(metric)) for r in self.runs]

    def single_seeds(self) -> list[str]:
        """A note on cells with a single seed; empty if there are none."""
        alone = [f"{agent} on {game} ({twin})" for (agent, game, twin), runs in self.groups().items() if len(runs) < 2]
        return [f"no interval, a single seed: {listed(alone)}"] if alone else []


def listed(names: Sequence[str], most: int = 3) -> str:
    """Some names, and how many more: ``a, b, c and 2 more``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def find_runs(paths: Sequence[Path]) -> Runs:
    """All finished runs below some folders, which have to be comparable."""
    if not paths:
        raise ValueError("name the folder with the runs: --runs DIR")
    opened = {folder: open_run(folder) for path in paths for folder in _folders(path)}
    runs = [run for run in opened.values() if run is not None]
    if not runs:
        raise ValueError(f"none of the {len(opened)} runs below {listed([str(p) for p in paths])} has finished")
    check_comparable(Runs(tuple(runs)))
    unfinished = [folder.name for folder, run in opened.items() if run is None]
    notes = [f"left out, not finished: {listed(unfinished)}"] if unfinished else []
    made = [run.record.get("versions") for run in runs]
    several = sorted({str(each.get("arcade_torch", "")) for each in made if isinstance(each, dict)} - {""})
    if len(several) > 1:
        notes.append(f"the runs were made with several versions of arcade_torch: {', '.join(several)}")
    return Runs(tuple(runs), notes)


def _folders(path: Path) -> list[Path]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if not path.is_dir():
        raise ValueError(f"{path} is a file: give a folder with runs")
    if (path / "meta.json").is_file():
        raise ValueError(f"{path} is a single checkpoint: give its run folder, {path.parent.parent}")
    rows = read_csv(table) if (table := path / "results.csv").is_file() else []  # of a study: in the order of its grid
    order = {row.get("run"): place for place, row in enumerate(rows)}
    found = [file.parent for file in path.rglob("config.json") if "checkpoints" not in file.parts]
    if not found:
        raise ValueError(f"{path} holds no run: a run folder has a config.json")
    return sorted(found, key=lambda folder: (order.get(folder.name, len(order)), folder))


def check_comparable(found: Runs) -> None:
    """Refuse several versions or rules of a game, a run that stands there twice, and seeds that are none."""
    games = sorted({run.game for run in found.runs if _VERSION.search(run.game)})
    for old, new in pairwise(games):
        if _VERSION.sub("", old) == _VERSION.sub("", new):
            raise ValueError(f"runs of {old} and {new} cannot be compared: give one version of a game")
    for key in ("rules", "obs_size"):
        values = sorted({str(run.config[key]) for run in found.runs if key in run.config})
        if len(values) > 1:
            raise ValueError(f"runs with {key} {' and '.join(values)} cannot be compared: give runs with one of them")
    played: dict[str, Any] = {}
    for run in found.runs:
        own = run.config.get("env_options") or {}
        if (first := played.setdefault(run.game, own)) != own:
            raise ValueError(f"{run.game} was played with env_options {first} and {own}: give runs with one of them")
    for (agent, game, twin), runs in found.groups().items():
        for one, run in pairwise(runs):  # by seed
            if one.seed == run.seed:
                raise ValueError(f"{one.path} and {run.path} are the same cell: give one of them")
            first, other = _settings(one), _settings(run)
            if differ := [name for name in first if name in other and first[name] != other[name]]:
                what = f"{differ[0]}: {first[differ[0]]} and {other[differ[0]]}; give runs with one of them"
                raise ValueError(f"seeds of {agent} on {game} ({twin}) differ in {what}")


def _settings(run: Run) -> dict[str, Any]:
    """What decides a run's result beside its agent, its game and its seed."""
    others = _CELL | FREE | ({"pqn", "ppo", "dqn"} - {run.key.algorithm})
    own = {name: value for name, value in run.config.items() if name not in others}
    return flatten(own | {"env_options": run.config.get("env_options") or {}})


Source = str | Path | Sequence[str | Path] | Iterable[Score]
_COLUMNS: dict[str, tuple[str, ...]] = {"agent": ("agent", "memory", "model"), "game": ("game", "env", "task")}
_COLUMNS |= {"observability": ("observability",), "seed": ("seed",), "score": ("score", "return", "value")}


def read_scores(runs: Source, metric: str = "eval_final") -> list[Score]:
    """Scores from wherever they stand.

    Args:
        runs: a study's folder, a run's folder, a CSV file, several of these, or scores (which are passed through).
            A CSV file has one run a line with columns agent (or memory), game (or env), observability, seed and score
            (or ``eval_mean`` and ``train_max_ewm``), optionally algorithm and player; or one task a line with model,
            env, difficulty, mdp_mean and pomdp_mean.
        metric: one of `METRICS`.

    Returns:
        One score a run: those that were given, those of runs, those of tables. Unfinished runs are left out.

    Raises:
        FileNotFoundError: a path does not exist.
        ValueError: the metric is unknown, a folder holds no finished run, runs may not be compared, a table lacks a
            column, or a run appears twice.
    """
    require(metric in METRICS, "metric", metric, f"one of {', '.join(METRICS)}")
    parts = [runs] if isinstance(runs, str | Path) else list(runs)
    paths = [Path(part) for part in parts if not isinstance(part, Score)]
    tables = {path: table for path in paths if (table := table_of(path))}
    found = [(AgentKey("", part.agent), part) for part in parts if isinstance(part, Score)]  # agents without names yet
    if folders := [path for path in paths if path not in tables]:
        opened = find_runs(folders)
        found += zip((run.key for run in opened.runs), opened.scores(metric), strict=True)
    for table in tables.values():
        found += _read_table(table, metric)
    names, newest = agent_names(key for key, _ in found), dict[str, str]()
    for game in {score.game for _, score in found if _VERSION.search(score.game)}:
        bare = _VERSION.sub("", game)  # stands for the newest version that is there
        newest[bare] = max(newest.get(bare, game), game, key=lambda name: int(name.rpartition("-v")[2]))
    scores = [replace(score, agent=names[key], game=newest.get(score.game, score.game)) for key, score in found]
    seen: set[Score] = set()
    for score in scores:
        if any(name.splitlines() != [name] for name in (score.agent, score.game)):
            raise ValueError(f"names of agents and games are one line, not {score.agent!r} and {score.game!r}")
        cell = replace(score, value=0.0)
        if cell in seen:
            raise ValueError(f"two scores for {score.agent} on {score.game} ({score.observability}), seed {score.seed}")
        seen.add(cell)
    return scores


def table_of(path: Path) -> Path | None:
    """The table of scores that a path is: a file, or the ``results.csv`` of a study that has lost its runs."""
    bare = (path / "results.csv").is_file() and next(path.rglob("config.json"), None) is None
    return path if path.is_file() else path / "results.csv" if bare else None


def _read_table(path: Path, metric: str) -> list[tuple[AgentKey, Score]]:
    rows, found = read_csv(path), []
    if rows and {"model", "env", "mdp_mean", "pomdp_mean"} <= set(rows[0]):  # means over seeds count as a single seed
        rows = [
            {"model": row["model"], "game": row["env"] + row.get("difficulty", "").capitalize(), "seed": "0"}
            | {"observability": twin, "score": row[column]}
            for row in rows
            for twin, column in (("full", "mdp_mean"), ("partial", "pomdp_mean"))
        ]
    header = list(rows[0]) if rows else []
    roles = _COLUMNS | {"score": ("eval_mean" if metric == "eval_final" else metric, metric, *_COLUMNS["score"])}
    columns = {role: next((name for name in names if name in header), "") for role, names in roles.items()}
    if missing := [role for role, name in columns.items() if not name]:
        raise ValueError(f"{path} has no column for {', '.join(missing)}; it has {', '.join(header) or 'none'}")
    played = dict[str, list[str | None]]()
    for row in rows:
        agent, game, twin, seed, score = (row[name] for name in columns.values())
        if not score:
            continue
        how = [row.get(name) for name in ("rules", "obs_size", "options")]
        if (first := played.setdefault(game, how)) != how:
            raise ValueError(f"{path}: {game} has scores of rules, obs_size and options {first} and {how}: keep one")
        try:
            made = Score("", game, twin, int(seed), float(score), row.get("player") or "")
        except ValueError:
            raise ValueError(f"{path}: seed {seed!r} or score {score!r} is not a number") from None
        found.append((AgentKey(row.get("algorithm") or "", agent), made))
    return found
