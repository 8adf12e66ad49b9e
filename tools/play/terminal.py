"""A session in a terminal: two pixels a character, by half blocks in 24-bit colours."""

import os
import re
import select
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from arcade_torch.tools.optional import need
from arcade_torch.tools.play.session import LEGEND, NEXT, QUIT, RESTART, TOGGLE, Frame, Session

_ARROWS = dict(zip("ABCD", ("up", "down", "right", "left"), strict=True))
_KEYS = {
    **{f"\x1b{prefix}{letter}".encode(): name for prefix in "[O" for letter, name in _ARROWS.items()},
    b" ": "fire",
    **dict.fromkeys((b"r", b"R"), RESTART),
    **dict.fromkeys((b"p", b"P"), TOGGLE),
    **dict.fromkeys((b"\r", b"\n"), NEXT),
    **dict.fromkeys((b"\x1b", b"q", b"\x03", b"\x04"), QUIT),
}
_SEQUENCE = re.compile(rb"\x1b[\[O][^@-~]*[@-~]?|.", re.DOTALL)  # up to the final byte of a sequence, or one byte
_REST_WITHIN_S = 0.05  # the rest of an arrow key's sequence arrives within this
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l\x1b[2J", "\x1b[0m\x1b[?25h\x1b[?1049l"
_TEXT_ROWS = 2


def decode_keys(data: bytes) -> list[str]:
    """Names of the keys in what a terminal sent; a lone escape is quit, unknown sequences are left out.

    Example:
        >>> decode_keys(b"\\x1b[A p\\x1b")
        ['up', 'fire', 'toggle', 'quit']
    """
    return [_KEYS[found] for found in _SEQUENCE.findall(data) if found in _KEYS]


def shrink(frame: Frame, height: int, width: int) -> Frame:
    """Make a frame smaller by means over areas; one that fits already stays as it is.

    Example:
        >>> shrink(np.zeros((128, 256, 3), np.uint8), 60, 60).shape
        (30, 60, 3)
    """
    image = need("PIL.Image")
    picture = image.fromarray(frame)
    picture.thumbnail((width, height), image.Resampling.BOX, reducing_gap=None)
    return np.asarray(picture)


def half_blocks(frame: Frame) -> list[str]:
    """Lines that draw a frame, two rows of pixels each: upper half in the text's colour, lower in the background's."""
    if frame.shape[0] % 2:
        frame = np.concatenate([frame, np.zeros_like(frame[:1])])
    lines = []
    for upper, lower in zip(frame[::2].tolist(), frame[1::2].tolist(), strict=True):
        parts, before = [], None
        for top, bottom in zip(upper, lower, strict=True):
            if (top, bottom) != before:
                parts.append("\x1b[38;2;{};{};{};48;2;{};{};{}m".format(*top, *bottom))
                before = (top, bottom)
            parts.append("\u2580")
        lines.append("".join(parts) + "\x1b[0m")
    return lines


def screen(session: Session, columns: int, rows: int) -> str:
    """What to write to the terminal to show a session."""
    picture = half_blocks(shrink(session.frame, 2 * max(1, rows - _TEXT_ROWS), columns))
    text = [words[:columns] for words in (session.caption, LEGEND)]
    return "\x1b[H" + "\r\n".join(f"{line}\x1b[K" for line in [*picture, *text]) + "\x1b[J"


def play_in_terminal(session: Session) -> None:
    """Show a session in this process's terminal and hand it the keys, until it is closed."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ValueError("playing needs a window or a terminal, and this is neither: standard input is redirected")
    with _raw_terminal() as source:
        while not session.closed:
            size = shutil.get_terminal_size()
            print(screen(session, size.columns, size.lines), end="", flush=True)
            data = os.read(source, 64)
            while data.endswith((b"\x1b", b"\x1b[", b"\x1bO")) and select.select([source], [], [], _REST_WITHIN_S)[0]:
                data += os.read(source, 64)
            for key in decode_keys(data or b"\x04"):  # a closed terminal quits
                session.press(key)


@contextmanager
def _raw_terminal() -> Iterator[int]:
    """Keys one by one and unseen, on a screen of our own; everything as before afterwards, whatever happens."""
    import termios
    import tty

    source = sys.stdin.fileno()
    before = termios.tcgetattr(source)
    try:
        tty.setcbreak(source)
        print(_ENTER, end="")
        yield source
    finally:
        termios.tcsetattr(source, termios.TCSADRAIN, before)
        print(_LEAVE, end="", flush=True)
