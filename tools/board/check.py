"""An entry evaluated again from its checkpoints, and refused where it does not agree."""

import datetime
import hashlib
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from arcade_torch.agents.checked import Checked, Options, Range
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.runs.files import read_bytes, read_json, write_json
from arcade_torch.tools.board.entry import (
    MOST_BYTES,
    BoardRun,
    Day,
    Entry,
    EntryRefusedError,
    Hash,
    check_observations,
    check_protocol,
    read_entry,
    read_table,
)
from arcade_torch.tools.board.evaluation import (
    WEIGHTS,
    Evaluator,
    Played,
    made_with,
    weights_hash,
)
from arcade_torch.tools.board.protocol import PROTOCOL, Protocol
from arcade_torch.tools.board.pull import folder_name, has_weights, pull
from arcade_torch.tools.board.submit import Progress, checkpoint_name
from arcade_torch.tools.run_folders import SETTINGS, RunFolders

MOST_FRAMES_AGAIN = 25_000_000
"""Frames of the longest run that `retrain` makes again."""
LEAST_TOLERANCE = 0.002
"""Of a score, where every episode has the same return."""
SIZES = ("parameters", "state_bytes")
"""What an entry says once for all of its runs: the largest of them."""
Origin = Literal["kept", "pulled", "retrained"]
"""Where checkpoints come from: a folder, the hub that the entry names, or its settings."""
Candidates = dict[tuple[Any, ...], list[tuple[Path, TrainConfig]]]
_Count = Annotated[int, Range("a whole number from 0", lambda x: 0 <= x <= 10**6)]


@dataclass(frozen=True)
class CheckRecord(Checked):
    """What a check found, for the page: a file of its own, beside the entry."""

    GROUP = "check."

    entry_sha256: Hash  # of the file that was checked: another file is unchecked
    date: Day
    runs: _Count  # that were evaluated again
    of: _Count  # runs of the entry
    equal: _Count  # of them to the bit
    largest_difference: float  # of a score
    weights: Origin  # where the checkpoints came from
    made_with: Options

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(self.runs <= self.of, "runs", f"at most the {self.of} of the entry")
        self._require(self.equal <= self.runs, "equal", f"at most the {self.runs} evaluated")


def check(
    file: Path,
    runs: Path,
    cells: int = 0,
    protocol: Protocol = PROTOCOL,
    progress: Progress | None = None,
    generator: random.Random | None = None,
    weights: Origin = "kept",
) -> CheckRecord:
    """Evaluate an entry again.

    Scores have to be equal to the bit where commit, versions and processor are those of the entry.
    Elsewhere a score may differ by half the 95 % interval of its mean as it is evaluated here, or
    by `LEAST_TOLERANCE`, whichever is more. Runs that were trained again elsewhere have other
    weights: their scores are compared, which decides nothing.

    Args:
        file: of the entry; read as a stranger's.
        runs: folder with its run folders somewhere below.
        cells: evaluate so many runs, drawn at random; 0 for all.
        protocol: what is played.
        progress: told after every run.
        generator: of the draw; by default one that nobody can foresee.
        weights: how to get runs that are not below ``runs``: not at all, from the hub that the
            entry names, or by training them from their settings.

    Returns:
        What to record.

    Raises:
        EntryRefusedError: what does not agree, and of which run, in one line.
    """
    sha256 = hashlib.sha256(read_bytes(file, MOST_BYTES)).hexdigest()
    entry = read_entry(file)
    check_protocol(entry, protocol)
    chosen = _drawn(entry.runs, cells, generator or random.SystemRandom())
    if weights != "kept":
        get_missing = {"pulled": pull, "retrained": retrain}[weights]
        missing = _missing(entry, chosen, runs, weights)
        get_missing(entry, missing, runs, progress)
    folders = find_folders(entry, chosen, runs)
    is_same = _is_same_machine(entry.made_with, made_with())
    if weights == "retrained" and not is_same:
        _compare_other_weights(entry, chosen, folders, protocol, progress)
    results, equal = _play_again(entry, chosen, folders, protocol, is_same, progress)
    if len(results) == len(entry.runs):
        _check_largest(entry, results)
    pairs = zip(results, chosen, strict=True)
    return CheckRecord(
        entry_sha256=sha256,
        date=datetime.date.today().isoformat(),
        runs=len(chosen),
        of=len(entry.runs),
        equal=equal,
        largest_difference=max(abs(played.score - run.score) for played, run in pairs),
        weights=weights,
        made_with=made_with(),
    )


def _drawn(runs: Sequence[BoardRun], count: int, generator: random.Random) -> list[BoardRun]:
    """Some runs drawn without repetition, or all; in the order of the entry."""
    if not count or count >= len(runs):
        return list(runs)
    places = sorted(generator.sample(range(len(runs)), count))
    return [runs[place] for place in places]


def find_folders(
    entry: Entry, runs: Sequence[BoardRun], below: Path
) -> dict[tuple[str, str, int], Path]:
    """The run folder of every run, by its settings, and of several the one with its weights; an
    `EntryRefusedError` names one that is not there.
    """
    if not below.is_dir():
        raise FileNotFoundError(f"{below} is no folder: give the one with the runs of the entry")
    candidates = _candidates(below)
    folders = {}
    for run in runs:
        same, reason = _of_same_settings(entry, run, candidates)
        if not same:
            raise EntryRefusedError(
                f"no run of {entry.memory} on {run.name} lies below {below}{reason}"
            )
        last = f"checkpoints/{checkpoint_name(entry.frames)}"
        trained = [folder for folder in same if (folder / last / WEIGHTS).is_file()]
        equal = [folder for folder in trained if has_weights(folder / last, run)]
        folders[run.cell] = [*equal, *trained, *same][0]
    return folders


def _missing(
    entry: Entry, runs: Sequence[BoardRun], below: Path, weights: Origin
) -> list[BoardRun]:
    """Runs that do not lie below a folder: with the weights of the entry, which are to be pulled,
    or trained to their end.
    """
    candidates = _candidates(below)
    missing = []
    for run in runs:
        same, _ = _of_same_settings(entry, run, candidates)
        ends = [folder / "checkpoints" / checkpoint_name(entry.frames) for folder in same]
        if weights == "pulled":
            is_there = any(has_weights(end, run) for end in ends)
        else:
            is_there = any((end / WEIGHTS).is_file() for end in ends)
        if not is_there:
            missing.append(run)
    return missing


def _candidates(below: Path) -> Candidates:
    """Run folders and their settings, by what an entry says of a run."""
    candidates: Candidates = {}
    for folder in sorted(RunFolders().below(below)):
        config = _config_of(folder)
        if config is not None:
            key = (config.env, config.observability, config.seed, config.memory, config.algorithm)
            candidates.setdefault(key, []).append((folder, config))
    return candidates


def _of_same_settings(
    entry: Entry, run: BoardRun, candidates: Candidates
) -> tuple[list[Path], str]:
    """The folders with the settings of a run, and in what the last of the others differs."""
    wanted = entry.config(run)
    same = list[Path]()
    reason = ""
    for folder, config in candidates.get((*run.cell, entry.memory, entry.algorithm), []):
        differences = differing_fields(config, wanted)
        if differences:
            reason = f"; {folder} differs in {', '.join(differences)}"
        else:
            same.append(folder)
    return same, reason


def _play_again(
    entry: Entry,
    chosen: Sequence[BoardRun],
    folders: dict[tuple[str, str, int], Path],
    protocol: Protocol,
    is_same: bool,
    progress: Progress | None,
) -> tuple[list[Played], int]:
    """What the runs play now, and how many scores are equal to the bit; refuses what does not
    agree.
    """
    evaluator = Evaluator(protocol)
    results = list[Played]()
    equal = 0
    for done, run in enumerate(chosen, 1):
        checkpoint = folders[run.cell] / "checkpoints" / checkpoint_name(entry.frames)
        _check_weights(run, checkpoint)
        played = evaluator.play(checkpoint, run.twin)
        equal += _check_played(entry, run, played, is_same)
        results.append(played)
        if progress is not None:
            progress(run.name, done, len(chosen))
    return results, equal


def _compare_other_weights(
    entry: Entry,
    chosen: Sequence[BoardRun],
    folders: dict[tuple[str, str, int], Path],
    protocol: Protocol,
    progress: Progress | None,
) -> None:
    """Play runs that were trained at another commit or on another processor than the entry's and
    have other weights than its; if there are any, refuse the check and say how far the scores are
    apart.
    """
    evaluator = Evaluator(protocol)
    differences = list[float]()
    for done, run in enumerate(chosen, 1):
        checkpoint = folders[run.cell] / "checkpoints" / checkpoint_name(entry.frames)
        if _hash_of(run, checkpoint) == run.weights_sha256:
            continue
        differences.append(abs(evaluator.play(checkpoint, run.twin).score - run.score))
        if progress is not None:
            progress(f"compared {run.name}", done, len(chosen))
    if not differences:
        return
    raise EntryRefusedError(
        f"trained again here, {len(differences)} of {len(chosen)} runs have other weights than "
        f"the entry's: it was made by {_made_by(entry.made_with)}, this is "
        f"{_made_by(made_with())}, and a training is the same to the bit only where all of that "
        f"is. Their scores differ by {sum(differences) / len(differences):.4f} on average, at most "
        f"by {max(differences):.4f}. That neither confirms nor refutes the entry: ask for its "
        "checkpoints, or train it where it was trained"
    )


def _made_by(about: Mapping[str, Any]) -> str:
    """Commit, processor and version of torch of something, in words."""
    commit = about.get("commit") or "unknown"
    processor = about.get("processor") or "an unknown processor"
    return f"commit {commit} on {processor} with torch {about.get('torch', 'unknown')}"


def _config_of(folder: Path) -> TrainConfig | None:
    """The settings of a run folder; None of one that is damaged."""
    try:
        return TrainConfig.from_dict(read_json(folder / SETTINGS)["config"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _hash_of(run: BoardRun, checkpoint: Path) -> str:
    """SHA-256 of the weights of a run; refuses a checkpoint without weights."""
    try:
        return weights_hash(checkpoint)
    except FileNotFoundError:
        raise EntryRefusedError(f"checkpoint of {run.name}: {checkpoint} has no weights") from None


def _check_weights(run: BoardRun, checkpoint: Path) -> None:
    """Refuse weights that are not those of the entry, before anything is loaded."""
    sha256 = _hash_of(run, checkpoint)
    if sha256 != run.weights_sha256:
        raise EntryRefusedError(
            f"checkpoint of {run.name}: the weights below {checkpoint} have SHA-256 "
            f"{sha256[:16]}..., the entry says {run.weights_sha256[:16]}..."
        )


def _check_played(entry: Entry, run: BoardRun, played: Played, is_same: bool) -> bool:
    """Refuse a score, a size or an observation that is not what was played; returns whether the
    score is equal to the bit.
    """
    check_observations(f"{run.name}, acting", played.observations)
    for name in SIZES:
        actual = getattr(played, name)
        if actual > getattr(entry, name):
            raise EntryRefusedError(
                f"{name} of {run.name}: {actual:,}, the entry says {getattr(entry, name):,}"
            )
    if (played.score, played.returns_sha256) == (run.score, run.returns_sha256):
        if not math.isclose(played.std, run.std, rel_tol=1e-6, abs_tol=1e-9):
            raise EntryRefusedError(
                f"std of {run.name}: evaluated again it is {played.std!r}, the entry says "
                f"{run.std!r}"
            )
        return True
    difference = abs(played.score - run.score)
    tolerance = max(played.half_width, LEAST_TOLERANCE)
    if is_same or difference > tolerance:
        allowed = "equal to the bit: same commit, versions and processor"
        if not is_same:
            allowed = f"within {tolerance:.4f}"
        raise EntryRefusedError(
            f"score of {run.name}: evaluated again it is {played.score!r}, the entry says "
            f"{run.score!r}; it has to be {allowed}"
        )
    return False


def _check_largest(entry: Entry, results: Sequence[Played]) -> None:
    """Refuse sizes that no run has: an entry says the largest over its games, which may differ."""
    for name in SIZES:
        largest = max(getattr(played, name) for played in results)
        if largest != getattr(entry, name):
            raise EntryRefusedError(
                f"{name}: {largest:,} is the largest of the runs, the entry says "
                f"{getattr(entry, name):,}"
            )


def _is_same_machine(entry: Any, now: Any) -> bool:
    """Whether scores have to be equal to the bit: same versions, commit and processor, all of them
    known.
    """
    is_known = bool(now.get("processor")) and bool(now.get("commit"))
    is_clean = not str(now.get("commit")).endswith("+changes")
    return is_known and is_clean and dict(entry) == dict(now)


def retrain(
    entry: Entry,
    runs: Sequence[BoardRun],
    out: Path,
    progress: Callable[[str, int, int], None] | None = None,
) -> None:
    """Train runs of an entry from their settings, or go on with them.

    Games and memories have to be known to this process; nothing is imported for it.

    Raises:
        EntryRefusedError: a run is too long.
        ValueError: a game, a memory or one of their options does not exist here.
    """
    from arcade_torch.agents.training import train

    if entry.frames > MOST_FRAMES_AGAIN:
        raise EntryRefusedError(
            f"runs of {entry.frames:,} frames are not trained again, at most "
            f"{MOST_FRAMES_AGAIN:,}: ask for the checkpoints"
        )
    for done, run in enumerate(runs, 1):
        train(entry.config(run), out / folder_name(entry, run), resume=True)
        if progress is not None:
            progress(f"trained {run.name}", done, len(runs))


def record_file(entry: Path) -> Path:
    """Where the record of a check of an entry lies."""
    return entry.parent / "checks" / entry.name


def write_record(entry: Path, record: CheckRecord) -> Path:
    """Keep what a check found beside the entry."""
    return write_json(record_file(entry), asdict(record))


def read_record(entry: Path) -> CheckRecord | None:
    """The record of the last check of the very file of an entry; None if there is none."""
    file = record_file(entry)
    if not file.exists():
        return None
    values = read_table(file)
    try:
        record = CheckRecord(**values)
    except (TypeError, ValueError) as error:
        raise EntryRefusedError(f"{file} is no record of a check: {error}") from error
    sha256 = hashlib.sha256(read_bytes(entry, MOST_BYTES)).hexdigest()
    return record if record.entry_sha256 == sha256 else None
