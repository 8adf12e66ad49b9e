"""Run folders with networks that were never trained, and the entry of them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.policy import build_network
from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.checkpoint import save_checkpoint
from arcade_torch.tools.board.protocol import PROTOCOL
from arcade_torch.tools.board.submit import Words, submit

SHORT = replace(PROTOCOL, episodes=4)
"""The protocol with four episodes."""
GAME = "MineSweeperEasy-v0"
WORDS = Words("Untrained MinGRU", "https://example.org/code", "0123abc", "for the tests")


def write_run(folder: Path, **changes: Any) -> Path:
    """A finished run as the trainer leaves it, of a network as it begins."""
    config: TrainConfig = preset("smoke", **({"env": GAME} | changes))
    name = f"{config.env}-{config.observability}-{config.memory}-{config.seed}"
    run = folder / name
    frames = config.num_updates * config.learner.frames_per_update
    weights = build_network(config).state_dict()
    save_checkpoint(run / "checkpoints", config, frames, weights, {})
    (run / "config.json").write_text(json.dumps({"config": config.to_dict(), "versions": {}}))
    final = {
        "status": "finished",
        "frames": frames,
        "seconds": 2.0,
        "mean": 0.0,
        "returns": [0.0],
        "lengths": [3],
    }
    (run / "eval.json").write_text(json.dumps(final))
    return run


def write_pair(folder: Path, **changes: Any) -> None:
    """A run on each twin."""
    for twin in ("full", "partial"):
        write_run(folder, observability=twin, **changes)


def plain_entry(runs: Path) -> dict[str, Any]:
    """The entry of runs as its file holds it."""
    plain: dict[str, Any] = json.loads(json.dumps(submit([runs], WORDS, protocol=SHORT).to_dict()))
    return plain
