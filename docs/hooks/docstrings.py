"""How our docstrings are read: ``Example:`` is a section of examples, a role such as ``:func:`` is
only its name.

The comment behind a field or a constant is its docstring.
"""

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^( *)Example:$", re.MULTILINE)
_ROLE = re.compile(r":(?:attr|class|func|meth|mod):(?=`)")
_COMMENT = re.compile(r"  # (?!type:|noqa|fmt:)(.+)$")


class OurDocstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Called once for each module, class, function and attribute that was found in the
        source.
        """
        lines = getattr(obj, "lines", [])
        if obj.docstring is None and len(lines) == 1 and (comment := _COMMENT.search(lines[0])):
            obj.docstring = griffe.Docstring(comment[1], parent=obj)
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub("", _EXAMPLE.sub(r"\1Examples:", obj.docstring.value))
