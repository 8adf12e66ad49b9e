"""Run a study: skip what is finished, resume what was interrupted, keep what others did when one
fails.
"""

import contextlib
import errno
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import write_json
from arcade_torch.tools.errors import is_told
from arcade_torch.tools.machine import available_cores
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.runs import Run
from arcade_torch.tools.studies.engines import Engine, Inline, Job, Ray, RayOptions
from arcade_torch.tools.studies.folder import Row, StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study
from arcade_torch.tools.studies.processes import Processes
from arcade_torch.tools.studies.shards import part_of
from arcade_torch.tools.text import warn

LOOK_EVERY_S = 0.5
"""The display is drawn this often, or less often where a look at all runs takes long."""
LEAST_FREE_BYTES = 1 << 20
"""A run that fails with less space than this on the disk failed for want of space."""
SHARE = 0.02
"""Share of the time that looking at all runs, and writing their table, may take."""


class DiskFullError(RuntimeError):
    """There is no space left; what is finished is kept, what is not goes on from its last
    checkpoint.
    """


@dataclass(frozen=True)
class StudyResult:
    """Where a study stands after an invocation."""

    root: Path
    rows: list[dict[str, Any]]  # of ``results.csv``
    # run name -> one line with the reason and the log, for runs that failed in this invocation
    errors: dict[str, str]

    @property
    def finished(self) -> int:
        """Number of finished runs."""
        return Counter(row["status"] for row in self.rows)["finished"]


class Pace:
    """Does, not too often, what costs more the larger a study is.

    It rests after each piece of work, fifty times as long as that took, and ``least_s`` at least.

    Args:
        least_s: shortest rest, seconds.
        clock: gives the time in seconds.
    """

    def __init__(self, least_s: float = 0.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._least_s = least_s
        self._clock = clock
        self._next_s = clock()

    @property
    def rest_s(self) -> float:
        """Seconds until the next piece of work is due; 0 if it is."""
        return max(0.0, self._next_s - self._clock())

    def work(self, task: Callable[[], object]) -> None:
        """Do a piece of work, and rest."""
        start_s = self._clock()
        task()
        end_s = self._clock()
        self._next_s = end_s + max(self._least_s, (end_s - start_s) / SHARE)


def study(
    plan_or_file: Study | str | Path,
    out: str | Path,
    engine: Engine | str = "auto",
    workers: int = 0,
    command: str = "",
    stream: Any = None,
    shard: str = "",
) -> StudyResult:
    """Carry out a study, or go on with it.

    Finished runs are skipped, interrupted ones resumed from their last checkpoint, failed ones
    tried again.

    Args:
        plan_or_file: a study or the path of its TOML file.
        out: folder of the study; made if it is missing, continued if it holds this study.
        engine: where the runs are carried out: ``auto``, ``inline``, ``processes``, ``ray`` or an
            object with a method ``run``.
        workers: how many runs at once, 0 for one a core.
        command: how the user started this, kept in ``study.json``.
        stream: where progress is shown, stderr by default.
        shard: ``3/10`` carries out every tenth run from the third on; others, in the same folder,
            the other runs.

    Returns:
        The rows of ``results.csv`` and the errors of this invocation.

    Raises:
        FileNotFoundError: there is no such file.
        FileExistsError: ``out`` holds something else.
        ValueError: the study names a game, memory model or setting that does not exist, or is no
            study.
        DiskFullError: there is no space left for results; what is finished is kept.
    """
    file = None if isinstance(plan_or_file, Study) else plan_or_file
    definition = plan_or_file if isinstance(plan_or_file, Study) else Study.load(plan_or_file)
    engine = make_engine(engine, workers) if isinstance(engine, str) else engine
    plan = planned(definition, shard, file)
    engine = fit_threads(engine, plan.values())
    folder = StudyFolder(Path(out))
    try:
        folder.claim(definition, command)
        results = Results(folder, definition)
        results.write()
        jobs = {run: folder.job(run) for run in plan if folder.run(run).final is None}
        for run, job in jobs.items():
            write_json(job.config, plan[run].to_dict())
        errors = dict[str, str]()
        if jobs:
            errors = _carry_out(results, list(plan), list(jobs.values()), engine, stream)
        return StudyResult(folder.root, results.write(), errors)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFullError(
            f"{error.strerror}: {error.filename or 'the study'}; make room and start again"
        ) from error


def make_engine(name: str, workers: int = 0, ray: RayOptions | None = None) -> Engine:
    """An engine by its name; ``auto`` takes processes where there is more than one core."""
    require(workers >= 0, "workers", workers, "at least 1, or 0 for as many as there is room for")
    of_ray = vars(ray or RayOptions())
    if name == "ray":
        return Ray(**of_ray, workers=workers)
    for option, value in of_ray.items():
        if value != getattr(RayOptions, option):
            raise ValueError(
                f"--{option.replace('_', '-')} is for --engine ray, and the engine is {name}"
            )
    if name == "processes" or (name == "auto" and len(available_cores()) > 1):
        return Processes(workers)
    if name in ("auto", "inline"):
        return Inline()
    raise ValueError(f"unknown engine {name!r}: allowed are auto, inline, processes, ray")


def fit_threads(engine: Engine, configs: Iterable[TrainConfig]) -> Engine:
    """An engine with room for the threads of its runs: of processes as many as have their cores,
    where the user names no number; on Ray a line says what would give them room.
    """
    threads = max((config.threads or 1 for config in configs), default=1)
    if isinstance(engine, Processes) and not engine.workers and threads > 1:
        return replace(engine, workers=max(1, len(available_cores()) // threads))
    if isinstance(engine, Ray) and engine.cpus_per_run < threads:
        warn(
            f"a run has {threads} threads and Ray gives it {engine.cpus_per_run:g} cores: "
            f"--cpus-per-run {threads} gives it as many"
        )
    return engine


def planned(
    plan: Study, shard: str = "", file: str | Path | None = None
) -> dict[RunSpec, TrainConfig]:
    """The runs of a study with their configs, of shard ``3/10`` every tenth run from the third, and
    all checked; what is refused names the file that the study stands in, if there is one.
    """
    part, parts = part_of(shard)
    try:
        _check_names(plan)
        configs = plan.configs(plan.runs()[part - 1 :: parts])
        _check_options(configs.values())
    except (TypeError, ValueError) as error:
        if file is None or not is_told(error):
            raise
        raise ValueError(f"{file}: {error}") from error
    return configs


def _check_options(configs: Iterable[TrainConfig]) -> None:
    """Refuse options of games, networks and memories that each run would refuse when it begins."""
    from arcade_torch.agents.policy import check_network
    from arcade_torch.envs_jax import make

    games = set[str]()
    networks = set[str]()
    for config in configs:
        of_game: dict[str, Any] = {
            "obs_size": config.obs_size,
            "rules": config.rules,
            **config.env_options,
        }
        game = repr((config.env, of_game))
        if game not in games:
            make(config.env, **of_game)
            games.add(game)
        parts = (config.network, config.network_options, config.memory, config.algorithm)
        network = repr((parts, config.obs_size))
        if network not in networks:
            check_network(config)
            networks.add(network)


def _check_names(plan: Study) -> None:
    """Refuse games and memories that do not exist, or stand there twice by two names, and an
    untrained baseline.
    """
    from arcade_torch.envs_jax import make, resolve_id
    from arcade_torch.models import make_memory, memory_names
    from arcade_torch.models.registry import ALIASES

    games = dict[str, str]()
    memories = dict[str, str]()
    for game in plan.games:
        make(game)
        bare = resolve_id(game).rpartition("-v")[0]
        first = games.setdefault(bare, game)
        if first != game:
            raise ValueError(f"games = {first}, {game} are one game: give it once, in one version")
    for memory in plan.memories:
        if memory not in (*memory_names(), "feedforward"):
            make_memory(memory, 1, 1)  # refuses it
        first = memories.setdefault(ALIASES.get(memory, memory), memory)
        if first != memory:
            raise ValueError(f"memories = {first}, {memory} are one memory model: give it once")
    if plan.baseline != Study.baseline:
        plan.require_baseline()
    plan.require_subject()


class Results:
    """The tables of a study while it goes on, which cost little however many runs it has."""

    def __init__(self, folder: StudyFolder, study: Study) -> None:
        self.folder = folder
        self.study = study
        self._finished = dict[RunSpec, Row]()
        self._pace = Pace()

    def write(self) -> list[Row]:
        """Write them."""
        return self.folder.write_results(self.study, self._finished)

    def write_if_due(self) -> None:
        """Write them, unless that has taken much of the time lately."""
        if not self._pace.rest_s:
            self._pace.work(self.write)


def _carry_out(
    results: Results, plan: list[RunSpec], jobs: list[Job], engine: Engine, stream: Any
) -> dict[str, str]:
    """Run the jobs and watch them; the tables are written in the end too, whatever ends it."""
    try:
        return _watch(results, plan, jobs, engine, stream)
    except BaseException:
        with contextlib.suppress(OSError):  # a full disk, which is told already
            results.write()
        raise


def _watch(
    results: Results, plan: list[RunSpec], jobs: list[Job], engine: Engine, stream: Any
) -> dict[str, str]:
    folder = results.folder
    runs = {run.name: run for run in plan}
    errors = dict[str, str]()
    ended = set(runs) - {job.name for job in jobs}
    folders = {name: folder.run(run) for name, run in runs.items()}
    bars = progress_bars(results.study.name, folders, ended, stream)
    with bars as note, contextlib.closing(engine.run(jobs)) as ends:  # type: ignore[type-var]
        if ended:
            note(f"{len(ended)} of {len(runs)} runs are finished already")
        for name, error in ends:
            run = runs[name]
            ended.add(name)
            # a process killed after its last word has done its work
            if folder.run(run).final is not None:
                error = ""
            else:
                error = error or "ended without a final evaluation"
                errors[name] = f"{error} (log: {folder.job(run).log})"
                note(f"{name} failed: {errors[name]}")
            folder.note_failure(run, error)
            results.write_if_due()
            if error and (
                "No space left" in error or shutil.disk_usage(folder.root).free < LEAST_FREE_BYTES
            ):
                raise DiskFullError(
                    f"the disk with {folder.root} is full ({error}); make room and start it again"
                )
    return _still_failed(folder, runs, errors)


def _still_failed(
    folder: StudyFolder, runs: Mapping[str, RunSpec], errors: Mapping[str, str]
) -> dict[str, str]:
    """The errors without those of runs that another process, which trained them, has finished."""
    left = dict[str, str]()
    for name, error in errors.items():
        if folder.run(runs[name]).final is None:
            left[name] = error
        else:
            folder.note_failure(runs[name], "")
    return left


@contextlib.contextmanager
def progress_bars(
    title: str, runs: Mapping[str, Run], ended: set[str], stream: Any
) -> Iterator[Callable[[str], None]]:
    """Show how far a study is, from the ``progress.json`` of its runs, a bar for all and one for
    each run at work.

    ``ended`` holds the names of the runs that have ended; the caller adds to it. Gives a function
    that prints a line.
    """
    stop = threading.Event()
    with Bars(stream, "frames", first_line_s=3.0) as bars:
        kept = dict[str, tuple[int, int, str]]()
        pace = Pace(LOOK_EVERY_S)

        def look() -> None:
            show_progress(bars, title, runs, ended, kept)

        def loop() -> None:
            while not stop.wait(pace.rest_s):
                pace.work(look)

        thread = threading.Thread(target=loop, daemon=True, name="study-progress")
        thread.start()
        try:
            yield lambda text: bars.note(f"{title}: {text}")
        finally:
            stop.set()
            thread.join()
            look()


def show_progress(
    bars: Bars,
    title: str,
    runs: Mapping[str, Run],
    ended: set[str],
    kept: dict[str, tuple[int, int, str]] | None = None,
) -> None:
    """Read the folders of all runs and draw the bars; ``kept`` gathers what those that have ended
    said at last.
    """
    kept = {} if kept is None else kept
    seen = dict[str, tuple[int, int, str]]()
    for name, run in runs.items():
        has_ended = name in ended  # before it is read: what is read after the end stays as it is
        seen[name] = kept.get(name) or run.progress()
        if has_ended:
            kept[name] = seen[name]
    totals = [total for _, total, _ in seen.values() if total]
    usual = totals[0] if totals else 0  # of a run that has not begun
    all_done = 0
    all_frames = 0
    for name, (done, total, status) in seen.items():
        total = total or usual
        done = total if status == "finished" else min(done, total)
        all_done += done
        all_frames += total
        bar = f"  {name.replace('__', ' ')}"
        if bars.terminal and status == "running" and name not in ended:
            bars.update(bar, done, total)
        else:
            bars.remove(bar)
    bars.update(title, all_done, all_frames, f"{len(ended)}/{len(runs)} runs")
