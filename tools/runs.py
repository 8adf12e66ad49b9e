"""A run, to read from: its settings, which agent it is, and what it scored."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields, flatten
from arcade_torch.agents.runs.files import (
    list_checkpoints,
    read_json,
    read_log,
)
from arcade_torch.agents.runs.final import is_final, wrong_mean
from arcade_torch.tools.imports import remembered_imports
from arcade_torch.tools.names import AgentKey

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
    def imports(self) -> dict[str, str]:
        """The files and modules that its game and its memory came from -> SHA-256, empty of
        modules.
        """
        return remembered_imports(self.record, self.path / self.settings_file)

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
            frames = int(values["frames"])
            total = int(values["total_frames"])
            status = str(values.get("status", "running"))
        except (OSError, ValueError, KeyError, TypeError, OverflowError):  # it may just be replaced
            return 0, 0, ""
        return frames, total, status

    def table(self, name: str) -> list[dict[str, str]]:
        """Rows of ``metrics.csv`` or ``eval.csv``; none if there is no such file."""
        file = self.path / name
        if not file.exists():
            return []
        return read_log(file)

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
        name = "mean" if metric == "eval_final" else metric
        value = (self.final or {}).get(name)
        if value is None:
            raise ValueError(f"{self.path} has no {metric}: choose another metric")
        if metric == "train_max_ewm":
            self._check_train_score(float(value))
        return float(value)

    def _check_train_score(self, score: float) -> None:
        """Refuse a best training score that is not that of ``metrics.csv``, where there is one."""
        from arcade_torch.agents.metrics import paper_score  # which loads torch

        frames = list[float]()
        returns = list[float]()
        for row in self.table("metrics.csv"):
            if row.get("train_return_last"):
                frames.append(float(row["frames"]))
                returns.append(float(row["train_return_last"]))
        if not frames:
            return
        actual = paper_score(frames, returns)
        if not math.isclose(score, actual, rel_tol=1e-5, abs_tol=1e-6):
            raise ValueError(
                f"{self.path / 'eval.json'} was changed, or metrics.csv: its train_max_ewm is "
                f"{score:g}, that of the curve {actual:g}"
            )


def read_record(file: Path) -> dict[str, Any]:
    """A JSON file that holds a table of names and values; a damaged one is refused."""
    values = read_json(file)
    if not isinstance(values, dict):
        raise ValueError(f"{file} is damaged: it holds no table of names and values")
    return values


def open_run(path: Path) -> Run | None:
    """A run from its folder, None if it has not finished; refuses damaged or changed settings, and
    a mean that is not that of the returns, by the name of the file.
    """
    run = described(Run(path))
    if run.final is None:
        check_mean(path)
        return None
    check_unchanged(run)
    return run


def check_unchanged(run: Run) -> None:
    """Refuse settings that are not those of the run's newest checkpoint, where it keeps one: they
    were changed since.
    """
    for checkpoint in list_checkpoints(run.path / "checkpoints")[:1]:
        try:
            trained = TrainConfig.from_dict(read_record(checkpoint / "meta.json")["config"])
        except (OSError, ValueError, KeyError, TypeError):
            continue  # it is damaged, and says nothing of the settings
        changed = differing_fields(run.config, trained, FREE)
        if changed:
            raise ValueError(
                f"{run.path / run.settings_file} was changed since the training, see {checkpoint}: "
                f"{', '.join(changed)}"
            )


def check_mean(path: Path) -> None:
    """Refuse the ``eval.json`` of a run, if there is one, whose mean is not that of its returns."""
    file = path / "eval.json"
    try:
        wrong = wrong_mean(read_json(file))
    except (OSError, ValueError):
        return
    if wrong:
        raise ValueError(
            f"{file} was changed: {wrong}; go on with the run (train --resume, or its study "
            "again), and it is evaluated again"
        )


def described(run: Run) -> Run:
    """The same run, if its settings say which agent learned which game from which seed; else a
    ``ValueError``.
    """
    file = run.path / run.settings_file
    is_named = bool(run.config.get("env")) and bool(run.config.get("memory"))
    if not is_named or type(run.config.get("seed", 0)) is not int:
        raise ValueError(
            f"{file} does not describe a run: it needs an env, a memory and a seed, a whole number"
        )
    try:
        run.key  # noqa: B018  (refuses damaged options)
        flatten(run.config)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    return run
