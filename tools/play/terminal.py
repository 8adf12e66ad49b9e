"""A session in a terminal: two pixels a character, by half blocks in 24-bit colours."""

import os
import select
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from arcade_torch.tools.play.session import LEGEND, NEXT, QUIT, RESTART, TOGGLE, Frame, Session

_SEQUENCES = {
    **{b"\x1b" + prefix + bytes([letter]): name
       for prefix in (b"[", b"O")
       for letter, name in zip(b"ABCD", ("up", "down", "right", "left"), strict=True)},
    b" ": "fire",
    b"r": RESTART,
    b"R": RESTART,
    b"p": TOGGLE,
    b"P": TOGGLE,
    b"\r": NEXT,
    b"\n": NEXT,
    b"q": QUIT,
    b"\x03": QUIT,
    b"\x04": QUIT,
}  # fmt: skip
_ESCAPE = b"\x1b"
_ESCAPE_WAIT_S = 0.05  # the rest of an arrow key's sequence arrives within this
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l\x1b[2J", "\x1b[0m\x1b[?25h\x1b[?1049l"
_TEXT_ROWS = 2


def decode_keys(data: bytes) -> list[str]:
    """Names of the keys in what a terminal sent; a lone escape is quit, unknown sequences are left out.

    Example:
        >>> decode_keys(b"\\x1b[A p\\x1b")
        ['up', 'fire', 'toggle', 'quit']
    """
    keys = []
    while data:
        if data[:1] == _ESCAPE and data[1:2] in (b"[", b"O"):
            length = 3
            while length <= len(data) and not 0x40 <= data[length - 1] <= 0x7E:  # up to the final byte of a sequence
                length += 1
        else:
            length = 1
        chunk, data = data[:length], data[length:]
        name = QUIT if chunk == _ESCAPE else _SEQUENCES.get(chunk)
        if name is not None:
            keys.append(name)
    return keys


def shrink(frame: Frame, height: int, width: int) -> Frame:
    """Make a frame smaller by means over areas; one that fits already stays as it is.

    Example:
        >>> shrink(np.zeros((128, 256, 3), np.uint8), 60, 60).shape
        (30, 60, 3)
    """
    factor = min(height / frame.shape[0], width / frame.shape[1])
    if factor >= 1:
        return frame
    out: npt.NDArray[np.float64] = frame.astype(np.float64)
    for axis in (0, 1):
        size = frame.shape[axis]
        fits = max(1, int(size * factor + 1e-9))
        edges = np.arange(fits + 1) * size // fits
        shape = [-1 if i == axis else 1 for i in range(3)]
        out = np.add.reduceat(out, edges[:-1], axis=axis) / np.diff(edges).reshape(shape)
    return out.round().astype(np.uint8)


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
            sys.stdout.write(screen(session, size.columns, size.lines))
            sys.stdout.flush()
            for key in decode_keys(_read(source)):
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
        sys.stdout.write(_ENTER)
        yield source
    finally:
        termios.tcsetattr(source, termios.TCSADRAIN, before)
        sys.stdout.write(_LEAVE)
        sys.stdout.flush()


def _read(source: int) -> bytes:
    """Wait for keys; the rest of a sequence that has begun is waited for. A closed terminal quits."""
    data = os.read(source, 64)
    while data.endswith((_ESCAPE, b"\x1b[", b"\x1bO")) and select.select([source], [], [], _ESCAPE_WAIT_S)[0]:
        data += os.read(source, 64)
    return data or b"\x04"
