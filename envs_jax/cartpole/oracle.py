"""Scripted players of CartPole: linear feedback on the state, and the same on a belief kept by a
particle filter.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.cartpole import rules
from arcade_torch.envs_jax.cartpole.renderer import LINEAR_TOP, LOG_CLASSES
from arcade_torch.envs_jax.cartpole.rules import START, THETA_LIMIT, X_LIMIT
from arcade_torch.envs_jax.game import LEFT, RIGHT, Array
from arcade_torch.envs_jax.settings import compiled, fixed

# on x, x_dot, theta, theta_dot; the sign of the sum is the side to push to
GAINS = (0.1, 0.2, 1.0, 0.3)


def feedback(pose: Any) -> Any:
    """Which way to push: the sign of the result is the side, for pose [..., 4]."""
    return sum(gain * pose[..., i] for i, gain in enumerate(GAINS))


class StateOracle:
    """Sees the state; keeps the pole up for as long as the episode lasts."""

    def __init__(self, game: Any) -> None:
        del game

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        pose = np.stack([seen.x, seen.x_dot, seen.theta, seen.theta_dot], -1)
        return np.where(feedback(pose) > 0, RIGHT, LEFT).astype(np.int32)


class Belief(NamedTuple):
    """Weighted guesses at one env's pose."""

    pose: Array  # float32 [particles, 4]
    log_weight: Array  # float32 [particles]
    key: Array  # uint32 [2]


class FramesOracle:
    """Sees the POMDP's frames: reads the two arrows, and keeps a belief over poses.

    The dynamics are known and deterministic, the start is known to 0.05, and every picture tells in
    which of eight classes each velocity lies. A particle filter turns that into a belief, whose
    mean is fed back as if it were the state.

    Args:
        game: The CartPole to play.
        particles: Guesses per env.
    """

    def __init__(self, game: Any, particles: int = 400) -> None:
        self.game = game
        self.particles = particles
        self.belief: Belief | None = None
        self.action = np.zeros(0, np.int32)
        update = partial(_update, edges=_arrow_edges(game), sigma=game.level.sigma)
        self._update = compiled(jax.vmap(update))

    @fixed
    def act(
        self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        codes = np.stack([slot.read(seen) for slot in self.game.screen.arrows], -1)
        if self.belief is None or len(self.action) != len(seen):
            self.action = np.zeros(len(seen), np.int32)
            keys = jax.random.split(jnp.zeros(2, jnp.uint32), len(seen))
            shape = (len(seen), self.particles)
            self.belief = Belief(jnp.zeros((*shape, 4)), jnp.zeros(shape), keys)
        self.belief, action = self._update(self.belief, self.action, codes, is_init)
        self.action = np.asarray(action)
        return self.action


def _arrow_edges(game: Any) -> Array:
    """Velocities between which each arrow code is drawn: float32 [codes, 2]."""
    levels = len(game.screen.arrows[0].pictures) // 2
    level = np.arange(levels + 1)
    if game.arrow == "log":
        edge = np.where(level < LOG_CLASSES, np.exp(level / 2) - 1, np.inf)
    else:
        edge = np.append(np.maximum(level[:-1] - 0.5, 0) * LINEAR_TOP / game.screen.geo.box, np.inf)
    right = np.stack([edge[:-1], edge[1:]], -1)
    left = -right[:, ::-1]
    if game.arrow == "linear":
        right[0] = left[0] = [-edge[1], edge[1]]  # no arrow at all, whichever the side
    return jnp.asarray(np.concatenate([left, right]), jnp.float32)


def _update(
    belief: Belief, action: Array, codes: Array, is_init: Array, edges: Array, sigma: float
) -> tuple[Belief, Array]:
    """Advance one env's belief by the action taken and the arrows seen; choose the next action."""
    key, for_start, for_jitter, for_resample = jax.random.split(belief.key, 4)
    start = jax.random.uniform(for_start, belief.pose.shape, minval=-START, maxval=START)
    moved = rules.move(rules.at_pose(belief.pose.T, jnp.zeros(4)), action)
    pose = jnp.stack([moved.x, moved.x_dot, moved.theta, moved.theta_dot], -1)
    pose = jnp.where(is_init, start, pose)
    log_weight = jnp.where(is_init, 0.0, belief.log_weight)

    spread = jnp.sqrt(sigma**2 + 0.01**2)
    low = edges[codes][:, 0]
    high = edges[codes][:, 1]
    velocity = pose[:, 1::2]
    chance = jax.scipy.stats.norm.cdf((high - velocity) / spread) - jax.scipy.stats.norm.cdf(
        (low - velocity) / spread
    )
    log_weight += jnp.log(chance + 1e-6).sum(-1)
    alive = (jnp.abs(pose[:, 0]) <= X_LIMIT) & (jnp.abs(pose[:, 2]) <= THETA_LIMIT)
    log_weight += jnp.where(alive, 0.0, -20.0)  # the episode goes on, so the limits hold
    log_weight -= jax.nn.logsumexp(log_weight)

    weight = jnp.exp(log_weight)
    action = jnp.where(feedback(weight @ pose) > 0, RIGHT, LEFT)

    count = len(weight)
    ladder = (jnp.arange(count) + jax.random.uniform(for_resample)) / count
    pick = jnp.minimum(jnp.searchsorted(jnp.cumsum(weight), ladder), count - 1)
    poor = 1 / jnp.sum(weight**2) < count / 2
    jitter = jax.random.normal(for_jitter, pose.shape) * jnp.array([0.002, 0.005, 0.0005, 0.005])
    pose = jnp.where(poor, pose[pick] + jitter, pose)
    log_weight = jnp.where(poor, 0.0, log_weight)
    return Belief(pose, log_weight, key), action
