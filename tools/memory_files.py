"""Memory models of a user: their check before a training, and what they import only while they
train.
"""

import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import read_json, write_json
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.imports import imports_of, is_from_user

SKIP = "--no-check-memory trains it unchecked"


class MemoryRefusedError(RuntimeError):
    """A memory model of a user breaks a law, or cannot be checked; says how to go on."""


def check_memory_of(config: TrainConfig) -> None:
    """Check the memory model of a run, as wide as it will be trained, if it is a user's.

    Random numbers of the training are not touched.

    Raises:
        MemoryRefusedError: it breaks one of the laws of `check_memory`, or fails while it is
            checked.
        ValueError, TypeError: there is no such memory model, or it has other options.
    """
    if not is_from_user(config.memory):
        return
    from arcade_torch.agents.policy import build_network
    from arcade_torch.models import MemoryLawError, check_memory
    from arcade_torch.models.networks import MemoryBlock

    network = build_network(replace(config, device="cpu", cuda_graphs=False))
    block = next(module for module in network.modules() if isinstance(module, MemoryBlock))
    cell = block.cells[0]
    try:
        check_memory(cell, input_size=block.hidden_size)
        width = _width(cell, block.hidden_size)
    except MemoryLawError as error:
        raise MemoryRefusedError(f"memory {config.memory!r}: {error} {SKIP}") from error
    except Exception as error:
        raise MemoryRefusedError(
            f"memory {config.memory!r} failed when it was checked in float64, "
            f"{type(error).__name__}{_place(error)}: {one_line(error)}; {SKIP}"
        ) from error
    if width != block.hidden_size:
        raise MemoryRefusedError(
            f"memory {config.memory!r} was made with hidden_size={block.hidden_size}, and its y is "
            f"{width} wide: bring it to hidden_size, with a last nn.Linear for example"
        )


class LateImports:
    """Notes in a run's ``config.json`` what game and memory import only when they are run.

    Called with every row of a training, as its ``progress``; it looks once, after the first update,
    when everything has run.
    """

    def __init__(self, run: Path, config: TrainConfig) -> None:
        self._file = run / "config.json"
        self._config = config
        self._is_noted = False

    def __call__(self, row: Any) -> None:
        """Look, and write."""
        if self._is_noted:
            return
        self._is_noted = True
        imports = imports_of(self._config)
        if not imports:
            return
        record = read_json(self._file)
        remembered = {entry["name"] for entry in record["imports"]}
        late = [entry for entry in imports if entry["name"] not in remembered]
        if late:
            record["imports"] += late
            write_json(self._file, record)


def _width(cell: Any, input_size: int) -> int:
    """How many numbers a memory gives at each step."""
    import torch

    x = torch.zeros(1, 1, input_size)
    with torch.no_grad():
        y, _ = cell(x, cell.initial_state(1), torch.ones(1, 1, dtype=torch.bool))
    return int(y.shape[-1])


def _place(error: Exception) -> str:
    """The last line of a user that an error came through, such as `` (yours.py:23)``."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package not in ("arcade_torch", "torch", "tensordict"):
            place = f" ({Path(frame.f_code.co_filename).name}:{line})"
    return place
