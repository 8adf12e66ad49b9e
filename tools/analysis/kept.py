"""Numbers of an analysis, kept in the run folder they were made from and used again while nothing has changed."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arcade_torch.tools.files import write_bytes

Arrays = dict[str, NDArray[Any]]


def kept(run: Path, name: str, options: Mapping[str, Any], compute: Callable[[], Arrays]) -> Arrays:
    """Arrays from ``run/analysis``, computed and written there if they are missing.

    Args:
        run: run folder; anything else (a single checkpoint, a folder that cannot be written) keeps nothing.
        name: of the analysis.
        options: everything that decides the numbers, the checkpoint included; JSON values.
        compute: makes the arrays.

    Returns:
        The arrays, with the options as JSON in ``options``.
    """
    text = json.dumps(dict(options), sort_keys=True)
    folder = run / "analysis"
    file = folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}.npz"
    if file.is_file():
        arrays = read_npz(file)
        if str(arrays.get("options")) == text:
            return arrays
    arrays = {**compute(), "options": np.array(text)}
    if (run / "config.json").is_file() and os.access(run, os.W_OK):
        write_npz(file, arrays)
    return arrays


def analysis_folder(path: Path) -> Path:
    """Where figures about a run folder, or about one of its checkpoints, go by default."""
    return (path.parent.parent if (path / "meta.json").is_file() else path) / "analysis"


def write_npz(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays atomically and compressed."""
    buffer = BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_bytes(path, buffer.getvalue())


def read_npz(path: Path) -> Arrays:
    """Read arrays; nothing is unpickled.

    Raises:
        ValueError: the file is damaged; names it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise ValueError(f"{path} is damaged ({error}): delete it") from error
