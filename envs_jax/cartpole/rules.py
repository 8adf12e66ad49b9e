"""The rules of CartPole: Euler steps of the classic cart and pole, paid by survival.

Source: Barto, Sutton and Anderson (1983), the equations of Gymnasium's CartPole; limits and rewards
of POPGym Arcade (ICML 2026).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.game import LEFT, RIGHT, UNSET, Array, Rules

GRAVITY = 9.8  # m/s^2
CART_MASS = 1.0  # kg
POLE_MASS = 0.1  # kg
TOTAL_MASS = CART_MASS + POLE_MASS
HALF_POLE = 0.5  # m
FORCE = 10.0  # N
TAU = 0.02  # s, one step
X_LIMIT = 2.4  # m
THETA_LIMIT = 12 * 2 * 3.141592653589793 / 360  # rad
START = 0.05  # all four variables start uniformly in [-START, START]


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    max_steps: int  # time limit in steps; each survived step pays ``1 / max_steps``
    sigma: float = 0.0  # standard deviation of the noise on what is drawn (m, m/s, rad, rad/s)


LEVELS = {
    "CartPoleEasy": Params(200),
    "CartPoleMedium": Params(400),
    "CartPoleHard": Params(600),
    "NoisyCartPoleEasy": Params(200, 0.1),
    "NoisyCartPoleMedium": Params(200, 0.2),
    "NoisyCartPoleHard": Params(200, 0.3),
}


class CartPoleState(NamedTuple):
    """Cart, pole, and what the next picture adds to them."""

    x: Array  # float32, position of the cart, m
    x_dot: Array  # float32, m/s
    theta: Array  # float32, angle of the pole, rad, positive to the right
    theta_dot: Array  # float32, rad/s
    score: Array  # int32, paid steps
    time: Array  # int32, steps taken
    noise: Array  # float32 [4], added to (x, x_dot, theta, theta_dot) in the picture alone
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def is_out(state: CartPoleState) -> Array:
    """Whether cart or pole is beyond its limit (bool scalar)."""
    return (jnp.abs(state.x) > X_LIMIT) | (jnp.abs(state.theta) > THETA_LIMIT)


def draw_noise(key: Array, level: Params) -> Array:
    """Noise for one picture: float32 [4], normal with the level's sigma."""
    if level.sigma == 0:
        return jnp.zeros(4)
    return level.sigma * jax.random.normal(key, (4,))


def reset(key: Array, level: Params) -> CartPoleState:
    """Cart and pole near the upright rest, all four variables uniform in [-0.05, 0.05]."""
    for_pose, for_noise = jax.random.split(key)
    pose = jax.random.uniform(for_pose, (4,), minval=-START, maxval=START)
    return at_pose(pose, draw_noise(for_noise, level))


def at_pose(pose: Array, noise: Array) -> CartPoleState:
    """The first state of an episode at a pose (x, x_dot, theta, theta_dot), float32 [4] or [4,
    ...].
    """
    zero = jnp.zeros(pose.shape[1:], jnp.int32)
    return CartPoleState(pose[0], pose[1], pose[2], pose[3], zero, zero, noise)


def accelerations(state: CartPoleState, action: Array) -> tuple[Array, Array]:
    """Accelerations of cart (m/s^2) and pole (rad/s^2) under an action."""
    force = jnp.where(action == LEFT, -FORCE, jnp.where(action == RIGHT, FORCE, 0.0))
    sin = jnp.sin(state.theta)
    cos = jnp.cos(state.theta)
    push = (force + POLE_MASS * HALF_POLE * state.theta_dot**2 * sin) / TOTAL_MASS
    theta_acc = (GRAVITY * sin - cos * push) / (
        HALF_POLE * (4.0 / 3.0 - POLE_MASS * cos**2 / TOTAL_MASS)
    )
    return push - POLE_MASS * HALF_POLE * theta_acc * cos / TOTAL_MASS, theta_acc


def move(state: CartPoleState, action: Array) -> CartPoleState:
    """One Euler step of the dynamics; positions advance with the old velocities."""
    x_acc, theta_acc = accelerations(state, action)
    return state._replace(
        x=state.x + TAU * state.x_dot,
        x_dot=state.x_dot + TAU * x_acc,
        theta=state.theta + TAU * state.theta_dot,
        theta_dot=state.theta_dot + TAU * theta_acc,
        time=state.time + 1,
    )


def step(
    key: Array, state: CartPoleState, action: Array, level: Params, rules: Rules
) -> tuple[CartPoleState, Array, Array, Array]:
    """One step: reward ``1 / max_steps`` for every step that began within the limits.

    By default the episode ends with the step that crosses a limit or reaches the time limit. With
    ``rules="reference"`` both are judged on the state before the step, so that one unpaid step
    follows.
    """
    new = move(state, action)._replace(noise=draw_noise(key, level))
    judged = new if rules == "default" else state
    over_before = is_out(state) | (state.time >= level.max_steps)
    paid = jnp.where(over_before, 0, 1)
    new = new._replace(score=state.score + paid)
    reward = paid.astype(jnp.float32) / level.max_steps
    return new, reward, is_out(judged), judged.time >= level.max_steps
