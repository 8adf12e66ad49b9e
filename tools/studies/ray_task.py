"""What a machine of a cluster does with one run of a study; imported there, so it knows nothing of the cluster."""

import contextlib
import getpass
import hashlib
import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from arcade_torch.agents.lease import LOCK, TIMEOUT_S, Lease
from arcade_torch.tools.studies.engines import Job, Processes

LOG_BYTES = 100_000
_LEFT_BEHIND = ("trainer.pt",)  # half of a checkpoint's bytes, needed only to go on training
_LEFT_BEHIND_FOLDERS = ("replay", "lock")


@dataclass(frozen=True)
class Order:
    """One run to carry out.

    Attributes:
        name: of the run.
        words: what follows ``arcade-torch``, with absolute paths.
        log: file that takes what the run prints.
        folder: of the run, as it stands among the words; None if nothing is to be fetched.
        probe: a file and its content; who can read it shares the disk.
        environment: variables for the run.
    """

    name: str
    words: tuple[str, ...]
    log: Path
    folder: Path | None
    probe: tuple[Path, str]
    environment: Mapping[str, str]


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        exit_code: 0 is success.
        error: one line otherwise.
        files: path in the run folder -> content, where the disk is not shared.
        log: what the run printed last, where the disk is not shared.
        lost: whether the process or machine was lost, so that another attempt makes sense.
    """

    exit_code: int
    error: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    log: bytes = b""
    lost: bool = False


def carry_out(order: Order) -> Outcome:
    """Start the run as a process of its own and wait for it; when cancelled, it gets time to save.

    Args:
        order: the run.
    """
    if order.folder is None:
        return _start(order)
    if shares_disk(order):
        _wait_for_predecessor(order.folder)
        return _start(order)
    here = local_folder(order)
    here.mkdir(parents=True, exist_ok=True)
    log = here.with_name(here.name + ".log")
    log.unlink(missing_ok=True)
    words = tuple(str(here) if word == str(order.folder) else word for word in order.words)
    outcome = _start(replace(order, words=words, log=log))
    printed = log.read_bytes()[-LOG_BYTES:] if log.exists() else b""
    outcome = replace(outcome, files=collect(here), log=printed)
    if outcome.exit_code == 0:
        shutil.rmtree(here, ignore_errors=True)
        log.unlink(missing_ok=True)
    return outcome


def shares_disk(order: Order) -> bool:
    """Whether this machine sees the study's folder."""
    file, content = order.probe
    try:
        return file.read_text() == content
    except OSError:
        return False


def local_folder(order: Order) -> Path:
    """Where a run is carried out on a machine that does not share the disk: another attempt finds it again."""
    key = hashlib.sha256(f"{order.probe[1]} {order.name}".encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"arcade-torch-{getpass.getuser()}" / f"{order.name}-{key}"


def collect(folder: Path) -> dict[str, bytes]:
    """The small files of a run: all but the replay and the state that only a resumed training needs.

    Args:
        folder: of the run.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        inner = path.relative_to(folder)
        if path.is_file() and path.name not in _LEFT_BEHIND and inner.parts[0] not in _LEFT_BEHIND_FOLDERS:
            found[inner.as_posix()] = path.read_bytes()
    return found


def _wait_for_predecessor(folder: Path, limit_s: float = TIMEOUT_S + 30.0) -> None:
    """Let the training of a lost attempt save and stop, or fall silent, before the next one begins."""
    lease, end = Lease(folder / LOCK), time.monotonic() + limit_s
    while lease.held() and time.monotonic() < end:
        time.sleep(0.5)


def _start(order: Order) -> Outcome:
    engine = Processes(1, environment=order.environment, pin=False)
    with contextlib.closing(engine.run([Job(order.name, order.words, order.log)])) as results:  # type: ignore[type-var]
        result = next(results)
    return Outcome(result.exit_code, result.error, lost=result.exit_code < 0)
