"""Finding the runs a figure is made from, and refusing what cannot be compared."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from arcade_torch.tools.analysis.scores import METRICS, Score
from arcade_torch.tools.studies.folder import RunFolder


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: its files.
        config: resolved settings.
        final: its final evaluation.
    """

    folder: RunFolder
    config: dict[str, Any]
    final: dict[str, Any]

    @property
    def game(self) -> str:
        """Environment id."""
        return str(self.config["env"])

    @property
    def twin(self) -> str:
        """``full`` or ``partial``."""
        return str(self.config.get("observability", "full"))

    @property
    def agent(self) -> str:
        """Name of the memory, with the algorithm in front where it is not PQN."""
        memory, algorithm = str(self.config["memory"]), str(self.config.get("algorithm", "pqn"))
        return memory if algorithm == "pqn" else f"{algorithm}-{memory}"

    @property
    def seed(self) -> int:
        """Of the training."""
        return int(self.config.get("seed", 0))

    def score(self, metric: str, agent: str = "") -> Score:
        """The score of the run.

        Args:
            metric: one of `METRICS`.
            agent: another name for the agent.

        Raises:
            ValueError: the metric is unknown, or this run has none.
        """
        if metric not in METRICS:
            raise ValueError(f"unknown metric {metric!r}: allowed are {', '.join(METRICS)}")
        value = self.final.get("mean" if metric == "eval_final" else "train_max_ewm")
        if value is None:
            raise ValueError(f"{self.folder.path} has no {metric}: choose another metric")
        return Score(agent or self.agent, self.game, self.twin, self.seed, float(value))


@dataclass(frozen=True)
class Found:
    """Finished runs, and what to say about those that were left out."""

    runs: tuple[Run, ...]
    notes: list[str] = field(default_factory=list)

    def groups(self) -> dict[tuple[str, str, str], list[Run]]:
        """(agent, game, twin) -> runs by seed."""
        found: dict[tuple[str, str, str], list[Run]] = {}
        for run in sorted(self.runs, key=lambda run: run.seed):
            found.setdefault((run.agent, run.game, run.twin), []).append(run)
        return found

    def single_seeds(self) -> list[str]:
        """A note on cells with a single seed; empty if there are none."""
        alone = [f"{agent} on {game} ({twin})" for (agent, game, twin), runs in self.groups().items() if len(runs) < 2]
        return [f"no interval, a single seed: {listed(alone)}"] if alone else []


def listed(names: Sequence[str], most: int = 3) -> str:
    """Some names, and how many more.

    Example:
        >>> listed(["a", "b", "c", "d", "e"])
        'a, b, c and 2 more'
    """
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def find_runs(paths: Sequence[Path]) -> Found:
    """All finished runs below some folders.

    Args:
        paths: run folders, studies, or folders that hold such.

    Returns:
        The runs in the order of their paths, and notes on what was left out.

    Raises:
        FileNotFoundError: a path does not exist.
        ValueError: there is no finished run, a path is something else, a run stands there twice, or the runs cannot be
            compared (several versions of a game, several rules).
    """
    if not paths:
        raise ValueError("name the folder with the runs: --runs DIR")
    folders = list(dict.fromkeys(folder for path in paths for folder in _folders(path)))
    runs, unfinished = [], []
    for folder in folders:
        run = RunFolder(folder)
        final, config = run.final(), run.config()
        if not {"env", "memory"} <= set(config):
            raise ValueError(f"{folder / 'config.json'} does not describe a run: it has no env or no memory")
        if type(config.get("seed", 0)) is not int or not isinstance(config.get("network_options") or {}, dict):
            raise ValueError(f"{folder / 'config.json'} is damaged: its seed or its network_options are of no use")
        if final is None:
            unfinished.append(folder.name)
        else:
            runs.append(Run(run, config, final))
    if not runs:
        raise ValueError(f"none of the {len(folders)} runs below {listed([str(p) for p in paths])} has finished")
    notes = [f"left out, not finished: {listed(unfinished)}"] if unfinished else []
    return Found(tuple(runs), notes + _comparable(runs))


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
    return found


def _comparable(runs: Sequence[Run]) -> list[str]:
    """Refuse several laws of one game; note several versions of the package."""
    ids: dict[str, set[str]] = {}
    for run in runs:
        ids.setdefault(re.sub(r"-v\d+$", "", run.game), set()).add(run.game)
    for names in ids.values():
        if len(versioned := sorted(name for name in names if re.search(r"-v\d+$", name))) > 1:
            raise ValueError(f"runs of {' and '.join(versioned)} cannot be compared: give one version of a game")
    for key in ("rules", "obs_size"):
        values = sorted({str(run.config[key]) for run in runs if key in run.config})
        if len(values) > 1:
            raise ValueError(f"runs with {key} {' and '.join(values)} cannot be compared: give runs with one of them")
    seen: dict[tuple[str, ...], Path] = {}
    for run in runs:
        options = str(sorted(dict(run.config.get("network_options") or {}).items()))
        cell = (run.agent, run.game, run.twin, str(run.seed), options)
        if cell in seen:
            raise ValueError(f"{seen[cell]} and {run.folder.path} are the same cell: give one of them")
        seen[cell] = run.folder.path
    made_with = [run.folder.record().get("versions") for run in runs]
    versions = sorted({str(made.get("arcade_torch", "")) for made in made_with if isinstance(made, dict)} - {""})
    return [f"the runs were made with several versions of arcade_torch: {', '.join(versions)}"] * (len(versions) > 1)
