"""State contamination: what one disturbed past observation does to the decisions after it.

A greedy trajectory is recorded; frame j is replaced by itself plus noise (on the [0, 1] scale of pixels), the memory
replays it, and k steps later the outputs are compared with those of the undisturbed replay. A memory-free agent is
untouched for k >= 1; noise on the decision's own frame (k = 0) is the ceiling. ``shuffled_beginning`` permutes early
frames instead, each of which stays a frame that training has seen.

By default the recorded actions and start flags are replayed (teacher forcing), so that nothing but the observation
reaches the memory; with ``feedback`` the previous action is the replay's own, as in the published code.

Source: POPGym Arcade (ICML 2026), recurrent state contamination. Its code adds noise of standard deviation 1 to pixels
in 0..255, which is sigma = 1/255 here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.analysis.gradients import encode_frames
from arcade_torch.tools.analysis.perturbation import disturbed_frames, replayed, shuffle_order
from arcade_torch.tools.analysis.policy import Policy, Target, evaluation, outputs, policy_of, resolve
from arcade_torch.tools.analysis.resolve import resolve_agent
from arcade_torch.tools.analysis.windows import MAX_STEPS, Window, greedy_windows

Floats = NDArray[np.float64]

SIGMAS = (0.1, 0.3, 1.0)
"""Standard deviations of the noise, on the [0, 1] scale."""

DELAYS = (0, 1, 2, 5, 10, 20, 50, 100)
"""Steps between the disturbed frame and the decision; 0 is the ceiling."""

POINTS_AN_EPISODE = 4
"""Start points drawn from one trajectory."""


@dataclass(frozen=True)
class Contamination:
    """How decisions of one checkpoint change.

    Entries are NaN where the episode ended before the decision.

    Attributes:
        kind: ``noise`` or ``shuffle``.
        sigmas: float64 [S]; one NaN for ``shuffle``.
        delays: int64 [K], steps from the disturbance (its last frame) to the decision.
        flip: float64 [P, S, K], 1 where the best action changed.
        change: float64 [P, S, K], ``||A' - A||_inf / (max A - min A)`` with A the outputs minus their mean.
        kl: float64 [P, S, K], KL(pi || pi') in nats for policies; NaN for Q-values.
        points: int64 [P, 2], trajectory and index of the disturbed frame.
        clean_error: largest difference that replacing a frame by itself made to any output.
        skipped: trajectories too short for a start point.
        target: which outputs.
        feedback: whether actions of the replay were fed back.
        clip: whether noisy pixels were clipped to their range.
    """

    kind: str
    sigmas: Floats
    delays: NDArray[np.int64]
    flip: Floats
    change: Floats
    kl: Floats
    points: NDArray[np.int64]
    clean_error: float
    skipped: int
    target: str
    feedback: bool
    clip: bool

    def mean(self, measure: Literal["flip", "change", "kl"]) -> Floats:
        """Mean over start points, float64 [S, K]; NaN where there is none."""
        values: Floats = getattr(self, measure)
        count = np.isfinite(values).sum(axis=0)
        total = np.where(np.isfinite(values), values, 0.0).sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def counts(self) -> NDArray[np.int64]:
        """Start points behind every mean, int64 [S, K]."""
        return np.asarray(np.isfinite(self.flip).sum(axis=0), dtype=np.int64)


def contamination(
    agent: Any,
    env: Any = None,
    *,
    sigmas: Sequence[float] = SIGMAS,
    delays: Sequence[int] = DELAYS,
    starts: int = 200,
    clip: bool = False,
    feedback: bool = False,
    seed: int = 0,
    observability: Literal["full", "partial"] | None = None,
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Contamination:
    """Noise on one past observation, for a grid of strengths and delays.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, any `Policy` or network.
        env: environments; by default 16 of the agent's own game.
        sigmas: standard deviations of Gaussian noise on the [0, 1] scale; all share the same draw.
        delays: steps from the disturbed frame to the decision.
        starts: disturbed frames P, at most four an episode, drawn uniformly from the frames before its last.
        clip: keep noisy pixels in their range (the published code does not).
        feedback: let the replay choose the previous actions itself.
        seed: of episodes, start points and noise.
        observability: another twin than the one trained on (without ``env``).
        cap: longest trajectory.
        target: which outputs, see `outputs`.
        progress: called with (start points done, starts).

    Returns:
        Arrays.

    Raises:
        ValueError: an option is out of range, or no episode was long enough.
    """
    if not sigmas or min(sigmas) < 0:
        raise ValueError(f"sigmas must be numbers of at least 0, got {list(sigmas)}")
    grid = _Grid(np.array(sigmas, dtype=np.float64), _delays(delays))

    def disturb(policy: Policy, window: Window, features: Tensor, rng: np.random.Generator, wanted: int) -> _Rows:
        places = np.sort(rng.choice(window.n, min(wanted, window.n), replace=False))
        noisy = disturbed_frames(window.frames, places, grid.sigmas, clip, int(rng.integers(2**62)))
        rows = features.repeat(1 + noisy.shape[0], 1, 1)
        index = torch.as_tensor(np.repeat(places, len(grid.sigmas)))
        rows[torch.arange(1, 1 + noisy.shape[0]), index] = encode_frames(policy.encode, noisy)
        return _Rows(rows, places, places)

    options = _Options(starts, POINTS_AN_EPISODE, feedback, seed, cap, target, 2)
    return _measure("noise", agent, env, observability, grid, options, disturb, clip, progress)


def shuffled_beginning(
    agent: Any,
    env: Any = None,
    *,
    first: int = 1,
    last: int = 10,
    delays: Sequence[int] = DELAYS,
    starts: int = 200,
    feedback: bool = False,
    identity: bool = False,
    seed: int = 0,
    observability: Literal["full", "partial"] | None = None,
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Contamination:
    """Permute the frames first + 1 ... last of a trajectory and keep all others.

    Actions and start flags stay in their order. On a POMDP another order may rightly change what the agent believes:
    draw conclusions on MDPs only.

    Args:
        agent: as for `contamination`.
        env: as for `contamination`.
        first: index of the last frame of the beginning that stays.
        last: index of the last permuted frame.
        delays: steps from frame ``last`` to the decision.
        starts: permutations P, one a trajectory.
        feedback: as for `contamination`.
        identity: use the identity in place of random permutations, which must change nothing.
        seed: as for `contamination`.
        observability: as for `contamination`.
        cap: as for `contamination`.
        target: as for `contamination`.
        progress: as for `contamination`.

    Returns:
        Arrays; ``sigmas`` is one NaN.

    Raises:
        ValueError: fewer than two frames are permuted, an option is out of range, or no episode was long enough.
    """
    if first < 0 or last < first + 2:
        raise ValueError(f"frames first + 1 to last must be at least two, got first = {first} and last = {last}")
    grid = _Grid(np.array([np.nan]), _delays(delays))

    def disturb(policy: Policy, window: Window, features: Tensor, rng: np.random.Generator, wanted: int) -> _Rows:
        order = np.arange(window.n + 1) if identity else shuffle_order(window.n + 1, first, last, rng)
        rows = torch.cat([features, features[:, torch.as_tensor(order)]])
        return _Rows(rows, np.array([last]), np.array([first]))

    options = _Options(starts, 1, feedback, seed, cap, target, last + 1)
    return _measure("shuffle", agent, env, observability, grid, options, disturb, False, progress)


@dataclass(frozen=True)
class _Grid:
    sigmas: Floats
    delays: NDArray[np.int64]


@dataclass(frozen=True)
class _Options:
    starts: int
    per_window: int
    feedback: bool
    seed: int
    cap: int
    target: Target
    shortest: int


@dataclass(frozen=True)
class _Rows:
    """Features [1 + points * S, T, E], the undisturbed row first; where decisions count from; where to free actions."""

    features: Tensor
    places: NDArray[np.int64]
    touched: NDArray[np.int64]


def _delays(delays: Sequence[int]) -> NDArray[np.int64]:
    if not delays or min(delays) < 0:
        raise ValueError(f"delays must be whole numbers of at least 0, got {list(delays)}")
    return np.array(sorted(set(delays)), dtype=np.int64)


Disturb = Callable[[Policy, Window, Tensor, np.random.Generator, int], _Rows]


@torch.no_grad()
def _measure(
    kind: str,
    agent: Any,
    env: Any,
    observability: Literal["full", "partial"] | None,
    grid: _Grid,
    options: _Options,
    disturb: Disturb,
    clip: bool,
    progress: Callable[[int, int], None] | None,
) -> Contamination:
    if options.starts < 1:
        raise ValueError(f"starts must be at least 1, got {options.starts}")
    player, env = resolve_agent(agent, env, observability)
    what = resolve(player, options.target)
    if what == "value":
        raise ValueError("contamination compares actions: target must be q, logits or probs, not value")
    policy, parts = policy_of(player), []
    points: list[tuple[int, int]] = []
    skipped, error = 0, 0.0
    rng = np.random.default_rng([options.seed, 1])
    episodes = 4 * -(-options.starts // options.per_window) + 16
    windows = greedy_windows(player, env, episodes=episodes, seed=options.seed, cap=options.cap)
    with evaluation(policy):
        for number, window in enumerate(windows):
            if window.n + 1 < max(2, options.shortest):
                skipped += 1
                continue
            features = encode_frames(policy.encode, window.frames)[None]
            wanted = min(options.per_window, options.starts - len(points))
            rows = disturb(policy, window, features, rng, wanted)
            raw = replayed(policy, window, rows.features, rows.touched, options.feedback)
            parts.append(_compare(player, what, raw, rows.places, grid))
            error = max(error, _clean_error(policy, window, features, rows, raw[0], options.feedback))
            points += [(number, int(place)) for place in rows.places]
            if progress is not None:
                progress(len(points), options.starts)
            if len(points) >= options.starts:
                break
    if not parts:
        raise ValueError(f"none of {skipped} episodes was long enough: {options.shortest} frames are needed")
    flip, change, kl = (np.concatenate([part[i] for part in parts]) for i in range(3))
    found = np.array(points, dtype=np.int64)
    return Contamination(
        kind, grid.sigmas, grid.delays, flip, change, kl, found, error, skipped, what, options.feedback, clip
    )


def _compare(model: Any, what: str, raw: Tensor, places: NDArray[np.int64], grid: _Grid) -> tuple[Floats, ...]:
    """Flip, relative change and KL of rows 1... against row 0, each [points, S, K]."""
    shape = len(places), len(grid.sigmas), len(grid.delays)
    steps = np.broadcast_to(places[:, None, None] + grid.delays, shape)
    known = torch.as_tensor(steps < raw.shape[1])
    index = torch.as_tensor(np.minimum(steps, raw.shape[1] - 1)).reshape(-1)
    rows = torch.arange(1, raw.shape[0]).reshape(shape[:2])[..., None].expand(shape).reshape(-1)
    before, after = raw[0, index], raw[rows, index]
    scalars = outputs(model, what)
    a, b = (_centred(scalars(out).double().cpu()) for out in (before, after))
    spread = a.amax(-1) - a.amin(-1)
    change = torch.where(spread > 0, (b - a).abs().amax(-1) / spread, torch.nan)
    flip = (a.argmax(-1) != b.argmax(-1)).double()
    kl = torch.full_like(flip, torch.nan)
    if what in ("logits", "probs"):
        logits = outputs(model, "logits")
        p, q = (logits(out).double().cpu().log_softmax(-1) for out in (before, after))
        kl = (p.exp() * (p - q)).sum(-1)
    return tuple(torch.where(known, v.reshape(shape), torch.nan).numpy() for v in (flip, change, kl))


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(-1, keepdim=True)


def _clean_error(policy: Policy, window: Window, features: Tensor, rows: _Rows, clean: Tensor, feedback: bool) -> float:
    """What the machinery itself does: a frame in the middle is replaced by itself, encoded alone."""
    middle = window.n // 2
    again = features.clone()
    again[0, middle] = encode_frames(policy.encode, window.frames[middle : middle + 1])[0]
    return float((replayed(policy, window, again, rows.touched, feedback)[0] - clean).abs().max())
