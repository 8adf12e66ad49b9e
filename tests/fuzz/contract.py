"""What every entry point keeps, whatever arrives: it works, or refuses in one line that we wrote;
and the counts.

Refused properly means: an error type of the package (or ``ValueError``, ``TypeError`` or one about
files), raised by a ``raise`` statement in our own source, with one non-empty line. An
``AttributeError`` out of a dictionary, an error of torch, JAX or the standard library that passes
through, a hang: all of them fail the test.
"""

import ast
import functools
import os
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import HealthCheck, Phase, settings

from arcade_torch.tools.errors import FILES

ROOT = Path(__file__).resolve().parents[2]
OURS = tuple(
    str(ROOT / name) + os.sep for name in ("arcade_torch", "envs_jax", "models", "agents", "tools")
)
LIMIT_S = 60.0
"""No input may take longer; generous, since machines are shared."""
LONGEST_LINE = 15_000
"""Names of 5,000 characters arrive, and are quoted."""

SCALE = float(os.environ.get("FUZZ_SCALE", "1"))
"""``FUZZ_SCALE=0.01`` for a quick look, 10 for a night."""

few = False
"""Whether only a few inputs are generated, with the fast tests."""

counts: dict[str, Counter[str]] = {}


class Refused(Exception):
    """A refusal that the test itself has looked at."""


class Hang(BaseException):
    """An input took longer than `LIMIT_S`."""


def fuzz(inputs: int) -> settings:
    """Settings of hypothesis for so many generated inputs, times `SCALE`; with the fast tests for a
    few.
    """
    examples = (5 if inputs >= 1_000 else 1) if few else max(1, round(inputs * SCALE))
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )


def attempt(entry: str, call: Callable[[], object]) -> bool:
    """Try one input.

    Args:
        entry: name of the entry point, a row of the table at the end.
        call: hands the input to it.

    Returns:
        Whether it worked; False: it was refused properly.

    Raises:
        AssertionError: it did neither.
    """
    row = counts.setdefault(entry, Counter())
    row["inputs"] += 1
    try:
        with time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except Hang:
        raise AssertionError(f"{entry}: longer than {LIMIT_S:g} s") from None
    except Exception as error:
        if (why := improper(error)) is not None:
            raise AssertionError(
                f"{entry}: {why}: {type(error).__name__}: {str(error)[:300]}"
            ) from error
        row["refused"] += 1
        return False
    row["worked"] += 1
    return True


def improper(error: BaseException) -> str | None:
    """Why an error is no proper refusal; None if it is one."""
    if isinstance(error, Refused):
        return None
    kind, text = type(error), str(error)
    if not isinstance(error, (ValueError, TypeError, *FILES)) and not kind.__module__.startswith(
        "arcade_torch."
    ):
        return "not an error type of ours"
    if not text.strip() or "\n" in text:
        return "not one line"
    if len(text) > LONGEST_LINE:
        return f"a line of {len(text)} characters"
    place = traceback.extract_tb(error.__traceback__)[-1]
    if isinstance(error, OSError) and error.filename is not None:
        return None  # "[Errno 2] No such file or directory: 'x'" says it all
    if not place.filename.startswith(OURS):
        return f"raised in {place.filename}:{place.lineno}"
    if place.lineno is None or not any(place.lineno in lines for lines in _raises(place.filename)):
        return f"passed through {place.filename}:{place.lineno}"
    return None


@functools.cache
def _raises(filename: str) -> list[range]:
    """Lines of the statements of a file that raise."""
    nodes = ast.walk(ast.parse(Path(filename).read_text(encoding="utf-8")))
    return [
        range(node.lineno, (node.end_lineno or node.lineno) + 1)
        for node in nodes
        if isinstance(node, ast.Raise)
    ]


@contextmanager
def time_limit(seconds: float = LIMIT_S) -> Iterator[None]:
    """Raise `Hang` inside after so many seconds."""

    def late(number: int, frame: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Inside, no file of a folder may change, come or go."""
    before = content(folder)
    yield
    assert content(folder) == before, (
        f"files of {folder} were changed by something that only reads them"
    )


def content(folder: Path) -> dict[str, bytes]:
    """All files of a folder, by relative path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def table() -> str:
    """The counts as a Markdown table."""
    lines = ["| entry point | inputs | worked | refused in one line |", "|---|---:|---:|---:|"]
    for name in sorted(counts):
        row = counts[name]
        lines.append(f"| {name} | {row['inputs']:,} | {row['worked']:,} | {row['refused']:,} |")
    total = {
        key: sum(row[key] for row in counts.values()) for key in ("inputs", "worked", "refused")
    }
    lines.append(
        f"| **all** | **{total['inputs']:,}** | {total['worked']:,} | {total['refused']:,} |"
    )
    return "\n".join(lines)
