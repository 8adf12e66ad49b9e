"""The measures of one checkpoint, kept beside it: what commands, figures and report are made from."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import arcade_torch
from arcade_torch.tools.analysis.windows import Twin
from arcade_torch.tools.files import cached_arrays
from arcade_torch.tools.runs import AgentKey, agent_names, find_runs

Found = TypeVar("Found")


@dataclass(frozen=True)
class Label:
    """Which checkpoint this is: one seed of an agent on one twin of a game."""

    key: AgentKey
    game: str
    observability: str  # the twin that is looked at
    seed: int  # of the training
    frames: int  # of training behind it
    path: Path  # run folder or checkpoint
    agent: str = ""  # its name among those it is compared with, see `with_names`

    @property
    def task(self) -> tuple[str, str, str]:
        """What seeds are pooled over: (agent, game, observability)."""
        return self.agent, self.game, self.observability

    def __str__(self) -> str:
        """Agent, game, twin and seed in a few words."""
        return f"{self.agent} on {self.game} ({self.observability}), seed {self.seed}"


def load_labelled(path: Path, observability: Twin | None = None) -> tuple[Any, Label]:
    """An agent and what it is, called by the name of its memory alone."""
    from arcade_torch.agents import load

    agent = load(path)
    config = agent.config
    key = AgentKey.of(config.to_dict())
    return agent, Label(
        key, config.env, observability or config.observability, config.seed, agent.frames, path, key.memory
    )


def with_names(measured: Sequence[tuple[Label, Found]]) -> list[tuple[Label, Found]]:
    """Measures of checkpoints, with names that tell their agents apart."""
    names = agent_names(label.key for label, _ in measured)
    named = [(replace(label, agent=names[label.key]), found) for label, found in measured]
    seen: dict[tuple[Any, ...], Path] = {}
    for label, _ in named:
        cell = (*label.task, label.seed)
        if cell in seen:
            raise ValueError(f"{seen[cell]} and {label.path} are both {label}: give one of them")
        seen[cell] = label.path
    return named


def by_task(measured: Sequence[tuple[Label, Found]]) -> dict[tuple[str, str, str], list[Found]]:
    """(agent, game, observability) -> the measures of its seeds."""
    tasks: dict[tuple[str, str, str], list[Found]] = {}
    for label, found in measured:
        tasks.setdefault(label.task, []).append(found)
    return tasks


def checkpoints_of(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Run folders and checkpoints as they are, and the finished runs below other folders; notes on the rest."""
    found, notes = list[Path](), list[str]()
    for path in paths:
        if (path / "meta.json").is_file() or (path / "config.json").is_file() or (path / "checkpoints").is_dir():
            found.append(path)
        else:
            runs = find_runs([path])
            found += [run.path for run in runs.runs]
            notes += runs.notes
    return found, notes


NO_OPTIONS = ("agent", "env", "observability", "progress")
"""Arguments of a measure that do not decide its numbers, or stand in the label."""


def measure_run(
    path: Path,
    measure: Callable[..., Found],
    options: Mapping[str, Any],
    observability: Twin | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Label, Found]:
    """A measure of a checkpoint, kept under everything that it depends on: the very weights, the game, all options.

    ``measure`` takes an agent and returns a dataclass of arrays, numbers and words; ``observability`` is another twin
    than the one trained on, ``progress`` is called with (done, of how many).
    """
    agent, label = load_labelled(path, observability)
    how: Any = signature(measure)
    defaults = {name: item.default for name, item in how.parameters.items() if name not in NO_OPTIONS}
    chosen = {name: list(x) if isinstance(x, tuple) else x for name, x in (defaults | dict(options)).items()}
    weights = hashlib.sha256()
    for name, value in sorted(agent.network.state_dict().items()):
        weights.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    own = {"game": label.game, "rules": agent.config.rules, "observability": label.observability, "format": 2}
    own |= {"frames": label.frames, "weights": weights.hexdigest()[:16], "version": arcade_torch.__version__}

    def compute() -> dict[str, Any]:
        found = measure(agent, observability=observability, progress=progress, **options)
        return {name: np.asarray(value) for name, value in vars(found).items()}

    arrays = cached_arrays(path, measure.__name__, own | chosen, compute)
    kind, names = how.return_annotation, (field.name for field in fields(how.return_annotation))
    return label, kind(**{name: arrays[name].item() if arrays[name].ndim == 0 else arrays[name] for name in names})


def measure_runs(
    paths: Sequence[Path],
    measure: Callable[..., Found],
    options: Mapping[str, Any],
    observability: Twin | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[tuple[Label, Found]]:
    """`measure_run` of every path, with names that tell the agents apart."""
    told = [partial(progress, path.name) if progress else None for path in paths]
    each = zip(paths, told, strict=True)
    return with_names([measure_run(path, measure, options, observability, tell) for path, tell in each])
