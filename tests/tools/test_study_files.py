"""Files of a study and of an analysis that somebody else made: nothing is waited for, nothing
outside is written.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools.files import cached_arrays
from arcade_torch.tools.studies import engines
from arcade_torch.tools.studies.engines import Job, carry_out
from arcade_torch.tools.studies.grid import MOST_BYTES, Study
from arcade_torch.tools.studies.processes import end_of_worker


def job(folder: Path) -> Job:
    return Job(
        "run", folder / "configs" / "run.json", folder / "runs" / "run", folder / "logs" / "run.log"
    )


@pytest.mark.timeout(20)
def test_a_log_that_is_a_pipe_or_a_link_is_refused(tmp_path: Path) -> None:
    """Before: a pipe was waited for, for ever, and a link was followed."""
    outside = tmp_path / "outside"
    outside.write_text("mine")
    log = job(tmp_path).log
    log.parent.mkdir()
    log.symlink_to(outside)
    with pytest.raises(ValueError, match=r"run.log is not a regular file"):
        job(tmp_path).add_to_log("text")
    assert outside.read_text() == "mine"
    log.unlink()
    os.mkfifo(log)
    with pytest.raises(ValueError, match=r"run.log is not a regular file"):
        job(tmp_path).add_to_log("text")
    assert end_of_worker(1, log) == "exit code 1"
    log.unlink()
    assert end_of_worker(1, log) == "exit code 1"
    job(tmp_path).add_to_log("one\narcade-torch: last\n")
    assert end_of_worker(1, log) == "last"
    assert end_of_worker(-9, log) == "ended by signal 9; its log ends with: last"


CLAIM = """
import sys
from pathlib import Path
from arcade_torch.tools.studies.folder import StudyFolder
from tests.tools.fabricated import small_study
plan = small_study(total_frames=int(sys.argv[2]))
StudyFolder(Path(sys.argv[1] + sys.argv[2])).claim(plan)  # all that is slow the first time
print("ready", flush=True)
sys.stdin.readline()
try:
    StudyFolder(Path(sys.argv[1])).claim(plan)
    print("begun")
except FileExistsError as error:
    print(error)
"""


def test_of_two_studies_that_begin_at_once_in_one_folder_the_second_is_refused(
    tmp_path: Path,
) -> None:
    """Before: both began, and the configs of one took the place of the other's."""
    words = [sys.executable, "-c", CLAIM, str(tmp_path / "study")]
    both = []
    for frames in ("2048", "4096"):
        both.append(
            subprocess.Popen(
                [*words, frames], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        )
    for process in both:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in both:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    said = sorted(process.communicate()[0] for process in both)
    assert "holds study 'toy' with total_frames" in said[0] and said[1] == "begun\n"


class Returned:
    """A Ray whose task gives back some files."""

    class exceptions:
        RayError = ConnectionError

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = files

    def get(self, reference: object) -> tuple[str, str, dict[str, bytes]]:
        return "", "", self.files


@pytest.mark.parametrize(
    "name", ["../evil", "../../evil", "a/../../evil", "{outside}/evil", "", ".", "a\0b"]
)
def test_files_that_travel_back_stay_in_the_folder_of_their_run(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "study"
    returned: Any = Returned({"eval.json": b"{}", name.format(outside=tmp_path): b"x"})
    result = engines._result(returned, None, job(folder))
    assert "which is no file of a run" in result.error
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_the_final_evaluation_is_there_only_if_all_that_travelled_with_it_is(
    tmp_path: Path,
) -> None:
    (job(tmp_path).folder / "metrics.csv").mkdir(parents=True)  # so that no file can be written
    returned: Any = Returned({"eval.json": b"{}", "metrics.csv": b"frames"})
    with pytest.raises(OSError):
        engines._result(returned, None, job(tmp_path))
    assert not (job(tmp_path).folder / "eval.json").exists()


def test_runs_of_two_studies_on_one_machine_are_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They may have equal names and configs."""
    monkeypatch.setattr(engines.tempfile, "gettempdir", lambda: str(tmp_path / "disk"))
    folders = []

    def attempt(self: Job) -> tuple[str, str]:
        folders.append(self.folder)
        return "no luck", ""

    monkeypatch.setattr(Job, "attempt", attempt)
    for study in ("one", "other", "one"):
        carry_out(job(tmp_path / study), b"{}")
    assert folders[0] == folders[2] != folders[1]


def test_files_do_not_travel_back_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    run = job(tmp_path).folder
    run.mkdir(parents=True)
    (run / "tensorboard").symlink_to(tmp_path / "outside")
    returned: Any = Returned({"tensorboard/events": b"x"})
    assert "which is no file of a run" in engines._result(returned, None, job(tmp_path)).error
    assert list((tmp_path / "outside").iterdir()) == []


@pytest.mark.timeout(30)
def test_only_regular_files_travel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipe in the folder of a run, and a link to a file of the machine, are left where they
    are.
    """
    monkeypatch.setattr(engines.tempfile, "gettempdir", lambda: str(tmp_path))
    secret = tmp_path / "secret"
    secret.write_text("mine")

    def attempt(self: Job) -> tuple[str, str]:
        self.folder.mkdir(parents=True)
        os.mkfifo(self.folder / "pipe")
        (self.folder / "link").symlink_to(secret)
        (self.folder / "eval.json").write_text("{}")
        return "", ""

    monkeypatch.setattr(Job, "attempt", attempt)
    _, _, files = carry_out(job(tmp_path / "absent"), b"{}")
    assert files == {"eval.json": b"{}"}


@pytest.mark.timeout(20)
def test_a_study_is_a_regular_file_of_a_sensible_size(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    os.mkfifo(path)
    with pytest.raises(ValueError, match="not a regular file"):
        Study.load(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ValueError, match="not a regular file"):
        Study.load(path)
    path.unlink()
    path.write_bytes(b"#" * (MOST_BYTES + 1))
    with pytest.raises(ValueError, match="bytes, at most 131,072 are read"):
        Study.load(path)
    path.write_text("a = " + "[" * 100_000)
    with pytest.raises(ValueError, match="is not TOML"):
        Study.load(path)
    path.write_text(".".join(["a"] * 60_000) + " = 1")
    with pytest.raises(ValueError, match="more than 1,000 dots"):
        Study.load(path)


def test_an_analysis_writes_behind_no_link(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    (run / "analysis").symlink_to(tmp_path / "outside")
    arrays = cached_arrays(run, "measure", {"a": 1}, lambda: {"x": np.zeros(2)})
    assert arrays["x"].sum() == 0 and list((tmp_path / "outside").iterdir()) == []
