"""The folder of a run: who may write into it, what stands in it, how far it is."""

import importlib.metadata
import os
import platform
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import arcade_torch
from arcade_torch.agents.config import TrainConfig, differing_fields
from arcade_torch.agents.files import CsvLog, is_final, read_json, write_json
from arcade_torch.agents.lease import LOCK, Lease

METRIC_COLUMNS = (
    "frames",
    "updates",
    "grad_steps",
    "seconds",
    "fps",
    "loss",
    "q_mean",
    "td_error",
    "grad_norm",
    "policy_loss",
    "value_loss",
    "entropy",
    "kl",
    "clip_share",
    "replay_frames",
    "epsilon",
    "lr",
    "train_return",
    "train_return_ewm",
    "train_return_last",
    "episodes",
)
"""Columns of ``metrics.csv``; a cell that means nothing for an algorithm is empty. ``seconds`` is time spent
collecting and learning. ``train_return`` is the mean return of
the episodes that ended in the window (empty if none), ``train_return_ewm`` its running average, and
``train_return_last`` the last finished return of every environment averaged over the window, which is what the paper's
score reads."""
EVAL_COLUMNS = ("frames", "mean", "std", "n")
_PACKAGES = ("torch", "torchrl", "tensordict", "jax", "numpy")


class RunFolderError(RuntimeError):
    """A run folder cannot be used: taken, of another run, or not writable."""


class RunFolder:
    """Paths and small files of one run.

    Args:
        path: the folder; looked at by :meth:`check`, created by :meth:`claim`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.replay = path / "replay"
        self.lease = Lease(path / LOCK)
        self._reported = 0.0

    def check(self, config: TrainConfig, resume: bool) -> None:
        """Refuse a folder that this run may not use; writes nothing.

        Args:
            config: of the run.
            resume: whether a folder that holds this run already may be used.

        Raises:
            RunFolderError: the folder holds something and ``resume`` is off, holds another run, or cannot be written.
        """
        file = self.path / "config.json"
        if file.is_file() and resume:
            self._check_same(file, config)
        elif self.path.is_dir() and any(entry.name != LOCK for entry in self.path.iterdir()):
            hint = "pass resume=True to continue it, or " if file.is_file() else ""
            raise RunFolderError(f"{self.path} is not empty; {hint}choose another folder")
        existing = next(p for p in (self.path, *self.path.absolute().parents) if p.exists())
        if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
            raise RunFolderError(f"cannot write to {self.path}: {existing} is not a writable folder")

    def claim(self, config: TrainConfig) -> Lease:
        """Create the folder, take its lock, sweep out what a killed process left half written, and write
        ``config.json`` unless it is there already.

        Returns:
            The lock; use it as a context manager.

        Raises:
            RunFolderError: another process trains here, or the folder cannot be written.
        """
        file = self.path / "config.json"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if not self.lease.take():
                owner = self.lease.owner() or "another process"
                raise RunFolderError(f"{self.path} is being trained by {owner}: wait for it, or stop it")
            self._sweep()
            if file.is_file():
                self._check_same(file, config)  # another process may have come first
            else:
                write_json(file, {"config": config.to_dict(), "versions": versions(), "command": sys.argv})
        except OSError as error:
            self.lease.release()
            raise RunFolderError(f"cannot write to {self.path}: {error.strerror or error}") from error
        except BaseException:
            self.lease.release()
            raise
        return self.lease

    def _sweep(self) -> None:
        """Remove drafts of files and checkpoints: only the owner of the lock writes here, and it has just begun."""
        for draft in self.path.glob(".*.[0-9]*"):
            draft.unlink(missing_ok=True)
        for draft in self.checkpoints.glob(".frames-*"):
            shutil.rmtree(draft, ignore_errors=True)

    def _check_same(self, file: Path, config: TrainConfig) -> None:
        try:
            saved = TrainConfig.from_dict(read_json(file)["config"])
        except (ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{file} does not describe a run: {error}") from error
        if fields := differing_fields(saved, config):
            raise RunFolderError(f"{self.path} holds another run; differing fields: {', '.join(fields)}")

    def finished(self) -> dict[str, Any] | None:
        """The final ``eval.json`` if the run is finished; a damaged one is made again from the last checkpoint."""
        file = self.path / "eval.json"
        if not file.is_file():
            return None
        try:
            result = read_json(file)
        except ValueError:
            return None
        needed = ("status", "frames", "seconds", "returns", "lengths", "train_max_ewm")
        return result if is_final(result, needed) and result["frames"] is not None else None

    def open_logs(self, frames: int) -> tuple[CsvLog, CsvLog]:
        """``metrics.csv`` and ``eval.csv``, cut back to ``frames``."""
        return (
            CsvLog(self.path / "metrics.csv", METRIC_COLUMNS, keep_frames=frames),
            CsvLog(self.path / "eval.csv", EVAL_COLUMNS, keep_frames=frames),
        )

    def report(self, frames: int, total_frames: int, status: str, **more: Any) -> None:
        """Replace ``progress.json``; while running at most about once a second."""
        self.lease.confirm()
        now = time.monotonic()
        if status == "running" and now - self._reported < 1.0:
            return
        self._reported = now
        write_json(
            self.path / "progress.json", {"frames": frames, "total_frames": total_frames, "status": status, **more}
        )


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"python": platform.python_version(), "arcade_torch": arcade_torch.__version__}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
