"""What ``conftest.py`` sets for all tests."""

import subprocess
import sys
from pathlib import Path


def printed(code: str, ignored: str) -> str:
    """What a program prints that is started with a signal ignored."""
    done = subprocess.run(
        ["sh", "-c", f'trap \'\' {ignored}; exec "$0" -c "$1"', sys.executable, code],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done
    return done.stdout.strip()


def test_ctrl_c_reaches_what_tests_start_in_the_background() -> None:
    """A shell without job control has its background ignore Ctrl-C, and a program inherits that: a
    study that a test interrupts went on to its end.
    """
    code = "import signal; import tests.conftest; print(signal.getsignal(signal.SIGINT).__name__)"
    assert printed(code, ignored="INT") == "default_int_handler"


def test_a_hang_up_reaches_what_tests_start_under_nohup() -> None:
    """The tests of signals failed there. What tests start has the handlers of a terminal, and the
    tests themselves go on.
    """
    code = (
        "import os, signal, subprocess, sys, tests.conftest; os.kill(os.getpid(), signal.SIGHUP); "
        "print(subprocess.call([sys.executable, '-c', "
        "'import os, signal; os.kill(os.getpid(), signal.SIGHUP)']))"
    )
    assert printed(code, ignored="HUP") == "-1"
