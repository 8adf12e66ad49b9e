"""What a study asks: a grid of runs, written in one TOML file."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any

from arcade_torch.tools.extensions import command_line

OBSERVABILITIES = ("full", "partial")
MOST_SEEDS = 10_000
"""``seeds = N`` beyond this is a slip."""
_NAME = re.compile(r"[\w.\-]{1,80}")
_AXES = ("games", "observability", "memories", "algorithms", "seeds")


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
        settings: further options of ``arcade-torch train``, for example ``{"pqn": {"gamma": 0.9}}``.
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
        for word in ("preset", "baseline", "question"):
            if not isinstance(getattr(self, word), str):
                raise TypeError(f"{word} must be text, got {getattr(self, word)!r}")
        _check_settings(self.settings)
        for size in self.sizes:
            if not isinstance(size, str) or not re.fullmatch(r"[1-9]\d*x[1-9]\d*", size):
                raise ValueError(f"sizes are layers x width, such as '2x512', got {size!r}")
        if len(set(self.sizes)) != len(self.sizes):
            raise ValueError(f"sizes names something twice: {', '.join(self.sizes)}")
        unknown = [value for value in self.observability if value not in OBSERVABILITIES]
        if unknown:
            raise ValueError(f"observability must be among {', '.join(OBSERVABILITIES)}, got {unknown[0]!r}")
        if self.total_frames is not None and not (type(self.total_frames) is int and 1 <= self.total_frames <= 10**15):
            raise ValueError(f"total_frames must be a whole number of at least 1, got {self.total_frames!r}")
        clash = sorted(set(flatten(self.settings)) & {"env", "observability", "memory", "algorithm", "seed", "out"})
        if clash:
            raise ValueError(f"settings may not hold {clash[0]!r}: the grid decides it")

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
        for key in values:
            if key not in known:
                raise ValueError(f"unknown key {key!r} in a study; known are {', '.join(known)}")
        missing = [key for key in ("name", "games", "memories", "seeds") if key not in values]
        if missing:
            raise ValueError(f"a study needs {', '.join(missing)}")
        ready = dict(values)
        for axis in (*_AXES, "sizes"):
            if axis in ready:
                ready[axis] = _as_tuple(axis, ready[axis])
        return cls(**ready)

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
        values.setdefault("name", name)
        return cls.from_dict(values)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a JSON file; `from_dict` reads them back."""
        values = asdict(self)
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    def fixed(self) -> dict[str, Any]:
        """What may not change between two invocations in one folder: everything that decides a run's result."""
        return {"preset": self.preset, "total_frames": self.total_frames, "settings": flatten(self.settings)}

    def runs(self) -> list[RunSpec]:
        """All cells; seeds vary slowest, so that an unfinished study holds every agent once before any twice."""
        agents = [(memory, size) for memory in self.memories for size in self._sizes_of(memory)]
        cells = product(self.seeds, self.games, self.algorithms, agents, self.observability)
        return [RunSpec(game, twin, agent[0], algo, seed, agent[1]) for seed, game, algo, agent, twin in cells]

    def _sizes_of(self, memory: str) -> tuple[str, ...]:
        return ("",) if memory == self.baseline or not self.sizes else self.sizes

    def arguments(self, run: RunSpec, out: Path) -> list[str]:
        """The words after ``arcade-torch`` that train one run of this study."""
        words = ["train", "--preset", self.preset, "--env", run.game, "--observability", run.observability]
        words += ["--memory", run.memory, "--algorithm", run.algorithm, "--seed", str(run.seed)]
        if self.total_frames is not None:
            words += ["--total-frames", str(self.total_frames)]
        settings = {"threads": 1} | flatten(self.settings)  # equal results whatever the engine gives a run
        if run.size:
            layers, width = run.size.split("x")
            settings |= {"network_options.layers": layers, "network_options.hidden_size": width}
        for key, value in settings.items():
            group = key.partition(".")[0]
            if group in self.algorithms and group != run.algorithm:
                continue  # numbers of another learner of the grid
            words += _flag(key, value)
        return [*words, "--out", str(out)]

    def command(self, run: RunSpec, out: Path) -> str:
        """The same as one line for a shell."""
        return command_line(self.arguments(run, out))


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys.

    Example:
        >>> flatten({"device": "cpu", "pqn": {"gamma": 0.9}})
        {'device': 'cpu', 'pqn.gamma': 0.9}
    """
    return dict(_flatten(values, prefix))


def _flatten(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _flag(key: str, value: Any) -> list[str]:
    head, dot, last = key.replace("_", "-").rpartition(".")
    for table in ("env_options", "network_options"):
        if key.startswith(f"{table}."):
            return [f"--{table[:-1].replace('_', '-')}", f"{key.removeprefix(f'{table}.')}={value}"]
    if isinstance(value, bool):
        return [f"--{head}{dot}{'' if value else 'no-'}{last}"]
    values = value if isinstance(value, list | tuple) else [value]
    return [f"--{head}{dot}{last}", *(str(item) for item in values)]


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
    """Refuse anything but options, and tables of options of one learner, game or network."""
    if not isinstance(settings, Mapping):
        raise TypeError(f"settings must be a table of options, got {settings!r}")
    for key, value in settings.items():
        for name, inner in value.items() if isinstance(value, Mapping) else [(key, value)]:
            items = inner if isinstance(inner, list | tuple) else [inner]
            if not all(isinstance(item, bool | int | float | str) for item in items):
                raise TypeError(
                    f"settings: {name!r} must be a number, text, true, false or a list of such, got {inner!r}"
                )
        names = [key, *value] if isinstance(value, Mapping) else [key]
        if odd := [name for name in names if not isinstance(name, str) or not _NAME.fullmatch(name)]:
            raise ValueError(f"settings: {odd[0]!r} is no name of an option")
