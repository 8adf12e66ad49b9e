"""The file of an entry, from the run folders of one agent."""

import datetime
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_values
from arcade_torch.agents.runs.files import list_checkpoints
from arcade_torch.tools.board.entry import (
    BoardRun,
    Entry,
    EntryRefusedError,
    check_checkpoints,
    check_protocol,
    settings_of,
)
from arcade_torch.tools.board.evaluation import Evaluator, Played, made_with, weights_hash
from arcade_torch.tools.board.protocol import OBSERVATIONS, PROTOCOL, Protocol
from arcade_torch.tools.comparable import Runs, find_runs
from arcade_torch.tools.runs import FREE, Run

Progress = Callable[[str, int, int], None]
"""Called with what is done, how many runs are, and of how many."""


@dataclass(frozen=True)
class Words:
    """What a contestant says of an entry."""

    name: str
    url: str = ""
    commit: str = ""
    note: str = ""
    checkpoints: Mapping[str, Any] = field(default_factory=lambda: {"kind": "retrain"})


def submit(
    paths: Sequence[Path],
    words: Words,
    memory: str = "",
    seeds: Sequence[int] = (),
    protocol: Protocol = PROTOCOL,
    progress: Progress | None = None,
) -> Entry:
    """Evaluate the runs of one agent by the protocol.

    Args:
        paths: run folders, or folders with runs below them.
        words: what the entry says of itself.
        memory: only the runs with this memory; needed where there are several agents.
        seeds: only runs with these seeds of training; all by default.
        protocol: what is played.
        progress: told after every run.

    Returns:
        The entry; nothing is written.

    Raises:
        EntryRefusedError: the runs are several agents, were trained with different numbers of
            frames or on twins other than they are evaluated on, lack a cell, or keep no checkpoint
            of their end.
        ValueError: there is no finished run, or runs may not be compared.
    """
    check_checkpoints(words.checkpoints)
    runs = chosen_runs(find_runs(paths), memory, seeds)
    configs = [TrainConfig.from_dict(run.config) for run in runs]
    _check_group(runs, configs)
    shared, rest = settings_of(configs)
    _check_draft(words, runs, configs, shared, rest, protocol)
    rows = list[BoardRun]()
    played = list[Played]()
    evaluator = Evaluator(protocol)
    order = sorted(range(len(runs)), key=lambda place: _cell_of(configs[place]))
    for done, place in enumerate(order, 1):
        row, result = _evaluated(runs[place], configs[place], rest[place], evaluator)
        rows.append(row)
        played.append(result)
        if progress is not None:
            progress(row.name, done, len(runs))
    entry = _entry(words, configs[0], shared, rows, played, protocol)
    check_protocol(entry, protocol)
    return entry


def _evaluated(
    run: Run, config: TrainConfig, settings: Mapping[str, Any], evaluator: Evaluator
) -> tuple[BoardRun, Played]:
    """One run by the protocol."""
    checkpoint = last_checkpoint(run)
    weights = weights_hash(checkpoint)
    result = evaluator.play(checkpoint, config.observability)
    return _row(run, config, settings, weights, result), result


def _row(
    run: Run, config: TrainConfig, settings: Mapping[str, Any], weights: str, result: Played
) -> BoardRun:
    """What an entry says of a run."""
    return BoardRun(
        game=config.env,
        twin=config.observability,  # type: ignore[arg-type]  # no mixed one passed
        seed=config.seed,
        score=result.score,
        std=result.std,
        returns_sha256=result.returns_sha256,
        weights_sha256=weights,
        seconds=float((run.final or {}).get("seconds", 0.0)),
        settings=settings,
    )


def _check_draft(
    words: Words,
    runs: Sequence[Run],
    configs: Sequence[TrainConfig],
    shared: Mapping[str, Any],
    rest: Sequence[Mapping[str, Any]],
    protocol: Protocol,
) -> None:
    """Refuse what needs no evaluation to be refused: words, a missing cell or checkpoint, as an
    entry in which every score is 0.
    """
    nothing = "0" * 64
    result = Played(0.0, 0.0, 0.0, nothing, 0, 0, OBSERVATIONS)
    rows = list[BoardRun]()
    for run, config, settings in zip(runs, configs, rest, strict=True):
        last_checkpoint(run)
        rows.append(_row(run, config, settings, nothing, result))
    check_protocol(_entry(words, configs[0], shared, rows, [result], protocol), protocol)


def _entry(
    words: Words,
    config: TrainConfig,
    settings: Mapping[str, Any],
    rows: Sequence[BoardRun],
    played: Sequence[Played],
    protocol: Protocol,
) -> Entry:
    """The entry of runs that were evaluated; ``config`` is that of any of them."""
    return Entry(
        protocol=protocol.version,
        name=words.name,
        memory=config.memory,
        algorithm=config.algorithm,
        url=words.url,
        commit=words.commit,
        note=words.note,
        date=datetime.date.today().isoformat(),
        frames=_frames(config),
        parameters=_one_value(played, "parameters"),
        state_bytes=_one_value(played, "state_bytes"),
        checkpoints=dict(words.checkpoints),
        observations={"training": _acting(played), "acting": _acting(played)},
        evaluation={"episodes": protocol.episodes, "seed": protocol.seed},
        environments={"rules": config.rules, "obs_size": config.obs_size},
        made_with=made_with(),
        settings=settings,
        runs=tuple(rows),
    )


def chosen_runs(runs: Runs, memory: str, seeds: Sequence[int]) -> list[Run]:
    """The runs of one memory, of some seeds."""
    chosen = []
    for run in runs.runs:
        fits = not memory or run.config.get("memory") == memory
        if fits and (not seeds or run.seed in seeds):
            chosen.append(run)
    if not chosen:
        memories = sorted({str(run.config.get("memory")) for run in runs.runs})
        raise EntryRefusedError(
            f"no finished run has memory {memory!r} and seeds {list(seeds) or 'of any number'}; "
            f"there are {', '.join(memories)}"
        )
    return chosen


def last_checkpoint(run: Run) -> Path:
    """The checkpoint of the end of a run."""
    frames = int((run.final or {}).get("frames", 0))
    name = checkpoint_name(frames)
    for checkpoint in list_checkpoints(run.path / "checkpoints"):
        if checkpoint.name == name:
            return checkpoint
    raise EntryRefusedError(f"{run.path} has no checkpoint {name}, the one of its end")


def checkpoint_name(frames: int) -> str:
    """The folder of the checkpoint after some frames."""
    return f"frames-{frames:012d}"


def file_name(name: str) -> str:
    """The file of an entry, by its name.

    Example:
        >>> file_name("LRU, preset small, 98,304 frames")
        'lru-preset-small-98-304-frames.json'
    """
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") + ".json"


def _cell_of(config: TrainConfig) -> tuple[str, int, str]:
    return config.env, config.seed, config.observability


def _frames(config: TrainConfig) -> int:
    return config.num_updates * config.learner.frames_per_update


def _one_value(played: Sequence[Played], name: str) -> int:
    """The largest of a size over the games, which are equal but for memories that grow."""
    return int(max(getattr(result, name) for result in played))


def _acting(played: Sequence[Played]) -> list[str]:
    """What any of the agents reads."""
    return sorted({name for result in played for name in result.observations})


def _check_group(runs: Sequence[Run], configs: Sequence[TrainConfig]) -> None:
    """Refuse runs that are not one agent: only the numbers of the learner may go by the game."""
    if len({run.key for run in runs}) > 1:
        names = sorted(Runs(tuple(runs)).names.values())
        raise EntryRefusedError(
            f"the runs are {len(names)} agents, {', '.join(names)}: an entry is one; choose with "
            "--memory"
        )
    first = configs[0]
    by_game = dict[str, TrainConfig]()
    for config in configs:
        if config.observability not in ("full", "partial"):
            raise EntryRefusedError(
                f"privileged observation: {config.env}, seed {config.seed} was trained on "
                f"{config.observability!r} twins, which shows the agent of the POMDP full frames"
            )
        if _frames(config) != _frames(first):
            raise EntryRefusedError(
                f"runs of {_frames(first):,} and {_frames(config):,} frames: an entry has one "
                "number of frames"
            )
        own_game = by_game.setdefault(config.env, config)
        differences = differing_values(own_game, config, FREE | {"observability", "seed"})
        if differences:
            raise EntryRefusedError(
                f"{config.env} was trained with other {', '.join(differences)} on one twin or seed "
                "than on another: settings may go by the game alone"
            )
        free = {"observability", "seed", "env", first.algorithm}
        differences = differing_values(first, config, FREE | free)
        if differences:
            raise EntryRefusedError(
                f"{config.env} was trained with other {', '.join(differences)} than {first.env}: "
                f"only {first.algorithm}.* may go by the game"
            )
