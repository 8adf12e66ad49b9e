"""TensorBoard and Weights & Biases beside the CSV files: a copy of the same rows that no run depends on."""

import importlib.util
import json
import os
import uuid
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import write_atomic

LoggerName = Literal["none", "tensorboard", "wandb"]
TIME_COLUMNS = ("seconds", "fps")


class LoggerError(RuntimeError):
    """The logger that was asked for cannot be used; says how to get it."""


def check_logger(name: str) -> None:
    """Refuse a logger whose package is missing.

    Args:
        name: see ``TrainConfig.logger``.

    Raises:
        LoggerError: its package is not installed.
    """
    if name != "none" and importlib.util.find_spec(name) is None:
        raise LoggerError(f"logger={name!r} needs a package that is missing: pip install 'arcade-torch[loggers]'")


class RunLogger:
    """Hands rows to one of TorchRL's loggers, with the frame count as step; after its first error it stays silent.

    Args:
        open_logger: makes a logger of TorchRL; None logs nothing.
    """

    def __init__(self, open_logger: Callable[[], Any] | None = None) -> None:
        self._logger = self._try(open_logger) if open_logger is not None else None

    def log(self, group: str, row: Mapping[str, Any]) -> None:
        """Log the numbers of a row of ``metrics.csv`` or ``eval.csv`` at step ``frames``; empty cells are left out.

        Args:
            group: ``"train"`` or ``"eval"``; stands before the name, except that times stand under ``"time"``.
            row: what to log.
        """
        if self._logger is not None:
            names = {key: "time" if key in TIME_COLUMNS else group for key in row if key != "frames"}
            found = {f"{name}/{key}": float(row[key]) for key, name in names.items() if row[key] is not None}
            logger = self._logger
            self._try(lambda: logger.log_metrics(found, step=int(row["frames"])))

    def close(self) -> None:
        """Write what is left and let go."""
        experiment = getattr(self._logger, "experiment", None)
        end = getattr(experiment, "finish", None) or getattr(experiment, "close", None)
        if end is not None:
            self._try(end)
        self._logger = None

    def _try(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except Exception as error:
            self._logger = None
            warnings.warn(
                f"logging ends here, the run and its CSV files go on: {type(error).__name__}: {error}", stacklevel=3
            )


def open_logger(config: TrainConfig, folder: Path, frames: int) -> RunLogger:
    """Open the logger of a run, or go on with it.

    Args:
        config: of the run.
        folder: of the run, which exists; TensorBoard writes to ``tensorboard`` in it, Weights & Biases to ``wandb``.
        frames: where the run goes on; what TensorBoard shows beyond is dropped, as in the CSV files.

    Returns:
        The logger; a silent one if it could not be opened.
    """
    makers = {"tensorboard": _tensorboard, "wandb": _wandb}
    make = makers.get(config.logger)
    return RunLogger(None if make is None else lambda: make(config, folder, frames))


def _tensorboard(config: TrainConfig, folder: Path, frames: int) -> Any:
    from torch.utils.tensorboard import SummaryWriter
    from torchrl.record.loggers import TensorboardLogger

    class Resumable(TensorboardLogger):
        """TorchRL's logger, which cannot say by itself that later steps are void."""

        def _create_experiment(self) -> Any:
            return SummaryWriter(log_dir=self.log_dir, purge_step=frames + 1 if frames else None)

    logger = Resumable(exp_name=folder.name, log_dir=str(folder / "tensorboard"))
    if not frames:
        logger.experiment.add_text("config", f"```\n{json.dumps(config.to_dict(), indent=1)}\n```")
    return logger


def _wandb(config: TrainConfig, folder: Path, frames: int) -> Any:
    """Offline unless WANDB_MODE says otherwise, so that no run waits for a network or asks for a key."""
    from torchrl.record.loggers import WandbLogger

    file = folder / "wandb_id.txt"
    if not file.is_file():
        write_atomic(file, uuid.uuid4().hex + "\n")
    logger = WandbLogger(
        exp_name=folder.name,
        id=file.read_text().strip(),
        project=os.environ.get("WANDB_PROJECT", "arcade-torch"),
        log_dir=str(folder),
        log_env_packages=False,
        mode=os.environ.get("WANDB_MODE", "offline"),
        settings={"silent": True, "disable_git": True, "console": "off"},
    )
    logger.log_hparams(config.to_dict())
    return logger
