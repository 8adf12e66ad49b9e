"""Several processes at one study: the runs are shared out, and those of the lost are taken over."""

import errno
import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from arcade_torch.tools.studies.engines import JobResult, Jobs
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from arcade_torch.tools.studies.presets import STUDY_PRESETS, study_preset, total_frames
from arcade_torch.tools.studies.queue import RunQueue
from arcade_torch.tools.studies.runner import DiskFullError, StudyResult, check_names, study
from tests.tools.fabricated import small_study, write_run


class Slow:
    """An engine that fabricates runs and waits where there is nothing to do."""

    def __init__(self, what: Study, error: str = "") -> None:
        self.runs, self.error, self.done = {run.name: run for run in what.runs()}, error, list[str]()

    def run(self, jobs: Jobs) -> Iterator[JobResult]:
        for job in jobs:
            time.sleep(0.01)
            if job is None:
                continue
            assert job.folder is not None
            self.done.append(job.name)
            if not self.error:
                write_run(job.folder, self.runs[job.name], 0.5)
            yield JobResult(job.name, int(bool(self.error)), self.error)


def queue_of(what: Study, folder: StudyFolder, others: "list[tuple[str, str]] | None" = None) -> RunQueue:
    return RunQueue(what, folder, lambda name, error: None if others is None else others.append((name, error)))


@pytest.fixture(autouse=True)
def _look_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arcade_torch.tools.studies.queue.LOOK_AGAIN_S", 0.0)


def test_two_studies_at_once_do_every_run_once_and_both_know_all_results(tmp_path: Path) -> None:
    what = small_study(seeds=4)
    engines, results = [Slow(what), Slow(what)], list[StudyResult]()
    threads = [
        threading.Thread(target=lambda e=engine: results.append(study(what, tmp_path / "s", e, stream=io.StringIO())))
        for engine in engines
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(engines[0].done + engines[1].done) == sorted(run.name for run in what.runs())
    assert [result.finished for result in results] == [16, 16]


def test_runs_in_other_hands_are_waited_for(tmp_path: Path) -> None:
    what, folder, others = small_study(seeds=1), StudyFolder(tmp_path / "s"), list[tuple[str, str]]()
    first, second = queue_of(what, folder), queue_of(what, folder, others)
    mine = [next(first) for _ in range(3)]
    theirs = next(second)
    assert theirs is not None and theirs.name not in {job.name for job in mine if job}
    assert next(second) is None and next(first) is None
    job = mine[0]
    assert job is not None and job.folder is not None
    write_run(job.folder, what.runs()[0], 0.5)
    first.done(job.name)
    assert next(second) is None and others == [(job.name, "")]
    first.close()  # as a lost owner would
    taken = next(second)
    assert taken is not None and taken.name in {job.name for job in mine if job}


def test_a_run_that_is_still_being_trained_is_not_started(tmp_path: Path) -> None:
    what, folder = small_study(seeds=1, memories=["mlp"], observability=["full"]), StudyFolder(tmp_path / "s")
    lock = folder.training(what.runs()[0])  # a worker whose study was killed saves and stops a little later
    assert lock.try_take()
    queue = queue_of(what, folder)
    assert next(queue) is None
    lock.release()
    assert next(queue) is not None


def test_what_fails_for_one_is_not_tried_by_the_other_at_once_but_the_next_time(tmp_path: Path) -> None:
    what, folder, others = small_study(seeds=1), StudyFolder(tmp_path / "s"), list[tuple[str, str]]()
    first, second = queue_of(what, folder), queue_of(what, folder, others)
    job = next(first)
    assert job is not None
    first.done(job.name, "no luck")
    names = [other.name for other in (next(second) for _ in range(3)) if other]
    assert job.name not in names and others == [(job.name, "no luck")]
    second.close()
    assert job.name in queue_of(what, folder).names
    row = next(row for row in folder.write_results(what) if row["run"] == job.name)
    assert (row["status"], row["error"]) == ("failed", "no luck")


def test_a_process_that_died_after_its_run_was_finished_has_not_failed(tmp_path: Path) -> None:
    class Late(Slow):
        def run(self, jobs: Jobs) -> Iterator[JobResult]:
            for result in super().run(jobs):
                yield JobResult(result.name, -9, "ended by signal 9")

    what = small_study()
    result = study(what, tmp_path / "s", Late(what), stream=io.StringIO())
    assert result.errors == {} and result.finished == 8


def test_a_full_disk_stops_the_study_with_one_line_instead_of_failing_every_run(tmp_path: Path) -> None:
    what = small_study()
    engine = Slow(what, error="internal error: OSError: [Errno 28] No space left on device")
    with pytest.raises(DiskFullError, match="make room"):
        study(what, tmp_path / "s", engine, stream=io.StringIO())
    assert len(engine.done) == 1
    assert not list((tmp_path / "s").glob("locks/*/owner*"))
    again = Slow(what)
    assert study(what, tmp_path / "s", again, stream=io.StringIO()).finished == 8


def test_a_disk_that_is_full_for_the_study_itself_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "results.csv")

    monkeypatch.setattr("arcade_torch.tools.studies.folder.write_csv", full)
    with pytest.raises(DiskFullError, match=r"No space left on device: results.csv"):
        study(small_study(), tmp_path / "s", Slow(small_study()), stream=io.StringIO())


@pytest.mark.parametrize(("name", "runs", "frames"), [
    ("demo", 16, 16 * 98_304),
    ("paper-easy", 800, None),
    ("paper", 2400, None),
    ("size-sweep", 2 * 2 * 3 * (3 * 5 + 1), None),
])  # fmt: skip
def test_ready_made_studies_name_what_exists(name: str, runs: int, frames: int | None) -> None:
    what = study_preset(name)
    check_names(what)
    assert name in STUDY_PRESETS and what.name == name and len(what.runs()) == runs
    if frames is not None:
        assert total_frames(what) == frames
