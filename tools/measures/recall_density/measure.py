"""Recall density: how the gradient of a decision is spread over the past of its episode.

For a trajectory o_0 ... o_n let ``g_t = sum_a || d Q(s_n, a) / d o_t ||_1`` and ``delta_t = g_t /
sum_i g_i``. The density is the mean of delta over trajectories, in bins of normalised time
(`binned`) or sampled at points as in the paper. On an MDP an ideal agent has all mass on the last
frame. The last action is no pixel: what is remembered through it does not show.

Source: POPGym Arcade (ICML 2026), recall density. Differs from its published code in the time axis
(own length of each trajectory), in whole episodes instead of ten steps, and in gradients of single
actions instead of their sum.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from arcade_torch.tools.measures.bootstrap import Array
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.policy import Progress, Target, as_policy, resolve
from arcade_torch.tools.measures.saliency.measure import Norm, Reduce, check_norm, saliency
from arcade_torch.tools.measures.windows import (
    MAX_STEPS,
    MIN_STEPS,
    End,
    Twin,
    Window,
    check_episodes,
    greedy_windows,
    resolve_agent,
)


@dataclass(frozen=True)
class RecallDensity:
    """Recall density of one checkpoint."""

    # float64, delta of every frame, oldest first, one trajectory after the other; each sums to 1
    deltas: Array
    lengths: NDArray[np.int64]  # [m], frames of each trajectory
    # [m], whether the trajectory ends with the decision that ended its episode
    ended: NDArray[np.bool_]
    dropped: int  # trajectories left out because they have fewer than three frames
    silent: int  # trajectories left out because all their gradients vanish
    target: str  # what was differentiated
    sizes: Array  # [m], the sum over its frames that the gradient of a trajectory was divided by
    certainty: Array  # [m], the largest output at the decision

    @property
    def shares(self) -> tuple[Array, ...]:
        """One float64 [n_i + 1] a trajectory."""
        if not self.lengths.size:
            return ()
        return tuple(np.split(self.deltas, np.cumsum(self.lengths)[:-1]))

    def mass(self, bins: int) -> Array:
        """Mean mass in equal parts of the trajectories, float64 [bins]; sums to 1."""
        return self._mean(lambda share: binned(share, bins))

    def points(self, taus: Array) -> Array:
        """The paper's point-sampled curve at ``taus`` in [0, 1]; does not integrate to 1."""
        return self._mean(lambda share: point_sampled(share, taus))

    def last_share(self) -> float:
        """Mean share of the last frame."""
        return float(self._mean(lambda share: share[-1]))

    def _mean(self, of: Callable[[Array], Array]) -> Array:
        """Mean over trajectories."""
        if not self.lengths.size:
            why = (
                f"{self.dropped} had fewer than {MIN_STEPS} frames, {self.silent} no gradient at "
                "all"
            )
            raise ValueError(f"no trajectory is left: {why}; play more episodes")
        return np.asarray(np.mean([of(share) for share in self.shares], axis=0))


def recall_density(
    agent: Any,
    env: Any = None,
    *,
    episodes: int = 100,
    seed: int = 0,
    observability: Twin | None = None,
    end: End = "last",
    cap: int = MAX_STEPS,
    norm: Norm = "l1",
    reduce: Reduce = "per_action",
    target: Target = "auto",
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> RecallDensity:
    """Recall density of an agent over whole greedy episodes.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, a TensorDict
            policy or anything else that `as_policy` takes.
        env: any env of TorchRL, whose episodes are played side by side; by default 16 of the
            agent's own game.
        episodes: number of trajectories.
        seed: of the episodes; training never sees them.
        observability: another twin than the one trained on (without ``env``).
        end: ``last``: n is the last frame before the terminating action, which is no typical
            decision (a failure may be imminent); ``random``: n is drawn uniformly from index 2 on.
        cap: longest trajectory; longer episodes give a window of that length with a random end.
        norm: over all pixels and channels, as for `saliency`, and so are ``reduce`` and ``target``;
            ``l1`` is the paper's.
        progress: called with (trajectories done, episodes).
        **names: keywords of `as_policy`.

    Returns:
        Arrays.

    Raises:
        ValueError: an option is out of range, or this agent does not offer ``target``.
    """
    check_episodes(episodes, seed, end, cap, observability)
    check_norm(reduce, norm)
    player, env = resolve_agent(agent, env, observability, **names)
    windows = greedy_windows(player, env, episodes=episodes, seed=seed, end=end, cap=cap)
    tell = None if progress is None else lambda count: progress(count, episodes)
    return density_of_windows(
        player, windows, norm=norm, reduce=reduce, target=target, progress=tell
    )


def density_of_windows(
    model: Any,
    windows: Iterable[Window],
    *,
    norm: Norm = "l1",
    reduce: Reduce = "per_action",
    target: Target = "auto",
    progress: Callable[[int], None] | None = None,
    **names: Unpack[Names],
) -> RecallDensity:
    """Recall density over windows of experience of your own; the last frame of each is explained.

    A start flag inside a window leaves exactly nothing on the frames before it; ``progress`` is
    called with the number of windows done. Everything else is as for `recall_density`.
    """
    policy = as_policy(model, **names)
    shares = [np.zeros(0)]
    ended = list[bool]()
    sizes = list[float]()
    certainty = list[float]()
    dropped = 0
    silent = 0
    for count, window in enumerate(windows, start=1):
        if window.n + 1 < MIN_STEPS:
            dropped += 1
        else:
            gradients = saliency(
                policy,
                window.frames,
                window.last_action,
                window.is_init,
                window.state,
                reduce=reduce,
                norm=norm,
                target=target,
            )
            if gradients.per_frame.sum() > 0:
                shares.append(gradients.shares())
                ended.append(window.ended)
                sizes.append(float(gradients.per_frame.sum()))
                certainty.append(float(gradients.output.max()))
            else:
                silent += 1
        if progress is not None:
            progress(count)
    return RecallDensity(
        deltas=np.concatenate(shares),
        lengths=np.array([share.size for share in shares[1:]], dtype=np.int64),
        ended=np.array(ended, dtype=np.bool_),
        dropped=dropped,
        silent=silent,
        target=resolve(policy, target),
        sizes=np.array(sizes),
        certainty=np.array(certainty),
    )


def binned(shares: Array, bins: int) -> Array:
    """Mass in equal parts of a trajectory.

    Step t of N owns the interval [t/N, (t+1)/N) and bin b of B owns [b/B, (b+1)/B); the mass of a
    step is split by the overlap of the intervals. Every trajectory therefore keeps its whole mass,
    whatever its length.

    Raises:
        ValueError: there is no step or no bin.

    Example:
        >>> binned(np.array([1.0, 0.0]), 3).round(3).tolist()
        [0.667, 0.333, 0.0]
    """
    if bins < 1 or shares.size < 1:
        raise ValueError(f"need at least one bin and one step, got {bins} and {shares.size}")
    steps = np.arange(shares.size + 1) / shares.size
    mass_before = np.concatenate([[0.0], np.cumsum(shares)])
    return np.diff(np.interp(np.arange(bins + 1) / bins, steps, mass_before))


def point_sampled(shares: Array, taus: Array) -> Array:
    """The paper's curve: the share of step floor(tau n), n the index of the last step.

    It does not integrate to one over trajectories of different length; `binned` does.
    """
    return shares[np.floor(taus * (shares.size - 1) + 1e-9).astype(np.int64)]


def no_memory(lengths: Sequence[int], bins: int) -> Array:
    """Reference line: only the last frame of each trajectory counts.

    A trajectory with fewer steps than bins spreads its last frame over several of them, as it does
    its other frames.
    """
    masses = []
    for length in lengths:
        last_frame_only = np.zeros(length)
        last_frame_only[-1] = 1.0
        masses.append(binned(last_frame_only, bins))
    return np.asarray(np.mean(masses, axis=0))
