"""The protocol of the leaderboard: what is evaluated, on which seeds, and who is ranked with whom.

A change of any number here is another protocol: it gets a version of its own, and entries of two
versions never share a table.
"""

from dataclasses import dataclass
from functools import cache

TWINS = ("full", "partial")
OBSERVATIONS = ("pixels", "last_action", "is_init")
"""What an agent may read, in training and when it is evaluated: the frame of the twin that it is
evaluated on, its last action, and whether an episode begins. Anything else is privileged."""
QUICK = ("SignpostEasy-v0", "MineSweeperEasy-v0", "CountRecallEasy-v0")
"""Three games that a core trains in a minute or two each: recall, mapping and counting."""
CLASSES = {"100k": 100_000, "2.5M": 2_500_000, "20M": 20_000_000}
"""Frames of training, at most: entries are ranked within a class alone."""
OPEN_CLASS = "open"
"""The class of entries with more frames than the largest of `CLASSES`."""


@dataclass(frozen=True)
class Protocol:
    """What decides a score."""

    version: int = 1
    episodes: int = 1024  # greedy, one in each of as many environments
    # evaluation seed; evaluations during training play seed 0
    seed: int = 1_000_000
    rules: str = "default"
    obs_size: int = 128


PROTOCOL = Protocol()
"""The protocol of the page."""


@dataclass(frozen=True)
class Suite:
    """Games that are ranked together; an entry is ranked if it has all of them."""

    name: str
    games: tuple[str, ...]  # versioned ids
    title: str


def frames_class(frames: int) -> str:
    """The class of an entry by its frames of training.

    Example:
        >>> frames_class(98_304), frames_class(10**9)
        ('100k', 'open')
    """
    for name, most in CLASSES.items():
        if frames <= most:
            return name
    return OPEN_CLASS


@cache
def suites() -> tuple[Suite, ...]:
    """The ten Easy games, the three quick ones, the ten Medium games, and the Easy games by what
    their POMDP asks of a memory.
    """
    from arcade_torch.envs_jax import make
    from arcade_torch.envs_jax.game import MEMORY_KINDS
    from arcade_torch.envs_jax.registry import GAMES, resolve_id

    easy = [resolve_id(f"{game}Easy") for game in GAMES]
    medium = tuple(resolve_id(f"{game}Medium") for game in GAMES)
    kinds: dict[str, list[str]] = {kind: [] for kind in MEMORY_KINDS}
    for game in easy:
        kinds[make(game).memory_kind].append(game)
    groups = [
        Suite("easy", tuple(easy), "The ten Easy games"),
        Suite("quick", QUICK, "The three quick games"),
        Suite("medium", medium, "The ten Medium games"),
    ]
    for kind, games in kinds.items():
        title = "No memory" if kind == "none" else kind.capitalize()
        meaning = MEMORY_KINDS[kind].removeprefix("nothing: ")
        groups.append(Suite(kind, tuple(games), f"{title}: {meaning}"))
    return tuple(groups)
