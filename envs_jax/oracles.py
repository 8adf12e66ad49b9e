"""Scripted players: upper baselines for reports, and proofs that the tasks can be solved.

A *state* oracle sees the game's state; it pins the return that is reachable. A *frames* oracle sees only what the
POMDP's frames have shown so far, and remembers it; it shows how much of that return memory can recover.
"""

import math
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.autoencode import AutoEncode
from arcade_torch.envs_jax.autoencode.oracle import AutoEncodeFrames, AutoEncodeState
from arcade_torch.envs_jax.batch import Batch, BatchedGame, env_keys
from arcade_torch.envs_jax.battleship import BattleShip
from arcade_torch.envs_jax.battleship.oracle import BattleShipFrames, BattleShipState
from arcade_torch.envs_jax.breakout import Breakout
from arcade_torch.envs_jax.breakout.oracle import BreakoutFrames, BreakoutState
from arcade_torch.envs_jax.cartpole import CartPole
from arcade_torch.envs_jax.cartpole.oracle import CartPoleFrames, CartPoleState
from arcade_torch.envs_jax.countrecall import CountRecall
from arcade_torch.envs_jax.countrecall.oracle import CountRecallFrames, CountRecallState
from arcade_torch.envs_jax.game import NUM_ACTIONS, Game, check_choice
from arcade_torch.envs_jax.minesweeper import MineSweeper
from arcade_torch.envs_jax.minesweeper.oracle import MineSweeperFrames, MineSweeperState
from arcade_torch.envs_jax.navigator import Navigator
from arcade_torch.envs_jax.navigator.oracle import NavigatorFrames, NavigatorState
from arcade_torch.envs_jax.signpost import Signpost
from arcade_torch.envs_jax.signpost.oracle import SignpostFrames, SignpostState
from arcade_torch.envs_jax.skittles import Skittles
from arcade_torch.envs_jax.skittles.oracle import SkittlesFrames, SkittlesState
from arcade_torch.envs_jax.tetris import Tetris
from arcade_torch.envs_jax.tetris.oracle import TetrisFrames, TetrisState

Kind = Literal["state", "frames"]
Actions = npt.NDArray[np.int32]


class Player(Protocol):
    """Somebody who plays N episodes at once.

    ``act`` gets what the player may see (for a state oracle the game's state with numpy leaves [N, ...], for a frames
    oracle uint8 [N, S, S, 3]) and bool [N], true where this is the first sight of an episode; it returns int32 [N].
    """

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> Actions:
        """Choose an action in every env."""


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


_ORACLES: dict[type[Game[Any]], dict[str, Callable[[Any], Player]]] = {
    AutoEncode: {"state": AutoEncodeState, "frames": AutoEncodeFrames},
    CountRecall: {"state": CountRecallState, "frames": CountRecallFrames},
    Breakout: {"state": BreakoutState, "frames": BreakoutFrames},
    BattleShip: {"state": BattleShipState, "frames": BattleShipFrames},
    Navigator: {"state": NavigatorState, "frames": NavigatorFrames},
    CartPole: {"state": CartPoleState, "frames": CartPoleFrames},
    MineSweeper: {"state": MineSweeperState, "frames": MineSweeperFrames},
    Signpost: {"state": SignpostState, "frames": SignpostFrames},
    Skittles: {"state": SkittlesState, "frames": SkittlesFrames},
    Tetris: {"state": TetrisState, "frames": TetrisFrames},
}


def register_oracle(game_class: type[Game[Any]], kind: Kind, build: Callable[[Any], Player]) -> None:
    """Add an oracle for a game class of one's own.

    Args:
        game_class: The class; its subclasses are served too.
        kind: ``"state"`` or ``"frames"``.
        build: Called with the game, returns the player.

    Raises:
        ValueError: Unknown ``kind``.
    """
    check_choice("kind", kind, ("state", "frames"))
    _ORACLES.setdefault(game_class, {})[kind] = build


def make_oracle(game: Game[Any], kind: Kind = "state") -> Player:
    """The scripted player of a game.

    Args:
        game: What to play.
        kind: ``"state"`` sees the state, ``"frames"`` the frames of the POMDP twin.

    Raises:
        ValueError: Unknown ``kind``, or the game has no such oracle.
    """
    check_choice("kind", kind, ("state", "frames"))
    for game_class, builders in _ORACLES.items():
        if isinstance(game, game_class) and kind in builders:
            return builders[kind](game)
    raise ValueError(
        f"{game.id} has no {kind} oracle: add one with register_oracle({type(game).__name__}, {kind!r}, ...)"
    )


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
        block: Envs played at once; bounds the memory, and does not change any result of a player that is deterministic.
        seconds: No block is begun when this time has passed; the first one is always played, and all to the end.

    Returns:
        Returns and lengths.

    Raises:
        ValueError: ``episodes`` is not positive.
    """
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}, expected at least 1")
    block = min(block, episodes)
    batched, started = BatchedGame(game), time.monotonic()
    parts: list[Episodes] = []
    for first in range(0, episodes, block):
        if parts and time.monotonic() - started > seconds:
            break
        parts.append(_play_block(batched, player, env_keys(seed, block, first), frames))
    return Episodes(*(np.concatenate(field)[:episodes] for field in zip(*parts, strict=True)))


def _play_block(batched: BatchedGame[Any], player: Player, keys: jax.Array, frames: bool) -> Episodes:
    """One episode in each env; envs that are finished idle at their end."""
    size = len(keys)
    batch: Batch = batched.init(keys, jnp.full(size, frames))
    returns, lengths = np.zeros(size, np.float32), np.zeros(size, np.int32)
    running, is_init = np.ones(size, bool), np.ones(size, bool)
    while running.any():
        seen = np.asarray(batched.render(batch)) if frames else jax.tree.map(np.asarray, batch.state)
        batch, outcome = batched.step(batch, player.act(seen, is_init).astype(np.int32))
        returns += np.asarray(outcome.reward) * running
        lengths += running
        running &= ~np.asarray(outcome.done)
        is_init = np.zeros(size, bool)
    return Episodes(returns, lengths)


def random_return(game: Game[Any], episodes: int = 1000, seed: int = 0) -> npt.NDArray[np.float32]:
    """Returns of the uniformly random policy: float32 [episodes].

    Example:
        >>> from arcade_torch.envs_jax import make
        >>> bool(0.02 < random_return(make("CartPoleEasy"), episodes=64).mean() < 0.3)
        True
    """
    return play(game, RandomPlayer(seed), episodes, seed).returns


def oracle_return(
    game: Game[Any], kind: Kind = "state", episodes: int = 1000, seed: int = 0
) -> npt.NDArray[np.float32]:
    """Returns of the game's oracle: float32 [episodes]; see :func:`make_oracle`."""
    return play(game, make_oracle(game, kind), episodes, seed, frames=kind == "frames").returns
