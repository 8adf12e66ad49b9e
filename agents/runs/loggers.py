"""TensorBoard and Weights & Biases beside the CSV files: a copy of the same rows that no run
depends on.
"""

import importlib.util
import json
import os
import uuid
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import read_text, write_atomic


class LoggerError(RuntimeError):
    """The logger that was asked for cannot be used; says how to get it."""


def check_logger(name: str) -> None:
    """Refuse a logger (see ``TrainConfig.logger``) whose package is missing, by a
    ``LoggerError``.
    """
    if name != "none" and importlib.util.find_spec(name) is None:
        raise LoggerError(
            f"logger={name!r} needs a package that is missing: pip install '.[loggers]'"
        )


class RunLogger:
    """Hands rows to the logger of TorchRL that a run names, at their frame count; after its first
    error it stays silent.

    Args:
        config: of the run.
        folder: of the run, which exists; TensorBoard writes to ``tensorboard`` in it, Weights &
            Biases to ``wandb``.
        frames: where the run goes on; what TensorBoard shows beyond is dropped, as in the CSV
            files.
    """

    def __init__(self, config: TrainConfig, folder: Path, frames: int) -> None:
        open_logger = {"none": None, "tensorboard": _tensorboard, "wandb": _wandb}[config.logger]
        self._logger = open_logger and self._try(lambda: open_logger(config, folder, frames))

    def log(self, group: str, row: Mapping[str, Any]) -> None:
        """Log a row of ``metrics.csv`` or ``eval.csv``, without empty cells, as ``group/name``, of
        times ``time/name``.
        """
        logger = self._logger
        if logger is None:
            return
        values = {}
        for name, value in row.items():
            if name != "frames" and value is not None:
                place = "time" if name in ("seconds", "fps") else group
                values[f"{place}/{name}"] = float(value)
        self._try(lambda: logger.log_metrics(values, step=int(row["frames"])))

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
            reason = f"{type(error).__name__}: {error}"
            warnings.warn(
                f"logging ends here, the run and its CSV files go on: {reason}", stacklevel=3
            )


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
    """Offline unless WANDB_MODE says otherwise, so that no run waits for a network or asks for a
    key.
    """
    from torchrl.record.loggers import WandbLogger

    file = folder / "wandb_id.txt"
    if not file.is_file():
        write_atomic(file, uuid.uuid4().hex + "\n")
    logger = WandbLogger(
        exp_name=folder.name,
        id=read_text(file).strip(),
        project=os.environ.get("WANDB_PROJECT", "arcade-torch"),
        log_dir=str(folder),
        log_env_packages=False,
        mode=os.environ.get("WANDB_MODE", "offline"),
        settings={"silent": True, "disable_git": True, "console": "off"},
    )
    logger.log_hparams(config.to_dict())
    return logger
