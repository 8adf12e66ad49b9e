"""N episodes of an env of another suite side by side: pure functions of JAX, compiled."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.compiled import pack_numbers
from arcade_torch.envs_jax.batch import choose_rows
from arcade_torch.suite import Outcome, Suite


class Episodes(NamedTuple):
    """Everything that is known about N running episodes."""

    key: Any  # uint32 [N, 2], advanced by every step of its env
    reset_key: Any  # uint32 [N, 2], of the next episode
    state: Any  # the env's own, leaves [N, ...]
    obs: Any  # leaves [N, ...]
    last_action: jax.Array  # [N, ...], zeros before the first step; survives resets
    step_count: jax.Array  # int32 [N]
    episode_reward: jax.Array  # float32 [N]


class BatchedSuite:
    """What happens to N episodes of a suite's env.

    Args:
        suite: The env.
        action: Shape and type of the action of one env.
    """

    def __init__(self, suite: Suite, action: jax.ShapeDtypeStruct) -> None:
        self.suite = suite
        self._action = action
        self.begin = jax.jit(self._begin)
        self.begin_anew = jax.jit(self._begin_anew)
        self.advance = jax.jit(self._advance)
        self.advance_and_begin_anew = jax.jit(self._advance_and_begin_anew)
        self.advance_and_pack = jax.jit(self._advance_and_pack)

    def _begin(self, keys: jax.Array) -> Episodes:
        """Episodes that begin, from the random keys of the envs, uint32 [N, 2]."""
        key, reset_key = _split(keys)
        obs, state = jax.vmap(self.suite.reset)(reset_key)
        action = jnp.zeros((len(keys), *self._action.shape), self._action.dtype)
        counts = jnp.zeros(len(keys), jnp.int32)
        return Episodes(key, reset_key, state, obs, action, counts, counts.astype(jnp.float32))

    def _begin_anew(self, live: Episodes, mask: jax.Array) -> Episodes:
        """Begin a new episode where ``mask`` (bool [N]) is true."""
        obs, state = jax.vmap(self.suite.reset)(live.reset_key)
        following = jax.vmap(jax.random.fold_in, in_axes=(0, None))(live.reset_key, 1)
        fresh = live._replace(
            reset_key=following,
            state=state,
            obs=obs,
            step_count=jnp.zeros_like(live.step_count),
            episode_reward=jnp.zeros_like(live.episode_reward),
        )
        chosen: Episodes = choose_rows(mask, fresh, live)
        return chosen

    def _advance(self, live: Episodes, action: jax.Array) -> tuple[Episodes, Outcome]:
        """Take one action in every env.

        Keys go as in gymnax's own ``step``: one for the step, one for the episode after it.
        """
        key, of_this_step = _split(live.key)
        step_key, reset_key = _split(of_this_step)
        count = live.step_count + 1
        obs, state, outcome = jax.vmap(self.suite.step)(step_key, live.state, action, count)
        total = live.episode_reward + outcome.reward
        return Episodes(key, reset_key, state, obs, action, count, total), outcome

    def _advance_and_begin_anew(
        self, live: Episodes, action: jax.Array
    ) -> tuple[Episodes, Episodes, Outcome]:
        """Take one action, and begin anew where that ended an episode.

        Returns:
            What to go on with; what the step led to, without keys and state, since every array that
            a compiled function returns is written; and the outcome.
        """
        after, outcome = self._advance(live, action)
        root = self._begin_anew(after, outcome.terminated | outcome.truncated)
        return root, after._replace(key=None, reset_key=None, state=None), outcome

    def _advance_and_pack(
        self, live: Episodes, action: jax.Array
    ) -> tuple[Episodes, Any, jax.Array]:
        """The same for a collector: what to go on with, the observation that the step led to, and
        all numbers in one array.
        """
        root, after, outcome = self._advance_and_begin_anew(live, action)
        return root, after.obs, pack_numbers(after, outcome)


def _split(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two keys of each, uint32 [N, 2]."""
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], pairs[:, 1]
