"""Formulas as MathML, which browsers draw by themselves: the site needs no script and no font for
them.
"""

import html
import re

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">'
    r"(?:\\\((?P<inline>.*?)\\\)|\\\[(?P<block>.*?)\\\])</(?P=tag)>",
    re.DOTALL,
)


def to_mathml(body: str) -> str:
    r"""Turn what the Markdown extension ``arithmatex`` leaves into MathML.

    Args:
        body: HTML with ``<span class="arithmatex">\(...\)</span>`` and ``<div
            class="arithmatex">\[...\]</div>``.
    """
    from latex2mathml.converter import convert

    def replace(match: re.Match[str]) -> str:
        block = match["block"] is not None
        source = html.unescape(match["block"] if block else match["inline"]).strip()
        formula = convert(source, display="block" if block else "inline")
        return f'<div class="formula">{formula}</div>' if block else formula

    return _FORMULA.sub(replace, body)
