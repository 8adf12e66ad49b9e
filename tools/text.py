"""Text from files and from the command line on its way out: names in it are text, whatever they
hold.

One function for each place that text goes to: `printable` for a terminal, `csv_cell` for a table,
`markdown_cell` for a page. HTML pages are escaped by their templates, figures by
`arcade_torch.tools.figures.style`.
"""

import html
import sys
import unicodedata
from numbers import Number
from typing import Any

_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))
"""Unicode's control and format characters, lone surrogates, separators of lines and paragraphs."""
_FORMULA = ("=", "+", "-", "@")


def printable(text: object) -> str:
    r"""Text in one line, with everything written out that a terminal would obey, hide or reorder.

    These are escape sequences, line breaks, marks of direction, and bytes that are no text.

    Example:
        >>> print(printable("\x1b[2Jred\n\u202etxt"))
        \x1b[2Jred\n\u202etxt
    """
    given = str(text)
    if given.isascii() and given.isprintable():
        return given
    return "".join(map(_written_out, given))


def _written_out(char: str) -> str:
    if unicodedata.category(char) not in _HIDDEN:
        return char
    return char.encode("unicode_escape").decode("ascii")


def counted(number: int, noun: str) -> str:
    """A number of things.

    Example:
        >>> counted(1, "run"), counted(2000, "run")
        ('1 run', '2,000 runs')
    """
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def say(text: object) -> None:
    """Print one line to stdout, at once: in a log it stands before what stderr says later."""
    print(printable(text), flush=True)


def warn(text: object) -> None:
    """Print one line to stderr."""
    print(printable(text), file=sys.stderr, flush=True)


def csv_cell(value: Any) -> Any:
    """A cell of a table that no spreadsheet takes for a formula; numbers stay as they are.

    Example:
        >>> csv_cell("=1+1"), csv_cell("-0.5"), csv_cell(-0.5)
        ("'=1+1", '-0.5', -0.5)
    """
    if value is None or isinstance(value, Number):
        return value
    text = printable(value)
    if text.startswith(_FORMULA) and not _is_number(text):
        return f"'{text}"
    return text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def markdown_cell(text: str) -> str:
    """A cell of a Markdown table, without elements of HTML.

    Example:
        >>> markdown_cell("a|<b>")
        'a\\\\|&lt;b&gt;'
    """
    return html.escape(printable(text), quote=False).replace("|", "\\|")
