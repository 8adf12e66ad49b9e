"""The one table of games: versioned ids, aliases, and how to make each. Loads no JAX before a game
is made.
"""

import difflib
import inspect
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

from arcade_torch.envs_jax.validation import check_choice, format_value, plain

if TYPE_CHECKING:
    from arcade_torch.envs_jax.game import Game

Factory = Callable[..., "Game[Any]"]
OBS_SIZES = (128, 256)
DIFFICULTIES = ("Easy", "Medium", "Hard")
# A game of this package is one line: where its class is. The class knows its difficulties
# (``levels``) and oracles.
GAMES = {
    "AutoEncode": "autoencode:AutoEncode",
    "BattleShip": "battleship:BattleShip",
    "Breakout": "breakout:Breakout",
    "CartPole": "cartpole:CartPole",
    "CountRecall": "countrecall:CountRecall",
    "MineSweeper": "minesweeper:MineSweeper",
    "Navigator": "navigator:Navigator",
    "NoisyCartPole": "cartpole:CartPole",
    "Skittles": "skittles:Skittles",
    "Tetris": "tetris:Tetris",
}
PROBES = {"Signpost": "signpost:Signpost"}


class _Entry(NamedTuple):
    factory: Factory | str  # a string as in ``GAMES`` is imported when the game is asked for
    probe: bool


_ENTRIES: dict[str, _Entry] = {}  # by versioned id
_ALIASES: dict[str, str] = {}  # bare names and aliases: which bare name each means
_LISTENERS: list[Callable[[str], object]] = []
_VERSIONED = re.compile(r"(?P<name>[A-Za-z][A-Za-z0-9]*)-v(?P<version>0|[1-9][0-9]*)")
_SHARES = re.compile(r"(?P<shares>[1-9][0-9]?)\*(?P<name>.+)")


def register(
    id: str, factory: Factory, aliases: Iterable[str] = (), *, probe: bool = False
) -> None:
    """Add a game: ``make``, Gymnasium, the command line and all tools know it from then on.

    Args:
        id: Versioned id, ``"NameDifficulty-vN"``. The bare name comes to mean the highest version
            registered.
        factory: Called as ``factory(id=..., obs_size=..., rules=..., **options)``; returns the
            game, which ``make`` checks. Mostly the game's class. Its further keyword arguments are
            the options that ``make`` accepts.
        aliases: Other bare names for the same game.
        probe: Whether this is a small task for looking at agents, listed by :func:`probe_ids`, and
            not one of the benchmark's, listed by :func:`registered_ids` and known to Gymnasium.

    Raises:
        TypeError: The id is no string, the factory cannot be called, or the aliases are one string.
        ValueError: The id is not a name of letters and digits with a version, or is taken; or one
            of the names is another game's.
    """
    if not callable(factory):
        raise TypeError(
            f"the factory of {format_value(id)} is {format_value(factory)}, expected the game's "
            "class, or a function that makes the game"
        )
    if isinstance(aliases, str):
        raise TypeError(f"aliases is {aliases!r}, expected a list: [{aliases!r}]")
    _add(id, factory, aliases, probe)


def _add(id: str, factory: Factory | str, aliases: Iterable[str], probe: bool) -> None:
    """See :func:`register`; the factory of a game of this package is where its class is."""
    if not isinstance(id, str):
        raise TypeError(f"id is {format_value(id)}, expected a string such as 'PairsEasy-v0'")
    match = _VERSIONED.fullmatch(id)
    if match is None:
        lacks = "is no name of letters and digits with a" if "-v" in id else "has no"
        raise ValueError(f"id {id!r} {lacks} version: write it as 'NameDifficulty-v0'")
    if id in _ENTRIES:
        raise ValueError(
            f"id {id!r} is registered already: raise its version or choose another name"
        )
    names = dict.fromkeys((match["name"], *aliases), match["name"])
    for alias, name in names.items():
        owner = _ALIASES.get(alias.partition("-v")[0], name)
        if owner != name:
            raise ValueError(
                f"the name {alias!r} belongs to the game {owner!r} already: choose another"
            )
    _ENTRIES[id] = _Entry(factory, probe)
    _ALIASES.update(names)
    if not probe:
        for listener in _LISTENERS:
            listener(id)


def on_register(listener: Callable[[str], object]) -> None:
    """Call a function with every id that ``registered_ids`` gives now, and with each that is
    registered later.
    """
    _LISTENERS.append(listener)
    for id in registered_ids():
        listener(id)


def registered_ids() -> list[str]:
    """All versioned ids of the benchmark and of games of your own, sorted; without the probes.

    Example:
        >>> "MineSweeperEasy-v0" in registered_ids()
        True
    """
    return sorted(id for id, entry in _ENTRIES.items() if not entry.probe)


def probe_ids() -> list[str]:
    """Versioned ids of the small tasks that show whether an agent remembers, sorted.

    Example:
        >>> probe_ids()
        ['SignpostEasy-v0', 'SignpostHard-v0', 'SignpostMedium-v0']
    """
    return sorted(id for id, entry in _ENTRIES.items() if entry.probe)


def resolve_id(id: str) -> str:
    """Turn a bare name, an alias or a versioned id into the versioned id.

    Args:
        id: What the user wrote; of a mixture the names of its games, see :func:`games_of`.

    Returns:
        The versioned id.

    Raises:
        TypeError: ``id`` is not a string.
        ValueError: No such game; the message names the nearest one.

    Example:
        >>> resolve_id("NoisyPoleEasy")
        'NoisyCartPoleEasy-v0'
        >>> resolve_id("CartPoleEasy+TetrisEasy")
        'CartPoleEasy-v0+TetrisEasy-v0'
    """
    if is_mixture(id):
        return mixture_id(Counter(games_of(id)))
    return _resolve_one(id)


def is_mixture(id: str) -> bool:
    """Whether an id names several games, ``"CartPoleEasy+TetrisEasy"``; none of one has a plus."""
    return isinstance(id, str) and "+" in id


def names_in(id: str) -> list[str]:
    """The names that an id is written with, each as often as it has shares; nothing is looked up.

    Example:
        >>> names_in("CartPoleEasy+2*TetrisEasy")
        ['CartPoleEasy', 'TetrisEasy', 'TetrisEasy']
    """
    if not is_mixture(id):
        return [id]
    names: list[str] = []
    for part in id.split("+"):
        match = _SHARES.fullmatch(part)
        names += [match["name"]] * int(match["shares"]) if match else [part]
    return names


def games_of(id: str) -> tuple[str, ...]:
    """The versioned ids of the games that an id names: one, or those of a mixture.

    Args:
        id: ``"CartPoleEasy"``, or of a mixture ``"CartPoleEasy+2*TetrisEasy"``.

    Returns:
        The ids, each as often as the game has shares of the envs.

    Raises:
        TypeError: ``id`` is not a string.
        ValueError: No such game; the message names the nearest one.

    Example:
        >>> games_of("CartPoleEasy+2*TetrisEasy")
        ('CartPoleEasy-v0', 'TetrisEasy-v0', 'TetrisEasy-v0')
    """
    return tuple(_resolve_one(name) for name in names_in(id))


def mixture_id(shares: Mapping[str, int]) -> str:
    """The id of a mixture, from the versioned ids of its games and their shares of the envs.

    Example:
        >>> mixture_id({"CartPoleEasy-v0": 1, "TetrisEasy-v0": 2})
        'CartPoleEasy-v0+2*TetrisEasy-v0'
    """
    parts = [f"{count}*{id}" if count > 1 else id for id, count in shares.items()]
    return "+".join(parts)


def _resolve_one(id: str) -> str:
    """See :func:`resolve_id`, of one game."""
    if not isinstance(id, str):
        raise TypeError(
            f"the env id is {format_value(id)}, expected a string such as 'CartPoleEasy'"
        )
    match = _VERSIONED.fullmatch(id)
    name = match["name"] if match else id
    name = _ALIASES.get(name, name)
    newest = _newest()
    wanted = f"{name}-v{match['version']}" if match else newest.get(name, "")
    if wanted in _ENTRIES:
        return wanted
    if name in newest:
        raise ValueError(
            f"unknown version in env id {format_value(id)}: the newest is {newest[name]!r}"
        )
    names = {alias.lower(): alias for alias in _ALIASES}
    near = difflib.get_close_matches(name.lower(), list(names), n=1, cutoff=0.4)
    hint = f"did you mean {names[near[0]]!r}? Else " if near else ""
    raise ValueError(
        f"unknown env id {format_value(id)}: {hint}arcade_torch.registered_ids() lists all, as "
        "does 'arcade-torch list'; a game of your own has to be registered first in every "
        "process, on the command line with --import"
    )


def is_built_in(id: str) -> bool:
    """Whether a registered id, bare name or alias means a game of this package, not one of yours;
    of a mixture whether all its games are.

    Example:
        >>> is_built_in("TetrisEasy")
        True
    """
    return all(isinstance(_ENTRIES[game].factory, str) for game in games_of(id))


def _newest() -> dict[str, str]:
    """The newest id of each bare name."""
    newest = dict[str, int]()
    for id in _ENTRIES:
        name, _, version = id.rpartition("-v")
        newest[name] = max(newest.get(name, 0), int(version))
    return {name: f"{name}-v{version}" for name, version in newest.items()}


def make(id: str, *, obs_size: int = 128, rules: str = "default", **options: Any) -> "Game[Any]":
    """Make a game.

    Args:
        id: A registered id (``"CartPoleEasy-v0"``), its bare name (``"CartPoleEasy"``, the newest
            version), or an alias.
        obs_size: Side of the picture in pixels, 128 or 256.
        rules: ``"default"`` for the corrected rules, ``"reference"`` for those of the published
            numbers (late endings included).
        **options: Options of this game; an unknown one is refused with the list of those it has.

    Returns:
        The game.

    Raises:
        ValueError: Unknown id, size, rules or option value; or a game of one's own whose factory
            raises an error, or that does not keep the contract, see ``check_game``.
        TypeError: Unknown option.

    Example:
        >>> make("MineSweeperHard").max_steps
        128
    """
    if is_mixture(id):
        raise ValueError(
            f"{format_value(id)} names several games, expected one: a mixture is a batch of envs, "
            "arcade_torch.make(...) or MixedGames(...)"
        )
    full_id = resolve_id(id)
    obs_size = plain(obs_size)
    options = {name: plain(value) for name, value in options.items()}
    check_choice("obs_size", obs_size, OBS_SIZES)
    check_choice("rules", rules, ("default", "reference"))
    allowed = option_names(full_id)
    unknown = sorted(set(options) - set(allowed))
    if unknown:
        has = f"its options are {', '.join(allowed)}" if allowed else "it has none of its own"
        # TorchRL's GymEnv passes a frameskip, and does without it where it reads these words.
        raise TypeError(
            f"{full_id} has no option {unknown[0]!r}: {has} (unexpected keyword argument "
            f"{unknown[0]!r})"
        )
    from arcade_torch.envs_jax.checks import check_made

    factory = _factory(full_id)
    if is_built_in(full_id):
        return factory(id=full_id, obs_size=obs_size, rules=rules, **options)
    try:
        game = factory(id=full_id, obs_size=obs_size, rules=rules, **options)
    except Exception as error:
        given = f" with {format_value(options)}" if options else ""
        raise ValueError(
            f"the factory of {full_id} failed{given}, {type(error).__name__}: "
            f"{' '.join(str(error).split())}"
        ) from error
    check_made(game, full_id, obs_size)
    return game


def _factory(id: str) -> Factory:
    """What makes a game."""
    factory = _ENTRIES[id].factory
    if not isinstance(factory, str):
        return factory
    module, _, name = factory.partition(":")
    game_class = getattr(import_module(f"arcade_torch.envs_jax.{module}"), name)
    return partial(game_class, game_class.levels[id.rpartition("-v")[0]])


def option_names(id: str) -> list[str]:
    """Names of the options a game takes beside size and rules.

    Args:
        id: A registered id, bare name or alias.

    Returns:
        The names, in the order of the game's documentation; of a mixture those that all its games
        have.
    """
    first, *others = map(_options_of_one, games_of(id))
    return [name for name in first if all(name in names for names in others)]


def _options_of_one(id: str) -> list[str]:
    """See :func:`option_names`."""
    parameters = inspect.signature(_factory(id)).parameters.values()
    named = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    return [name for name in named if name not in ("id", "obs_size", "rules")]


for _name, _where in (GAMES | PROBES).items():
    for _difficulty in DIFFICULTIES:
        _aliases = [f"NoisyPole{_difficulty}"] if _name == "NoisyCartPole" else []
        _add(f"{_name}{_difficulty}-v0", _where, _aliases, _name in PROBES)
