"""How a value that is refused stands in a message: on one line, and not longer than a line."""

from typing import Any

_LONGEST = 200


def shown(value: Any) -> str:
    """The ``repr`` of a value without line breaks, cut where it gets long.

    Example:
        >>> import numpy as np
        >>> shown(np.zeros((2, 2)))
        'array([[0., 0.], [0., 0.]])'
    """
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"
