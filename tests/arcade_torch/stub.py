"""A tiny game for the tests of the bridge: cheap, random, with both kinds of end."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.compiled import CompiledGame
from arcade_torch.envs_jax import Game, MixedGames

Array = jax.Array


class Clock(NamedTuple):
    """A place inside a nested state, so that snapshots meet nesting and unsigned integers."""

    count: Array  # int32, steps so far
    serial: Array  # uint32, a random number that tells episodes apart


class State(NamedTuple):
    """State of the stub game."""

    clock: Clock
    total: Array  # float32, sum of actions
    dice: Array  # int32 [2], random numbers of the last step


class StubGame(Game[State]):
    """Counts. Ends at random with probability ``risk``, and truncates after ``max_steps``.

    The frame shows count, serial, dice and total, the partial one all but the serial.
    """

    obs_size = 8
    rules = "default"
    return_range = (-1e9, 1e9)

    def __init__(self, risk: float = 0.1, max_steps: int = 20, id: str = "StubEasy-v0") -> None:
        self.id = id
        self.risk = risk
        self.max_steps = max_steps

    def reset(self, key: Array) -> State:
        serial = jax.random.bits(key, dtype=jnp.uint32)
        return State(Clock(jnp.int32(0), serial), jnp.float32(0), jnp.zeros(2, jnp.int32))

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array]:
        first, second = jax.random.split(key)
        dice = jax.random.randint(first, (2,), 0, 256)
        count = state.clock.count + 1
        following = State(Clock(count, state.clock.serial), state.total + action, dice)
        reward = action.astype(jnp.float32) + dice[0] / 256
        return following, reward, jax.random.uniform(second) < self.risk, count >= self.max_steps

    def render(self, state: State, partial: Any) -> Array:
        serial = jnp.where(partial, jnp.uint32(0), state.clock.serial)
        rows = [
            state.clock.count,
            serial,
            serial >> 8,
            serial >> 16,
            state.dice[0],
            state.dice[1],
            state.total,
        ]
        column = jnp.stack([jnp.asarray(row).astype(jnp.uint8) for row in rows] + [jnp.uint8(7)])
        return jnp.broadcast_to(column[:, None, None], (8, 8, 3))


class Coin(NamedTuple):
    """State of the other stub game, with another structure."""

    heads: Array  # bool
    count: Array  # uint8, steps so far


class CoinGame(Game[Coin]):
    """Tosses a coin: action 0 keeps it, any other tosses it. Ends at five heads in a row, truncates
    at seven steps.

    The frame shows the count and the coin, the partial one all but the coin.
    """

    id = "CoinEasy-v0"
    obs_size = 8
    rules = "default"
    max_steps = 7
    return_range = (0.0, 1.0)

    def reset(self, key: Array) -> Coin:
        return Coin(jax.random.bernoulli(key), jnp.uint8(0))

    def step(self, key: Array, state: Coin, action: Array) -> tuple[Coin, Array, Array, Array]:
        heads = jnp.where(action == 0, state.heads, jax.random.bernoulli(key))
        count = state.count + jnp.uint8(1)
        return (
            Coin(heads, count),
            heads.astype(jnp.float32) / 7,
            heads & (count == 5),
            count >= self.max_steps,
        )

    def render(self, state: Coin, partial: Any) -> Array:
        coin = jnp.where(partial, 0, 100 + state.heads.astype(jnp.uint8))
        column = jnp.stack([state.count, coin.astype(jnp.uint8), *[jnp.uint8(9)] * 6])
        return jnp.broadcast_to(column[:, None, None], (8, 8, 3))


# Shared by all test modules, so that each is compiled once. In the second all envs end at once, in
# every fifth step; the third has four envs of one game and two of another where there are six.
GAME = CompiledGame(StubGame())
LOCKSTEP = CompiledGame(StubGame(risk=0.0, max_steps=5))
MIXED = CompiledGame(MixedGames([StubGame(), CoinGame()], weights=(2, 1)))
