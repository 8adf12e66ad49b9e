"""Load a trained agent from a run folder or one of its checkpoints."""

import dataclasses
from os import PathLike
from pathlib import Path

import torch

from arcade_torch.agents.agent import Agent, build_network
from arcade_torch.agents.checkpoint import Checkpoint, CheckpointError, load_checkpoint, load_latest


def load(path: str | PathLike[str], device: str | torch.device | None = None) -> Agent:
    """Load an agent.

    Args:
        path: a run folder (its newest whole checkpoint), its ``checkpoints`` folder, or one checkpoint folder.
        device: where to put the network; default the device of the run if it is there, else the CPU.

    Returns:
        The agent, in evaluation mode.

    Raises:
        CheckpointError: there is nothing to load at ``path``, or it is damaged; says what was found.
    """
    checkpoint = _find(Path(path))
    config = checkpoint.config
    network = build_network(dataclasses.replace(config, device="cpu"))
    try:
        network.load_state_dict(checkpoint.weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(f"the weights in {checkpoint.path} do not fit the network: {reason}") from error
    if device is None:
        device = config.device if config.device == "cpu" or torch.cuda.is_available() else "cpu"
    return Agent(config, network.to(device).eval(), checkpoint.frames)


def _find(path: Path) -> Checkpoint:
    try:
        there = path.is_dir()
    except OSError as error:  # a name that is too long, or a folder nobody may enter
        raise CheckpointError(f"{path} cannot be looked at: {error.strerror}") from error
    if not there:
        raise CheckpointError(f"{path} is not a folder; give a run folder or one of its checkpoints")
    if (path / "meta.json").is_file():
        return load_checkpoint(path, weights_only=True)
    if (path / "checkpoints").is_dir():
        return load_latest(path / "checkpoints", weights_only=True)
    if any(path.glob("frames-*")):
        return load_latest(path, weights_only=True)
    raise CheckpointError(f"{path} holds no checkpoint; give a run folder or one of its checkpoints")
