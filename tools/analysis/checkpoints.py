"""The measures of one checkpoint, kept beside it: what commands and figures are made from."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

import arcade_torch
from arcade_torch.tools.analysis.contamination import Contamination, contamination, shuffled_beginning
from arcade_torch.tools.analysis.kept import Arrays, kept
from arcade_torch.tools.analysis.recall_density import RecallDensity, recall_density
from arcade_torch.tools.analysis.subject import Twin

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Label:
    """Which checkpoint this is: one seed of an agent on one twin of a game.

    Attributes:
        agent: name of its memory, with the algorithm in front where it is not PQN.
        game: environment id.
        observability: the twin that is looked at.
        seed: of the training.
        frames: of training behind it.
        path: run folder or checkpoint.
    """

    agent: str
    game: str
    observability: str
    seed: int
    frames: int
    path: Path

    @property
    def task(self) -> tuple[str, str, str]:
        """What seeds are pooled over: (agent, game, observability)."""
        return self.agent, self.game, self.observability


def load_labelled(path: Path, observability: Twin | None = None) -> tuple[Any, Label]:
    """An agent and what it is.

    Args:
        path: run folder or checkpoint.
        observability: another twin than the one trained on.

    Raises:
        CheckpointError: there is nothing to load, or it is damaged.
    """
    from arcade_torch.agents import load

    agent = load(path)
    config = agent.config
    name = config.memory if config.algorithm == "pqn" else f"{config.algorithm}-{config.memory}"
    return agent, Label(name, config.env, observability or config.observability, config.seed, agent.frames, path)


def check_distinct(labels: Sequence[Label]) -> None:
    """Refuse two checkpoints that would be pooled as if they were two seeds.

    Raises:
        ValueError: two checkpoints are of the same agent, twin, game and seed; names them.
    """
    seen: dict[tuple[str, str, str, int], Path] = {}
    for label in labels:
        cell = (*label.task, label.seed)
        if cell in seen:
            raise ValueError(
                f"{seen[cell]} and {label.path} are both {label.agent} on {label.game} ({label.observability}), "
                f"seed {label.seed}: give one of them"
            )
        seen[cell] = label.path


def density_of_run(
    path: Path, options: Mapping[str, Any], observability: Twin | None = None, progress: Progress | None = None
) -> tuple[Label, RecallDensity]:
    """Recall density of a checkpoint.

    Args:
        path: run folder or checkpoint.
        options: keyword arguments of `recall_density`.
        observability: another twin than the one trained on.
        progress: as for `recall_density`.
    """
    agent, label = load_labelled(path, observability)

    def compute() -> Arrays:
        found = recall_density(agent, observability=observability, progress=progress, **options)
        return {
            "shares": np.concatenate([*found.shares, np.zeros(0)]),
            "lengths": found.lengths,
            "ended": found.ended,
            "counts": np.array([found.dropped, found.silent]),
            "how": np.array([found.end, found.norm, found.reduce, found.target]),
        }

    arrays = kept(path, "recall_density", _identity(agent, label, recall_density, options), compute)
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
    """State contamination of a checkpoint.

    Args:
        path: run folder or checkpoint.
        options: keyword arguments of `contamination`, or of `shuffled_beginning`.
        shuffle: whether to permute early frames in place of adding noise.
        observability: another twin than the one trained on.
        progress: as for `contamination`.
    """
    agent, label = load_labelled(path, observability)
    measure = shuffled_beginning if shuffle else contamination

    def compute() -> Arrays:
        found = asdict(measure(agent, observability=observability, progress=progress, **options))
        return {name: np.asarray(value) for name, value in found.items()}

    name = "shuffle" if shuffle else "contamination"
    arrays = kept(path, name, _identity(agent, label, measure, options), compute)
    plain: dict[str, Any] = {name: value.item() if value.ndim == 0 else value for name, value in arrays.items()}
    return label, Contamination(**{field.name: plain[field.name] for field in fields(Contamination)})


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
