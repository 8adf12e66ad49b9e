"""Letters that the font of figures lacks, such as those of Chinese: from other fonts that are
installed.
"""

import contextlib
import re
import warnings
from typing import IO, Any

from arcade_torch.tools.errors import need

_MISSING = re.compile(r"Glyph (\d+) .*missing from font")
_NO_LETTERS = re.compile(r"\.?Last ?Resort|STIXNon|STIXSize|cm[a-z]+10")
"""Fonts that have a sign for everything, or signs under the numbers of others."""


def save_figure(figure: Any, file: IO[Any], **options: Any) -> str:
    """Write a figure into an empty file; options are those of ``Figure.savefig``.

    Returns:
        The letters that no installed font has, which are drawn as boxes.
    """
    missing = _save(figure, file, options)
    fonts = _fonts_with(missing)
    if not fonts:
        return missing
    for text in figure.findobj(need("matplotlib.text").Text):
        text.set_fontfamily([*text.get_fontfamily(), *fonts])
    file.seek(0)
    file.truncate()
    return _save(figure, file, options)


def _save(figure: Any, file: IO[Any], options: dict[str, Any]) -> str:
    """Write a figure; gives the letters that matplotlib warns of, in the order of the alphabet."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        figure.savefig(file, **options)
    missing = set[str]()
    for warning in caught:
        said = _MISSING.match(str(warning.message))
        if said:
            missing.add(chr(int(said[1])))
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    return "".join(sorted(missing))


def _fonts_with(letters: str) -> list[str]:
    """Names of installed fonts that have some letters, those with the most of them first."""
    if not letters:
        return []
    wanted = set(map(ord, letters))
    manager = need("matplotlib.font_manager")
    covered = dict[str, set[int]]()
    for entry in manager.fontManager.ttflist:
        if _NO_LETTERS.match(entry.name):
            continue
        with contextlib.suppress(OSError, RuntimeError):  # what cannot be opened has no letters
            font = manager.get_font(entry.fname)
            if not font.num_fixed_sizes:  # no pictures in one size, as colourful emoji are
                covered.setdefault(entry.name, set()).update(wanted & set(font.get_charmap()))
    names = list[str]()
    while wanted and covered:
        best = max(covered, key=lambda name: len(covered[name] & wanted))
        letters_of_best = covered.pop(best) & wanted
        if not letters_of_best:
            break
        names.append(best)
        wanted -= letters_of_best
    return names
