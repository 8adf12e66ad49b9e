"""Training several seeds of one setting in one process; each has a run folder as if it had been trained alone."""

import contextlib
import dataclasses
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from arcade_torch.agents.agent import Agent
from arcade_torch.agents.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoint_frames,
    discard_later,
    list_checkpoints,
    load_checkpoint,
)
from arcade_torch.agents.checks import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.evaluation import make_eval_env
from arcade_torch.agents.files import read_csv
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.lease import LeaseLostError
from arcade_torch.agents.loggers import check_logger
from arcade_torch.agents.loop import Progress, Run, TrainResult, result_from, stop_signals, torch_threads
from arcade_torch.agents.run_folder import RunFolder, RunFolderError
from arcade_torch.agents.seed_trainer import SeedTrainer
from arcade_torch.envs_jax import resolve_id

_MEANS = ("fps", "eval_return", "train_return", "train_return_ewm", "train_return_last", "loss", "epsilon", "lr")


def train_seeds(
    config: TrainConfig,
    seeds: Sequence[int],
    run_dirs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    resume: bool = False,
    progress: Progress | None = None,
    on_evaluation: Callable[[Agent], None] | None = None,
) -> list[TrainResult]:
    """Train several seeds of one setting of PQN together: one batch of environments, one pass, one optimiser.

    Every seed draws, learns and is saved as by :func:`train` alone. The weights differ from those of a run alone by the
    rounding of sums that are taken in another order: at most 1e-5 of their norm in the first updates. Later a tie
    between two actions may fall the other way, and the runs part as two runs on different machines do.

    Each run folder is one of :func:`train`: whatever reads those reads these, and a seed may go on alone. Seeds that
    are finished are left alone; the others go on from the last checkpoint that all of them have.

    Args:
        config: what to train; its seed is not looked at.
        seeds: one a run, all different.
        run_dirs: folders of the runs, or one folder in which they are ``seed0``, ``seed1`` and so on.
        resume: see :func:`train`.
        progress: called after every update with counts of all seeds together (``frames``, ``total_frames``, ``fps``)
            and the mean over the seeds of returns, loss, epsilon and learning rate (None where a seed has none yet).
        on_evaluation: see :func:`train`; called for every seed.

    Returns:
        How they ended, in the order of the seeds.

    Raises:
        ValueError: seeds that are out of range or given twice, another algorithm than PQN, the logger wandb,
            ``compile`` or ``cuda_graphs``, a game, memory model or network that does not exist, or a memory model that
            does not run under ``torch.vmap``. Nothing was changed.
        RunFolderError: see :func:`train`.
        CheckpointError: ``resume`` found no moment at which all seeds have a whole checkpoint.
        NonFiniteError: see :func:`train`; names the seed. All seeds stop, and can go on alone.
    """
    _check(config, seeds)
    config = dataclasses.replace(config, env=resolve_id(config.env))
    folders = [RunFolder(path) for path in _paths(run_dirs, seeds)]
    configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
    for folder, each in zip(folders, configs, strict=True):
        folder.check(each, resume)
    check_logger(config.logger)
    todo = [index for index, folder in enumerate(folders) if folder.finished() is None]
    if todo:
        with torch_threads(config.threads):
            trainer = SeedTrainer(config, [seeds[index] for index in todo])
            try:
                lanes = zip(todo, trainer.lanes, strict=True)
                runs = [Run(configs[index], folders[index], lane, None, on_evaluation) for index, lane in lanes]
                ended = dict(zip(todo, _go(trainer, runs, progress), strict=True))
            finally:
                trainer.close()
    else:
        ended = {}
    return [ended[index] if index in ended else _finished(folder) for index, folder in enumerate(folders)]


def _check(config: TrainConfig, seeds: Sequence[int]) -> None:
    """Refuse what cannot be trained together."""
    require(len(seeds) >= 1, "seeds", list(seeds), "at least one seed")
    whole = all(isinstance(seed, int) and not isinstance(seed, bool) for seed in seeds)
    require(whole, "seeds", list(seeds), "whole numbers")
    require(len(set(seeds)) == len(seeds), "seeds", list(seeds), "all different")
    require(config.algorithm == "pqn", "algorithm", config.algorithm, "'pqn' for several seeds in one process")
    require(config.logger != "wandb", "logger", config.logger, "'none' or 'tensorboard' for several seeds")
    for name in ("compile", "cuda_graphs"):
        value = getattr(config, name)
        require(not value, name, value, "false for several seeds in one process")


def _paths(run_dirs: Any, seeds: Sequence[int]) -> list[Path]:
    if isinstance(run_dirs, str | os.PathLike):
        return [Path(run_dirs) / f"seed{seed}" for seed in seeds]
    paths = [Path(path) for path in run_dirs]
    require(len(paths) == len(seeds), "run_dirs", list(map(str, paths)), f"a folder for each of {len(seeds)} seeds")
    different = len({path.absolute() for path in paths}) == len(paths)
    require(different, "run_dirs", list(map(str, paths)), "all different")
    return paths


def _finished(folder: RunFolder) -> TrainResult:
    result = folder.finished()
    assert result is not None
    return result_from(folder.path, result)


def _go(trainer: SeedTrainer, runs: list[Run], progress: Progress | None) -> list[TrainResult]:
    """Move all runs to the end, or to the first signal."""
    with contextlib.ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.folder.claim(run.config))
            if run.folder.finished() is not None:
                raise RunFolderError(f"{run.folder.path} was finished by another process just now: start again")
        _start(trainer, runs)
        eval_env = make_eval_env(trainer.config, trainer.config.eval_episodes)  # every evaluation begins it afresh
        for run in runs:
            run.eval_env = eval_env
            stack.enter_context(run.logs())
        try:
            with stop_signals() as stopped:
                while not trainer.done and not stopped():
                    trainer.update()
                    for run in runs:
                        run.update()
                    if progress is not None:
                        progress(_together(runs))
            for run in runs:
                run.save()  # all, before the first is finished
            return [run.end() for run in runs]
        except BaseException as error:
            for run in runs:
                with contextlib.suppress(LeaseLostError):
                    run.failed(error)
            if isinstance(error, NonFiniteError):
                raise NonFiniteError(f"{error}; {runs[0].last_good()}, and so with the other seeds") from error
            raise


def _start(trainer: SeedTrainer, runs: list[Run]) -> None:
    """From the newest moment at which all have a whole checkpoint, or from the beginning."""
    saved = [{checkpoint_frames(path): path for path in list_checkpoints(run.folder.checkpoints)} for run in runs]
    common = sorted(set.intersection(*map(set, saved)), reverse=True)
    problems: list[str] = []
    for frames in common:
        try:
            found = [load_checkpoint(own[frames], run.config) for own, run in zip(saved, runs, strict=True)]
            _load(trainer, found)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(f"{'; '.join(problems)}; going on from frame {frames}", RuntimeWarning, stacklevel=4)
        for run in runs:
            discard_later(run.folder.checkpoints, frames)
            run.saved_at = frames
        return
    if problems or not _begun_together(runs, saved):
        at = ", ".join(f"seed {r.config.seed} at {sorted(own) or 'none'}" for r, own in zip(runs, saved, strict=True))
        why = "".join(f"; {problem}" for problem in problems)
        raise CheckpointError(f"no frame has a whole checkpoint of every seed ({at}), resume them one by one{why}")
    for run in runs:
        discard_later(run.folder.checkpoints, 0)
    trainer.warm_up()


def _begun_together(runs: list[Run], saved: Sequence[Mapping[int, Path]]) -> bool:
    """Whether nothing is lost but the way to the first checkpoint: none has one, or the group was killed in between
    the first checkpoint of one seed and that of another.
    """
    newest = max((frames for own in saved for frames in own), default=0)
    if newest == 0:
        return True
    if min(map(len, saved)) > 0 or max(map(len, saved)) > 1:
        return False
    return all(_reached(run) >= newest - run.config.learner.frames_per_update for run in runs)


def _reached(run: Run) -> int:
    """Frames of the last row of ``metrics.csv``; 0 without one."""
    file = run.folder.path / "metrics.csv"
    rows = read_csv(file) if file.is_file() else []
    return int(rows[-1]["frames"]) if rows else 0


def _load(trainer: SeedTrainer, found: list[Checkpoint]) -> None:
    where = found[0].path
    try:
        trainer.load([each.weights for each in found], [each.trainer or {} for each in found])
        whole = all(lane.frames == each.frames for lane, each in zip(trainer.lanes, found, strict=True))
    except Exception as error:  # whatever a damaged state leads to, it is not to be used
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise CheckpointError(f"the states beside {where} do not fit together: {reason}") from error
    if not whole:
        raise CheckpointError(f"the states beside {where} are not of its frame")


def _together(runs: list[Run]) -> dict[str, Any]:
    """One row for all seeds: their counts added up, the rest averaged."""
    rows: list[Mapping[str, Any]] = [run.trainer.row | {"eval_return": run.last_eval} for run in runs]
    row: dict[str, Any] = {}
    for name in _MEANS:
        values = [each.get(name) for each in rows]
        row[name] = None if None in values else sum(values) / len(values)  # type: ignore[arg-type]
    frames, total = sum(each["frames"] for each in rows), sum(run.trainer.total_frames for run in runs)
    return row | {"frames": frames, "total_frames": total, "updates": rows[0]["updates"]}
