"""What a study asks: a grid of runs, written in one TOML file."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arcade_torch.tools.extensions import command_line

if TYPE_CHECKING:
    from arcade_torch.agents.config import TrainConfig

OBSERVABILITIES = ("full", "partial")
STUDY_PRESETS = ("demo", "paper-easy", "paper", "size-sweep")
MOST_SEEDS = 10_000
"""``seeds = N`` beyond this is a slip."""
_NAME = re.compile(r"[\w.\-]{1,80}")
_AXES = ("games", "observability", "memories", "algorithms", "seeds")
_GRID = {"name", "env", "observability", "memory", "algorithm", "seed", "total_frames", "out"}


@dataclass(frozen=True)
class RunSpec:
    """One cell of the grid.

    Attributes:
        game: environment id.
        observability: ``full`` (MDP) or ``partial`` (POMDP).
        memory: name of the memory model.
        algorithm: name of the learner.
        seed: of everything random in the run.
        size: of the memory block, ``LAYERSxWIDTH``; empty for that of the preset.
    """

    game: str
    observability: str
    memory: str
    algorithm: str
    seed: int
    size: str = ""

    @property
    def agent(self) -> str:
        """The memory with its size, ``lru 2x512``."""
        return f"{self.memory} {self.size}".strip()

    @property
    def name(self) -> str:
        """Name of the run's folder: the same for the same cell, whatever else is in the grid."""
        memory = f"{self.memory}-{self.size}" if self.size else self.memory
        return f"{self.game}__{self.observability}__{memory}__{self.algorithm}__seed{self.seed}"


@dataclass(frozen=True)
class Study:
    """A grid of trainings: games x observability x memories x algorithms x seeds.

    Attributes:
        name: of the study; letters, digits, dots, dashes.
        games: environment ids.
        memories: memory models; the memory-free control is one of them.
        seeds: one run a seed.
        observability: the twins, ``full`` and/or ``partial``.
        algorithms: learners.
        preset: settings that all runs start from.
        total_frames: environment steps of each run; None keeps the preset's.
        settings: further fields of ``TrainConfig``, for example ``{"pqn": {"gamma": 0.9}}``.
        baseline: the memory-free agent, against which Bias is measured.
        sizes: of the memory block, ``LAYERSxWIDTH`` such as ``2x512``; the memory-free agent keeps the preset's.
        question: what the study asks, a sentence for its report.
    """

    name: str
    games: tuple[str, ...]
    memories: tuple[str, ...]
    seeds: tuple[int, ...]
    observability: tuple[str, ...] = OBSERVABILITIES
    algorithms: tuple[str, ...] = ("pqn",)
    preset: str = "paper"
    total_frames: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    baseline: str = "mlp"
    sizes: tuple[str, ...] = ()
    question: str = ""

    def __post_init__(self) -> None:
        """Check the shape of the grid.

        Raises:
            ValueError: an axis is empty or repeats itself, or a value is out of range.
            TypeError: an axis holds something of the wrong type.
        """
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name) or set(self.name) == {"."}:
            raise ValueError(f"a study's name is made of letters, digits, dots and dashes, got {self.name!r}")
        for axis in _AXES:
            _check_axis(axis, getattr(self, axis), int if axis == "seeds" else str)
        for name in ("preset", "baseline", "question"):
            if not isinstance(getattr(self, name), str):
                raise TypeError(f"{name} must be text, got {getattr(self, name)!r}")
        _check_settings(self.settings)
        for size in self.sizes:
            if not isinstance(size, str) or not re.fullmatch(r"[1-9]\d*x[1-9]\d*", size):
                raise ValueError(f"sizes are layers x width, such as '2x512', got {size!r}")
        if len(set(self.sizes)) != len(self.sizes):
            raise ValueError(f"sizes names something twice: {', '.join(self.sizes)}")
        if unknown := [value for value in self.observability if value not in OBSERVABILITIES]:
            raise ValueError(f"observability must be among {', '.join(OBSERVABILITIES)}, got {unknown[0]!r}")
        if self.total_frames is not None and not (type(self.total_frames) is int and 1 <= self.total_frames <= 10**15):
            raise ValueError(f"total_frames must be a whole number of at least 1, got {self.total_frames!r}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Study":
        """Build a study from plain values, as they stand in a TOML or JSON file.

        ``seeds = 3`` means ``[0, 1, 2]``; a single string stands for a list of one.

        Raises:
            ValueError: a key is unknown or missing, or a value is out of range.
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"a study is a table of names and values, got {values!r}")
        known = [item.name for item in fields(cls)]
        if unknown := [key for key in values if key not in known]:
            raise ValueError(f"unknown key {unknown[0]!r} in a study; known are {', '.join(known)}")
        if missing := [key for key in ("name", "games", "memories", "seeds") if key not in values]:
            raise ValueError(f"a study needs {', '.join(missing)}")
        lists = {axis: _as_tuple(axis, values[axis]) for axis in (*_AXES, "sizes") if axis in values}
        return cls(**{**values, **lists})

    @classmethod
    def load(cls, path: str | Path) -> "Study":
        """Read a study from a TOML file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is not TOML or not a study; names the file.
        """
        path = Path(path)
        try:
            return cls.parse(path.read_text(encoding="utf-8"), path.stem)
        except FileNotFoundError:
            raise FileNotFoundError(f"no study at {path}: give a TOML file with games, memories and seeds") from None
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def parse(cls, text: str, name: str) -> "Study":
        """Read a study from TOML text.

        Args:
            text: the TOML.
            name: of the study, where the text gives none.

        Raises:
            ValueError: it is not TOML or not a study.
        """
        try:
            values = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ValueError(f"it is not TOML: {error}") from error
        return cls.from_dict({"name": name} | values)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a JSON file; `from_dict` reads them back."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    def fixed(self) -> dict[str, Any]:
        """What may not change between two invocations in one folder: everything that decides a run's result."""
        return {"preset": self.preset, "total_frames": self.total_frames, "settings": flatten(self.settings)}

    def runs(self) -> list[RunSpec]:
        """All cells; seeds vary slowest, so that an unfinished study holds every agent once before any twice."""
        sizes = {memory: self.sizes if memory != self.baseline and self.sizes else ("",) for memory in self.memories}
        agents = [(memory, size) for memory in self.memories for size in sizes[memory]]
        cells = product(self.seeds, self.games, self.algorithms, agents, self.observability)
        return [RunSpec(game, twin, agent[0], algo, seed, agent[1]) for seed, game, algo, agent, twin in cells]

    def config(self, run: RunSpec) -> "TrainConfig":
        """The config of one run; with one torch thread unless told, so that results are equal everywhere.

        Raises:
            ValueError: the preset or a setting does not exist, or has a value that is not allowed.
        """
        from arcade_torch.agents.presets import preset

        changes: dict[str, Any] = {"threads": 1, **self.settings}
        for other in set(self.algorithms) - {run.algorithm}:
            changes.pop(other, None)
        if self.total_frames is not None:
            changes["total_frames"] = self.total_frames
        if run.size:
            layers, width = map(int, run.size.split("x"))
            changes["network_options"] = {**changes.get("network_options", {}), "layers": layers, "hidden_size": width}
        base = preset(self.preset, env=run.game, algorithm=run.algorithm)
        for name in {"env_options", "network_options"} & set(changes):
            changes[name] = {**getattr(base, name), **changes[name]}
        cell = {"env": run.game, "observability": run.observability, "memory": run.memory}
        return preset(self.preset, **cell, algorithm=run.algorithm, seed=run.seed, **changes)

    def command(self, run: RunSpec, out: Path) -> str:
        """The line for a shell that trains one run of this study in its folder ``out``."""
        config = out.parent.parent / "configs" / f"{run.name}.json"
        return command_line(["train", "--config", str(config), "--out", str(out), "--resume"])


def study_preset(name: str) -> Study:
    """A ready-made study.

    * ``demo``: what ``arcade-torch demo`` runs.
    * ``paper-easy``: the paper's agents on the easy game of each family, both twins, five seeds.
    * ``paper``: all of the paper's main experiment: 30 games, both twins, seven memories and none, five seeds.
    * ``size-sweep``: depth and width of the memory on two games, for the figure of that name.

    Raises:
        ValueError: there is no such preset.

    Example:
        >>> len(study_preset("paper").runs())
        2400
    """
    if name not in STUDY_PRESETS:
        raise ValueError(f"unknown study preset {name!r}; presets: {', '.join(STUDY_PRESETS)}")
    return Study.parse((files("arcade_torch.tools") / "data" / f"study-{name}.toml").read_text("utf-8"), name)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys.

    Example:
        >>> flatten({"device": "cpu", "pqn": {"gamma": 0.9}})
        {'device': 'cpu', 'pqn.gamma': 0.9}
    """
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _as_tuple(axis: str, value: Any) -> tuple[Any, ...]:
    if axis == "seeds" and type(value) is int:
        if not 1 <= value <= MOST_SEEDS:
            raise ValueError(f"seeds = {value}: give the number of seeds (1 to {MOST_SEEDS}) or a list")
        return tuple(range(value))
    if isinstance(value, str):
        return (value,)
    if isinstance(value, Sequence):
        return tuple(value)
    raise ValueError(f"{axis} must be a list, got {value!r}")


def _check_axis(axis: str, values: tuple[Any, ...], kind: type) -> None:
    if not values:
        raise ValueError(f"{axis} is empty: a study needs at least one")
    for value in values:
        if type(value) is not kind:
            raise TypeError(f"{axis} must hold {'whole numbers' if kind is int else 'names'}, got {value!r}")
    if len(set(values)) != len(values):
        raise ValueError(f"{axis} names something twice: {', '.join(map(str, values))}")
    if kind is int and not (min(values) >= 0 and max(values) < 2**32):
        raise ValueError(f"seeds must be 0 or more and below 2**32, got {min(values)} to {max(values)}")
    if kind is str and (odd := [value for value in values if not _NAME.fullmatch(value)]):
        raise ValueError(f"{axis} become names of folders: letters, digits, dots and dashes only, got {odd[0]!r}")


def _check_settings(settings: Any) -> None:
    """Refuse anything but a table of fields; what they are called and hold is checked by ``TrainConfig``."""
    if not isinstance(settings, Mapping):
        raise TypeError(f"settings must be a table of options, got {settings!r}")
    for name in ("env_options", "network_options"):
        if not isinstance(settings.get(name, {}), Mapping):
            raise TypeError(f"settings: {name} must be a table of options, got {settings[name]!r}")
    if odd := [name for name in settings if not isinstance(name, str) or not _NAME.fullmatch(name)]:
        raise ValueError(f"settings: {odd[0]!r} is no name of an option")
    if clash := sorted(set(settings) & _GRID):
        raise ValueError(f"settings may not hold {clash[0]!r}: the grid decides it")
