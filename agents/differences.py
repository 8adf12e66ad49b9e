"""In what two runs differ, by their plain settings."""

from collections.abc import Iterable, Mapping
from typing import Any


def flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys: ``{"device": "cpu", "pqn": {"gamma": 0.9}}`` has
    ``pqn.gamma``.
    """
    parts = [
        flatten(x, f"{prefix}{n}.") if isinstance(x, Mapping) else {prefix + n: x}
        for n, x in plain.items()
    ]
    return {name: value for part in parts for name, value in part.items()}


def differences(
    one: Mapping[str, Any],
    other: Mapping[str, Any],
    default: Mapping[str, Any],
    algorithms: Iterable[str],
    free: Iterable[str],
) -> dict[str, tuple[Any, Any]]:
    """The settings in which two runs differ: dotted name -> both values.

    Args:
        one: nested settings of a run, as its ``config.json`` holds them.
        other: those of another.
        default: value of every setting. A run that lacks one has it: it may be from before there
            was that setting. One that is not known here is None where it is missing.
        algorithms: names of groups with the numbers of learners; those that neither run uses make
            no difference.
        free: settings, and groups of settings, that may differ.
    """
    mine = flatten(default) | flatten(_stated(one))
    theirs = flatten(default) | flatten(_stated(other))
    used = {str(mine["algorithm"]), str(theirs["algorithm"])}
    skipped = {*free} | {*algorithms} - used
    pairs = dict[str, tuple[Any, Any]]()
    for name in sorted(mine.keys() | theirs.keys()):
        group = name.partition(".")[0]
        values = mine.get(name), theirs.get(name)
        if values[0] != values[1] and not {name, group} & skipped:
            pairs[name] = values
    return pairs


def _stated(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings without those that are null, which say nothing."""
    return {name: value for name, value in settings.items() if value is not None}
