"""NAME=VALUE on the command line."""

import json
from typing import Any


def name_and_value(text: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``; the value as JSON where it is JSON, otherwise as a word.

    Example:
        >>> name_and_value("tail=previous"), name_and_value("random_start=True")
        (('tail', 'previous'), ('random_start', True))
    """
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ValueError(f"an option is written NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value.lower() if value in ("True", "False") else value)
    except (ValueError, RecursionError):  # no JSON, or numbers and nesting that Python does not read
        return name, value
