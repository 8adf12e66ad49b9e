"""What a study asks: a grid of runs, written in one TOML file."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from arcade_torch.agents.checked import Options, Range, coerce, require
from arcade_torch.agents.config import Seed, TrainConfig
from arcade_torch.agents.differences import flatten
from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.files import read_text
from arcade_torch.tools.names import AgentKey, agent_names, find_baselines
from arcade_torch.tools.runs import FREE

STUDY_PRESETS = ("demo", "paper-easy", "paper", "size-sweep")
MOST_SEEDS = 10_000
"""``seeds = N`` beyond this is a slip."""
MOST_BYTES = 1 << 17
"""Of a file with a study."""
MOST_DOTS = 1_000
"""In a line of it: a name of many parts takes tomllib minutes."""
_FOLDERS = "names of folders, of letters, digits, dots and dashes"
_GAMES = f"{_FOLDERS}, one game each (train --env A+B trains an agent of several)"
_FOLDER = r"(?!\.*$)[\w.\-]{1,80}"


def _text(allowed: str, form: str) -> Any:
    return Annotated[str, Range(allowed, lambda text: re.fullmatch(form, text) is not None)]


_AXES: dict[str, Any] = {
    "games": _text(_GAMES, _FOLDER),
    "memories": _text(_FOLDERS, _FOLDER),
    "algorithms": _text(_FOLDERS, _FOLDER),
    "observability": _text("full or partial, or a list of the two", "full|partial"),
    "seeds": Annotated[int, Range("0 or more and below 2**32", lambda seed: 0 <= seed < 2**32)],
    "sizes": _text("layers x width, such as '2x512'", r"[1-9]\d{0,8}x[1-9]\d{0,8}"),
}
"""Axis -> what its values may be."""
_OTHERS = {
    "name": _text("made of letters, digits, dots and dashes", _FOLDER),
    "settings": Options,
    "memory_options": Options,
    "preset": str,
    "baseline": str,
    "question": str,
    "subject": str,
}
"""The same of what is no axis."""
_FRAMES = Annotated[int, Range("from 1 to 10**15", lambda frames: 1 <= frames <= 10**15)]
_GRID = {
    "env": "games",
    "memory": "memories",
    "algorithm": "algorithms",
    "seed": "seeds",
    "observability": "observability",
    "total_frames": "total_frames",
    "name": "name",
    "out": "name",
}
"""Setting of one run -> what decides it in a study."""


@dataclass(frozen=True)
class RunSpec:
    """One cell of the grid; an empty ``size`` is that of the preset."""

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

    Raises:
        ValueError: an axis is empty or repeats itself, or a value is not allowed.
    """

    name: str  # letters, digits, dots, dashes
    games: tuple[str, ...]  # environment ids
    memories: tuple[str, ...]  # memory models; the memory-free control is one of them
    seeds: tuple[int, ...]  # one run a seed
    observability: tuple[str, ...] = ("full", "partial")  # the twins
    algorithms: tuple[str, ...] = ()  # learners; none given: that of the preset
    preset: str = "paper"  # settings that all runs start from
    total_frames: int | None = None  # environment steps of each run; None keeps the preset's
    # fields of ``TrainConfig``: ``{"pqn": {"gamma": 0.9}}``
    settings: Mapping[str, Any] = field(default_factory=dict)
    baseline: str = "mlp"  # the memory-free agent, against which Bias is measured
    # of the memory block, ``2x512``; the memory-free agent keeps the preset's
    sizes: tuple[str, ...] = ()
    question: str = ""  # what the study asks, a sentence for its report
    # the memory, or the agent, that the report is about: it is compared with every other
    subject: str = ""
    # options of one memory, by its name: ``{"frame_stack": {"frames": 7}}``
    memory_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, kind in _OTHERS.items():
            object.__setattr__(self, name, coerce(name, getattr(self, name), kind))
        if not self.algorithms:
            object.__setattr__(self, "algorithms", (preset(self.preset).algorithm,))
        for axis in _AXES:
            object.__setattr__(self, axis, _axis(axis, getattr(self, axis)))
        for name in self.settings:
            if name in _GRID:
                raise ValueError(
                    f"settings may not hold {name!r}: in a study the key {_GRID[name]} decides it, "
                    "which stands above the first [table] of its file"
                )
        for name in ("env_options", "network_options"):
            coerce(f"settings: {name}", self.settings.get(name, {}), Options)
        for memory, options in self.memory_options.items():
            coerce(f"memory_options.{memory}", options, Options)
            if memory not in self.memories:
                raise ValueError(
                    f"memory_options names {memory!r}, which is none of memories, "
                    f"{', '.join(self.memories)}"
                )
        for name in ("layers", "hidden_size"):
            if self.sizes and name in self.settings.get("network_options", {}):
                raise ValueError(
                    f"settings may not hold network_options.{name}: in this study the key sizes "
                    "decides it; leave out one of the two"
                )
        if self.total_frames is not None:
            object.__setattr__(
                self, "total_frames", coerce("total_frames", self.total_frames, _FRAMES)
            )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Study":
        """A study from plain values, as they stand in a TOML or JSON file; refuses unknown and
        missing keys.
        """
        require(isinstance(values, Mapping), "a study", values, "a table of names and values")
        names = [item.name for item in fields(cls)]
        for key in values:
            if key not in names:
                raise ValueError(f"unknown key {key!r} in a study; known are {', '.join(names)}")
        missing = [key for key in ("name", "games", "memories", "seeds") if key not in values]
        if missing:
            raise ValueError(f"a study needs {', '.join(missing)}")
        return cls(**values)

    @classmethod
    def load(cls, path: str | Path) -> "Study":
        """Read a study from a TOML file; a ``ValueError`` names the file if it is none."""
        path = Path(path)
        try:
            values = tomllib.loads(_text_of(path))
            study = cls.from_dict({"name": path.stem} | values)
            if "baseline" in values:
                study.require_baseline()
            study.require_subject()
        except FileNotFoundError:
            raise FileNotFoundError(
                f"no study at {path}: give a TOML file with games, memories and seeds"
            ) from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ValueError(f"{path} is not TOML in UTF-8: {error}") from error
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from error
        return study

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a JSON file; `from_dict` reads them back."""
        values = asdict(self)
        for name in _AXES:
            values[name] = list(values[name])
        return values

    def require_baseline(self) -> None:
        """Refuse a memory-free agent that the study does not train: there would be no Bias to
        report.
        """
        names = self._agent_names()
        if not find_baselines(names, self.baseline):
            raise ValueError(
                f"baseline = {self.baseline!r} is none of the agents that this study trains, "
                f"{', '.join(names)}: add it to memories, or name one of them"
            )

    def require_subject(self) -> None:
        """Refuse a subject that the study does not train; an empty one is none."""
        if not self.subject:
            return
        names = self._agent_names() + [run.agent for run in self.runs()]
        if self.subject not in (*self.memories, *names):
            raise ValueError(
                f"subject = {self.subject!r} is none of the agents that this study trains, "
                f"{', '.join(dict.fromkeys(names))}"
            )

    def _agent_names(self) -> list[str]:
        """What the agents that the study trains are called, whatever their size."""
        agents = product(self.algorithms, self.memories)
        return list(agent_names(AgentKey(*agent) for agent in agents).values())

    def overridden_preset(self) -> str:
        """Say in one line that the study trains another algorithm than its preset; empty where it
        does not.
        """
        algorithm = preset(self.preset).algorithm
        if algorithm in self.algorithms:
            return ""
        trained = " and ".join(self.algorithms)
        return (
            f"the preset {self.preset!r} trains {algorithm}, but this study {trained}, as its "
            "algorithms say: leave them out for the preset's"
        )

    def fixed(self) -> dict[str, Any]:
        """What may not change between two invocations in one folder: everything that decides a
        run's result.
        """
        settings = flatten(self.settings)
        return {
            "preset": self.preset,
            "total_frames": self.total_frames,
            "settings": {name: settings[name] for name in settings if name not in FREE},
            "memory_options": flatten(self.memory_options),
        }

    def runs(self) -> list[RunSpec]:
        """All cells; seeds vary slowest, so that an unfinished study holds every agent once before
        any twice.
        """
        agents = list[tuple[str, str]]()
        for memory in self.memories:
            sizes = self.sizes if memory != self.baseline else ()
            for size in sizes or ("",):
                agents.append((memory, size))
        cells = product(self.seeds, self.games, self.algorithms, agents, self.observability)
        runs = []
        for seed, game, algorithm, (memory, size), twin in cells:
            runs.append(RunSpec(game, twin, memory, algorithm, seed, size))
        return runs

    def configs(self, runs: Iterable[RunSpec]) -> dict[RunSpec, TrainConfig]:
        """The configs of some runs; seeds of one cell share all that was checked, but for the
        seed.
        """
        cells = dict[RunSpec, TrainConfig]()
        configs = dict[RunSpec, TrainConfig]()
        for run in runs:
            cell = replace(run, seed=0)
            if cell not in cells:
                cells[cell] = self.config(cell)
            configs[run] = copy(cells[cell])
            object.__setattr__(configs[run], "seed", coerce("seed", run.seed, Seed))
        return configs

    def config(self, run: RunSpec) -> TrainConfig:
        """The config of one run; with one torch thread unless told, so that results are equal
        everywhere.
        """
        base = preset(self.preset, env=run.game, algorithm=run.algorithm)
        changes: dict[str, Any] = {"threads": 1}
        other_algorithms = set(self.algorithms) - {run.algorithm}
        for name, value in self.settings.items():
            if name not in other_algorithms:
                changes[name] = value
        if self.total_frames is not None:
            changes["total_frames"] = self.total_frames
        for name in ("env_options", "network_options"):
            changes[name] = dict(getattr(base, name)) | dict(changes.get(name, {}))
        if of_memory := self.memory_options.get(run.memory):
            common = changes["network_options"].get("memory_options") or {}
            changes["network_options"]["memory_options"] = {**common, **of_memory}
        if run.size:
            layers, hidden_size = map(int, run.size.split("x"))
            changes["network_options"] |= {"layers": layers, "hidden_size": hidden_size}
        return preset(
            self.preset,
            algorithm=run.algorithm,
            env=run.game,
            observability=run.observability,
            memory=run.memory,
            seed=run.seed,
            **changes,
        )


def study_preset(name: str) -> Study:
    """A ready-made study, one of `STUDY_PRESETS`; its file in ``tools/data`` says what it asks.

    Example:
        >>> len(study_preset("paper").runs())
        2400
    """
    allowed = f"one of {', '.join(STUDY_PRESETS)}"
    require(name in STUDY_PRESETS, "the preset of a study", name, allowed)
    file = Path(__file__).resolve().parents[1] / "data" / f"study-{name}.toml"
    return replace(Study.load(file), name=name)


def demo_study(games: tuple[str, ...], frames: int, seeds: int) -> Study:
    """The study behind ``arcade-torch demo``: games, both twins, one memory model and the
    memory-free control.
    """
    demo = study_preset("demo")
    changes = {"games": games, "seeds": seeds, "total_frames": frames}
    study = Study.from_dict(demo.to_dict() | changes)
    if games == demo.games:
        return study
    question = (
        f"What does a memory do for agents that play {' and '.join(games)} as MDPs (full) and "
        "POMDPs (partial)?"
    )
    return replace(study, question=question)


def compare_study(
    memory: str, against: Sequence[str], games: tuple[str, ...], frames: int, seeds: int
) -> Study:
    """The study behind ``arcade-torch compare``: one memory model beside others, as `demo` trains
    them, and a report about the one.
    """
    others = [Study.baseline if name == "none" else name for name in against]
    changes = {
        "name": f"compare-{memory}",
        "games": games,
        "memories": (memory, *others),
        "seeds": seeds,
        "total_frames": frames,
        "subject": memory,
        "question": f"What does {memory} remember that {' and '.join(others)} do not, or the other "
        "way round, and what does it cost where nothing has to be remembered (MDP)?",
    }
    return Study.from_dict(study_preset("demo").to_dict() | changes)


def _text_of(path: Path) -> str:
    """The text of a file that is small and plain enough to be a study."""
    text = read_text(path, MOST_BYTES)
    if any(line.count(".") > MOST_DOTS for line in text.split("\n")):
        raise ValueError(
            f"it has a line with more than {MOST_DOTS:,} dots: give a TOML file with games and "
            "memories"
        )
    return text


def _axis(axis: str, value: Any) -> tuple[Any, ...]:
    """The values of an axis, checked."""
    if axis == "seeds" and type(value) is int:
        if not 1 <= value <= MOST_SEEDS:
            raise ValueError(
                f"seeds = {value}: give the number of seeds (1 to {MOST_SEEDS}) or a list"
            )
        value = range(value)
    if isinstance(value, str):
        value = (value,)
    allowed = "a list, or the number of them" if axis == "seeds" else "a list"
    require(isinstance(value, Sequence), axis, value, allowed)
    if not value and axis != "sizes":
        raise ValueError(f"{axis} is empty: a study needs at least one")
    values = tuple(coerce(axis, item, _AXES[axis]) for item in value)
    if len(set(values)) != len(values):
        raise ValueError(f"{axis} names something twice: {', '.join(map(str, values))}")
    return values
