"""Who works on something: a lock in a folder, taken over when its owner is gone, on this machine or on another.

The folder holds one small file an owner, ``owner-000001.json``: host, process, token. Taking it means creating the next
number, which the file system lets one process do, and then finding nobody else at work; the dead are swept away after.
An owner is gone

* on the same host: when its process is, at once (process numbers that were given out again do not fool it);
* on another host: when its heartbeat, the modification time of its file, has stood still for `TIMEOUT_S` of the
  observer's own monotonic clock while it kept looking. No two clocks are compared, so none can be wrong, and time in
  which the observer could not look (suspended, file server away) counts as a single look.

An owner that slept through its own end finds out by `Lease.confirm` before it writes again.
"""

import contextlib
import errno
import functools
import json
import os
import re
import socket
import threading
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Any

LOCK = "lock"
"""Name of the folder in a run folder that says who trains there."""
HEARTBEAT_S = 10.0
"""Seconds between two heartbeats of an owner."""
TIMEOUT_S = 120.0
"""Seconds without a heartbeat after which an owner on another host is taken to be gone. File servers may show the
times of files a minute late."""
_NAME = re.compile(r"owner-(\d{6})\.json")
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
_tokens: set[str] = set()  # of the leases that this process holds


class LeaseLostError(RuntimeError):
    """Somebody else took over while this process was suspended; what it would write now is no longer wanted."""


class Lease:
    """The right to work on something; only one process at a time has it.

    Keep the object between two attempts: it remembers since when an owner on another host has been silent.

    Args:
        folder: of the lock; made when it is taken, removed when it is released.
        timeout_s: see `TIMEOUT_S`.
    """

    def __init__(self, folder: Path, timeout_s: float = TIMEOUT_S) -> None:
        self.folder, self.timeout_s = folder, timeout_s
        self._file: Path | None = None
        self._token = ""
        self._lost = False
        self._beat_s = 0.0
        self._silent: dict[str, tuple[tuple[str, int], float, float]] = {}

    @property
    def mine(self) -> bool:
        """Whether this object holds the lease, as far as it knows."""
        return self._file is not None and not self._lost

    def held(self) -> bool:
        """Whether somebody works on it, this process included; for owners on other hosts, ask again and again."""
        return any(self._alive(file) for file in self._files())

    def owner(self) -> str:
        """The owner in words, for messages; empty if there is none."""
        for file in reversed(self._files()):
            record = _read(file)
            if record is not None:
                return f"process {record.get('pid')} on {record.get('name')}"
        return ""

    def try_take(self) -> bool:
        """Take the lease if nobody has it.

        Returns:
            Whether this object has it now. False also where two asked at the same moment: ask again.

        Raises:
            OSError: the folder cannot be written.
        """
        files = self._files()
        if any(self._alive(file) for file in files):
            return False
        number = int(_NAME.fullmatch(files[-1].name)[1]) if files else 0  # type: ignore[index]
        token = uuid.uuid4().hex
        mine = self.folder / f"owner-{number + 1:06d}.json"
        taken = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _tokens.add(token)
            _create(mine, token)
            others = [file for file in self._files() if file != mine]
            taken = not any(self._alive(file) for file in others)
            if not taken:  # somebody asked at the same moment
                mine.unlink(missing_ok=True)
                return False
        except (FileExistsError, FileNotFoundError):  # another was faster, or has just released and swept
            return False
        finally:
            if not taken:  # whatever happened, nobody may see a living owner in what is left
                _tokens.discard(token)
        for file in others:
            with contextlib.suppress(OSError):  # the dead stay dead
                file.unlink()
        self._file, self._token, self._lost, self._beat_s = mine, token, False, _awake_s()
        _heart.add(self)
        return True

    def take(self, poll_s: float = 1.0) -> bool:
        """Take the lease, waiting for an owner on another host only until it shows that it lives or is silent for long.

        Returns:
            Whether this object has it now; False: its owner is at work.
        """
        first = self._times()
        while not self.try_take():
            if any(self._here(file) and self._alive(file) for file in self._files()) or _moved(first, self._times()):
                return False
            time.sleep(poll_s)
        return True

    def confirm(self) -> None:
        """Make sure, before writing, that nobody took over; looks at the disk only after a missed heartbeat.

        Raises:
            LeaseLostError: somebody did.
        """
        if self._file is not None and not self._lost and _awake_s() - self._beat_s > self.timeout_s / 2:
            self.beat()
        if self._lost:
            raise LeaseLostError(f"{self.folder.parent} was taken over by {self.owner() or 'another process'}")

    def beat(self) -> None:
        """Show that this process lives: moves the file's modification time on, which a full disk allows."""
        file = self._file
        if file is None:
            return
        try:
            record = _read(file)
            if record is None or record.get("token") != self._token:
                self._lost = True
                return
            moved = file.stat().st_mtime_ns + int(HEARTBEAT_S * 1e9)
            os.utime(file, ns=(moved, moved))
            self._beat_s = _awake_s()
        except FileNotFoundError:
            self._lost = True
        except OSError:
            return  # the file server is away: nobody else gets at it either

    def release(self) -> None:
        """Let go; nothing happens where the lease is not held."""
        file, self._file = self._file, None
        if file is None:
            return
        _heart.remove(self)
        try:
            record = _read(file)
            if record is not None and record.get("token") == self._token:
                file.unlink(missing_ok=True)
            self.folder.rmdir()
        except OSError:  # others' files are in it, or it is gone
            return
        finally:  # not before: who looks dead is swept, and its number, given out again, would be unlinked here
            _tokens.discard(self._token)

    def __enter__(self) -> "Lease":
        """The lease, taken before."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Release it."""
        self.release()

    def _files(self) -> list[Path]:
        try:
            return sorted(file for file in self.folder.iterdir() if _NAME.fullmatch(file.name))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def _times(self) -> dict[str, tuple[str, int]]:
        found = {}
        for file in self._files():
            try:
                found[file.name] = (file.read_text(errors="replace"), file.stat().st_mtime_ns)
            except OSError:
                continue
        return found

    def _here(self, file: Path) -> bool:
        record = _read(file)
        return record is not None and record.get("host") == host()

    def _alive(self, file: Path) -> bool:
        record = _read(file)
        if record is not None and record.get("host") == host():
            if record.get("pid") == os.getpid():
                return record.get("token") in _tokens
            return _runs(int(record["pid"]), record.get("started"))
        return self._watched(file)

    def _watched(self, file: Path) -> bool:
        """Of an owner elsewhere, or one that cannot be read: whether it may still be alive."""
        try:
            shown = (file.read_text(errors="replace"), file.stat().st_mtime_ns)
        except FileNotFoundError:
            return False
        now = time.monotonic()
        before, last_s, silent_s = self._silent.get(file.name, (None, now, 0.0))
        silent_s = silent_s + min(now - last_s, HEARTBEAT_S) if before == shown else 0.0
        self._silent[file.name] = (shown, now, silent_s)
        return silent_s < self.timeout_s


class _Heart:
    """One thread that beats for all leases of this process."""

    def __init__(self) -> None:
        self._leases: list[Lease] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def add(self, lease: Lease) -> None:
        with self._lock:
            self._leases.append(lease)
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._loop, daemon=True, name="lease-heartbeat")
                self._thread.start()

    def remove(self, lease: Lease) -> None:
        with self._lock:
            self._leases = [item for item in self._leases if item is not lease]

    def _loop(self) -> None:
        while True:
            time.sleep(HEARTBEAT_S)
            with self._lock:
                leases = list(self._leases)
            for lease in leases:
                lease.beat()


_heart = _Heart()


@functools.cache
def host() -> str:
    """What two processes share that can see each other's process numbers: boot of the machine, and container."""
    parts = [socket.gethostname()]
    try:
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    except OSError:
        parts.append(f"{uuid.getnode():x}")
    return " ".join(parts)


def _started(pid: int) -> str | None:
    """When a process began, in ticks since boot, or None where the system does not say or it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else fields[19]


def _runs(pid: int, started: Any) -> bool:
    if Path("/proc/self/stat").exists():
        return (now := _started(pid)) is not None and started in (None, now)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _read(file: Path) -> dict[str, Any] | None:
    """The record of an owner; None if there is none or only a part of one."""
    try:
        record: Any = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and isinstance(record.get("pid"), int) else None


def _create(file: Path, token: str) -> None:
    """Create a whole record under a name that nobody else has."""
    pid = os.getpid()
    record = {"name": socket.gethostname(), "pid": pid, "host": host(), "started": _started(pid), "token": token}
    text = json.dumps(record) + "\n"
    draft = file.with_name(f".{token}")
    try:
        draft.write_text(text)
        os.link(draft, file)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        with file.open("x") as stream:  # a file system without links: a reader may meet the empty file, and waits
            stream.write(text)
    finally:
        draft.unlink(missing_ok=True)


def _moved(before: dict[str, tuple[str, int]], now: dict[str, tuple[str, int]]) -> bool:
    return any(name not in before or before[name] != shown for name, shown in now.items())


def _awake_s() -> float:
    """Seconds that go on while the machine sleeps, where the system has such a clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()
