"""Worker processes of a study: they take one run after the other, and nothing of one run reaches
another.
"""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from arcade_torch.tools.machine import PARENT_VARIABLE, available_cores
from arcade_torch.tools.studies import processes, runner
from arcade_torch.tools.studies.engines import Ray
from arcade_torch.tools.studies.processes import Processes
from arcade_torch.tools.studies.runner import study
from tests.tools.fabricated import jobs, small_study

EXECUTE = """
import pathlib
from arcade_torch.tools.worker import serve

def execute(words):
    exec(pathlib.Path(words[2]).read_text(), {})
    return 0

serve(execute)
"""
"""A worker whose runs are Python code in the place of configs."""


def python_engine(workers: int = 2) -> Processes:
    return Processes(workers, program=(sys.executable, "-c", EXECUTE), poll_s=0.02)


def test_worker_processes_run_side_by_side_and_report_how_they_ended(tmp_path: Path) -> None:
    wait = f"""
        import pathlib, time
        here = pathlib.Path({str(tmp_path)!r})
        (here / "NAME").touch()
        while len(list(here.glob("up*"))) < 2: time.sleep(0.02)
    """
    texts = [
        wait.replace("NAME", "up0"),
        wait.replace("NAME", "up1"),
        "raise SystemExit('broken: no disk')",
    ]
    results = {result.name: result for result in python_engine().run(jobs(tmp_path, *texts))}
    assert [results[f"job{i}"].error for i in range(3)] == ["", "", "broken: no disk"]


def pid_of(tmp_path: Path, number: int) -> str:
    return (tmp_path / f"pid{number}").read_text()


def note_pid(tmp_path: Path, number: int, then: str = "") -> str:
    """A run that notes the process that carries it out."""
    note = f"pathlib.Path({str(tmp_path / f'pid{number}')!r}).write_text(str(os.getpid()))"
    return f"import os, pathlib, sys\n{note}\nprint('run {number}')\n{then}"


def is_there(pid: str) -> bool:
    """Whether a process goes on."""
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_takes_one_run_after_the_other_and_each_has_its_log(tmp_path: Path) -> None:
    parts = jobs(tmp_path, *(note_pid(tmp_path, number) for number in range(3)))
    assert [result.error for result in python_engine(1).run(parts)] == ["", "", ""]
    assert pid_of(tmp_path, 0) == pid_of(tmp_path, 1) == pid_of(tmp_path, 2)
    assert [part.log.read_text() for part in parts] == ["run 0\n", "run 1\n", "run 2\n"]
    assert not is_there(pid_of(tmp_path, 0))


def test_a_run_notes_its_own_command_and_not_that_of_its_worker(tmp_path: Path) -> None:
    (part,) = jobs(tmp_path, "import sys\nprint(sys.argv)")
    assert [result.error for result in python_engine(1).run([part])] == [""]
    assert part.log.read_text() == f"{['arcade-torch', *part.order]}\n"


def test_a_warning_stands_in_the_log_of_every_run_that_gives_it(tmp_path: Path) -> None:
    """Python gives a warning of one place once a process."""
    warn = "registry = sys.__dict__.setdefault('_of_a_module', {})\n"
    warn += (
        "import warnings; warnings.warn_explicit('odd', UserWarning, 'm.py', 1, registry=registry)"
    )
    parts = jobs(tmp_path, note_pid(tmp_path, 0, warn), note_pid(tmp_path, 1, warn))
    assert [result.error for result in python_engine(1).run(parts)] == ["", ""]
    assert pid_of(tmp_path, 0) == pid_of(tmp_path, 1)
    assert all("odd" in part.log.read_text() for part in parts)


def test_a_worker_ends_when_no_run_waits_while_others_go_on(tmp_path: Path) -> None:
    parts = jobs(
        tmp_path, note_pid(tmp_path, 0), note_pid(tmp_path, 1, "import time; time.sleep(60)")
    )
    results = python_engine(2).run(parts)
    first = int(next(results).name.removeprefix("job"))
    # the process is still to be waited for: it has ended when this returns
    os.waitid(os.P_PID, int(pid_of(tmp_path, first)), os.WEXITED | os.WNOWAIT)
    results.close()  # type: ignore[attr-defined]


def test_a_run_that_reads_its_input_takes_no_order_away(tmp_path: Path) -> None:
    reads = "import subprocess; assert sys.stdin.read() + input_of_a_program() == ''"
    program = "subprocess.run(['cat'], capture_output=True, check=True, text=True).stdout"
    reads = reads.replace("input_of_a_program()", program)
    parts = jobs(tmp_path, note_pid(tmp_path, 0, reads), note_pid(tmp_path, 1))
    assert [result.error for result in python_engine(1).run(parts)] == ["", ""]


@pytest.mark.parametrize("end", ["raise SystemExit('no luck')", "os._exit(3)", "1 / 0"])
def test_after_a_run_that_failed_another_process_takes_the_next(tmp_path: Path, end: str) -> None:
    parts = jobs(tmp_path, note_pid(tmp_path, 0, end), note_pid(tmp_path, 1))
    errors = [result.error for result in python_engine(1).run(parts)]
    assert errors[0] and not errors[1]
    assert pid_of(tmp_path, 0) != pid_of(tmp_path, 1)
    assert parts[1].log.read_text() == "run 1\n"


def test_a_worker_killed_between_two_runs_costs_none(tmp_path: Path) -> None:
    parts = jobs(tmp_path, note_pid(tmp_path, 0), note_pid(tmp_path, 1))
    results = python_engine(1).run(parts)
    assert next(results).error == ""
    pid = int(pid_of(tmp_path, 0))
    os.kill(pid, signal.SIGKILL)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    assert next(results).error == ""
    assert pid_of(tmp_path, 0) != pid_of(tmp_path, 1)
    results.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize(("limit", "value"), [("LONG_S", 0.0), ("MOST_RUNS", 1)])
def test_a_worker_that_has_worked_for_long_takes_no_further_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: float
) -> None:
    monkeypatch.setattr(processes, limit, value)
    parts = jobs(tmp_path, note_pid(tmp_path, 0), note_pid(tmp_path, 1))
    assert [result.error for result in python_engine(1).run(parts)] == ["", ""]
    assert pid_of(tmp_path, 0) != pid_of(tmp_path, 1)


def test_every_worker_takes_as_many_runs_as_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "MOST_RUNS", 2)
    parts = jobs(tmp_path, *(note_pid(tmp_path, number) for number in range(4)))
    assert [result.error for result in python_engine(1).run(parts)] == [""] * 4
    pids = [pid_of(tmp_path, number) for number in range(4)]
    assert pids[0] == pids[1] != pids[2] == pids[3]


def test_a_worker_that_ends_without_a_word_behind_one_that_failed_says_so(tmp_path: Path) -> None:
    texts = ("raise SystemExit('no luck')", "import os; print('64', flush=True); os._exit(7)")
    errors = [result.error for result in python_engine(1).run(jobs(tmp_path, *texts))]
    assert errors == ["no luck", "ended without a word (exit code 7); its log ends with: 64"]


def test_a_worker_knows_the_process_whose_end_is_its_own(tmp_path: Path) -> None:
    text = f"import os; assert os.environ[{PARENT_VARIABLE!r}] == '{os.getpid()}'"
    (result,) = python_engine(1).run(jobs(tmp_path, text))
    assert result.error == ""


def test_a_worker_that_waits_ends_with_its_study(tmp_path: Path) -> None:
    parts = jobs(
        tmp_path, note_pid(tmp_path, 0), note_pid(tmp_path, 1, "import time; time.sleep(1)")
    )
    results = python_engine(2).run(parts)
    assert next(results).error == ""
    results.close()  # type: ignore[attr-defined]
    assert not is_there(pid_of(tmp_path, 0))


def test_a_worker_that_somebody_ends_without_a_word_says_so(tmp_path: Path) -> None:
    """Before: the last line of progress was the reason, as if that were wrong."""
    quits = "import os; print('64 of 512 frames', flush=True); os._exit(7)"
    (result,) = python_engine().run(jobs(tmp_path, quits))
    assert result.error == "ended without a word (exit code 7); its log ends with: 64 of 512 frames"


def test_a_killed_worker_is_reported_with_its_signal(tmp_path: Path) -> None:
    (result,) = python_engine().run(jobs(tmp_path, "import os; os.kill(os.getpid(), 9)"))
    assert result.error == "ended by signal 9"


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system cannot pin")
def test_each_worker_has_a_core_of_its_own_and_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cores = available_cores()[:2]
    monkeypatch.setattr(processes, "available_cores", lambda: cores)
    text = f"""
        import os, pathlib, time
        here = pathlib.Path({str(tmp_path)!r})
        for _ in range(500):  # the engine pins it just after its start
            if len(os.sched_getaffinity(0)) > 1: time.sleep(0.02)
        core, = os.sched_getaffinity(0)
        (here / f"core-{{core}}-{{os.environ['OMP_NUM_THREADS']}}").touch()
        (here / f"up-{{os.getpid()}}").touch()
        while len(list(here.glob("up-*"))) < COUNT: time.sleep(0.02)
    """
    count = len(cores)
    text = text.replace("COUNT", str(count))
    assert all(
        result.error == "" for result in python_engine(count).run(jobs(tmp_path, *[text] * count))
    )
    assert len(list(tmp_path.glob("core-*-1"))) == count


def test_only_a_study_that_takes_all_cores_gives_each_run_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two studies of one worker each were both pinned to the first core."""
    pinned: list[set[int]] = []
    monkeypatch.setattr(processes, "available_cores", lambda: [3, 7])
    monkeypatch.setattr(
        os, "sched_setaffinity", lambda process, cores: pinned.append(cores), raising=False
    )
    for workers, wanted in ((1, [{3, 7}] * 2), (3, [{3, 7}] * 2), (2, [{3}, {7}]), (0, [{3}, {7}])):
        list(Processes(workers, program=("true",), poll_s=0.01).run(jobs(tmp_path, "", "")))
        assert pinned == wanted
        pinned.clear()


def test_closing_the_engine_asks_workers_to_stop_and_lets_them_save(tmp_path: Path) -> None:
    text = f"""
        import pathlib, signal, sys, time
        here = pathlib.Path({str(tmp_path)!r})
        def save(*_):
            (here / "saved").touch(); sys.exit(130)
        signal.signal(signal.SIGTERM, save)
        (here / "up").touch()
        time.sleep(60)
    """
    results = python_engine().run(jobs(tmp_path, "pass", text, "pass"))
    next(results)
    while not (tmp_path / "up").exists():
        time.sleep(0.02)
    results.close()  # type: ignore[attr-defined]
    assert (tmp_path / "saved").exists()


def test_a_worker_that_ignores_the_request_is_killed_after_the_grace_time(tmp_path: Path) -> None:
    text = f"""
        import pathlib, signal, time
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        pathlib.Path({str(tmp_path / "up")!r}).touch()
        time.sleep(60)
    """
    engine = Processes(2, program=(sys.executable, "-c", EXECUTE), poll_s=0.02, grace_s=0.3)
    results = engine.run(jobs(tmp_path, text, "import time; time.sleep(0.5)"))
    next(results)
    while not (tmp_path / "up").exists():
        time.sleep(0.02)
    start = time.monotonic()
    results.close()  # type: ignore[attr-defined]
    assert time.monotonic() - start < 30


def test_all_workers_that_ignore_the_request_share_one_grace_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    given = []
    wait = processes.Worker.wait

    def wait_in_vain(worker: processes.Worker, grace_s: float) -> None:
        nonlocal now
        given.append(grace_s)
        now += grace_s
        wait(worker, 0.0)

    clock = SimpleNamespace(monotonic=lambda: now, sleep=time.sleep)
    engine = python_engine()
    results = engine.run(jobs(tmp_path, "pass", "import time; time.sleep(60)"))
    next(results)
    monkeypatch.setattr(processes, "time", clock)
    monkeypatch.setattr(processes.Worker, "wait", wait_in_vain)
    results.close()  # type: ignore[attr-defined]
    assert given == [engine.grace_s, 0.0]


def test_a_worker_stops_when_its_study_is_gone(tmp_path: Path) -> None:
    inner = (
        "import time, pathlib, signal, sys\n"
        "from arcade_torch.tools.machine import watch_parent\n"
        "signal.signal(signal.SIGTERM, lambda *_: "
        f"(pathlib.Path({str(tmp_path / 'saved')!r}).touch(), sys.exit()))\n"
        "watch_parent()\n"
        f"pathlib.Path({str(tmp_path / 'up')!r}).touch()\n"
        "time.sleep(120)\n"
    )
    outer = (
        "import os, subprocess, sys, time\n"
        "os.environ['ARCADE_TORCH_PARENT'] = str(os.getpid())\n"
        f"subprocess.Popen([sys.executable, '-c', {inner!r}])\n"
        "time.sleep(120)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", outer], cwd=Path(__file__).resolve().parents[2]
    )
    deadline = time.monotonic() + 100
    while not (tmp_path / "up").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    while not (tmp_path / "saved").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert (tmp_path / "saved").exists()


def test_runs_with_several_threads_get_as_many_cores(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Each of sixteen runs had its four threads on one core, and was four times slower."""
    monkeypatch.setattr(runner, "available_cores", lambda: list(range(16)))
    used = list[Any]()

    class Kept(Processes):
        def run(self, jobs: Any) -> Any:
            used.append(self.workers)
            yield from ()

    class KeptRay(Ray):
        def run(self, jobs: Any) -> Any:
            yield from ()

    for threads, workers in ((1, 0), (4, 4), (32, 1)):
        what = small_study(settings={"threads": threads})
        study(what, tmp_path / "s", Kept(), stream=io.StringIO())
        assert used.pop() == workers
    study(what, tmp_path / "s", Kept(16), stream=io.StringIO())
    assert used.pop() == 16  # the user says so
    assert not capsys.readouterr().err
    study(what, tmp_path / "s", KeptRay(module=object(), cpus_per_run=32), stream=io.StringIO())
    assert not capsys.readouterr().err
    study(what, tmp_path / "s", KeptRay(module=object()), stream=io.StringIO())
    said = capsys.readouterr().err
    assert said == (
        "a run has 32 threads and Ray gives it 1 cores: --cpus-per-run 32 gives it as many\n"
    )
