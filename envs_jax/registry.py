"""The one table of games: versioned ids, aliases, and how to make each."""

import difflib
import inspect
import re
from collections.abc import Callable, Iterable
from typing import Any

from arcade_torch.envs_jax.game import OBS_SIZES, RULES, Game, check_choice

Factory = Callable[..., Game[Any]]

_FACTORIES: dict[str, Factory] = {}
_NEWEST: dict[str, str] = {}
_ALIASES: dict[str, str] = {}
_VERSIONED = re.compile(r"^(?P<name>[A-Za-z][A-Za-z0-9]*)-v(?P<version>\d+)$")


def register(id: str, factory: Factory, aliases: Iterable[str] = ()) -> None:
    """Add a game to the registry.

    Args:
        id: Versioned id, ``"NameDifficulty-vN"``. The bare name comes to mean the highest version registered.
        factory: Called as ``factory(id=..., obs_size=..., rules=..., **options)``; returns the game. Its further
            keyword arguments are the options that ``make`` accepts.
        aliases: Other bare names for the same game.

    Raises:
        ValueError: The id has no version, or is taken.
    """
    match = _VERSIONED.match(id)
    if match is None:
        raise ValueError(f"id {id!r} has no version: write it as 'NameDifficulty-v0'")
    if id in _FACTORIES:
        raise ValueError(f"id {id!r} is registered already: raise its version or choose another name")
    _FACTORIES[id] = factory
    name = match["name"]
    if name not in _NEWEST or int(match["version"]) > int(_NEWEST[name].rsplit("-v", 1)[1]):
        _NEWEST[name] = id
    for alias in aliases:
        _ALIASES[alias] = name


def registered_ids() -> list[str]:
    """All versioned ids, sorted.

    Example:
        >>> "MineSweeperEasy-v0" in registered_ids()
        True
    """
    return sorted(_FACTORIES)


def resolve_id(id: str) -> str:
    """Turn a bare name, an alias or a versioned id into the versioned id.

    Args:
        id: What the user wrote.

    Returns:
        The versioned id.

    Raises:
        TypeError: ``id`` is not a string.
        ValueError: No such game; the message names the nearest one.

    Example:
        >>> resolve_id("NoisyPoleEasy")
        'NoisyCartPoleEasy-v0'
    """
    if not isinstance(id, str):
        raise TypeError(f"the env id is {id!r}, expected a string such as 'CartPoleEasy'")
    match = _VERSIONED.match(id)
    name = match["name"] if match else id
    name = _ALIASES.get(name, name)
    wanted = f"{name}-v{match['version']}" if match else _NEWEST.get(name, "")
    if wanted in _FACTORIES:
        return wanted
    if match and name in _NEWEST:
        raise ValueError(f"unknown version in env id {id!r}: the newest is {_NEWEST[name]!r}")
    known = {known.lower(): known for known in (*_NEWEST, *_ALIASES)}
    near = difflib.get_close_matches(name.lower(), list(known), n=1, cutoff=0.4)
    hint = f"did you mean {known[near[0]]!r}? " if near else ""
    raise ValueError(f"unknown env id {id!r}: {hint}All ids: arcade_torch.registered_ids() or 'arcade-torch list'")


def make(id: str, *, obs_size: int = 128, rules: str = "default", **options: Any) -> Game[Any]:
    """Make a game.

    Args:
        id: A registered id (``"CartPoleEasy-v0"``), its bare name (``"CartPoleEasy"``, the newest version), or an
            alias.
        obs_size: Side of the picture in pixels, 128 or 256.
        rules: ``"default"`` for the corrected law, ``"reference"`` for the law of the published numbers (late endings
            included).
        **options: Options of this game; an unknown one is refused with the list of those it has.

    Returns:
        The game.

    Raises:
        ValueError: Unknown id, size, rules or option value.
        TypeError: Unknown option.

    Example:
        >>> make("MineSweeperHard").max_steps
        128
    """
    full_id = resolve_id(id)
    check_choice("obs_size", obs_size, OBS_SIZES)
    check_choice("rules", rules, RULES)
    factory = _FACTORIES[full_id]
    allowed = option_names(full_id)
    unknown = sorted(set(options) - set(allowed))
    if unknown:
        has = f"its options are {', '.join(allowed)}" if allowed else "it has no options"
        raise TypeError(f"{full_id} has no option {unknown[0]!r}: {has}")
    return factory(id=full_id, obs_size=obs_size, rules=rules, **options)


def option_names(id: str) -> list[str]:
    """Names of the options a game takes beside size and rules.

    Args:
        id: A registered id, bare name or alias.

    Returns:
        The names, in the order of the game's documentation.
    """
    parameters = inspect.signature(_FACTORIES[resolve_id(id)]).parameters.values()
    fixed = {"id", "obs_size", "rules", "level"}
    return [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in fixed]
