"""The checkpoints that an entry names on a hub, fetched into run folders for a check."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from arcade_torch.agents import hub
from arcade_torch.agents.runs.checkpoint import MOST_WEIGHTS
from arcade_torch.agents.runs.files import checksum, read_bytes, write_atomic
from arcade_torch.tools.board.entry import BoardRun, Entry, EntryRefusedError, file_word
from arcade_torch.tools.board.evaluation import WEIGHTS, weights_hash
from arcade_torch.tools.board.submit import Progress, checkpoint_name
from arcade_torch.tools.run_folders import SETTINGS

META = "meta.json"
MOST_TABLE = 2**20
"""Bytes of the largest table of settings that is fetched."""
BYTES_A_PARAMETER = 16
"""At most, in a file of weights: buffers and the agent's average beside float32 numbers."""
HEADER = 2**20
"""Bytes for the header of a file of weights, at most."""


def folder_name(entry: Entry, run: BoardRun) -> str:
    """The folder of a run in the repository of its entry, as a study names it.

    Returns:
        ``GAME__TWIN__MEMORY__ALGORITHM__seedN``, the game without its version.
    """
    game = run.game.rpartition("-")[0]
    agent = f"{file_word(entry.memory)}__{file_word(entry.algorithm)}"
    return f"{game}__{run.twin}__{agent}__seed{run.seed}"


def pull(
    entry: Entry, runs: Sequence[BoardRun], into: Path, progress: Progress | None = None
) -> None:
    """Fetch run folders of an entry from its hub, those that are not there yet.

    Of each come the settings, and from the checkpoint of the end the weights and their table;
    nothing that would have to be unpickled. The weights' SHA-256 has to be that of the entry, which
    is looked at before any file of the run is read or put into ``into``.

    Args:
        entry: whose ``checkpoints`` are of kind ``hub``.
        runs: which of its runs.
        into: folder that the run folders go to, made if need be.
        progress: told after every run.

    Raises:
        EntryRefusedError: the entry names no hub, or other weights lie there.
        HubError: a file is missing or too large, or the hub cannot be reached.
    """
    place: dict[str, Any] = dict(entry.checkpoints)
    if place["kind"] != "hub":
        advice = {"url": f"fetch them from {place.get('url')} by hand", "retrain": "use --retrain"}
        raise EntryRefusedError(
            f"the checkpoints of this entry are of kind {place['kind']!r}, which is no hub: "
            f"{advice[place['kind']]}"
        )
    most_weights = min(MOST_WEIGHTS, HEADER + BYTES_A_PARAMETER * entry.parameters)
    for done, run in enumerate(runs, 1):
        name = folder_name(entry, run)
        checkpoint = f"checkpoints/{checkpoint_name(entry.frames)}"
        sizes = {
            SETTINGS: MOST_TABLE,
            f"{checkpoint}/{META}": MOST_TABLE,
            f"{checkpoint}/{WEIGHTS}": most_weights,
        }
        # the weights are written last
        if not has_weights(into / name / checkpoint, run):
            on_hub = {f"{name}/{file}": size for file, size in sizes.items()}
            source = hub.download(place["repo"], on_hub, revision=place["revision"]) / name
            _check_hash(source / checkpoint / WEIGHTS, run, most_weights)
            for file, size in sizes.items():
                write_atomic(into / name / file, read_bytes(source / file, size))
        if progress is not None:
            progress(f"pulled {run.name}", done, len(runs))


def has_weights(checkpoint: Path, run: BoardRun) -> bool:
    """Whether a checkpoint has the weights of a run."""
    try:
        return weights_hash(checkpoint) == run.weights_sha256
    except FileNotFoundError:
        return False


def _check_hash(weights: Path, run: BoardRun, most_bytes: int) -> None:
    """Refuse weights from the hub that are not those of the entry."""
    sha256 = checksum(weights, most_bytes)
    if sha256 != run.weights_sha256:
        raise EntryRefusedError(
            f"checkpoint of {run.name}: the weights on the hub have SHA-256 {sha256[:16]}..., the "
            f"entry says {run.weights_sha256[:16]}..."
        )
