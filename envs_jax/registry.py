"""The one table of games: versioned ids, aliases, and how to make each."""

import difflib
import inspect
import re
from collections.abc import Callable, Iterable
from typing import Any

from arcade_torch.envs_jax.checks import check_foreign
from arcade_torch.envs_jax.game import OBS_SIZES, RULES, Game, check_choice
from arcade_torch.envs_jax.shown import shown

Factory = Callable[..., Game[Any]]

_FACTORIES: dict[str, Factory] = {}
_NEWEST: dict[str, str] = {}
_ALIASES: dict[str, str] = {}
_PROBES: set[str] = set()
_VERSIONED = re.compile(r"^(?P<name>[A-Za-z][A-Za-z0-9]*)-v(?P<version>\d+)$")


def register(id: str, factory: Factory, aliases: Iterable[str] = (), *, probe: bool = False) -> None:
    """Add a game to the registry.

    Args:
        id: Versioned id, ``"NameDifficulty-vN"``. The bare name comes to mean the highest version registered.
        factory: Called as ``factory(id=..., obs_size=..., rules=..., **options)``; returns the game, which ``make``
            checks. Its further keyword arguments are the options that ``make`` accepts.
        aliases: Other bare names for the same game.
        probe: Whether this is a small task for looking at agents, listed by :func:`probe_ids`, and not one of the
            benchmark's, listed by :func:`registered_ids`.

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
    if probe:
        _PROBES.add(id)


def registered_ids() -> list[str]:
    """All versioned ids of the benchmark and of games of your own, sorted; without the probes.

    Example:
        >>> "MineSweeperEasy-v0" in registered_ids()
        True
    """
    return sorted(_FACTORIES.keys() - _PROBES)


def probe_ids() -> list[str]:
    """Versioned ids of the small tasks that show whether an agent remembers, sorted.

    Example:
        >>> probe_ids()
        ['SignpostEasy-v0', 'SignpostHard-v0', 'SignpostMedium-v0']
    """
    return sorted(_PROBES)


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
        raise TypeError(f"the env id is {shown(id)}, expected a string such as 'CartPoleEasy'")
    match = _VERSIONED.match(id)
    name = match["name"] if match else id
    name = _ALIASES.get(name, name)
    wanted = f"{name}-v{match['version']}" if match else _NEWEST.get(name, "")
    if wanted in _FACTORIES:
        return wanted
    if match and name in _NEWEST:
        raise ValueError(f"unknown version in env id {shown(id)}: the newest is {_NEWEST[name]!r}")
    known = {known.lower(): known for known in (*_NEWEST, *_ALIASES)}
    near = difflib.get_close_matches(name.lower(), list(known), n=1, cutoff=0.4)
    hint = f"did you mean {known[near[0]]!r}? " if near else ""
    raise ValueError(
        f"unknown env id {shown(id)}: {hint}All ids: arcade_torch.registered_ids() or 'arcade-torch list'; a game of "
        "your own has to be registered first, on the command line with --import"
    )


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
        ValueError: Unknown id, size, rules or option value; or a game of one's own that does not keep the contract,
            see ``check_game``.
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
    game = factory(id=full_id, obs_size=obs_size, rules=rules, **options)
    _check_made(game, full_id, obs_size)
    return game


def _check_made(game: Game[Any], full_id: str, obs_size: int) -> None:
    """Refuse what a factory made if it is not the game that was asked for, or does not keep the contract."""
    if not isinstance(game, Game):
        raise ValueError(f"the factory of {full_id} made a {type(game).__name__}, wanted a Game")
    if (game.id, game.obs_size) != (full_id, obs_size):
        made = f"{game.id!r} with obs_size {game.obs_size!r}"
        raise ValueError(
            f"the factory of {full_id} made {made}, wanted {full_id!r} with obs_size {obs_size}: pass on both"
        )
    check_foreign(game)


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
