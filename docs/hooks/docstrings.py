"""How our docstrings are read: ``Example:`` is a section of examples, a role such as ``:func:`` is only its name."""

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^( *)Example:$", re.MULTILINE)
_ROLE = re.compile(r":(?:attr|class|func|meth|mod):(?=`)")


class OurDocstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Called once for each module, class, function and attribute that was found in the source."""
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub("", _EXAMPLE.sub(r"\1Examples:", obj.docstring.value))
