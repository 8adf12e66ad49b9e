"""The last observations of episodes that have ended: of our games drawn from the states that steps
led to, of other suites kept. Loads no torch.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from arcade_torch.compiled import CompiledGame
from arcade_torch.frame_memory import FrameMemory

# One compiled shape draws final observations: an eighth of the batch, at least 4 frames, of at most
# 8 different steps.
_SHARE = 8
_MIN_FRAMES = 4
_MAX_STEPS = 8


class FinalObservations:
    """The true last observations of ended episodes: keeps the states that steps led to, and draws
    many at once.

    Keeping the states of up to ``max_steps`` steps costs nothing; neither the host nor the device
    waits.
    """

    def __init__(
        self, compiled: CompiledGame, num_envs: int, max_steps: int, device: jax.Device
    ) -> None:
        batched = compiled.batched
        steps = min(max_steps, _MAX_STEPS)
        obs_size = batched.game.obs_size
        self._games: list[_OneGame] = []
        for draw_rows, rows in zip(compiled.draw_rows, batched.rows(num_envs), strict=True):
            self._games.append(_OneGame(draw_rows, rows, steps, obs_size, device))
        self._split_states = batched.states
        self._states: dict[int, tuple[Any, ...]] = {}
        self._partial: dict[int, jax.Array] = {}  # a policy may change the twin in mid-window

    def add(self, index: int, final: tuple[Any, jax.Array]) -> None:
        """Keep the state that a step led to, before the resets, under a number; and who saw the
        partial view.
        """
        final_state, partial = final
        self._states[index] = self._split_states(final_state)
        self._partial[index] = partial

    def draw(
        self, wanted: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, dict[str, jax.Array | np.ndarray], slice]]:
        """Draw the observations that are wanted, and forget all steps.

        Args:
            wanted: bool [N, L], by env and by the number of the step; those steps must have been
                added.

        Returns:
            Portions: int64 [n] rows, int64 [n] steps, ``pixels`` uint8 [m, S, S, 3] on the device,
            and which of these count, the first n. All at once, for on a GPU JAX would draw into
            memory that was given back and is still being read.
        """
        steps, rows = np.nonzero(wanted.T)
        portions = []
        for number, game in enumerate(self._games):
            plays_it = (rows >= game.first) & (rows < game.last)
            for some_rows, some_steps in game.portions(rows[plays_it], steps[plays_it]):
                indices = np.unique(some_steps)
                states = [self._states[index][number] for index in indices.tolist()]
                flags = [self._partial[index] for index in indices.tolist()]
                place = np.searchsorted(indices, some_steps)
                frames = game.draw(states, flags, place, some_rows)
                portions.append((some_rows, some_steps, {"pixels": frames}, slice(len(some_rows))))
        self._states.clear()
        self._partial.clear()
        return portions


class _OneGame:
    """Draws rows of the states of the envs ``first`` to ``last``, which play one game."""

    def __init__(
        self, draw_rows: Any, rows: slice, max_steps: int, obs_size: int, device: jax.Device
    ) -> None:
        self.first = rows.start
        self.last = rows.stop
        self._max_steps = max_steps
        self._draw_rows = draw_rows
        size = rows.stop - rows.start
        self._size = min(size, max(_MIN_FRAMES, size // _SHARE))
        # so many portions at once
        self._memory = FrameMemory((self._size, obs_size, obs_size, 3), device, most=8)

    def portions(
        self, rows: np.ndarray, steps: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Cut rows and their steps (in ascending order) into what one call draws."""
        while len(rows):
            numbers = np.unique(steps[: self._size])
            count = min(self._size, len(rows))
            if len(numbers) > self._max_steps:
                count = int(np.searchsorted(steps, numbers[self._max_steps]))
            yield rows[:count], steps[:count]
            rows = rows[count:]
            steps = steps[count:]

    def draw(
        self, states: list[Any], flags: list[jax.Array], step: np.ndarray, row: np.ndarray
    ) -> jax.Array | np.ndarray:
        """One call; ``step`` counts in ``states`` and ``flags``. What is short of the compiled
        shape is filled up.
        """
        missing = self._max_steps - len(states)
        states = states + [states[-1]] * missing
        flags = flags + [flags[-1]] * missing
        index = np.empty((2, self._size), np.int32)
        index[:, : len(row)] = (step, row)
        index[:, len(row) :] = ((step[-1],), (row[-1],))
        spare = self._memory.spare()
        frames = self._draw_rows(states, flags, index, np.int32(self.first), spare)
        return self._memory.show(frames)


class KeptObservations:
    """The observations that steps led to, for the ends among them; what ``FinalObservations`` is
    for our games.

    Args:
        names: Keys of the observation's leaves.
    """

    def __init__(self, names: Sequence[Any]) -> None:
        self._names = tuple(names)
        self._steps: dict[int, Any] = {}

    def add(self, index: int, final_obs: Any) -> None:
        """Keep the observation that a step led to, leaves [N, ...], under a number."""
        self._steps[index] = final_obs

    def draw(
        self, wanted: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, dict[Any, jax.Array], np.ndarray]]:
        """Give the observations that are wanted, and forget all steps.

        Args:
            wanted: bool [N, L], by env and by the number of the step; those steps must have been
                added.

        Returns:
            A portion for each step: int64 [n] rows, int64 [n] steps, arrays [N, ...] by key, and
            the rows of those that count.
        """
        portions = []
        for step in np.flatnonzero(wanted.any(0)).tolist():
            rows = np.flatnonzero(wanted[:, step])
            leaves = jax.tree.leaves(self._steps[step])
            arrays = dict(zip(self._names, leaves, strict=True))
            portions.append((rows, np.full(len(rows), step), arrays, rows))
        self._steps.clear()
        return portions
