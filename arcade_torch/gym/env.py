"""``ArcadeGymEnv``: one game as a Gymnasium environment."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax.batch import env_keys
from arcade_torch.envs_jax.validation import Observability, changed_flags, partial_flags
from arcade_torch.gym.batch import Frames, Info, NumpyBatch
from arcade_torch.gym.copies import Copyable
from arcade_torch.gym.window import Window

RENDER_FPS = 30
_WINDOW_SIDE_PIXELS = 512


def action_space(num_actions: int) -> Any:
    """What one env takes: up, down, left, right, fire."""
    return gymnasium.spaces.Discrete(num_actions)


def observation_space(obs_size: int) -> Any:
    """What one env shows: uint8 [S, S, 3], rows downwards, RGB."""
    return gymnasium.spaces.Box(0, 255, (obs_size, obs_size, 3), np.uint8)


def check_reset_options(options: dict[str, Any] | None, allowed: tuple[str, ...]) -> dict[str, Any]:
    """The options of ``reset``; raises ValueError if nobody reads one of them."""
    unknown = sorted(set(options or ()) - set(allowed))
    if unknown:
        raise ValueError(f"reset has no option {unknown[0]!r}, allowed: {', '.join(allowed)}")
    return options or {}


class ArcadeGymEnv(Copyable, gymnasium.Env[Frames, int]):
    """One game, one episode at a time. Made by ``gymnasium.make("arcade_torch/<id>", ...)``.

    Observations are the true frames, uint8 [S, S, 3]; the last one of an episode shows its end.
    ``info`` has ``episode_reward`` (float64, return so far) and ``step_count`` (int64). A seed
    gives the bits that env 0 of ``arcade_torch.make(..., seed=seed)`` has; ``reset()`` without a
    seed goes on as that env does after an end.

    Args:
        game: Id of the game; ``gymnasium.make`` fills it in.
        observability: ``"full"`` (the MDP, default) or ``"partial"`` (the POMDP).
        partial_obs: Alias: true means ``"partial"``.
        obs_size: Side of the frames, 128 or 256.
        rules: ``"default"`` or ``"reference"``.
        render_mode: ``"rgb_array"``: ``render()`` returns the frame; ``"human"``: a window shows
            every frame.
        **options: Options of the game.

    Raises:
        ValueError: Unknown id, size, rules, observability or render mode.
        TypeError: An option the game does not have.
        ImportError: ``render_mode="human"`` without pygame.

    Example:
        >>> import gymnasium, arcade_torch
        >>> env = gymnasium.make("arcade_torch/CartPoleEasy-v0", observability="partial")
        >>> frame, info = env.reset(seed=0)
        >>> frame, reward, terminated, truncated, info = env.step(2)
        >>> frame.shape, int(info["step_count"])
        ((128, 128, 3), 1)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": RENDER_FPS,
    }

    def __init__(
        self,
        game: str,
        *,
        observability: Observability | None = None,
        partial_obs: bool | None = None,
        obs_size: int = 128,
        rules: str = "default",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}, allowed: None, 'human', 'rgb_array'")
        flags = partial_flags(observability, 1, partial_obs)
        self._batch = NumpyBatch(compiled_game(game, obs_size, rules, options), flags)
        self.action_space = action_space(self._batch.game.num_actions)
        self.observation_space = observation_space(obs_size)
        self.render_mode = render_mode
        self._window = (
            Window(max(1, _WINDOW_SIDE_PIXELS // obs_size)) if render_mode == "human" else None
        )
        self._frame: Frames | None = None
        self._running = False

    def set_observability(self, observability: Observability) -> None:
        """Change which twin is shown, also in mid-episode; only the frames drawn from now on
        change.
        """
        self._batch.set_partial(changed_flags(observability, 1))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Frames, Info]:
        """Begin an episode.

        Args:
            seed: 0 to 4294967295; None goes on with the random numbers there are (at first: draws a
                seed).
            options: ``{"observability": "full" | "partial"}`` changes the twin.

        Returns:
            Frame and info.

        Raises:
            ValueError: A seed out of range (TypeError: no whole number), or an unknown option.
        """
        options = check_reset_options(options, ("observability",))
        # a seed is refused before anything changes
        keys = None if seed is None else env_keys(seed, 1)
        if "observability" in options:
            self.set_observability(options["observability"])
        super().reset(seed=None if seed is None else int(seed))
        if seed is None and self._frame is None:
            keys = env_keys(int(self.np_random.integers(2**32)), 1)
        self._batch.reset(np.ones(1, bool), keys)
        self._running = True
        return self._look(self._batch.draw()), self._info(self._batch.info)

    def step(self, action: int) -> tuple[Frames, SupportsFloat, bool, bool, Info]:
        """Take an action.

        Args:
            action: 0 to 4: up, down, left, right, fire.

        Returns:
            Frame, reward, terminated (the game's own end), truncated (the time limit), info.

        Raises:
            ResetNeeded: No episode runs.
            ValueError: Not an action.
        """
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() first, and after every end")
        if not self.action_space.contains(action):
            raise ValueError(
                f"action is {action!r}, allowed: integers from 0 to "
                f"{self._batch.game.num_actions - 1}"
            )
        stepped = self._batch.step(np.array([action], np.int32))
        terminated = bool(stepped.terminated[0])
        truncated = bool(stepped.truncated[0])
        self._running = not (terminated or truncated)
        return (
            self._look(self._batch.draw()),
            float(stepped.reward[0]),
            terminated,
            truncated,
            self._info(stepped.info),
        )

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The frame of the twin that is played, uint8 [S, S, 3], with ``render_mode="rgb_array"``;
        otherwise None.

        Raises:
            ResetNeeded: There is no frame yet.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode: pass render_mode='rgb_array' to gymnasium.make"
            )
            return None
        if self._frame is None:
            raise ResetNeeded("there is no frame before the first reset()")
        if self.render_mode == "rgb_array":
            return self._frame.copy()
        self._show()
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _look(self, frames: Frames) -> Frames:
        """Remember and show the frame of the only env."""
        self._frame = frames[0]
        if self.render_mode == "human":
            self._show()
        return self._frame.copy()

    def _show(self) -> None:
        if self._window is not None and self._frame is not None:
            self._window.show(self._frame, self._batch.game.id)
            self._window.tick(RENDER_FPS)

    @staticmethod
    def _info(info: Info) -> Info:
        return {key: value[0] for key, value in info.items()}
