"""The measures of one checkpoint, kept beside it: what commands, figures and report are made
from.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import arcade_torch
from arcade_torch.agents import load
from arcade_torch.agents.runs.checkpoint import list_checkpoints
from arcade_torch.tools.analysis.policy import Progress
from arcade_torch.tools.comparable import Runs, check_comparable, find_runs
from arcade_torch.tools.files import cached_arrays
from arcade_torch.tools.names import AgentKey, agent_names, game_names
from arcade_torch.tools.runs import Run, described

Found = TypeVar("Found")
SETTINGS_FILES = ("config.json", "meta.json")
"""Files with the settings: of a run folder, and of a single checkpoint."""


@dataclass(frozen=True)
class Label:
    """Which checkpoint this is: one seed of an agent on one twin of a game."""

    key: AgentKey
    game: str
    observability: str  # the twin that is looked at
    seed: int  # of the training
    path: Path  # run folder or checkpoint
    agent: str  # its name among those it is compared with; that of its memory until then
    trained_on: str = ""  # the twin that it learned

    @property
    def task(self) -> tuple[str, str, str]:
        """What seeds are pooled over: (agent, game, observability)."""
        return self.agent, self.game, self.observability

    def __str__(self) -> str:
        """Agent, game, twin and seed in a few words."""
        return f"{self.agent} on {self.game} ({self.observability}), seed {self.seed}"


def by_task(measured: Sequence[tuple[Label, Found]]) -> dict[tuple[str, str, str], list[Found]]:
    """(agent, game, observability) -> the measures of its seeds, by seed."""
    tasks: dict[tuple[str, str, str], list[Found]] = {label.task: [] for label, _ in measured}
    for label, found in sorted(measured, key=lambda pair: pair[0].seed):
        tasks[label.task].append(found)
    return tasks


def checkpoints_of(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Run folders and checkpoints as they are, and the finished runs below other folders; notes on
    the rest.
    """
    found = list[Path]()
    notes = list[str]()
    for path in paths:
        if list_checkpoints(path / "checkpoints") or any(
            (path / name).exists() for name in SETTINGS_FILES
        ):
            found.append(path)
        else:
            runs = find_runs([path])
            found += [run.path for run in runs.runs]
            notes += runs.notes
    stated = [
        Run(path, name) for path in found for name in SETTINGS_FILES if (path / name).exists()
    ]
    check_comparable(Runs(tuple(described(run) for run in stated)))
    return found, notes


def measure_run(
    path: Path,
    measure: Callable[..., Found],
    options: Mapping[str, Any],
    progress: Progress | None = None,
) -> tuple[Label, Found]:
    """A measure of a checkpoint, kept under everything that it depends on: the very weights, the
    game, all options.

    ``measure`` takes an agent and returns a dataclass of arrays, numbers and words. Of ``options``
    it gets those that it has arguments for; ``observability`` is another twin than the one trained
    on.
    """
    agent = load(path)
    how = signature(measure)
    given = {**options, "progress": progress}
    config = agent.config
    key = AgentKey.of(agent.config.to_dict())
    twin = options.get("observability") or config.observability
    label = Label(key, config.env, twin, config.seed, path, key.memory, config.observability)
    known = {
        name: given.get(name, one.default)
        for name, one in how.parameters.items()
        if name not in ("agent", "env")
    }
    weights = hashlib.sha256()
    for name, value in sorted(agent.network.state_dict().items()):
        weights.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    own = {
        name: list(x) if isinstance(x, tuple) else x
        for name, x in known.items()
        if name != "progress"
    }
    own |= {"game": label.game, "rules": config.rules, "observability": twin, "format": 2}
    own |= {
        "frames": agent.frames,
        "weights": weights.hexdigest()[:16],
        "version": arcade_torch.__version__,
    }

    def compute() -> dict[str, Any]:
        return {name: np.asarray(value) for name, value in vars(measure(agent, **known)).items()}

    arrays = cached_arrays(path, measure.__name__, own, compute)
    values = {
        name: array.item() if array.ndim == 0 else array
        for name, array in arrays.items()
        if name != "options"
    }
    return label, how.return_annotation(**values)


def measure_runs(
    paths: Sequence[Path],
    measure: Callable[..., Found],
    options: Mapping[str, Any],
    progress: Callable[[str, int, int], None] | None = None,
) -> list[tuple[Label, Found]]:
    """`measure_run` of every path, with names that tell the agents apart."""
    each = [(path, partial(progress, path.name) if progress else None) for path in paths]
    measured = [measure_run(path, measure, options, tell) for path, tell in each]
    names = agent_names(label.key for label, _ in measured)
    seen = dict[Any, Path]()
    games = game_names(label.game for label, _ in measured)
    named = [
        (replace(label, agent=names[label.key], game=games[label.game]), found)
        for label, found in measured
    ]
    twins = dict[Any, str]()
    for label, _ in named:
        if (learned := twins.setdefault(label.task, label.trained_on)) != label.trained_on:
            task = f"{label.agent} on {label.game}"
            raise ValueError(
                f"seeds of {task} learned the twins {learned} and {label.trained_on}: give runs of "
                "one"
            )
        if (cell := (label.task, label.seed)) in seen:
            raise ValueError(f"{seen[cell]} and {label.path} are both {label}: give one of them")
        seen[cell] = label.path
    return named
