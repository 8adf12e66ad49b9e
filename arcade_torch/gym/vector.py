"""``ArcadeVectorEnv``: N envs of one game as a Gymnasium vector environment, stepped by one
compiled call.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax.validation import (
    Observability,
    changed_flags,
    check_choice,
    check_fits,
    check_num_envs,
    partial_flags,
    plain,
)
from arcade_torch.gym.batch import Bools, Frames, Info, NumpyBatch, seed_keys
from arcade_torch.gym.copies import Copyable
from arcade_torch.gym.env import RENDER_FPS, action_space, check_reset_options, observation_space

Rewards = npt.NDArray[np.float64]
StepResult = tuple[Frames, Rewards, Bools, Bools, Info]


class ArcadeVectorEnv(Copyable, VectorEnv[Frames, npt.NDArray[Any], npt.NDArray[Any]]):
    """N envs of one game. Made by ``gymnasium.make_vec("arcade_torch/<id>", num_envs=N, ...)``.

    ``vectorization_mode="async"`` would start a process an env; it needs
    ``vector_kwargs={"context": "spawn"}``.

    Observations are uint8 [N, S, S, 3]. Infos, and what happens at an end, follow
    ``gymnasium.vector.SyncVectorEnv`` in all three auto-reset modes, to the bit; ``autoreset_mode``
    (in ``metadata`` too) says which one is in force:

    * ``NEXT_STEP`` (Gymnasium's default): an end shows its final frame; the following step ignores
      the env's action, pays 0 and shows the first frame of the new episode.
    * ``SAME_STEP``: an end shows the first frame of the new episode; the final frame is in
      ``infos["final_obs"]``, its counts are in ``infos["final_info"]``. No step is lost, and this
      is how ``ArcadeEnv`` steps.
    * ``DISABLED``: call ``reset(options={"reset_mask": bool [N]})``.

    Args:
        game: Id of the game; ``gymnasium.make_vec`` fills it in.
        num_envs: N.
        observability: ``"full"``, ``"partial"``, or bool [N], true = partial.
        partial_obs: Alias: true means ``"partial"``.
        obs_size: Side of the frames, 128 or 256.
        rules: ``"default"`` or ``"reference"``.
        autoreset_mode: One of the three, or its value: ``"NextStep"``, ``"SameStep"``,
            ``"Disabled"``.
        copy: Whether observations are the caller's own. False hands out what JAX wrote, read only:
            no copy, and each step still has its own memory.
        render_mode: ``"rgb_array"``: ``render()`` returns the N frames.
        max_episode_steps: The game's own limit, as ``spec`` has it, or None; no other.
        **options: Options of the game.

    Raises:
        ValueError: Unknown id, size, rules, observability, mode, or a number of envs that is not
            positive.
        TypeError: An option the game does not have.

    Example:
        >>> import gymnasium, arcade_torch
        >>> id = "arcade_torch/CartPoleEasy-v0"
        >>> envs = gymnasium.make_vec(id, num_envs=3, autoreset_mode="SameStep")
        >>> frames, infos = envs.reset(seed=0)
        >>> action = envs.action_space.sample()
        >>> frames, rewards, terminations, truncations, infos = envs.step(action)
        >>> frames.shape
        (3, 128, 128, 3)
    """

    def __init__(
        self,
        game: str,
        num_envs: int = 1,
        *,
        observability: Observability | None = None,
        partial_obs: bool | None = None,
        obs_size: int = 128,
        rules: str = "default",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        num_envs = check_num_envs(num_envs)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode of a vector environment is {render_mode!r}, allowed: None, "
                "'rgb_array'"
            )
        self.num_envs = num_envs
        self.render_mode = render_mode
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        check_choice("autoreset_mode", mode, tuple(one.value for one in AutoresetMode))
        self.autoreset_mode = AutoresetMode(mode)
        self._copy = copy
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        flags = partial_flags(observability, num_envs, partial_obs)
        self._batch = NumpyBatch(compiled_game(game, obs_size, rules, options), flags)
        check_fits(num_envs, obs_size)
        if max_episode_steps not in (None, self.time_limit):
            raise ValueError(
                f"max_episode_steps is {max_episode_steps!r}, but episodes of "
                f"{self._batch.game.id} have {self.time_limit} steps at most, and a vector "
                "environment has no other limit: leave it out"
            )
        self.single_action_space = action_space(self._batch.game.num_actions)
        self.single_observation_space = observation_space(obs_size)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._started = False
        self._ended = np.zeros(num_envs, bool)

    def set_observability(self, observability: Observability) -> None:
        """Change which twins are shown, also in mid-episode; only the frames drawn from now on
        change.
        """
        self._batch.set_partial(changed_flags(observability, self.num_envs))

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Frames, Info]:
        """Begin episodes in all envs, or where a mask says so.

        Args:
            seed: One seed: env ``i`` has the bits of env ``i`` of ``arcade_torch.make(...,
                seed=seed)``. One an env, none of them None: each has the bits of ``gymnasium.make``
                with its seed. None alone goes on with the random numbers there are (at first: draws
                a seed).
            options: ``{"reset_mask": bool [N]}``: the other envs go on.

        Returns:
            Frames and infos.

        Raises:
            ValueError: A seed out of range (TypeError: no whole number), an unknown option, a mask
                that does not fit.
        """
        mask = self._reset_mask(check_reset_options(options, ("reset_mask",)))
        # a seed is refused before anything changes
        keys = None if seed is None else seed_keys(seed, self.num_envs)
        one_seed = plain(seed)
        super().reset(seed=one_seed if isinstance(one_seed, int) else None)
        if seed is None and not self._started:
            keys = seed_keys(int(self.np_random.integers(2**32)), self.num_envs)
        self._batch.reset(mask, keys)
        self._started = True
        self._ended &= ~mask
        return self._batch.draw(copy=self._copy), _masked(self._batch.info, mask)

    def _reset_mask(self, options: dict[str, Any]) -> Bools:
        mask = np.array(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask is {mask.dtype} {mask.shape}, expected bool ({self.num_envs},) with "
                "at least one True"
            )
        if not self._started and not mask.all():
            raise ResetNeeded("the first reset() needs all envs: leave reset_mask out")
        return mask

    def step(self, actions: npt.NDArray[Any]) -> StepResult:
        """Take one action in every env.

        Args:
            actions: Integers [N] in 0..4.

        Returns:
            Frames uint8 [N, S, S, 3], rewards float64 [N], terminations bool [N], truncations bool
            [N], infos.

        Raises:
            ResetNeeded: Before the first reset, or, with auto-reset disabled, after an end.
            ValueError: Actions of a wrong shape, type or range.
        """
        if not self._started:
            raise ResetNeeded("call reset() before step()")
        argument = self._check_actions(actions)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            return self._step_same(argument)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            stepped = self._batch.reset_or_step(argument, self._ended)
        else:
            if self._ended.any():
                raise ResetNeeded(
                    f"envs {np.flatnonzero(self._ended).tolist()} have ended: reset them by a "
                    "reset_mask"
                )
            stepped = self._batch.step(argument)
        self._ended = stepped.terminated | stepped.truncated
        frames = self._batch.draw(copy=self._copy)
        return frames, *stepped[:3], _masked(stepped.info, np.ones(self.num_envs, bool))

    def _step_same(self, argument: npt.NDArray[np.int32]) -> StepResult:
        """Step, begin anew at once, and put the ends into the infos."""
        stepped, frames, rows, final_frames = self._batch.step_and_reset(argument, self._copy)
        ended = stepped.terminated | stepped.truncated
        infos: Info = {}
        if len(rows):
            final_obs = np.full(self.num_envs, None, dtype=object)
            final_obs[rows] = list(final_frames)
            infos = {"final_obs": final_obs, "_final_obs": ended.copy()}
            infos |= {"final_info": _masked(stepped.info, ended), "_final_info": ended.copy()}
        going_on = {key: np.where(ended, 0, value) for key, value in stepped.info.items()}
        return frames, *stepped[:3], infos | _masked(going_on, np.ones(self.num_envs, bool))

    def render(self) -> tuple[Frames, ...] | None:
        """The N frames with ``render_mode="rgb_array"``, otherwise None."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode: pass render_mode='rgb_array' to gymnasium.make_vec"
            )
            return None
        if not self._started:
            raise ResetNeeded("there is no frame before the first reset()")
        return tuple(self._batch.draw())

    def _check_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
        """The actions as a new array, which JAX may read while the caller goes on."""
        given = np.asarray(actions)
        if given.shape != (self.num_envs,) or not np.issubdtype(given.dtype, np.integer):
            raise ValueError(
                f"actions are {given.dtype} {given.shape}, expected integers ({self.num_envs},)"
            )
        num_actions = self._batch.game.num_actions
        if given.min() < 0 or given.max() >= num_actions:
            raise ValueError(
                f"actions range from {given.min()} to {given.max()}, allowed: 0 to "
                f"{num_actions - 1}"
            )
        return given.astype(np.int32, copy=True)


def _masked(info: Info, mask: Bools) -> Info:
    """Infos as Gymnasium batches them: values beside ``_key`` masks, zeros where the mask is
    false.
    """
    out: Info = {}
    for key, value in info.items():
        out[key] = np.where(mask, value, 0)
        out[f"_{key}"] = mask.copy()
    return out
