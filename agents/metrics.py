"""Numbers about episodes: the paper's training score, and the bookkeeping behind it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from arcade_torch.models.arguments import is_number

CURVE_POINTS = 1000  # equispaced points on the frame axis
EWM_SPAN = 100  # in points of the curve (paper score) or in updates (running average)


def ewm(values: ArrayLike, span: float = EWM_SPAN) -> NDArray[np.float64]:
    """Exponentially weighted mean without bias adjustment: ``y[0] = x[0]``, ``y[t] = y[t-1] + alpha
    (x[t] - y[t-1])``.

    ``alpha = 2 / (span + 1)``; values and result are float [P].
    """
    smooth = np.array(values, dtype=np.float64)
    alpha = 2.0 / (span + 1.0)
    for t in range(1, len(smooth)):
        smooth[t] = smooth[t - 1] + alpha * (smooth[t] - smooth[t - 1])
    return smooth


def student_half_width(values: ArrayLike) -> float:
    """Half the width of Student's 95 % interval of the mean of some values; NaN where one value
    alone gives none.

    Example:
        >>> round(student_half_width([0.0, 1.0]), 2), student_half_width([0.5])
        (6.35, nan)
    """
    from scipy.special import stdtrit  # which JAX brings

    numbers = np.asarray(values, dtype=np.float64)
    if numbers.size < 2:
        return float("nan")
    quantile = stdtrit(numbers.size - 1, 0.975)
    return float(quantile * numbers.std(ddof=1) / np.sqrt(numbers.size))


def paper_score(frames: ArrayLike, returns: ArrayLike, max_frames: float | None = None) -> float:
    """The number the paper reports for a run: the best smoothed training return.

    The training curve is interpolated linearly on 1,000 equispaced points in [0, ``max_frames``]
    (constant beyond the ends) and smoothed by an exponentially weighted mean with span 100 points;
    its maximum is the score. It contains exploration noise and never goes down; keep it beside a
    greedy evaluation, not in place of one.

    Args:
        frames: float [P], increasing; frames seen at each point of the history.
        returns: float [P], at each point the return of every environment's last finished episode,
            averaged.
        max_frames: end of the frame axis; default the last of ``frames``.

    Returns:
        The score, in units of the undiscounted return.

    Raises:
        ValueError: the history is empty, its two parts differ in length, ``frames`` is not finite
            and increasing, ``returns`` not finite, or ``max_frames`` not above 0.

    Source: POPGym Arcade (ICML 2026), plotting of the reference implementation.
    """
    x = np.asarray(frames, dtype=np.float64)
    y = np.asarray(returns, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) == 0:
        raise ValueError(
            f"frames and returns must be two histories of one length >= 1; got {x.shape} and "
            f"{y.shape}"
        )
    if not (np.isfinite(x).all() and np.all(np.diff(x) > 0)):
        raise ValueError("frames must be finite and increase from row to row")
    if not np.isfinite(y).all():
        raise ValueError("returns must be finite")
    if max_frames is not None and (not is_number(max_frames) or max_frames <= 0):
        raise ValueError(f"max_frames must be a number above 0; got {max_frames!r}")
    grid = np.linspace(0.0, x[-1] if max_frames is None else max_frames, CURVE_POINTS)
    return float(ewm(np.interp(grid, x, y)).max())


@dataclass
class EpisodeStats:
    """Returns of training episodes, followed from window to window."""

    # [N], return of the last finished episode of each environment; NaN before the first
    last: NDArray[np.float64]
    episodes: int = 0  # finished so far
    # running average of finished episodes (span 100 windows); None before the first
    smooth: float | None = None
    # [E], those of the last window
    finished: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def update(self, episode_reward: Tensor, done: Tensor) -> float | None:
        """Read one window of new steps.

        Args:
            episode_reward: float32 [N, T], return so far of the episode, after each step.
            done: bool [N, T].

        Returns:
            The last finished return of each environment, averaged over the window, for
            :func:`paper_score`; None until each has one: 0 in its place, as in published scores,
            beats what is negative (results/differences.md, Tetris).
        """
        returns = episode_reward.cpu().double().numpy()
        ends = done.cpu().numpy()
        self.finished = returns[ends]
        end_steps = np.where(ends, np.arange(ends.shape[1]), -1)
        latest_end = np.maximum.accumulate(end_steps, axis=1)
        returns_at_end = np.take_along_axis(returns, latest_end.clip(0), axis=1)
        last_returns = np.where(latest_end >= 0, returns_at_end, self.last[:, None])
        self.last = last_returns[:, -1].copy()
        self.episodes += len(self.finished)
        if len(self.finished):
            mean = float(self.finished.mean())
            if self.smooth is None:
                self.smooth = mean
            else:
                self.smooth += 2 / (EWM_SPAN + 1) * (mean - self.smooth)
        return None if np.isnan(last_returns).any() else float(last_returns.mean())

    def state_dict(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        return {
            "last": torch.from_numpy(self.last.copy()),
            "episodes": self.episodes,
            "smooth": self.smooth,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment."""
        self.last = state["last"].numpy().copy()
        self.episodes = state["episodes"]
        self.smooth = state["smooth"]
