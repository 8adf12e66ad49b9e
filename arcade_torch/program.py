"""What the process of the command line does first and last: standard streams, the signals that stop
it, its end.

It is loaded with the package, before everything that takes long, and loads nothing itself.

SIGINT, SIGTERM and SIGHUP end every command with one line on stderr and exit code 130:

* before a command has begun, and while it imports, at once: libraries in C++ abort when their
  import is interrupted;
* while it works, by a ``KeyboardInterrupt``, so that open files are closed and half written ones
  are removed. JAX and Python lose exceptions that arrive in one of their callbacks (three in ten
  did), so it is raised until it is seen;
* when it has done its work, with what came of the work;
* on a second Ctrl-C at once, also in the middle of a compilation. A thread listens for it, because
  Python's handlers wait until C returns.

The process never reaches the end of the interpreter, which takes modules apart while threads of JAX
and torch still run, and crashes there.
"""

import atexit
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NoReturn

EXIT_STOPPED = 130
"""Exit code after each of `STOP_SIGNALS`."""
STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
REPEAT_S = 0.5
"""A ``KeyboardInterrupt`` that got lost is raised again after this time."""
NOTHING_BEGUN = "no work was begun"


class _Process:
    """How far this process is."""

    begun = False  # the handlers are installed
    phase: Literal["loading", "working", "over"] = "loading"  # of the command
    asked = False  # a signal has asked the command to stop
    hint = NOTHING_BEGUN  # what an interruption leaves, and how to go on
    code: int | None = None  # what came of it


def is_command_line() -> bool:
    """Whether this process is ``arcade-torch`` or ``python -m arcade_torch.tools``, and no child or
    user of it.
    """
    script = "".join(sys.argv[:1])
    if script == "-m":
        return f"{__package__}.tools" in sys.orig_argv
    return Path(script).name == "arcade-torch" and script in sys.orig_argv


def begin() -> None:
    """Repair the standard streams and install the handlers, once; signals that are ignored
    (``nohup``) stay so.
    """
    if _Process.begun or threading.current_thread() is not threading.main_thread():
        return
    _Process.begun = True
    if sys.flags.optimize > 1:
        _start_with_docstrings()
    _repair_streams()
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)
    sys.unraisablehook = _note_lost
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(
        target=_listen, args=(reader,), daemon=True, name="arcade-torch-signals"
    ).start()


@contextmanager
def working(hint: str) -> Iterator[None]:
    """Inside, a signal raises ``KeyboardInterrupt`` in the place of ending the process at once.

    Args:
        hint: what an interruption leaves, and how to go on.
    """
    _Process.hint = hint
    _Process.phase = "working"
    try:
        yield
    finally:
        _Process.phase = "over"


def wait_for_work() -> None:
    """After a command, in a process that carries out another: until then a signal ends it at
    once.
    """
    _Process.hint = NOTHING_BEGUN
    _Process.phase = "loading"


def is_asked_to_stop() -> bool:
    """Whether a signal has asked this process to stop."""
    return _Process.asked


def leave(code: int) -> NoReturn:
    """End this process with an exit code, without taking the interpreter apart."""
    _Process.code = code
    _Process.phase = "over"
    if code != EXIT_STOPPED:
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(code)


def _start_with_docstrings() -> None:
    """Run this program again without ``-OO``: TorchRL adds to docstrings while it is imported, and
    fails without.
    """
    words: list[str] = []
    rest = iter(sys.orig_argv[1:])
    for word in rest:
        if word in ("-W", "-X"):
            words += [word, next(rest, "")]
        elif word.startswith(("-W", "-X")):
            words.append(word)
        elif not word.startswith("-") or word.startswith(("-m", "-c")):
            words.append(word)
            break
        elif word.strip("O") != "-":
            words.append(word.replace("O", ""))
    words += rest
    if words != sys.orig_argv[1:] or os.environ.get("PYTHONOPTIMIZE", "1") != "1":
        os.environ["PYTHONOPTIMIZE"] = "1"
        os.execv(sys.executable, [sys.executable, *words])


def _repair_streams() -> None:
    """Give closed standard streams ``/dev/null``, and let every character be written in some
    form.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream: Any = getattr(sys, name)
        if stream is None:
            stream = open(os.devnull, "w" if number else "r", encoding="utf-8")  # noqa: SIM115
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
        if number and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _stop(number: int, frame: FrameType | None) -> None:
    """The handler of `STOP_SIGNALS`."""
    if _Process.phase == "over":
        if _Process.code is not None:
            os._exit(_Process.code)
        return
    if _Process.phase == "loading" or _is_importing(frame):
        _end_now("stopped")
    _Process.asked = True
    if not _is_unwinding():
        raise KeyboardInterrupt


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported where a frame stands."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _note_lost(lost: Any) -> None:
    """Say nothing of a ``KeyboardInterrupt`` that a callback swallowed: it is raised again."""
    if not (_Process.asked and issubclass(lost.exc_type, KeyboardInterrupt)):
        sys.__unraisablehook__(lost)


def _is_unwinding() -> bool:
    """Whether an interruption is on its way through the ``finally`` blocks of the main thread."""
    error = sys.exception()
    while error is not None:
        if isinstance(error, KeyboardInterrupt | GeneratorExit):
            return True
        error = error.__context__
    return False


def _listen(reader: int) -> None:
    """End the process on the second signal if that is Ctrl-C; repeat the first one as long as
    nobody sees it.
    """
    signals = 0
    while True:
        again = REPEAT_S if _Process.asked and _Process.phase == "working" else None
        if not select.select([reader], [], [], again)[0]:
            _repeat()
            continue
        for number in os.read(reader, 64):
            if number not in STOP_SIGNALS:
                continue
            signals += 1
            if signals > 1 and number == signal.SIGINT:
                _end_now("stopped at once")


def _repeat() -> None:
    """Send the main thread the signal once more, unless a training has taken the handlers and
    saves.
    """
    ident = threading.main_thread().ident
    if signal.getsignal(signal.SIGTERM) is _stop and ident is not None:
        signal.pthread_kill(ident, signal.SIGTERM)


def _end_now(reason: str) -> NoReturn:
    """End this process with a line on stderr; a terminal gets its cursor back."""
    show_cursor = "\x1b[?25h" if os.isatty(2) else ""
    with suppress(OSError):
        os.write(2, f"{show_cursor}arcade-torch: {reason}; {_Process.hint}\n".encode())
    os._exit(EXIT_STOPPED)
