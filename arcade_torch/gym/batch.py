"""N episodes of one game behind numpy arrays: what the Gymnasium environments and the player's
session stand on.

Loads no torch. Every array that is handed out is the caller's own.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.compiled import CompiledGame
from arcade_torch.envs_jax.batch import Batch, Outcome, env_keys
from arcade_torch.envs_jax.game import Game
from arcade_torch.envs_jax.settings import as_numpy, is_key
from arcade_torch.final_observations import FinalObservations
from arcade_torch.frame_memory import FrameMemory
from arcade_torch.process import check_process, missing_platform

Bools = npt.NDArray[np.bool_]
Frames = npt.NDArray[np.uint8]
Info = dict[str, Any]


class Stepped(NamedTuple):
    """What one step gave, before anything was begun anew."""

    reward: npt.NDArray[np.float64]  # [N]
    terminated: Bools  # [N]
    truncated: Bools  # [N]
    info: Info  # episode_reward float64 [N], step_count int64 [N]


def seed_keys(seed: int | Sequence[int] | npt.NDArray[Any], num_envs: int) -> jax.Array:
    """Random keys of N envs.

    Args:
        seed: One seed for the batch: env ``i`` walks the path of env ``i`` of an ``ArcadeEnv`` with
            that seed. Or one seed an env: each walks the path of env 0 of an ``ArcadeEnv`` with its
            seed.
        num_envs: Number of envs.

    Returns:
        uint32 [num_envs, 2].

    Raises:
        TypeError: A seed is no whole number.
        ValueError: A seed is out of range, or their number is wrong.
    """
    seed = seed.tolist() if isinstance(seed, np.ndarray) else seed
    if not isinstance(seed, Sequence):
        return env_keys(seed, num_envs)
    if len(seed) != num_envs:
        raise ValueError(f"{len(seed)} seeds for {num_envs} envs: give one seed, or one an env")
    return jnp.concatenate([env_keys(env_seed, 1) for env_seed in seed])


class NumpyBatch:
    """N running episodes: numpy in, numpy out, nothing is begun anew unless asked. The first call
    is a reset of all.

    Steps and drawing are compiled apart, so that whoever plays, resets and redraws compiles the
    picture once.

    Args:
        compiled: The game.
        flags: bool [N], true where the env shows its POMDP twin.

    Raises:
        RuntimeError: This process was forked after JAX had started; so do all methods that compute.
        ValueError: JAX has no device of JAX_PLATFORMS.
    """

    def __init__(self, compiled: CompiledGame, flags: Bools) -> None:
        check_process()
        problem = missing_platform()
        if problem:
            raise ValueError(problem)
        self._compiled = compiled
        self._batched = compiled.batched
        self.num_envs = len(flags)
        # Nothing runs before the first reset, so its shape is all that is needed of a batch.
        self._batch = self._batched.blank(env_keys(0, self.num_envs), jnp.asarray(flags))
        self._no_ends = (jnp.zeros(self.num_envs, bool), jnp.zeros(self.num_envs, bool))
        (device,) = self._batch.partial.devices()
        self._finals = FinalObservations(compiled, self.num_envs, 1, device)
        self._memory = FrameMemory(
            (self.num_envs, self.game.obs_size, self.game.obs_size, 3), device
        )

    def __getstate__(self) -> dict[str, Any]:
        """The game and everything that determines what comes, as numpy arrays, for ``copy`` and
        ``pickle``; keys of ``jax.random.key`` as they are.
        """
        copy = jax.tree.map(lambda x: x if is_key(x) else np.array(x), self._batch)
        return {"compiled": self._compiled, "batch": copy}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on from there; memory for frames is new."""
        batch: Batch = state["batch"]
        NumpyBatch.__init__(self, state["compiled"], np.asarray(batch.partial))
        self._batch = jax.tree.map(jnp.array, batch)

    @property
    def game(self) -> Game[Any]:
        """The game that is played."""
        return self._batched.game  # never a mixture of games

    @property
    def state(self) -> Any:
        """The game's state, numpy leaves [N, ...]; read only."""
        return as_numpy(self._batch.state)

    @property
    def info(self) -> Info:
        """Return so far (float64 [N]) and steps so far (int64 [N]) of the running episodes."""
        counts = np.array(self._batch.step_count, np.int64)
        return {
            "episode_reward": np.array(self._batch.episode_reward, np.float64),
            "step_count": counts,
        }

    def set_partial(self, flags: Bools) -> None:
        """Change which twin is shown, bool [N]; only what is drawn from now on changes."""
        self._batch = self._batch._replace(partial=jnp.asarray(flags))

    def draw(self, flags: Bools | None = None, copy: bool = True) -> Frames:
        """Draw all envs.

        Args:
            flags: bool [N], the twins to draw; those the envs show by default.
            copy: Whether the caller may write into the frames.

        Returns:
            uint8 [N, S, S, 3].
        """
        check_process()
        batch = self._batch if flags is None else self._batch._replace(partial=jnp.asarray(flags))
        return np.array(self._batched.render(batch), copy=copy or None)

    def reset(self, mask: Bools, keys: jax.Array | None = None) -> None:
        """Begin a new episode where ``mask`` (bool [N]) is true, from ``keys`` (uint32 [N, 2]) if
        they are given.
        """
        check_process()
        if keys is not None:
            keys = jnp.where(jnp.asarray(mask)[:, None], keys, self._batch.key)
            self._batch = self._batch._replace(key=keys)
        self._batch = self._batched.reset_where(self._batch, mask)

    def step(self, action: npt.NDArray[np.int32]) -> Stepped:
        """Take one action in every env, int32 [N] in 0..4; nothing is drawn."""
        check_process()
        stepped, outcome = self._batched.step(self._batch, action)
        outcome.done.block_until_ready()
        self._batch = stepped
        return self._stepped(outcome)

    def reset_or_step(self, action: npt.NDArray[np.int32], ended: Bools) -> Stepped:
        """Begin anew where ``ended`` (bool [N]) is true and take one action elsewhere; nothing is
        drawn.

        Rows that begin anew ignore their action; their reward is 0 and no flag is set.
        """
        check_process()
        running = self._batched.without_ends(self._batch)
        stepped, outcome = self._compiled.reset_or_step(running, action, ended)
        outcome.done.block_until_ready()
        self._batch = self._batched.with_ends(stepped, outcome.terminated, outcome.truncated)
        return self._stepped(outcome)

    def _stepped(self, outcome: Outcome) -> Stepped:
        flags = np.array(outcome.terminated), np.array(outcome.truncated)
        return Stepped(np.array(outcome.reward, np.float64), *flags, self.info)

    def step_and_reset(
        self, action: npt.NDArray[np.int32], copy: bool = True
    ) -> tuple[Stepped, Frames, npt.NDArray[np.int64], Frames]:
        """Take one action in every env, begin anew where that ended an episode, draw once, and draw
        the ends.

        Returns:
            What the step gave before anything was begun anew; frames uint8 [N, S, S, 3] after that;
            the n envs that ended, int64 [n]; and their final frames, uint8 [n, S, S, 3].
        """
        check_process()
        step = self._compiled.step(
            self._batched.without_ends(self._batch), action, self._memory.spare()
        )
        frames = np.array(self._memory.show(step.pixels), copy=copy or None)
        numbers = np.asarray(step.numbers)
        # Now that the step has been computed: one that fails leaves the state as it was.
        self._batch = self._batched.with_ends(step.root, *self._no_ends)
        reward, episode_reward, step_count, terminated, truncated = numbers.T
        info = {
            "episode_reward": episode_reward.view(np.float32).astype(np.float64),
            "step_count": step_count.astype(np.int64),
        }
        paid = reward.view(np.float32).astype(np.float64)
        stepped = Stepped(paid, terminated > 0, truncated > 0, info)
        ended = stepped.terminated | stepped.truncated
        self._finals.add(0, (step.final_state, step.root.partial))
        final_frames = [frames[:0]]  # where no episode ended there are none, of the same shape
        for _, _, drawn, counting in self._finals.draw(ended[:, None]):
            final_frames.append(np.asarray(drawn["pixels"])[counting])
        return stepped, frames, np.flatnonzero(ended), np.concatenate(final_frames)
