"""The folder of a run: who may write into it, what stands in it, how far it is."""

import contextlib
import importlib.metadata
import platform
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

import arcade_torch
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.runs.checkpoint import FORMAT, refuse_format, remove_draft_checkpoints
from arcade_torch.agents.runs.files import (
    check_writable_folder,
    read_json,
    remove_drafts,
    write_json,
)
from arcade_torch.agents.runs.final import is_final

METRIC_COLUMNS = (
    "frames", "updates", "grad_steps", "seconds", "fps",
    "loss", "q_mean", "td_error", "grad_norm",
    "policy_loss", "value_loss", "entropy", "kl", "clip_fraction",
    "replay_frames", "epsilon", "lr",
    "train_return", "train_return_ewm", "train_return_last", "episodes",
)  # fmt: skip
"""Columns of ``metrics.csv``; a cell that means nothing for an algorithm is empty. ``seconds`` is
time spent collecting and learning. ``train_return`` is the mean return of the episodes that ended
in the rollout (empty if none), ``train_return_ewm`` its running average, and ``train_return_last``
the last finished return of every environment averaged over the rollout, which is what the paper's
score reads."""
EVAL_COLUMNS = ("frames", "mean", "std", "n")
"""Columns of ``eval.csv``; behind them, of a mixture, the mean return in each of its games."""
LOCK = "lock"
"""File in a run folder that the process which trains there holds locked. The file itself stays; a
killed process loses the lock at once."""


_MOST_FIELDS = 8
"""Settings that are named where two runs differ; an agent of another preset differs in 30."""


# what a run writes and removes in place, so that none of it may be a link
_WRITTEN = (LOCK, "checkpoints", "replay", "tensorboard", "wandb", "wandb_id.txt")


class RunFolderError(RuntimeError):
    """A run folder cannot be used: taken, of another run, of version 0.1, or not writable."""


class RunFolder:
    """Paths and small files of one run, in a folder that :meth:`check` looks at and :meth:`claim`
    creates.
    """

    def __init__(self, path: Path, imports: Sequence[Mapping[str, str]] = ()) -> None:
        self.path = path
        self.imports = [dict(entry) for entry in imports]
        """What game and memory were imported from, ``name`` and ``sha256``; kept in
        ``config.json``."""
        self.checkpoints = path / "checkpoints"
        self.replay = path / "replay"
        self._config = path / "config.json"
        self._reported = 0.0

    def check(self, config: TrainConfig, resume: bool) -> None:
        """Refuse, by a ``RunFolderError``, a folder that holds something (with ``resume``: another
        run) or that cannot be written; change nothing.
        """
        if self._config.exists() and resume:
            self._check_same(config)
        elif self.path.is_dir() and any(entry.name != LOCK for entry in self.path.iterdir()):
            hint = ""
            if self._config.is_file():
                hint = "pass resume=True (--resume) to continue it, or "
            raise RunFolderError(f"{self.path} is not empty; {hint}choose another folder")
        try:
            check_writable_folder(self.path.absolute(), self.path)
        except OSError as error:
            raise RunFolderError(f"cannot write to {self.path}: {error.strerror}") from error

    @contextlib.contextmanager
    def claim(self, config: TrainConfig) -> Iterator[None]:
        """Hold the folder for this process alone; what a killed process left half written is
        removed.

        Raises:
            RunFolderError: another process trains here, the folder holds another run, or it cannot
                be written.
        """
        for name in _WRITTEN:
            if (self.path / name).is_symlink():
                raise RunFolderError(
                    f"{self.path / name} is a link: a run writes and removes files there; remove it"
                )
        with contextlib.ExitStack() as held:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                held.enter_context(FileLock(self.path / LOCK).acquire(timeout=0))
                self._prepare(config)
            except Timeout as error:
                raise RunFolderError(
                    f"another process trains in {self.path}: wait for it, or stop it"
                ) from error
            except OSError as error:
                raise RunFolderError(
                    f"cannot write to {self.path}: {error.strerror or error}"
                ) from error
            yield

    def _prepare(self, config: TrainConfig) -> None:
        for folder in (self.path, self.replay):
            remove_drafts(folder)
        remove_draft_checkpoints(self.checkpoints)
        if self._config.exists():
            self._check_same(config)  # another process may have come first
            record = read_json(self._config)
            if not self.imports or record.get("imports") == self.imports:
                return
            record["imports"] = self.imports  # the run goes on with these
        else:
            record = {
                "format": FORMAT,
                "config": config.to_dict(),
                "versions": versions(),
                "command": sys.argv,
                "imports": self.imports,
            }
        write_json(self._config, record)

    def _check_same(self, config: TrainConfig) -> None:
        try:
            record = read_json(self._config)
            if reason := refuse_format(f"the run in {self.path}", record.get("format", 1)):
                raise RunFolderError(reason)
            saved = TrainConfig.from_dict(record["config"])
        except PermissionError as error:
            raise RunFolderError(f"{self._config} may not be read: {error.strerror}") from error
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RunFolderError(f"{self._config} does not describe a run: {error}") from error
        if fields := differing_fields(saved, config):
            text = ", ".join(fields[:_MOST_FIELDS])
            if len(fields) > _MOST_FIELDS:
                text += f" and {len(fields) - _MOST_FIELDS} more"
            raise RunFolderError(
                f"{self.path} holds another run; differing fields: {text}; to go on with it: "
                f"arcade-torch train --config {shlex.quote(str(self._config))} --out "
                f"{shlex.quote(str(self.path))} --resume"
            )

    def check_there(self) -> None:
        """Raise ``RunFolderError`` if somebody removed or moved the folder while its run trains."""
        if not self._config.is_file():
            raise RunFolderError(
                f"{self.path} is not there any more, or its config.json: the run ends here"
            )

    def finished(self) -> dict[str, Any] | None:
        """The final ``eval.json`` if the run is finished; a damaged one is made again from the last
        checkpoint.
        """
        try:
            result = read_json(self.path / "eval.json")
        except PermissionError as error:
            raise RunFolderError(
                f"{self.path / 'eval.json'} may not be read: {error.strerror}"
            ) from error
        except (OSError, ValueError):
            return None
        needed = ("status", "frames", "seconds", "returns", "lengths", "train_max_ewm")
        return result if is_final(result, needed) and result["frames"] is not None else None

    def report(self, frames: int, total_frames: int, status: str, **more: Any) -> None:
        """Replace ``progress.json``; while running at most about once a second."""
        now = time.monotonic()
        if status == "running" and now - self._reported < 1.0:
            return
        self._reported = now
        if not self._config.is_file():  # somebody removed the folder: it is not made again for this
            return
        progress = {"frames": frames, "total_frames": total_frames, "status": status, **more}
        write_json(self.path / "progress.json", progress)


def wait_until_free(path: Path, limit_s: float) -> None:
    """Wait until no process trains in a run folder, at most so many seconds."""
    if (path / LOCK).is_file() and not (path / LOCK).is_symlink():
        # Timeout is an OSError
        with contextlib.suppress(OSError), FileLock(path / LOCK).acquire(timeout=limit_s):
            pass


def versions() -> dict[str, str]:
    """Versions of this package, Python and the packages that decide a result."""
    others = ("torch", "torchrl", "tensordict", "jax", "jaxlib", "numpy")
    versions = {"python": platform.python_version(), "arcade_torch": arcade_torch.__version__}
    for name in others:
        versions[name] = _version(name)
    return versions


def _version(name: str) -> str:
    """The version of a package, also where a nightly build of it is installed, which has a name of
    its own.
    """
    for distribution in (name, f"{name}-nightly"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            return importlib.metadata.version(distribution)
    return "unknown"
