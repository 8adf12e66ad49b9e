"""Where a session is shown: a window of pygame, or a terminal with half blocks in 24-bit colours,
two pixels each.
"""

import os
import re
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import groupby
from types import FrameType

import numpy as np

from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.gym.window import Window
from arcade_torch.tools.errors import MissingPackage, need
from arcade_torch.tools.play.session import LEGEND, NEXT, QUIT, RESTART, TOGGLE, Frame, Session
from arcade_torch.tools.text import printable

FPS = 30
_DELAY_MS = 300  # how long a key is held before it repeats
WINDOW_KEYS = {
    "K_UP": "up",
    "K_DOWN": "down",
    "K_LEFT": "left",
    "K_RIGHT": "right",
    "K_SPACE": "fire",
    "K_r": RESTART,
    "K_p": TOGGLE,
    "K_RETURN": NEXT,
    "K_ESCAPE": QUIT,
}

TERMINAL_KEYS = {
    b"\x1b[A": "up",
    b"\x1bOA": "up",
    b"\x1b[B": "down",
    b"\x1bOB": "down",
    b"\x1b[C": "right",
    b"\x1bOC": "right",
    b"\x1b[D": "left",
    b"\x1bOD": "left",
    b" ": "fire",
    b"r": RESTART,
    b"R": RESTART,
    b"p": TOGGLE,
    b"P": TOGGLE,
    b"\r": NEXT,
    b"\n": NEXT,
    b"\x1b": QUIT,
    b"q": QUIT,
    b"\x03": QUIT,  # Ctrl-C
    b"\x04": QUIT,  # Ctrl-D
}
# up to the final byte of a sequence, or one byte
_SEQUENCE = re.compile(rb"\x1b[\[O][^@-~]*[@-~]?|.", re.DOTALL)
_REST_WITHIN_S = 0.05  # the rest of an arrow key's sequence arrives within this
_ENTER = "\x1b[?1049h\x1b[?25l\x1b[2J"
_LEAVE = "\x1b[0m\x1b[?25h\x1b[?1049l"
_COLOURS = "\x1b[38;2;{};{};{};48;2;{};{};{}m"
_HALF_BLOCK = "\u2580"
_TEXT_ROWS = 2


def why_no_window() -> str | None:
    """Why a window cannot be opened here, in a few words; None if it can."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        pygame = need("pygame")
    except MissingPackage as error:
        return str(error)
    names = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in names):
        return "there is no display"
    try:
        pygame.display.init()
    except pygame.error as error:
        return f"no display can be opened ({error})"
    return None


class Watched:
    """Somebody who plays while another watches: presses a key of a session when it is time.

    Args:
        choose: looks at a session and names an action, 0 to 4.
        fps: actions a second; the last picture of an episode stays for a second.
        clock: gives the time in seconds.
    """

    def __init__(
        self,
        choose: Callable[[Session], int],
        fps: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._choose = choose
        self._rest_s = 1 / fps
        self._clock = clock
        self._next_s = clock() + self._rest_s

    @property
    def wait_s(self) -> float:
        """Seconds until the next key."""
        return max(0.0, self._next_s - self._clock())

    def press(self, session: Session) -> bool:
        """Press a key if it is time; says whether it was."""
        if session.closed or self.wait_s > 0:
            return False
        if session.end is None:
            session.press(ACTION_NAMES[self._choose(session)])
        else:
            session.press(NEXT)
        rest_s = self._rest_s if session.end is None else max(1.0, self._rest_s)
        self._next_s = self._clock() + rest_s
        return True


def play_in_window(
    session: Session, scale: int, key_repeat_ms: int, watched: Watched | None = None
) -> None:
    """Show a session and hand it the keys, until it is closed; of somebody who is ``watched``
    too.
    """
    window = Window(scale)
    pygame = window.pygame
    keys = {getattr(pygame, constant): name for constant, name in WINDOW_KEYS.items()}
    try:
        window.show(session.picture, session.caption)
        if key_repeat_ms:
            pygame.key.set_repeat(_DELAY_MS, key_repeat_ms)
        else:
            pygame.key.set_repeat()
        while not session.closed:
            for event in pygame.event.get((pygame.QUIT, pygame.KEYDOWN)):
                key = QUIT if event.type == pygame.QUIT else keys.get(event.key)
                if key is not None:
                    session.press(key)
                    window.show(session.picture, session.caption)
            if watched is not None and watched.press(session):
                window.show(session.picture, session.caption)
            window.tick(FPS)
    finally:
        window.close()


def play_in_terminal(session: Session, watched: Watched | None = None) -> None:
    """Show a session in this process's terminal and hand it the keys, until it is closed; of
    somebody who is ``watched`` too.

    Raises:
        ValueError: standard input or output is no terminal, or the terminal cannot move its cursor.
    """
    reason = why_no_terminal()
    if reason is not None:
        raise ValueError(f"playing needs a window or a terminal, and this is neither: {reason}")
    # before the terminal is changed: an interruption of imports ends the process at once
    need("PIL.Image")

    def draw() -> None:
        size = shutil.get_terminal_size()
        _write(screen(session, size.columns, size.lines))

    with _raw_terminal(draw) as source:
        while not session.closed:
            draw()
            if watched is not None and not select.select([source], [], [], watched.wait_s)[0]:
                watched.press(session)
                continue
            data = os.read(source, 64)
            while (
                data.endswith((b"\x1b", b"\x1b[", b"\x1bO"))
                and select.select([source], [], [], _REST_WITHIN_S)[0]
            ):
                data += os.read(source, 64)
            for key in decode_keys(data or b"\x04"):  # a closed terminal quits
                session.press(key)


def why_no_terminal() -> str | None:
    """Why nobody can play in this process's terminal, in a few words; None if one can."""
    streams = {"standard input": sys.stdin, "standard output": sys.stdout}
    redirected = [name for name, stream in streams.items() if stream is None or not stream.isatty()]
    if redirected:
        verb = "are" if len(redirected) > 1 else "is"
        return f"{' and '.join(redirected)} {verb} redirected"
    if os.environ.get("TERM", "") in ("dumb", "unknown"):
        return f"TERM is {os.environ['TERM']}, a terminal that shows no pictures"
    try:
        _HALF_BLOCK.encode(sys.stdout.encoding)
    except UnicodeEncodeError:
        return f"text is written in {sys.stdout.encoding}, without the blocks of UTF-8 to draw with"
    return None


@contextmanager
def _raw_terminal(draw: Callable[[], None]) -> Iterator[int]:
    """Keys one by one and unseen, on a screen of our own; everything as before afterwards, whatever
    happens, and while Ctrl-Z stops this process; then the screen is drawn anew.
    """
    import termios
    import tty

    source = sys.stdin.fileno()
    before = termios.tcgetattr(source)
    sys.stdout.flush()

    def enter() -> None:
        tty.setcbreak(source)
        _write(_ENTER)

    def leave() -> None:
        termios.tcsetattr(source, termios.TCSADRAIN, before)
        _write(_LEAVE)

    def pause(number: int, frame: FrameType | None) -> None:
        leave()
        os.kill(os.getpid(), signal.SIGSTOP)
        enter()
        draw()

    handler = signal.getsignal(signal.SIGTSTP)
    try:
        if handler is signal.SIG_DFL:
            signal.signal(signal.SIGTSTP, pause)
        enter()
        yield source
    finally:
        signal.signal(signal.SIGTSTP, handler)
        leave()


def _write(text: str) -> None:
    """Write to the terminal past Python's buffers, which a handler of signals may not enter."""
    data = text.encode(sys.stdout.encoding, "backslashreplace")
    while data:
        data = data[os.write(sys.stdout.fileno(), data) :]


def decode_keys(data: bytes) -> list[str]:
    """Names of the keys in what a terminal sent; a lone escape is quit, unknown sequences are left
    out.

    Example:
        >>> decode_keys(b"\\x1b[A p\\x1b")
        ['up', 'fire', 'toggle', 'quit']
    """
    return [TERMINAL_KEYS[code] for code in _SEQUENCE.findall(data) if code in TERMINAL_KEYS]


def screen(session: Session, columns: int, rows: int) -> str:
    """What to write to the terminal to show a session."""
    picture = half_blocks(session.frame, 2 * max(1, rows - _TEXT_ROWS), columns)
    caption = printable(session.caption)
    lines = [*picture, caption[:columns], LEGEND[:columns]]
    return "\x1b[H" + "\x1b[K\r\n".join(lines) + "\x1b[K\x1b[J"


def half_blocks(frame: Frame, height: int, width: int) -> list[str]:
    """Lines that draw a frame, made smaller by means over areas until it fits, two rows of pixels
    each.

    The upper row has the colour of the text, the lower one that of the background.
    """
    image = need("PIL.Image")
    picture = image.fromarray(frame)
    picture.thumbnail((width, height), image.Resampling.BOX, reducing_gap=None)
    pixels = np.asarray(picture)
    pixels = np.pad(pixels, ((0, len(pixels) % 2), (0, 0), (0, 0))).tolist()
    lines = []
    for upper, lower in zip(pixels[::2], pixels[1::2], strict=True):
        line = ""
        for (top, bottom), cells in groupby(zip(upper, lower, strict=True)):
            count = len(list(cells))
            line += _COLOURS.format(*top, *bottom) + _HALF_BLOCK * count
        lines.append(line + "\x1b[0m")
    return lines
