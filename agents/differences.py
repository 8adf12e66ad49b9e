"""In what two runs differ: their settings, flat, and side by side. Nothing here imports torch."""

from collections.abc import Iterable, Mapping
from typing import Any

from arcade_torch.agents.config import GROUPS, TrainConfig

# fields that do not belong to a run's identity
RESUME_MAY_CHANGE = ("checkpoint_every", "threads", "logger")

Settings = TrainConfig | Mapping[str, Any]  # a config, or what a ``config.json`` holds


def differing_fields(
    one: Settings, other: Settings, free: Iterable[str] = RESUME_MAY_CHANGE
) -> list[str]:
    """Names of the fields that make two configs different runs, as ``name (this != that)``; see
    `differing_values`.
    """
    pairs = differing_values(one, other, free).items()
    return [f"{name} ({this!r} != {that!r})" for name, (this, that) in pairs]


def differing_values(
    one: Settings, other: Settings, free: Iterable[str]
) -> dict[str, tuple[Any, Any]]:
    """The settings in which two runs differ: dotted name -> both values.

    Args:
        one: settings of a run, as a config or as its ``config.json`` holds them. A setting that is
            not there has its default: the run may be from before there was that setting. One that
            is not known here is None where it is missing.
        other: those of another.
        free: settings, and groups of settings, that may differ. The groups of learners that neither
            run uses make no difference.
    """
    default = flatten(TrainConfig().to_dict())
    mine = default | flatten(_stated(one))
    theirs = default | flatten(_stated(other))
    used = {str(mine["algorithm"]), str(theirs["algorithm"])}
    skipped = {*free} | {*GROUPS} - used
    pairs = dict[str, tuple[Any, Any]]()
    for name in sorted(mine.keys() | theirs.keys()):
        group = name.partition(".")[0]
        values = mine.get(name), theirs.get(name)
        if values[0] != values[1] and not {name, group} & skipped:
            pairs[name] = values
    return pairs


def _stated(settings: Settings) -> dict[str, Any]:
    """Plain settings without those that are null, which say nothing."""
    plain = settings.to_dict() if isinstance(settings, TrainConfig) else settings
    return {name: value for name, value in plain.items() if value is not None}


def flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys: ``{"device": "cpu", "pqn": {"gamma": 0.9}}`` has
    ``pqn.gamma``.
    """
    settings = dict[str, Any]()
    for name, value in plain.items():
        if isinstance(value, Mapping):
            settings |= flatten(value, f"{prefix}{name}.")
        else:
            settings[prefix + name] = value
    return settings
