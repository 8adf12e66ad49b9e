"""Scripted players: upper baselines for reports, and proofs that the tasks can be solved.

A *state* oracle sees the game's state; it pins the return that is reachable. A *frames* oracle sees
only what the POMDP's frames have shown so far, and remembers it; it shows how much of that return
memory can recover.
"""

import abc
import math
import time
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.batch import Batch, BatchedGame, env_keys
from arcade_torch.envs_jax.game import NUM_ACTIONS, ORACLES, Game, check_ends
from arcade_torch.envs_jax.settings import as_numpy
from arcade_torch.envs_jax.validation import check_choice, format_value, kind_of

Kind = Literal["state", "frames"]
Actions = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]
Frames = npt.NDArray[np.uint8]


class Player(Protocol):
    """Somebody who plays N episodes at once.

    ``act`` gets what the player may see (for a state oracle the game's state with numpy leaves [N,
    ...], for a frames oracle uint8 [N, S, S, 3]) and bool [N], true where this is the first sight
    of an episode; it returns int32 [N].
    """

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> Actions:
        """Choose an action in every env."""


class FramesPlayer(abc.ABC):
    """A player that sees the frames of the POMDP twin and remembers what they have shown.

    Args:
        game: What to play.
    """

    def __init__(self, game: Any) -> None:
        self.level = game.level
        self.screen = game.screen
        self._num_envs = -1

    def act(self, seen: Frames, is_init: Bools) -> Actions:
        """See :class:`Player`."""
        if len(seen) != self._num_envs:
            self.allocate(len(seen))
            self._num_envs = len(seen)
        return self.choose(seen, is_init).astype(np.int32)

    @abc.abstractmethod
    def allocate(self, num_envs: int) -> None:
        """Make a memory for N envs, with any content."""

    @abc.abstractmethod
    def choose(self, frames: Frames, is_init: Bools) -> npt.NDArray[Any]:
        """Choose an action in every env.

        Args:
            frames: uint8 [N, S, S, 3].
            is_init: bool [N], where an episode begins, and the memory is to be forgotten.

        Returns:
            Whole numbers [N].
        """


class Episodes(NamedTuple):
    """What a player reached."""

    returns: npt.NDArray[np.float32]  # [episodes], undiscounted
    lengths: npt.NDArray[np.int32]  # [episodes], steps


class RandomPlayer:
    """Uniformly random actions."""

    def __init__(self, seed: int = 0) -> None:
        self.generator = np.random.default_rng(seed)

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> Actions:
        """See :class:`Player`."""
        return self.generator.integers(NUM_ACTIONS, size=len(is_init), dtype=np.int32)


def make_oracle(game: Game[Any], kind: Kind = "state") -> Player:
    """The scripted player of a game.

    Args:
        game: What to play.
        kind: ``"state"`` sees the state, ``"frames"`` the frames of the POMDP twin.

    Raises:
        ValueError: Unknown ``kind``, the game has no such oracle, or it is no player.
    """
    check_choice("kind", kind, ORACLES)
    if kind not in game.oracles:
        raise ValueError(
            f"{game.id} has no {kind} oracle: name one in {type(game).__name__}.oracles"
        )
    player: Player = game.oracles[kind](game)
    if not callable(getattr(player, "act", None)):
        raise ValueError(
            f"{game.id}: the {kind} oracle is {kind_of(player)}, wanted a player with "
            "act(seen, is_init)"
        )
    return player


def play(
    game: Game[Any],
    player: Player,
    episodes: int,
    seed: int = 0,
    *,
    frames: bool = False,
    block: int = 256,
    seconds: float = math.inf,
) -> Episodes:
    """Let a player finish one episode in each of many envs.

    Args:
        game: What to play.
        player: Who plays.
        episodes: How many envs, one episode each.
        seed: Seed of the envs.
        frames: Show the player the frames of the POMDP twin; otherwise the states.
        block: Envs played at once; bounds the memory, and does not change any result of a player
            that is deterministic.
        seconds: No block is begun when this time has passed; the first one is always played, and
            all to the end.

    Returns:
        Returns and lengths.

    Raises:
        ValueError: ``episodes`` is not positive, an episode does not end in time, or the player
            gives no actions.
    """
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}, expected at least 1")
    block = min(block, episodes)
    batched = BatchedGame(game)
    started = time.monotonic()
    parts: list[Episodes] = []
    for first in range(0, episodes, block):
        if parts and time.monotonic() - started > seconds:
            break
        parts.append(_play_block(batched, player, env_keys(seed, block, first), frames))
    return Episodes(*(np.concatenate(field)[:episodes] for field in zip(*parts, strict=True)))


def _play_block(
    batched: BatchedGame[Any], player: Player, keys: jax.Array, frames: bool
) -> Episodes:
    """One episode in each env; envs that are finished idle at their end."""
    size = len(keys)
    batch: Batch = batched.init(keys, jnp.full(size, frames))
    returns = np.zeros(size, np.float32)
    lengths = np.zeros(size, np.int32)
    running = np.ones(size, bool)
    is_init = np.ones(size, bool)
    while running.any():
        check_ends(batched.game, int(lengths.max()))
        seen = np.asarray(batched.render(batch)) if frames else as_numpy(batch.state)
        batch, outcome = batched.step(batch, _checked(player.act(seen, is_init), size))
        returns += np.asarray(outcome.reward) * running
        lengths += running
        running &= ~np.asarray(outcome.done)
        is_init = np.zeros(size, bool)
    return Episodes(returns, lengths)


def _checked(actions: Any, num_envs: int) -> Actions:
    """A player's actions as int32 [N]; a ValueError if they are none."""
    given = np.asarray(actions)
    is_whole = np.issubdtype(given.dtype, np.integer) and given.shape == (num_envs,)
    if not is_whole or given.min() < 0 or given.max() >= NUM_ACTIONS:
        raise ValueError(
            f"the player gives {given.dtype} {list(given.shape)}, {format_value(given)}, expected "
            f"integers [{num_envs}] from 0 to {NUM_ACTIONS - 1}"
        )
    return given.astype(np.int32)


def random_return(game: Game[Any], episodes: int = 1000, seed: int = 0) -> npt.NDArray[np.float32]:
    """Returns of the uniformly random policy: float32 [episodes]."""
    return play(game, RandomPlayer(seed), episodes, seed).returns


def oracle_return(
    game: Game[Any], kind: Kind = "state", episodes: int = 1000, seed: int = 0
) -> npt.NDArray[np.float32]:
    """Returns of the game's oracle: float32 [episodes]; see :func:`make_oracle`."""
    return play(game, make_oracle(game, kind), episodes, seed, frames=kind == "frames").returns
