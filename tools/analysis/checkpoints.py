"""The measures of one checkpoint, kept beside it: what commands and figures are made from."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import arcade_torch
from arcade_torch.tools.analysis.contamination import Contamination, contamination, shuffled_beginning
from arcade_torch.tools.analysis.pixel_saliency import saliency
from arcade_torch.tools.analysis.recall_density import RecallDensity, recall_density
from arcade_torch.tools.analysis.resolve import Twin, episode_window
from arcade_torch.tools.analysis.windows import Window
from arcade_torch.tools.files import cached_arrays
from arcade_torch.tools.runs import AgentKey, agent_names, find_runs

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Label:
    """Which checkpoint this is: one seed of an agent on one twin of a game.

    Attributes:
        key: which agent.
        game: environment id.
        observability: the twin that is looked at.
        seed: of the training.
        frames: of training behind it.
        path: run folder or checkpoint.
        agent: name of the agent among those it is compared with, see `with_names`.
    """

    key: AgentKey
    game: str
    observability: str
    seed: int
    frames: int
    path: Path
    agent: str = ""

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
    twin = observability or config.observability
    return agent, Label(key, config.env, twin, config.seed, agent.frames, path, key.memory)


Found = TypeVar("Found")


def with_names(measured: Sequence[tuple[Label, Found]]) -> list[tuple[Label, Found]]:
    """Measures of checkpoints, with names that tell their agents apart."""
    names = agent_names(label.key for label, _ in measured)
    named = [(replace(label, agent=names[label.key]), found) for label, found in measured]
    seen: dict[tuple[str, str, str, int], Path] = {}
    for label, _ in named:
        cell = (*label.task, label.seed)
        if cell in seen:
            raise ValueError(f"{seen[cell]} and {label.path} are both {label}: give one of them")
        seen[cell] = label.path
    return named


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


def density_of_run(
    path: Path, options: Mapping[str, Any], observability: Twin | None = None, progress: Progress | None = None
) -> tuple[Label, RecallDensity]:
    """Recall density of a checkpoint."""
    agent, label = load_labelled(path, observability)

    def compute() -> dict[str, Any]:
        found = recall_density(agent, observability=observability, progress=progress, **options)
        return {
            "shares": np.concatenate([*found.shares, np.zeros(0)]),
            "lengths": found.lengths,
            "ended": found.ended,
            "counts": np.array([found.dropped, found.silent]),
            "how": np.array([found.end, found.norm, found.reduce, found.target]),
        }

    arrays = cached_arrays(path, "recall_density", _identity(agent, label, recall_density, options), compute)
    cuts = np.cumsum(arrays["lengths"])[:-1]
    shares = tuple(np.split(arrays["shares"], cuts)) if arrays["lengths"].size else ()
    dropped, silent = (int(count) for count in arrays["counts"])
    end, norm, reduce, target = (str(word) for word in arrays["how"])
    return label, RecallDensity(shares, arrays["ended"], dropped, silent, end, norm, reduce, target)


def contamination_of_run(
    path: Path,
    options: Mapping[str, Any],
    shuffle: bool = False,
    observability: Twin | None = None,
    progress: Progress | None = None,
) -> tuple[Label, Contamination]:
    """State contamination of a checkpoint."""
    agent, label = load_labelled(path, observability)
    measure = shuffled_beginning if shuffle else contamination

    def compute() -> dict[str, Any]:
        found = asdict(measure(agent, observability=observability, progress=progress, **options))
        return {name: np.asarray(value) for name, value in found.items()}

    name = "shuffle" if shuffle else "contamination"
    arrays = cached_arrays(path, name, _identity(agent, label, measure, options), compute)
    plain: dict[str, Any] = {name: value.item() if value.ndim == 0 else value for name, value in arrays.items()}
    return label, Contamination(**{field.name: plain[field.name] for field in fields(Contamination)})


def saliency_of_run(path: Path, show: int, tries: int) -> tuple[Label, dict[str, Any]]:
    """Saliency of the last decision of a greedy episode of a checkpoint."""
    agent, label = load_labelled(path)

    def compute() -> dict[str, Any]:
        windows: list[Window] = []
        while len(windows) < tries and not (windows and windows[-1].n + 1 >= show):
            windows.append(episode_window(agent, seed=len(windows)))
        w = max(windows, key=lambda window: window.n)
        found = saliency(agent, w.frames, w.last_action, w.is_init, w.state)
        arrays: dict[str, Any] = {"frames": w.frames, "action": w.action, "reward": w.reward}
        arrays |= {"maps": found.maps, "per_frame": found.per_frame, "output": found.output, "seed": w.seed}
        return {name: np.asarray(value) for name, value in arrays.items()}

    how = {"show": show, "tries": tries}
    return label, cached_arrays(path, "saliency", _identity(agent, label, episode_window, how), compute)


NO_OPTIONS = ("agent", "env", "observability", "progress", "chunk")
"""Arguments of a measure that do not decide its numbers, or stand in the label."""


def _identity(agent: Any, label: Label, measure: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Everything the numbers depend on: the very weights, the game, the options with their defaults."""
    defaults = {name: item.default for name, item in signature(measure).parameters.items() if name not in NO_OPTIONS}
    options = defaults | dict(options)
    weights = hashlib.sha256()
    for name, value in sorted(agent.network.state_dict().items()):
        weights.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    own = {"game": label.game, "rules": agent.config.rules, "observability": label.observability}
    own |= {"frames": label.frames, "weights": weights.hexdigest()[:16], "version": arcade_torch.__version__}
    return own | {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()}
