"""Run folders with networks that were never trained, and the entry of them."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.policy import build_network
from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.checkpoint import save_checkpoint
from arcade_torch.tools.board.entry import settings_of
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


def fabricated_entry(
    name: str = "LRU",
    games: Sequence[str] = (GAME,),
    seeds: Sequence[int] = (1,),
    score: Callable[[str, str, int], float] = lambda game, twin, seed: 0.5,
    frames: int = 98_304,
) -> dict[str, Any]:
    """The values of an entry that keeps the protocol, of runs that there are none of."""
    configs = {}
    for game in games:
        for twin in ("full", "partial"):
            for seed in seeds:
                changes = {"env": game, "observability": twin, "seed": seed, "total_frames": frames}
                configs[game, twin, seed] = preset("small", memory="lru", **changes)
    shared, rest = settings_of(configs.values())
    rows = []
    for (game, twin, seed), settings in zip(configs, rest, strict=True):
        row = {"game": game, "twin": twin, "seed": seed, "score": score(game, twin, seed)}
        row |= {"std": 0.1, "returns_sha256": "0" * 64, "weights_sha256": "1" * 64}
        rows.append(row | {"seconds": 60.0, "settings": settings})
    observations = ["is_init", "last_action", "pixels"]
    return {
        "protocol": 1,
        "name": name,
        "memory": "lru",
        "algorithm": "ppo",
        "url": "",
        "commit": "",
        "note": "",
        "date": "2026-11-27",
        "frames": frames,
        "parameters": 292_550,
        "state_bytes": 1024,
        "checkpoints": {"kind": "retrain"},
        "observations": {"training": observations, "acting": observations},
        "evaluation": {"episodes": PROTOCOL.episodes, "seed": PROTOCOL.seed},
        "environments": {"rules": "default", "obs_size": 128},
        "made_with": {"processor": "one"},
        "settings": shared,
        "runs": rows,
    }
