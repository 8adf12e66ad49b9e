"""Signals that stop a command: one line, exit code 130, no half file; from the first import to the
last flush.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = (sys.executable, "-m", "arcade_torch.tools")
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LIMIT_S = 120.0

SWALLOWS = """
import os, signal, time
from arcade_torch.tools.commands.list import List

class Loses:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass

def run(self):
    Loses()
    time.sleep(60)

List.run = run
"""
COMPUTES = """
import hashlib
from arcade_torch.tools.commands.list import List

def run(self):
    print("computing", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"x", b"y", 2**28)  # minutes in C, where no handler of Python's runs

List.run = run
"""
FAILS = """
import os, signal
from arcade_torch.tools.commands.list import List

def run(self):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass
    except KeyboardInterrupt:
        raise RuntimeError("INTERNAL: callback failed") from None

List.run = run
"""
FINISHES = """
import atexit, os, signal, time
from arcade_torch.tools.commands.list import List

def late():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)

atexit.register(late)
List.run = lambda self: print("done")
"""


def start(words: Sequence[str], folder: Path) -> "subprocess.Popen[str]":
    """A command in a process of its own."""
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    return subprocess.Popen(
        [*PROGRAM, *words], stdout=pipe, stderr=pipe, text=True, cwd=folder, env=environment
    )


def wait_for_handlers(process: "subprocess.Popen[str]") -> None:
    """Wait until a process catches SIGTERM; before, Python itself is being started."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline and process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
        if int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.002)


def ended(process: "subprocess.Popen[str]") -> tuple[int, str, str]:
    """How a process ended, within the limit: exit code, stdout, stderr."""
    try:
        out, err = process.communicate(timeout=LIMIT_S)
    finally:
        process.kill()
    return process.returncode, out, err


def assert_stopped(result: tuple[int, str, str]) -> None:
    code, _, err = result
    assert code == 130 and "Traceback" not in err, (code, err)
    assert err.splitlines()[-1].startswith("arcade-torch: stopped"), err


def run_with(code: str, folder: Path) -> "subprocess.Popen[str]":
    """``list`` with other code in its place."""
    (folder / "other.py").write_text(code)
    return start(["list", "--import", "other.py"], folder)


@pytest.mark.parametrize("number", STOPS, ids=[number.name for number in STOPS])
def test_a_signal_during_the_first_imports_is_one_line(number: int, tmp_path: Path) -> None:
    process = start(["list"], tmp_path)
    wait_for_handlers(process)
    process.send_signal(number)
    code, out, err = ended(process)
    assert (code, out, err) == (130, "", "arcade-torch: stopped; no work was begun\n")


def test_an_interruption_that_a_callback_swallows_is_raised_again(tmp_path: Path) -> None:
    code, _, err = ended(run_with(SWALLOWS, tmp_path))
    assert code == 130
    assert err == "arcade-torch: stopped; no file is half written; the same command starts again\n"


def test_an_interruption_that_comes_back_as_an_error_is_still_one(tmp_path: Path) -> None:
    assert_stopped(ended(run_with(FAILS, tmp_path)))


def test_a_second_ctrl_c_ends_at_once_even_while_c_computes(tmp_path: Path) -> None:
    process = run_with(COMPUTES, tmp_path)
    assert process.stdout is not None and process.stdout.readline() == "computing\n"
    time.sleep(1.0)  # until it is in C
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    code, _, err = ended(process)
    assert code == 130
    assert (
        err
        == "arcade-torch: stopped at once; no file is half written; the same command starts again\n"
    )


def test_a_signal_after_the_work_changes_nothing_of_its_result(tmp_path: Path) -> None:
    code, out, err = ended(run_with(FINISHES, tmp_path))
    assert (code, out, err) == (0, "done\n", "")


def test_signals_that_are_ignored_stay_ignored(tmp_path: Path) -> None:
    process = subprocess.Popen(
        ["sh", "-c", 'trap "" HUP; exec "$0" -m arcade_torch.tools list envs', sys.executable],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    wait_for_handlers(process)
    process.send_signal(signal.SIGHUP)
    out, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0 and "CartPoleEasy-v0" in out


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from arcade_torch.agents import preset, train

    folder = tmp_path_factory.mktemp("signals") / "run"
    train(preset("smoke", env="CartPoleEasy-v0", total_frames=256), folder)
    return folder


COMMANDS = {
    "evaluate": "evaluate {agent} --episodes 16 --json out.json",
    "record": "record CartPoleEasy --out out.gif",
    "record-agent": "record CartPoleEasy --player {agent} --out out.gif",
    "figure": "figure saliency {agent} --out out.png",
    "analyze": "analyze saliency {agent} --max-steps 20 --out figures",
    "list": "list memories",
    "sheet": "list sheet CartPoleEasy --steps 1 2 --out out.png",
    "bench": "bench envs --games CartPoleEasy --batches 4 --repeats 1 --seconds 0.05 --out out.json",
}
RUNS = int(os.environ.get("SIGNAL_RUNS", "30"))
"""Of each command, in the slow test."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", COMMANDS)
def test_signals_at_random_moments(name: str, agent: Path, tmp_path: Path) -> None:
    words = COMMANDS[name].format(agent=agent).split()
    began = time.monotonic()
    code, _, err = ended(start(words, tmp_path))
    assert code == 0, err
    took_s = time.monotonic() - began
    rng = random.Random(name)
    for number in range(RUNS):
        folder = tmp_path / str(number)
        folder.mkdir()
        process = start(words, folder)
        wait_for_handlers(process)
        time.sleep(rng.uniform(0.0, took_s))
        process.send_signal(rng.choice(STOPS))
        result = ended(process)
        if result[0] != 0:  # it may have been over
            assert_stopped(result)
            left = [path.name for path in folder.rglob("*") if path.name.startswith(".")]
            assert not left, left
