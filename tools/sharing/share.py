"""A run as a folder that can be shared: weights, settings, results, model card, film."""

import hashlib
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.evaluation import EvalResult, evaluate
from arcade_torch.agents.policy import agent_of
from arcade_torch.agents.runs.bundle import (
    CONFIG,
    WEIGHTS,
    find_checkpoint,
    is_bundle,
    load_bundle,
    write_bundle,
)
from arcade_torch.agents.runs.files import (
    CheckpointError,
    checksum,
    read_json,
    write_atomic,
    write_json,
)
from arcade_torch.envs_jax.registry import games_of
from arcade_torch.tools.errors import MissingPackage
from arcade_torch.tools.imports import remembered_imports
from arcade_torch.tools.machine import versions
from arcade_torch.tools.runs import Run, check_unchanged
from arcade_torch.tools.sharing import card
from arcade_torch.tools.sharing.place import FILMS, put_files, read_folder

RESULTS = "results.json"
README = "README.md"
EVALUATION = ".eval_results/arcade-torch.yaml"
MOST_STEPS = 500
"""Of the episode in the film."""
_TRAINING = ("train", "study", "demo", "compare")
"""Commands that train."""
_WORDS_LEFT_OUT = ("--out", "--wait")
"""Options of a training that say nothing of its result."""
_BY_CONFIG = "arcade-torch train --config config.json"
"""How to repeat the training by the file in the folder itself."""


def share(
    run: Path,
    folder: Path,
    repo: str = "",
    episodes: int = 1024,
    half: bool = False,
    film: bool = True,
) -> dict[str, Any]:
    """Write the agent of a run into a folder, and evaluate what was written.

    The folder is written when all of it is there: until then an agent that it holds stays.

    Args:
        run: run folder, checkpoint, or an agent that was shared.
        folder: where to; made if it is missing.
        repo: what it will be called; the folder's name by default.
        episodes: greedy ones, for the results.
        half: store the weights as float16.
        film: write a film of one episode, as an MP4 with the extra video, else as a GIF.

    Returns:
        What ``results.json`` holds.

    Raises:
        CheckpointError: there is no agent at ``run``.
        FileExistsError: the folder holds something else.
        ValueError: the settings in the run folder are not those of its checkpoint.
    """
    _check_free(folder)
    with tempfile.TemporaryDirectory() as scratch:
        draft = Path(scratch) / folder.resolve().name
        results = _write(run, draft, repo, episodes, half, film)
        put_files(read_folder(draft), folder)
    return results


def check_recorded(files: Mapping[str, bytes]) -> None:
    """Refuse (``CheckpointError``) an agent whose results name other hashes than those of its
    files; one without results, or whose results name none, is not refused.
    """
    try:
        recorded = json.loads(files[RESULTS])["sha256"]
    except (KeyError, TypeError, ValueError, RecursionError):
        return
    for name in (WEIGHTS, CONFIG):
        expected = recorded.get(name) if isinstance(recorded, dict) else None
        measured = hashlib.sha256(files[name]).hexdigest()
        if expected not in (None, measured):
            raise CheckpointError(
                f"{name} has the SHA-256 {measured}, {RESULTS} says {expected}: the file is "
                "damaged, or the results are of another agent; nothing was written"
            )


def _write(
    run: Path, folder: Path, repo: str, episodes: int, half: bool, film: bool
) -> dict[str, Any]:
    """Write all files into a new folder, for `share`."""
    checkpoint = find_checkpoint(run)
    record = _record_of(run)
    packages = record.get("versions")
    made_by = packages if isinstance(packages, dict) else {}
    training = {"versions": made_by, "command": _command(record)}
    needs = [Path(name).name for name in remembered_imports(record, run / CONFIG)]
    write_bundle(folder, checkpoint, training | {"needs": needs}, half)
    stored = replace(load_bundle(folder), path=run)  # errors name what the user named
    result = _evaluated(stored, episodes)
    results = _results(stored, result)
    if half:
        results["mean_reward_float32"] = round(_evaluated(checkpoint, episodes).mean, 6)
    results |= {"training": training, "evaluated_with": versions()}
    results["sha256"] = {name: checksum(folder / name) for name in (CONFIG, WEIGHTS)}
    video = _film(stored, folder) if film else ""
    write_json(folder / RESULTS, results)
    write_atomic(folder / README, card.model_card(repo or folder.name, results, video))
    write_atomic(folder / EVALUATION, card.eval_results(results))
    return results


def _check_free(folder: Path) -> None:
    """Refuse a folder that holds anything but an agent that was shared."""
    if folder.is_dir() and any(folder.iterdir()) and not is_bundle(folder):
        raise FileExistsError(
            f"{folder} is not empty and holds no shared agent: choose another folder"
        )


def _record_of(run: Path) -> dict[str, Any]:
    """The ``config.json`` of a run, of the run of a checkpoint, or of a shared agent."""
    for place in (run, run.parent, run.parent.parent):
        if (place / CONFIG).is_file():
            record = read_json(place / CONFIG)
            if isinstance(record, dict):
                check_unchanged(Run(place))
            return record if isinstance(record, dict) else {}
    return {}


def _command(record: dict[str, Any]) -> str:
    """How the training was started, or can be repeated, without names of places.

    A run that a script or a worker of a cluster started, or that was told its config by a file, is
    repeated by the config that is shared.
    """
    words = record.get("command", [])
    if isinstance(words, str):
        return words
    if not isinstance(words, list):  # somebody changed the file
        return ""
    words = [str(word) for word in words[1:]]
    if not words or words[0] not in _TRAINING:
        return _BY_CONFIG
    if any(word.partition("=")[0] == "--config" for word in words):
        return _BY_CONFIG
    kept = ["arcade-torch"]
    skips = False
    for word in words:
        if skips or word.partition("=")[0] in _WORDS_LEFT_OUT:
            skips = not skips and "=" not in word
        else:
            kept.append(Path(word).name if "/" in word else word)
    return " ".join(kept)


def _evaluated(checkpoint: Any, episodes: int) -> EvalResult:
    """Greedy episodes of a checkpoint, on the CPU."""
    config = replace(checkpoint.config, device="cpu", cuda_graphs=False)
    return evaluate(agent_of(replace(checkpoint, config=config), "cpu"), episodes=episodes)


def _results(checkpoint: Any, result: EvalResult) -> dict[str, Any]:
    """What an agent is and what it earned."""
    config = checkpoint.config
    return {
        "env": config.env,
        "observability": config.observability,
        "algorithm": config.algorithm,
        "memory": config.memory,
        "seed": config.seed,
        "frames": checkpoint.frames,
        "mean_reward": round(result.mean, 6),
        "std_reward": round(result.std, 6),
        "half_width_95": result.half_width,
        "is_deterministic": True,
        "n_eval_episodes": len(result.returns),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }


def _film(checkpoint: Any, folder: Path) -> str:
    """Write a film of one episode; gives its name, empty where no extra writes films."""
    from arcade_torch.compiled import compiled_game
    from arcade_torch.tools.play import recording
    from arcade_torch.tools.play.session import Session

    config = checkpoint.config
    first = games_of(config.env)[0]
    game = compiled_game(first, config.obs_size, config.rules, dict(config.env_options))
    for name in FILMS:
        try:
            write = recording.writer_for(folder / name)
        except MissingPackage:
            continue
        partial = config.observability != "full"
        session = Session(game, seed=recording.FILM_SEED, partial=partial, episodes=1)
        player = recording.trained(agent_of(checkpoint, "cpu"), partial)
        fps = recording.FILM_FPS
        frames = recording.recorded_frames(session, player, max_steps=MOST_STEPS, hold=fps, scale=2)
        with tempfile.TemporaryDirectory() as scratch:
            film = write(Path(scratch) / name, frames, fps)
            write_atomic(folder / name, film.read_bytes())
        return name
    return ""
