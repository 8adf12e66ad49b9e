"""An entry of the leaderboard: one JSON file, read as what a stranger wrote.

The file is bounded in size, every value is checked by its type and range, names are of a small
alphabet, and nothing in it is imported, followed or run.
"""

import dataclasses
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from arcade_torch.agents.checked import Checked, Options, PositiveOrZero, Range, coerce, require
from arcade_torch.agents.config import GROUPS, Seed, TrainConfig
from arcade_torch.agents.differences import flatten
from arcade_torch.agents.runs.files import read_bytes, write_json
from arcade_torch.envs_jax.registry import is_built_in, probe_ids, registered_ids
from arcade_torch.tools.board.protocol import OBSERVATIONS, TWINS, Protocol

MOST_BYTES = 4 * 2**20
"""Of the file of an entry, and of the record of a check."""
MOST_RUNS = 3_000
MOST_SETTINGS = 300
MOST_FRAMES = 10**10
_GAME = re.compile(r"[A-Za-z][A-Za-z0-9]{0,60}-v\d{1,4}")
_HASH = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 .,()+=/-]{0,59}")
_WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9 .,:+=/_()-]{0,119}")
_NOTE = re.compile(r"[A-Za-z0-9 .,:;()+=/'%-]{0,300}")
_URL = re.compile(r"https://[A-Za-z0-9.-]{1,100}(/[A-Za-z0-9._/~%-]{0,200})?")
_COMMIT = re.compile(r"[0-9a-f]{7,40}")
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}")


class EntryRefusedError(ValueError):
    """An entry does not keep the protocol, or is not what its checkpoints give; one line."""


def _range(pattern: re.Pattern[str], allowed: str, optional: bool = False) -> Range:
    """Words of a form; if optional, empty ones too."""

    def holds(text: str) -> bool:
        return pattern.fullmatch(text) is not None or (optional and not text)

    return Range(f"{allowed}, or empty" if optional else allowed, holds)


Hash = Annotated[str, _range(_HASH, "a SHA-256, 64 hexadecimal digits")]
GameId = Annotated[str, _range(_GAME, "a versioned game, such as 'MineSweeperEasy-v0'")]
Name = Annotated[str, _range(_NAME, "1 to 60 letters, digits, spaces or .,()+=/-")]
Word = Annotated[str, _range(_WORD, "a name of letters, digits, spaces or .,:+=/_()-")]
Address = Annotated[str, _range(_URL, "an https address of letters, digits, ./_-~%", True)]
Commit = Annotated[str, _range(_COMMIT, "7 to 40 hexadecimal digits", True)]
Note = Annotated[str, _range(_NOTE, "at most 300 letters, digits, spaces or .,:;()+=/'%-")]
Day = Annotated[str, _range(_DATE, "a day such as 2026-11-27")]
Finite = Annotated[float, Range("a finite number below a million", lambda x: abs(x) < 1e6)]
Frames = Annotated[int, Range("from 1 to 10**10", lambda x: 1 <= x <= MOST_FRAMES)]
Size = Annotated[int, Range("a whole number from 0 to 10**12", lambda x: 0 <= x <= 10**12)]


@dataclass(frozen=True)
class BoardRun(Checked):
    """One trained agent and what it scored: a seed of a cell."""

    game: GameId
    twin: Literal["full", "partial"]
    seed: Seed  # of the training
    score: Finite  # mean return of the episodes
    std: PositiveOrZero  # sample standard deviation of the returns
    returns_sha256: Hash  # of returns and lengths
    weights_sha256: Hash  # of ``weights.safetensors``
    seconds: PositiveOrZero  # of training
    # settings of the training that are not those of all runs, dotted names
    settings: Options = field(default_factory=dict)

    @property
    def cell(self) -> tuple[str, str, int]:
        """Game, twin and seed."""
        return self.game, self.twin, self.seed

    @property
    def name(self) -> str:
        """The cell for a message or a folder."""
        return f"{self.game} {self.twin}, seed {self.seed}"


@dataclass(frozen=True)
class Entry:
    """What a file in ``results/leaderboard`` holds."""

    protocol: int
    name: Name
    memory: Word
    algorithm: Word
    url: Address  # of the code that trained it
    commit: Commit
    note: Note
    date: Day
    frames: Frames  # of training, of each run
    parameters: Size
    state_bytes: Size  # of the recurrent state of one environment
    checkpoints: Options  # how to get them: see `check_checkpoints`
    observations: Options  # "training" and "acting": names of what the agent reads
    evaluation: Options  # episodes and seed
    environments: Options  # rules and obs_size
    made_with: Options  # versions, commit, platform and processor of the evaluation
    settings: Options  # of the training, dotted names, those that all runs share
    runs: tuple[BoardRun, ...]

    def __post_init__(self) -> None:
        kinds = get_type_hints(type(self), include_extras=True)
        for name in set(kinds) - {"runs"}:  # each of which has checked itself
            object.__setattr__(self, name, coerce(name, getattr(self, name), kinds[name]))

    def config(self, run: BoardRun) -> TrainConfig:
        """The settings that trained a run; an `EntryRefusedError` if they are none, or another
        run's.
        """
        try:
            config = TrainConfig.from_dict(nested({**self.settings, **run.settings}))
        except (ValueError, TypeError) as error:
            raise EntryRefusedError(f"settings of {run.name}: {error}") from error
        stated = {
            "env": run.game,
            "observability": run.twin,
            "seed": run.seed,
            "memory": self.memory,
            "algorithm": self.algorithm,
            "rules": self.environments.get("rules"),
            "obs_size": self.environments.get("obs_size"),
        }
        for name, value in stated.items():
            if getattr(config, name) != value:
                raise EntryRefusedError(
                    f"settings of {run.name}: {name} is {getattr(config, name)!r}, the entry says "
                    f"{value!r}"
                )
        if config.env_options:
            raise EntryRefusedError(
                f"settings of {run.name}: env_options make another task; leave them out"
            )
        return config

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return dataclasses.asdict(self)


def file_word(name: str) -> str:
    """A name that a folder can have."""
    return "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name)


def read_entry(path: Path) -> Entry:
    """An entry from its file.

    Raises:
        FileNotFoundError: there is none.
        EntryRefusedError: it is no JSON, too large, lacks a field, or holds a value that is not
            allowed; names the file and the field.
    """
    values = read_table(path)
    try:
        return entry_of(values)
    except (ValueError, TypeError) as error:
        raise EntryRefusedError(f"{path}: {error}") from error


def read_table(path: Path) -> dict[str, Any]:
    """The table of names and values in a small JSON file."""
    try:
        values = json.loads(read_bytes(path, MOST_BYTES).decode())
    except FileNotFoundError:
        raise
    except (ValueError, RecursionError) as error:
        raise EntryRefusedError(f"{path} does not hold the JSON of an entry: {error}") from error
    if not isinstance(values, dict):
        raise EntryRefusedError(f"{path} does not hold the JSON of an entry: no table of names")
    return values


def entry_of(values: Mapping[str, Any]) -> Entry:
    """An entry from plain values; a ``ValueError`` names what does not fit."""
    fields = dict(_complete_fields(values, Entry, "an entry"))
    runs = fields["runs"]
    allowed = f"a list of 1 to {MOST_RUNS} runs"
    require(isinstance(runs, list), "runs", type(runs).__name__, allowed)
    require(1 <= len(runs) <= MOST_RUNS, "the number of runs", len(runs), f"1 to {MOST_RUNS}")
    rows = []
    for place, row in enumerate(runs):
        try:
            run = BoardRun(**_complete_fields(row, BoardRun, "a run"))
            _check_settings(run.settings)
        except (ValueError, TypeError) as error:
            raise ValueError(f"runs[{place}]: {error}") from error
        rows.append(run)
    fields["runs"] = ()
    entry = Entry(**fields)
    _check_settings(entry.settings)
    _check_settings(entry.made_with)
    check_checkpoints(entry.checkpoints)
    return dataclasses.replace(entry, runs=tuple(rows))


def _complete_fields(values: Any, kind: Any, subject: str) -> Mapping[str, Any]:
    """The values of a dataclass, none missing and none that it does not know."""
    require(isinstance(values, Mapping), subject, type(values).__name__, "a table of names")
    names = [item.name for item in dataclasses.fields(kind)]
    for name in values:
        require(name in names, f"a field of {subject}", name[:80], f"one of {', '.join(names)}")
    for name in names:
        require(name in values, subject, f"none with {name!r}", "complete")
    return values  # type: ignore[no-any-return]


def _check_settings(settings: Mapping[str, Any]) -> None:
    """Refuse settings that are no flat table of short values."""
    require(
        len(settings) <= MOST_SETTINGS, "settings", len(settings), f"at most {MOST_SETTINGS} names"
    )
    for name, value in settings.items():
        plain = value is None or isinstance(value, str | int | float | bool | list)
        short = len(name) <= 100 and len(repr(value)) <= 300
        finite = not isinstance(value, float) or math.isfinite(value)
        require(plain and short and finite, f"the setting {name[:60]!r}", repr(value)[:80], "short")


def check_checkpoints(place: Mapping[str, Any]) -> None:
    """Refuse what does not say where the checkpoints are.

    Allowed are ``{"kind": "hub", "repo": "OWNER/NAME", "revision": COMMIT}``, ``{"kind": "url",
    "url": ADDRESS}``, and ``{"kind": "retrain"}``: they are not kept, and the settings of the entry
    make them again to the bit on the same processor and versions.
    """
    patterns = {
        "hub": {"repo": _REPOSITORY, "revision": re.compile(r"[0-9a-f]{40}")},
        "url": {"url": _URL},
        "retrain": dict[str, re.Pattern[str]](),
    }
    kind = place.get("kind")
    require(kind in list(patterns), "checkpoints.kind", kind, f"one of {', '.join(patterns)}")
    wanted = patterns[str(kind)]
    names = ", ".join(["kind", *wanted])
    require(set(place) == {"kind", *wanted}, f"checkpoints of kind {kind}", sorted(place), names)
    for name, pattern in wanted.items():
        value = place[name]
        fits = isinstance(value, str) and pattern.fullmatch(value) is not None
        require(fits, f"checkpoints.{name}", repr(value)[:100], f"of the form {pattern.pattern}")


def check_protocol(entry: Entry, protocol: Protocol) -> None:
    """Refuse an entry that does not keep the protocol by what it says of itself.

    Raises:
        EntryRefusedError: another protocol, other evaluation seeds or episodes, other rules or
            sizes of the picture, a privileged observation, a run twice, a missing cell, a game that
            is none of this package; in one line that names it.
    """
    _check_equal("protocol", entry.protocol, protocol.version)
    _check_equal("evaluation.episodes", entry.evaluation.get("episodes"), protocol.episodes)
    _check_equal("evaluation.seed", entry.evaluation.get("seed"), protocol.seed)
    _check_equal("environments.rules", entry.environments.get("rules"), protocol.rules)
    _check_equal("environments.obs_size", entry.environments.get("obs_size"), protocol.obs_size)
    for phase in ("training", "acting"):
        check_observations(phase, entry.observations.get(phase))
    _check_grid(entry.runs)
    _check_games(entry.runs)
    for run in entry.runs:
        entry.config(run)


def _check_equal(name: str, value: Any, wanted: Any) -> None:
    if type(value) is not type(wanted) or value != wanted:
        raise EntryRefusedError(
            f"{name} is {str(value)[:80]}; the protocol of this version demands {wanted}"
        )


def check_observations(phase: str, names: Any) -> None:
    """Refuse observations that are privileged: the state of a game, or frames of the other twin."""
    if not isinstance(names, list | tuple) or not names:
        raise EntryRefusedError(
            f"observations.{phase} does not say what the agent reads; allowed are "
            f"{', '.join(OBSERVATIONS)}"
        )
    for name in names:
        if name not in OBSERVATIONS:
            raise EntryRefusedError(
                f"privileged observation in {phase}: {str(name)[:80]!r}; an agent may read "
                f"{', '.join(OBSERVATIONS)} of the twin that it is evaluated on, and nothing else"
            )


def _check_grid(runs: Iterable[BoardRun]) -> None:
    """Refuse runs that are not all seeds of all games on both twins, once."""
    cells = set[tuple[str, str, int]]()
    for run in runs:
        if run.cell in cells:
            raise EntryRefusedError(f"two runs of one cell: {run.name}")
        cells.add(run.cell)
    games = sorted({game for game, _, _ in cells})
    seeds = sorted({seed for _, _, seed in cells})
    for game in games:
        for seed in seeds:
            for twin in TWINS:
                if (game, twin, seed) not in cells:
                    raise EntryRefusedError(
                        f"missing cell: {game} {twin}, seed {seed}; an entry has every seed of "
                        "every game on both twins"
                    )


def _check_games(runs: Iterable[BoardRun]) -> None:
    """Refuse games that are none of this package: nobody else could check their scores."""
    games = {id for id in registered_ids() + probe_ids() if is_built_in(id)}
    for run in runs:
        if run.game not in games:
            raise EntryRefusedError(
                f"the game {run.game} is none of this package, and the board compares agents on "
                "its games alone: arcade-torch report or figure gap-bias show games of yours"
            )


def write_entry(path: Path, entry: Entry) -> Path:
    """Write an entry in one step, after it was read as a stranger's."""
    plain = entry.to_dict()
    entry_of(json.loads(json.dumps(plain)))
    return write_json(path, plain)


def settings_of(configs: Iterable[TrainConfig]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The settings of runs, dotted names, without those of learners that are not used: those that
    all share, and of each run the others.
    """
    flat = list[dict[str, Any]]()
    for config in configs:
        plain = config.to_dict()
        for group in set(GROUPS) - {config.algorithm}:
            del plain[group]
        flat.append(flatten(plain))
    shared = {}
    for name, value in flat[0].items():
        if all(name in other and other[name] == value for other in flat):
            shared[name] = value
    rest = []
    for settings in flat:
        rest.append({name: value for name, value in settings.items() if name not in shared})
    return shared, rest


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of `agents.differences.flatten`; a ``ValueError`` where a name is both a value
    and a table.

    Example:
        >>> nested({"device": "cpu", "ppo.gamma": 0.9})
        {'device': 'cpu', 'ppo': {'gamma': 0.9}}
    """
    plain = dict[str, Any]()
    for name, value in flat.items():
        *groups, last = name.split(".")
        require(len(groups) <= 8, "a setting", name[:80], "nested at most 8 deep")
        table = plain
        for group in groups:
            table = table.setdefault(group, {})
            require(isinstance(table, dict), "a setting", name[:80], "a value or a table")
        require(last not in table, "a setting", name[:80], "a value or a table")
        table[last] = value
    return plain
