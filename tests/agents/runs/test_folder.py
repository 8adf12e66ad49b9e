"""A run folder has one trainer at a time, and says in one line why it cannot be used."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.folder import LOCK, RunFolder, RunFolderError, wait_until_free

ROOT = Path(__file__).resolve().parents[3]
CONFIG = preset("smoke")


def test_a_run_folder_has_one_trainer(tmp_path: Path) -> None:
    other = RunFolder(tmp_path / "run")
    with RunFolder(tmp_path / "run").claim(CONFIG):
        other.check(CONFIG, resume=True)
        with pytest.raises(
            RunFolderError, match=r"another process trains in .*run: wait for it, or stop it"
        ):
            other.claim(CONFIG).__enter__()
    with other.claim(CONFIG):
        pass
    assert sorted(path.name for path in other.path.iterdir()) == ["config.json", LOCK]


def test_counting_under_the_lock_loses_no_count(tmp_path: Path) -> None:
    count = tmp_path / "count"
    count.write_text("0")

    def work() -> None:
        done = 0
        while done < 25:
            try:
                with RunFolder(tmp_path / "run").claim(CONFIG):
                    count.write_text(str(int(count.read_text()) + 1))
                done += 1
            except RunFolderError:
                continue

    threads = [threading.Thread(target=work, daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert count.read_text() == "100"


def test_a_killed_process_frees_the_folder_at_once_and_what_it_left_half_written_is_removed(
    tmp_path: Path,
) -> None:
    folder = RunFolder(tmp_path / "run")
    code = (
        "import sys; from pathlib import Path; from arcade_torch.agents import preset\n"
        "from arcade_torch.agents.runs.folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).claim(preset('smoke')): print('claimed', flush=True), sys.stdin.read()"
    )
    words = [sys.executable, "-c", code, str(folder.path)]
    with subprocess.Popen(
        words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "claimed\n"
        with pytest.raises(RunFolderError, match="another process trains in"):
            folder.claim(CONFIG).__enter__()
        draft = ".progress.json.123-0123abcd.draft"
        (folder.path / draft).write_text("{")
        (folder.path / ".mine.123").write_text("the user's own")
        (folder.path / ".mine.124-0123abcd.draft").mkdir()
        (folder.checkpoints / ".frames-000000000064.123").mkdir(parents=True)
        folder.replay.mkdir()
        for name in (
            "window-000000000.safetensors",
            ".window-000000001.safetensors.7-0123abcd.draft",
        ):
            (folder.replay / name).write_text("frames")
        process.kill()
    with folder.claim(CONFIG):
        left = sorted(path.name for path in folder.path.rglob("*"))
        kept = [".mine.123", ".mine.124-0123abcd.draft"]
        assert left == [
            *kept,
            "checkpoints",
            "config.json",
            LOCK,
            "replay",
            "window-000000000.safetensors",
        ]


def test_a_run_remembers_the_imports_it_goes_on_with_and_how_it_began(tmp_path: Path) -> None:
    old = [{"name": "mine.py", "sha256": "0" * 64}]
    new = [{"name": "mine.py", "sha256": "1" * 64}]
    records = []
    for imports in (old, new, []):
        with RunFolder(tmp_path, imports).claim(CONFIG):
            records.append(json.loads((tmp_path / "config.json").read_text()))
    assert records[0]["imports"] == old
    assert records[1] == records[2] == records[0] | {"imports": new}


def test_progress_is_written_once_a_second_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(tmp_path)
    with folder.claim(CONFIG), monkeypatch.context() as patch:
        written = []
        for now_s, status in ((9.0, "running"), (9.9, "running"), (10.1, "running")):
            patch.setattr(time, "monotonic", lambda now_s=now_s: now_s)
            folder.report(int(10 * now_s), 192, status)
            written.append(json.loads((tmp_path / "progress.json").read_text())["frames"])
        folder.report(192, 192, "finished")
    assert written == [90, 90, 101]
    assert json.loads((tmp_path / "progress.json").read_text())["status"] == "finished"


def test_a_final_evaluation_without_a_count_of_frames_is_made_again(tmp_path: Path) -> None:
    final = {"status": "finished", "seconds": 1.0, "mean": 0.5, "train_max_ewm": None}
    final |= {"returns": [0.5], "lengths": [3]}
    for frames, is_finished in ((64, True), (None, False)):
        (tmp_path / "eval.json").write_text(json.dumps(final | {"frames": frames}))
        assert (RunFolder(tmp_path).finished() is not None) == is_finished


def test_a_lock_alone_does_not_make_a_folder_taken(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()
    RunFolder(tmp_path).check(CONFIG, resume=False)


def test_an_error_of_the_training_frees_the_folder_and_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="the disk is full"), RunFolder(tmp_path).claim(CONFIG):
        raise OSError("the disk is full")
    with RunFolder(tmp_path).claim(CONFIG):
        pass


@pytest.mark.parametrize("without", ["format", None])
def test_a_run_of_version_0_1_is_refused_in_one_line_and_left_alone(
    tmp_path: Path, without: str | None
) -> None:
    with RunFolder(tmp_path).claim(CONFIG):
        pass
    file = tmp_path / "config.json"
    old = json.loads(file.read_text()) | {"format": 1}
    old["config"]["pqn"]["epsilon_share"] = 0.25  # a name of then
    old.pop(without, None)
    file.write_text(json.dumps(old))
    said = "was made by arcade-torch 0.1; this version reads format 2: train it again, or use the version that made it"
    for use in (
        lambda run: run.check(CONFIG, resume=True),
        lambda run: run.claim(CONFIG).__enter__(),
    ):
        with pytest.raises(RunFolderError) as refused:
            use(RunFolder(tmp_path))
        assert str(refused.value) == f"the run in {tmp_path} {said}"
    assert json.loads(file.read_text()) == old


def test_a_lock_that_cannot_be_made_is_an_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "run" / LOCK).mkdir(parents=True)
    with pytest.raises(RunFolderError, match=r"cannot write to .*run: Is a directory"):
        RunFolder(tmp_path / "run").claim(CONFIG).__enter__()
    assert os.listdir(tmp_path / "run") == [LOCK]


def test_waiting_ends_when_the_other_process_has_stopped_or_the_time_is_over(
    tmp_path: Path,
) -> None:
    wait_until_free(tmp_path / "absent", 60)
    with RunFolder(tmp_path).claim(CONFIG):
        waiting = threading.Thread(target=wait_until_free, args=(tmp_path, 60.0), daemon=True)
        waiting.start()
        wait_until_free(tmp_path, 0.2)
        assert waiting.is_alive()
    waiting.join(30)
    assert not waiting.is_alive()
    with RunFolder(tmp_path).claim(CONFIG):
        pass
