"""CartPole and NoisyCartPole: all fields are shared; the noise is in our state alone, and in the
picture alone.

A pole lets the last bit of a rounded number grow without bounds, so every step begins from the
published pose.
"""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.cartpole.rules import CartPoleState
from tests.parity.translation import Array, Translation, number

FIELDS = ("x", "x_dot", "theta", "theta_dot", "score", "time")


def to_ours(game: Any, theirs: Any) -> CartPoleState:
    """Our state without noise."""
    pose = (jnp.asarray(getattr(theirs, name), jnp.float32) for name in FIELDS[:4])
    return CartPoleState(*pose, number(theirs.score), number(theirs.time), jnp.zeros(4))


def to_theirs(game: Any, ours: CartPoleState) -> dict[str, Any]:
    """All but the noise."""
    return {name: getattr(ours, name) for name in FIELDS}


def adopt(game: Any, ours: CartPoleState, theirs: Any) -> CartPoleState:
    """The published noise is never kept: leave it out of the comparison."""
    return ours._replace(noise=jnp.zeros(4))


def reported(
    game: Any, ours: CartPoleState, terminated: Array, truncated: Array
) -> tuple[Array, Array]:
    """C1: ``terminated`` is up at every end, and ``truncated`` looks at the clock after the step,
    the end before it.
    """
    return terminated | truncated, ours.time >= game.max_steps


def hasten(key: Array, game: Any, ours: CartPoleState) -> CartPoleState:
    """A fast cart anywhere, a pole that leans."""
    x, x_dot, theta, theta_dot = jax.random.uniform(key, (4,), minval=-1.0) * jnp.array(
        [2.4, 3.0, 0.2, 1.0]
    )
    return ours._replace(x=x, x_dot=x_dot, theta=theta, theta_dot=theta_dot)


TRANSLATION = Translation(
    to_ours,
    to_theirs,
    "time",
    adopt=adopt,
    reported=reported,
    hasten=hasten,
    tolerance=2e-6,
    resync=True,
)
