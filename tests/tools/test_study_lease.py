"""The lock that says who works: one owner, taken over from the dead, never from the living."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from arcade_torch.agents import lease as module
from arcade_torch.agents.lease import HEARTBEAT_S, TIMEOUT_S, Lease, LeaseLostError
from arcade_torch.agents.presets import preset
from arcade_torch.agents.run_folder import RunFolder, RunFolderError

ROOT = Path(__file__).resolve().parents[2]


class Clock:
    """A clock that stands still unless told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(module.time, "monotonic", lambda: self.now)


def owner_elsewhere(folder: Path, number: int = 1, **changes: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    record = {"name": "far", "pid": os.getpid(), "host": "far away", "started": None, "token": "theirs"} | changes
    file = folder / f"owner-{number:06d}.json"
    file.write_text(json.dumps(record))
    return file


def look(lease: Lease, clock: Clock, seconds: float, every: float = 1.0) -> bool:
    """Look again and again; whether it looks held at the end."""
    end, held = clock.now + seconds, lease.held()
    while clock.now < end:
        clock.now += every
        held = lease.held()
    return held


def test_only_one_has_it_and_release_leaves_nothing(tmp_path: Path) -> None:
    one, other = Lease(tmp_path / "lock"), Lease(tmp_path / "lock")
    assert one.try_take() and not other.try_take() and not one.try_take()
    assert other.held() and f"process {os.getpid()} on" in other.owner()
    one.release()
    assert not other.held() and list(tmp_path.iterdir()) == []
    assert other.try_take()
    other.release()


def test_counting_under_the_lock_loses_no_count(tmp_path: Path) -> None:
    count = tmp_path / "count"
    count.write_text("0")

    def work() -> None:
        for _ in range(25):
            lease = Lease(tmp_path / "lock")
            while not lease.try_take():
                pass
            count.write_text(str(int(count.read_text()) + 1))
            lease.release()

    threads = [threading.Thread(target=work, daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads), "a thread waits for a lease that nobody holds"
    assert count.read_text() == "100"


def test_letting_go_never_removes_the_file_of_a_successor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two, three, four = (Lease(tmp_path / "lock") for _ in range(4))
    assert one.try_take()
    read = module._read

    def interrupted(file: Path) -> object:
        """Others come and go between the look of the releasing owner at its file and the removal."""
        record = read(file)
        monkeypatch.setattr(module, "_read", read)
        if two.try_take():
            two.release()
        three.try_take()
        return record

    monkeypatch.setattr(module, "_read", interrupted)
    one.release()
    assert four.try_take() is not three.mine
    for lease in (three, four):
        lease.release()
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_held_is_free_at_once(tmp_path: Path) -> None:
    text = (
        "import os; from pathlib import Path; from arcade_torch.agents.lease import Lease\n"
        f"assert Lease(Path({str(tmp_path / 'lock')!r})).try_take(); os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", text], cwd=ROOT, check=False).returncode == -9
    assert len(list((tmp_path / "lock").iterdir())) == 1
    lease = Lease(tmp_path / "lock")
    assert lease.try_take()
    assert [file.name for file in (tmp_path / "lock").iterdir()] == ["owner-000002.json"]
    lease.release()


def test_a_process_number_that_was_given_out_again_is_not_the_owner(tmp_path: Path) -> None:
    record = {"host": module.host(), "pid": os.getppid(), "started": "1"}
    owner_elsewhere(tmp_path / "lock", **record)
    assert Lease(tmp_path / "lock").held() == (not Path("/proc/self/stat").exists())


def test_an_owner_elsewhere_is_gone_only_after_a_silence_that_was_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, lease = Clock(monkeypatch), Lease(tmp_path / "lock")
    owner_elsewhere(tmp_path / "lock")
    assert look(lease, clock, TIMEOUT_S - 1)
    assert not lease.try_take()
    assert not look(lease, clock, 10)
    assert lease.try_take()
    lease.release()


def test_a_heartbeat_starts_the_silence_afresh_whatever_time_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, lease = Clock(monkeypatch), Lease(tmp_path / "lock")
    file = owner_elsewhere(tmp_path / "lock")
    for moved in (2_000_000_000, 1, 3_000_000_000):  # their clock jumps to and fro
        os.utime(file, (moved, moved))
        assert look(lease, clock, TIMEOUT_S - 1)
    assert not look(lease, clock, 10)


def test_time_in_which_nobody_could_look_counts_as_one_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, lease = Clock(monkeypatch), Lease(tmp_path / "lock")
    owner_elsewhere(tmp_path / "lock")
    lease.held()
    clock.now += 1e6  # suspended, or the file server was away
    assert lease.held()
    assert not look(lease, clock, TIMEOUT_S - HEARTBEAT_S)


def test_half_a_record_is_respected_until_it_was_silent_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, lease = Clock(monkeypatch), Lease(tmp_path / "lock")
    owner_elsewhere(tmp_path / "lock").write_text("")
    assert look(lease, clock, TIMEOUT_S - 1) and not look(lease, clock, 10)


def test_a_heartbeat_moves_the_time_of_the_file(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "lock")
    assert lease.try_take()
    (file,) = (tmp_path / "lock").iterdir()
    before = file.stat().st_mtime_ns
    lease.beat()
    assert file.stat().st_mtime_ns - before == HEARTBEAT_S * 1e9
    lease.release()


def test_an_owner_that_slept_through_its_end_stops_before_it_writes(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "lock", timeout_s=-1.0)  # every confirmation looks at the disk
    assert lease.try_take()
    lease.confirm()
    (file,) = (tmp_path / "lock").iterdir()
    file.unlink()
    theirs = owner_elsewhere(tmp_path / "lock", number=2)
    with pytest.raises(LeaseLostError, match="taken over by process"):
        lease.confirm()
    lease.release()
    assert theirs.exists()


def test_who_waits_for_an_owner_elsewhere_gives_up_at_its_first_sign_of_life(tmp_path: Path) -> None:
    file, lease = owner_elsewhere(tmp_path / "lock"), Lease(tmp_path / "lock")
    threading.Timer(0.1, lambda: os.utime(file, (5, 5))).start()
    assert not lease.take(poll_s=0.02)


def test_a_run_folder_has_one_trainer(tmp_path: Path) -> None:
    config, folder = preset("smoke"), RunFolder(tmp_path / "run")
    with folder.claim(config):
        other = RunFolder(tmp_path / "run")
        other.check(config, resume=True)
        with pytest.raises(RunFolderError, match=f"is being trained by process {os.getpid()}"):
            other.claim(config)
    with other.claim(config):
        pass
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["config.json"]


def test_the_next_trainer_sweeps_out_what_a_killed_one_left_half_written(tmp_path: Path) -> None:
    config, folder = preset("smoke"), RunFolder(tmp_path / "run")
    with folder.claim(config):
        pass
    (folder.path / ".progress.json.123").write_text("{")
    (folder.checkpoints / ".frames-000000000064.123").mkdir(parents=True)
    with folder.claim(config):
        assert sorted(path.name for path in folder.path.rglob("*")) == [
            "checkpoints", "config.json", "lock", "owner-000001.json",
        ]  # fmt: skip


def test_a_lock_alone_does_not_make_a_folder_taken(tmp_path: Path) -> None:
    (tmp_path / "run" / "lock").mkdir(parents=True)
    RunFolder(tmp_path / "run").check(preset("smoke"), resume=False)
