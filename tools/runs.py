"""Finished runs: where they are, which agent each one is, how it scored, and which are seeds of one agent.

Whatever pools seeds (report, figures, gap and bias, curves, measures of checkpoints) asks here.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from arcade_torch.tools.files import read_csv
from arcade_torch.tools.studies.folder import RunFolder
from arcade_torch.tools.studies.grid import flatten

METRICS = ("eval_final", "train_max_ewm")
"""``eval_final``: mean of the final greedy evaluation. ``train_max_ewm``: the paper's, best smoothed training score."""

_SIZE = ("layers", "hidden_size")
_NOT_SETTINGS = (
    *("env", "observability", "memory", "seed", "network_options", "env_options", "device", "threads", "obs_size"),
    *("checkpoint_every", "eval_every", "eval_episodes", "logger", "algorithm", "network", "compile", "cuda_graphs"),
    "rules",
)


@dataclass(frozen=True)
class AgentKey:
    """What makes two runs seeds of the same agent.

    Attributes:
        algorithm: name of the learner; empty in tables that do not say.
        memory: name of the memory model, or of the agent in such a table.
        network: preset of the network.
        size: of the memory block, ``LAYERSxWIDTH``; empty for that of the preset.
        options: other options of the network, (name, value), sorted.
    """

    algorithm: str
    memory: str
    network: str = ""
    size: str = ""
    options: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "AgentKey":
        """The key of a run, from its resolved settings."""
        options = config.get("network_options") or {}
        if not isinstance(options, Mapping) or not isinstance(config.get("memory"), str):
            raise ValueError("its memory or its network_options are of no use")
        flat = flatten(options)
        network = str(config.get("network", "paper"))
        size = ""
        if any(name in flat for name in _SIZE):
            default = preset_size(network)
            chosen = "x".join(str(flat.get(name, base)) for name, base in zip(_SIZE, default.split("x"), strict=True))
            size = "" if chosen == default else chosen
        rest = tuple(sorted((name, str(value)) for name, value in flat.items() if name not in _SIZE))
        return cls(str(config.get("algorithm", "pqn")), config["memory"], network, size, rest)

    @property
    def full_size(self) -> str:
        """Layers and width, ``2x512``, those of the preset as well."""
        return self.size or preset_size(self.network or "paper")


def preset_size(network: str) -> str:
    """Layers and width of the memory block of a network preset, ``2x512``."""
    from arcade_torch.models.presets import PRESETS

    if network not in PRESETS:
        raise ValueError(f"unknown network {network!r}; known are {', '.join(PRESETS)}")
    return f"{PRESETS[network].layers}x{PRESETS[network].hidden_size}"


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
        parts = [key.full_size] if sized or len({other.size for other in same}) > 1 else []
        parts += [key.network] if len(networks) > 1 and key.network else []
        shared = set.intersection(*(set(other.options) for other in same))
        parts += [f"{option}={value}" for option, value in key.options if (option, value) not in shared]
        found[key] = " ".join([name, *parts])
    return found


def is_baseline(agent: str, baseline: str) -> bool:
    """Whether an agent is the memory-free one, alone or behind the name of an algorithm; any case."""
    agent, baseline = agent.lower(), baseline.lower()
    memory = agent.partition(" ")[0]  # without its size
    return baseline in (agent, memory) or memory.endswith(f"-{baseline}")


def find_baseline(agents: Sequence[str], baseline: str) -> str | None:
    """The memory-free agent that others are measured against: the one of that very name, else that of PQN, else any."""
    exact = [agent for agent in agents if agent.lower() == baseline.lower()]
    free = [agent for agent in agents if is_baseline(agent, baseline)]
    pqn = [agent for agent in free if agent.lower().startswith("pqn-")]
    return next(iter([*exact, *pqn, *free]), None)


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
    """A finished run: its files, its resolved settings, its final evaluation."""

    folder: RunFolder
    config: dict[str, Any]
    final: dict[str, Any]

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
        value = self.final.get("mean" if _known(metric) == "eval_final" else "train_max_ewm")
        if value is None:
            raise ValueError(f"{self.folder.path} has no {metric}: choose another metric")
        return float(value)


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
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def open_run(folder: RunFolder) -> Run | None:
    """A run from its folder, None if it has not finished."""
    final, config, file = folder.final(), folder.config(), folder.path / "config.json"
    if not {"env", "memory"} <= set(config):
        raise ValueError(f"{file} does not describe a run: it has no env or no memory")
    if type(config.get("seed", 0)) is not int:
        raise ValueError(f"{file} is damaged: its seed is {config['seed']!r}")
    run = Run(folder, config, final or {})
    try:
        run.key  # noqa: B018  (refuses damaged options here, with the name of the file)
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    return run if final is not None else None


def find_runs(paths: Sequence[Path]) -> Runs:
    """All finished runs below some folders."""
    if not paths:
        raise ValueError("name the folder with the runs: --runs DIR")
    folders = list(dict.fromkeys(folder for path in paths for folder in _folders(path)))
    opened = {folder: open_run(RunFolder(folder)) for folder in folders}
    runs = [run for run in opened.values() if run is not None]
    if not runs:
        raise ValueError(f"none of the {len(folders)} runs below {listed([str(p) for p in paths])} has finished")
    unfinished = [folder.name for folder, run in opened.items() if run is None]
    notes = [f"left out, not finished: {listed(unfinished)}"] if unfinished else []
    found = Runs(tuple(runs), notes)
    _check_comparable(found)
    return replace(found, notes=notes + _versions_note(runs))


def _folders(path: Path) -> list[Path]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if not path.is_dir():
        raise ValueError(f"{path} is a file: give a folder with runs")
    if (path / "meta.json").is_file():
        raise ValueError(f"{path} is a single checkpoint: give its run folder, {path.parent.parent}")
    found = sorted(file.parent for file in path.rglob("config.json") if "checkpoints" not in file.parts)
    if not found:
        raise ValueError(f"{path} holds no run: a run folder has a config.json")
    if (path / "results.csv").is_file():  # a study: in the order of its grid
        order = {row.get("run"): place for place, row in enumerate(read_csv(path / "results.csv"))}
        found.sort(key=lambda folder: order.get(folder.name, len(order)))
    return found


def _check_comparable(found: Runs) -> None:
    """Refuse several versions or rules of a game, a run that stands there twice, and seeds that are none."""
    ids: dict[str, set[str]] = {}
    for run in found.runs:
        ids.setdefault(re.sub(r"-v\d+$", "", run.game), set()).add(run.game)
    for names in ids.values():
        if len(versioned := sorted(name for name in names if re.search(r"-v\d+$", name))) > 1:
            raise ValueError(f"runs of {' and '.join(versioned)} cannot be compared: give one version of a game")
    for key in ("rules", "obs_size"):
        values = sorted({str(run.config[key]) for run in found.runs if key in run.config})
        if len(values) > 1:
            raise ValueError(f"runs with {key} {' and '.join(values)} cannot be compared: give runs with one of them")
    for (agent, game, twin), runs in found.groups().items():
        _check_seeds(runs, f"{agent} on {game} ({twin})")


def _check_seeds(runs: Sequence[Run], what: str) -> None:
    seen: dict[int, Run] = {}
    for run in runs:
        if run.seed in seen:
            raise ValueError(f"{seen[run.seed].folder.path} and {run.folder.path} are the same cell: give one of them")
        seen[run.seed] = run
        first, other = _settings(runs[0]), _settings(run)
        for name in first.keys() & other.keys():
            if first[name] != other[name]:
                raise ValueError(
                    f"seeds of {what} differ in {name}: {first[name]} and {other[name]}; give runs with one of them"
                )


def _settings(run: Run) -> dict[str, Any]:
    """What decides a run's result beside its agent, its game and its seed."""
    others = {"pqn", "ppo", "dqn"} - {run.key.algorithm}
    own = {name: value for name, value in run.config.items() if name not in (*_NOT_SETTINGS, *others)}
    return flatten(own | {"env_options": run.config.get("env_options") or {}})


def _versions_note(runs: Sequence[Run]) -> list[str]:
    made = [run.folder.record().get("versions") for run in runs]
    found = sorted({str(each.get("arcade_torch", "")) for each in made if isinstance(each, dict)} - {""})
    return [f"the runs were made with several versions of arcade_torch: {', '.join(found)}"] * (len(found) > 1)


_AGENT, _GAME, _SCORE = ("agent", "memory", "model"), ("game", "env", "task"), ("score", "return", "value")

Source = str | Path | Sequence[str | Path] | Iterable[Score]
Entry = tuple[AgentKey, Score]  # a score whose agent has no name yet


def read_scores(runs: Source, metric: str = "eval_final") -> list[Score]:
    """Scores from wherever they stand.

    Args:
        runs: a study's folder, a run's folder, a CSV file, several of these, or scores (which are passed through).
            A CSV file has one run a line with columns agent (or memory), game (or env), observability, seed and score
            (or ``eval_mean`` and ``train_max_ewm``), optionally algorithm and player; or one task a line with model,
            env, difficulty, mdp_mean and pomdp_mean.
        metric: one of `METRICS`.

    Returns:
        One score a run, in the order found. Unfinished runs are left out.

    Raises:
        FileNotFoundError: a path does not exist or holds no run.
        ValueError: the metric is unknown, a table lacks a column, or a run appears twice.
    """
    _known(metric)
    parts: list[Any] = [runs] if isinstance(runs, str | Path) else list(runs)
    found: list[Entry] = []
    for part in parts:
        found += [(AgentKey("", part.agent), part)] if isinstance(part, Score) else _read(Path(part), metric)
    names = agent_names(key for key, _ in found)
    scores = _one_name_a_game([replace(score, agent=names[key]) for key, score in found])
    seen: set[tuple[str, str, str, int, str]] = set()
    for score in scores:
        for name in (score.agent, score.game):
            if name.splitlines() != [name]:
                raise ValueError(f"names of agents and games are one line, not {name!r}")
        cell = (score.agent, score.game, score.observability, score.seed, score.player)
        if cell in seen:
            raise ValueError(f"two scores for {score.agent} on {score.game} ({score.observability}), seed {score.seed}")
        seen.add(cell)
    return scores


def _known(metric: str) -> str:
    if metric not in METRICS:
        raise ValueError(f"unknown metric {metric!r}: allowed are {', '.join(METRICS)}")
    return metric


def _one_name_a_game(scores: list[Score]) -> list[Score]:
    """Where a game stands both bare and with its version, as the newest version that is there."""
    full: dict[str, str] = {}
    for name in sorted({score.game for score in scores if re.search(r"-v\d+$", score.game)}, key=len):
        bare = name.rpartition("-v")[0]
        full[bare] = max(full.get(bare, name), name, key=lambda item: int(item.rpartition("-v")[2]))
    return [replace(score, game=full.get(score.game, score.game)) for score in scores]


def _read(path: Path, metric: str) -> list[Entry]:
    if path.is_file():
        return _read_table(path, metric)
    if (path / "results.csv").is_file():
        return _read_table(path / "results.csv", metric)
    if (path / "config.json").is_file():
        run = open_run(RunFolder(path))
        return [] if run is None else [(run.key, Score("", run.game, run.twin, run.seed, run.value(metric)))]
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    raise FileNotFoundError(f"{path} holds neither a study (results.csv) nor a run (config.json)")


def _read_table(path: Path, metric: str) -> list[Entry]:
    rows = read_csv(path)
    header = set(rows[0]) if rows else set()
    if {"mdp_mean", "pomdp_mean"} <= header:
        if missing := sorted({"env", "model"} - header):
            raise ValueError(f"{path} has no column for {', '.join(missing)}; it has {', '.join(sorted(header))}")
        try:
            return [score for row in rows for score in _wide(row)]
        except ValueError as error:
            raise ValueError(f"{path}: a mean is not a number ({error})") from None
    own = "eval_mean" if metric == "eval_final" else "train_max_ewm"
    roles: dict[str, tuple[str, ...]] = {"agent": _AGENT, "game": _GAME, "observability": ("observability",)}
    roles |= {"seed": ("seed",), "score": (own, metric, *_SCORE)}
    names = {role: next((name for name in choice if name in header), None) for role, choice in roles.items()}
    missing = [role for role, name in names.items() if name is None]
    if missing:
        raise ValueError(f"{path} has no column for {', '.join(missing)}; it has {', '.join(sorted(header)) or 'none'}")
    found = []
    for row in rows:
        cell = {role: row[str(name)] for role, name in names.items()}
        if cell["score"] == "":
            continue
        try:
            score = Score("", cell["game"], cell["observability"], int(cell["seed"]), float(cell["score"]))
        except ValueError:
            raise ValueError(f"{path}: seed {cell['seed']!r} or score {cell['score']!r} is not a number") from None
        found.append((_key_of_row(path, row, cell["agent"]), replace(score, player=row.get("player") or "")))
    return found


def _key_of_row(path: Path, row: Mapping[str, str], agent: str) -> AgentKey:
    """From the settings of the run a study's row is about; else by the names in the row."""
    run = RunFolder(path.parent / "runs" / row["run"]) if row.get("run") and path.name == "results.csv" else None
    if run is not None and (run.path / "config.json").is_file():
        return AgentKey.of(run.config())
    return AgentKey(row.get("algorithm") or "", agent)


def _wide(row: dict[str, str]) -> list[Entry]:
    """A line of a published table: means over seeds only, so each counts as a single seed."""
    game, key = row["env"] + row.get("difficulty", "").capitalize(), AgentKey("", row["model"])
    pairs = (("full", "mdp_mean"), ("partial", "pomdp_mean"))
    return [(key, Score("", game, twin, 0, float(row[column]))) for twin, column in pairs]
