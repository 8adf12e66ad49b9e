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
from arcade_torch.agents.runs.files import list_checkpoints
from arcade_torch.envs_jax.registry import resolve_id
from arcade_torch.tools.comparable import Runs, check_comparable, find_runs
from arcade_torch.tools.files import cached_arrays
from arcade_torch.tools.imports import load_agent
from arcade_torch.tools.measures.policy import Progress
from arcade_torch.tools.names import AgentKey, agent_names, game_names
from arcade_torch.tools.runs import Run, described

Measure = TypeVar("Measure")
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
    learned: str = ""  # the game and the twin that it was trained on

    @property
    def task(self) -> tuple[str, str, str]:
        """What seeds are pooled over: (agent, game, observability)."""
        return self.agent, self.game, self.observability

    def __str__(self) -> str:
        """Agent, game, twin and seed in a few words."""
        return f"{self.agent} on {self.game} ({self.observability}), seed {self.seed}"


def by_task(
    measured: Sequence[tuple[Label, Measure]],
) -> dict[tuple[str, str, str], list[Measure]]:
    """(agent, game, observability) -> the measures of its seeds, by seed."""
    tasks: dict[tuple[str, str, str], list[Measure]] = {label.task: [] for label, _ in measured}
    for label, measure in sorted(measured, key=lambda pair: pair[0].seed):
        tasks[label.task].append(measure)
    return tasks


def checkpoints_of(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Run folders and checkpoints as they are, and the finished runs below other folders; notes on
    the rest.
    """
    checkpoints = list[Path]()
    notes = list[str]()
    for path in paths:
        if list_checkpoints(path / "checkpoints") or _described_by(path):
            checkpoints.append(path)
        else:
            runs = find_runs([path])
            checkpoints += [run.path for run in runs.runs]
            notes += runs.notes
    described_runs = list[Run]()
    for path in checkpoints:
        for name in _described_by(path):
            described_runs.append(described(Run(path, name)))
    check_comparable(Runs(tuple(described_runs)))
    return checkpoints, notes


def _described_by(path: Path) -> list[str]:
    """Which of `SETTINGS_FILES` are there."""
    return [name for name in SETTINGS_FILES if (path / name).exists()]


def measure_run(
    path: Path,
    measure: Callable[..., Measure],
    options: Mapping[str, Any],
    progress: Progress | None = None,
) -> tuple[Label, Measure]:
    """A measure of a checkpoint, kept under everything that it depends on: the very weights, the
    game, all options.

    ``measure`` takes an agent and returns a dataclass of arrays, numbers and words. Of ``options``
    it gets those that it has arguments for; ``observability`` is another twin than the one trained
    on, ``game`` another game.
    """
    agent = load_agent(path)
    learned = f"{agent.config.env} ({agent.config.observability})"
    if options.get("game"):
        agent.config = replace(agent.config, env=resolve_id(options["game"]))
    config = agent.config
    twin = options.get("observability") or config.observability
    key = AgentKey.of(config.to_dict())
    label = Label(key, config.env, twin, config.seed, path, key.memory, learned)
    arguments = _arguments(measure, dict(options) | {"progress": progress})

    def compute() -> dict[str, Any]:
        result = measure(agent, **arguments)
        return {name: np.asarray(value) for name, value in vars(result).items()}

    settings = dict(arguments)
    settings.pop("progress", None)
    settings["game"] = config.env
    settings["rules"] = config.rules
    settings["observability"] = twin
    settings["format"] = 3
    settings["frames"] = agent.frames
    settings["weights"] = _hash_of_weights(agent.network)
    settings["version"] = arcade_torch.__version__
    arrays = cached_arrays(path, measure.__name__, settings, compute)
    values = dict[str, Any]()
    for name, array in arrays.items():
        if name != "options":
            values[name] = array.item() if array.ndim == 0 else array
    return label, signature(measure).return_annotation(**values)


def _arguments(measure: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a measure behind agent and env: from options, or their defaults; our agents
    need no names of entries.
    """
    arguments = {}
    for name, parameter in signature(measure).parameters.items():
        if name not in ("agent", "env", "names"):
            arguments[name] = options.get(name, parameter.default)
    return arguments


def _hash_of_weights(network: Any) -> str:
    """Sixteen hex digits that tell the weights of one network from those of another."""
    import torch

    weights = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        # as bytes: NumPy does not know all types that weights have
        stored = value.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
        weights.update(name.encode() + stored.numpy().tobytes())
    return weights.hexdigest()[:16]


def measure_runs(
    paths: Sequence[Path],
    measure: Callable[..., Measure],
    options: Mapping[str, Any],
    progress: Callable[[str, int, int], None] | None = None,
) -> list[tuple[Label, Measure]]:
    """`measure_run` of every path, with names that tell the agents apart."""
    measured = list[tuple[Label, Measure]]()
    for path in paths:
        tell = partial(progress, path.name) if progress else None
        measured.append(measure_run(path, measure, options, tell))
    names = agent_names(label.key for label, _ in measured)
    games = game_names(label.game for label, _ in measured)
    named = list[tuple[Label, Measure]]()
    for label, result in measured:
        label = replace(label, agent=names[label.key], game=games[label.game])
        named.append((label, result))
    _check_seeds([label for label, _ in named])
    return named


def _check_seeds(labels: Sequence[Label]) -> None:
    """Refuse a seed that is there twice, and seeds of one task that learned different games or
    twins.
    """
    first = dict[tuple[str, str, str], str]()
    paths = dict[tuple[tuple[str, str, str], int], Path]()
    for label in labels:
        learned = first.setdefault(label.task, label.learned)
        if learned != label.learned:
            task = f"{label.agent} on {label.game}"
            raise ValueError(
                f"seeds of {task} learned {learned} and {label.learned}: give runs of one"
            )
        cell = (label.task, label.seed)
        if cell in paths:
            raise ValueError(f"{paths[cell]} and {label.path} are both {label}: give one of them")
        paths[cell] = label.path
