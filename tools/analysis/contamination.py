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
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.analysis.policy import Policy, Target, outputs, policy_of, resolve
from arcade_torch.tools.analysis.windows import MAX_STEPS, Twin, Window, greedy_windows, resolve_agent

Progress = Callable[[int, int], None]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIGMAS = (0.1, 0.3, 1.0)  # on the [0, 1] scale of pixels
DELAYS = (0, 1, 2, 5, 10, 20, 50, 100)  # steps
POINTS_AN_EPISODE = 4
FIRST, LAST = 1, 10
"""A shuffle permutes the frames behind the first of these, up to the last."""
WHITE = 255.0  # pixel value that stands for 1


@dataclass(frozen=True)
class Contamination:
    """How decisions of one checkpoint change.

    Entries are NaN where the episode ended before the decision.

    Attributes:
        sigmas: float64 [S]; one NaN for shuffled frames.
        delays: int64 [K], steps from the disturbance (its last frame) to the decision.
        flip: float64 [P, S, K], 1 where the best action changed.
        change: float64 [P, S, K], ``||A' - A||_inf / (max A - min A)`` with A the outputs minus their mean.
        kl: float64 [P, S, K], KL(pi || pi') in nats for policies; NaN for Q-values.
        points: int64 [P, 2], trajectory and index of the disturbed frame.
        clean_error: largest difference that replacing a frame by itself made to any output.
        skipped: trajectories too short for a start point.
        target: which outputs.
    """

    sigmas: Floats
    delays: Ints
    flip: Floats
    change: Floats
    kl: Floats
    points: Ints
    clean_error: float
    skipped: int
    target: str

    def mean(self, measure: Literal["flip", "change", "kl"]) -> Floats:
        """Mean over start points, float64 [S, K]; NaN where there is none."""
        values = np.ma.masked_invalid(getattr(self, measure))
        return np.asarray(values.mean(axis=0).filled(np.nan))

    def counts(self) -> Ints:
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
    observability: Twin | None = None,
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Progress | None = None,
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
    strengths = np.array(sigmas, dtype=np.float64)

    def disturb(policy: Policy, window: Window, rng: np.random.Generator, wanted: int) -> Versions:
        places = np.sort(rng.choice(window.n, min(wanted, window.n), replace=False))
        noisy = disturbed_frames(window.frames, places, strengths, clip, int(rng.integers(2**62)))
        return _noisy_versions(policy, window, places, noisy)

    common: Any = {"delays": delays, "starts": starts, "feedback": feedback, "seed": seed, "cap": cap, "target": target}
    player, env = resolve_agent(agent, env, observability)
    return _measure(player, env, disturb, strengths, POINTS_AN_EPISODE, 2, progress, **common)


def shuffled_beginning(
    agent: Any,
    env: Any = None,
    *,
    delays: Sequence[int] = DELAYS,
    starts: int = 200,
    feedback: bool = False,
    identity: bool = False,
    seed: int = 0,
    observability: Twin | None = None,
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Progress | None = None,
) -> Contamination:
    """Permute frames 2 to 10 of a trajectory and keep all others.

    Actions and start flags stay in their order. On a POMDP another order may rightly change what the agent believes:
    draw conclusions on MDPs only.

    Args:
        agent: as for `contamination`, and so are ``env`` and all options that do not stand here.
        delays: steps from frame 10 to the decision.
        starts: permutations P, one a trajectory.
        identity: use the identity in place of random permutations, which must change nothing.

    Returns:
        Arrays; ``sigmas`` is one NaN.

    Raises:
        ValueError: an option is out of range, or no episode was long enough.
    """

    def disturb(policy: Policy, window: Window, rng: np.random.Generator, wanted: int) -> Versions:
        order = np.arange(window.n + 1) if identity else shuffle_order(window.n + 1, FIRST, LAST, rng)
        return _shuffled_versions(policy, window, order)

    common: Any = {"delays": delays, "starts": starts, "feedback": feedback, "seed": seed, "cap": cap, "target": target}
    player, env = resolve_agent(agent, env, observability)
    return _measure(player, env, disturb, np.array([np.nan]), 1, LAST + 1, progress, **common)


class Versions(NamedTuple):
    """A trajectory and its disturbed versions."""

    features: Tensor  # [1 + points * S, T, E], the undisturbed row first
    places: Ints  # where delays count from
    changed: int  # first frame that differs


@torch.no_grad()
def _measure(
    player: Any,
    env: Any,
    disturb: Callable[[Policy, Window, np.random.Generator, int], Versions],
    sigmas: Floats,
    per_window: int,
    shortest: int,
    progress: Progress | None,
    *,
    delays: Sequence[int],
    starts: int,
    feedback: bool,
    seed: int,
    cap: int,
    target: Target,
) -> Contamination:
    """Both measures: ``per_window`` start points from every trajectory of at least ``shortest`` frames."""
    if not delays or min(delays) < 0:
        raise ValueError(f"delays must be whole numbers of at least 0, got {list(delays)}")
    if starts < 1:
        raise ValueError(f"starts must be at least 1, got {starts}")
    what = resolve(player, target)
    if what == "value":
        raise ValueError("contamination compares actions: target must be q, logits or probs, not value")
    steps = np.unique(np.array(delays, dtype=np.int64))
    policy, parts, points = policy_of(player), list[tuple[Floats, ...]](), list[tuple[int, int]]()
    skipped, error, rng = 0, 0.0, np.random.default_rng([seed, 1])
    episodes = 4 * -(-starts // per_window) + 16
    with policy.evaluating():
        for number, w in enumerate(greedy_windows(player, env, episodes=episodes, seed=seed, cap=cap)):
            if w.n + 1 < shortest:
                skipped += 1
                continue
            features, places, changed = disturb(policy, w, rng, min(per_window, starts - len(points)))
            raw = replayed(policy, w, features, changed, feedback)
            parts.append(_compare(player, what, raw, places[:, None, None] + steps, len(sigmas)))
            # What the machinery itself does: a frame in the middle is replaced by itself, encoded alone.
            again, middle = features[:1].clone(), w.n // 2
            again[0, middle] = policy.features(w.frames[middle : middle + 1])[0]
            same = replayed(policy, w, again, changed, feedback)[0]
            error = max(error, float((same - raw[0]).abs().max()))
            points += [(number, int(place)) for place in places]
            if progress is not None:
                progress(len(points), starts)
            if len(points) >= starts:
                break
    if not parts:
        raise ValueError(f"none of {skipped} episodes was long enough: {shortest} frames are needed")
    flip, change, kl = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Contamination(sigmas, steps, flip, change, kl, np.array(points, dtype=np.int64), error, skipped, what)


def _compare(model: Any, what: str, raw: Tensor, decisions: Ints, sigmas: int) -> tuple[Floats, ...]:
    """Flip, relative change and KL of rows 1... against row 0 at steps [points, 1, K], each [points, S, K]."""
    shape = len(decisions), sigmas, decisions.shape[-1]
    steps = np.broadcast_to(decisions, shape)
    known = torch.as_tensor(steps < raw.shape[1])
    index = torch.as_tensor(np.minimum(steps, raw.shape[1] - 1)).reshape(-1)
    rows = torch.arange(1, raw.shape[0]).reshape(shape[:2])[..., None].expand(shape).reshape(-1)
    scalars = outputs(model, what)
    a, b = (_centred(scalars(out).double().cpu()) for out in (raw[0, index], raw[rows, index]))
    spread = a.amax(-1) - a.amin(-1)
    change = torch.where(spread > 0, (b - a).abs().amax(-1) / spread, torch.nan)
    flip = (a.argmax(-1) != b.argmax(-1)).double()
    kl = torch.full_like(flip, torch.nan)
    if what in ("logits", "probs"):
        logits = outputs(model, "logits")
        p, q = (logits(out).double().cpu().log_softmax(-1) for out in (raw[0, index], raw[rows, index]))
        kl = (p.exp() * (p - q)).sum(-1)
    return tuple(torch.where(known, v.reshape(shape), torch.nan).numpy() for v in (flip, change, kl))


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(-1, keepdim=True)


def disturbed_frames(frames: Tensor, places: Ints, sigmas: Floats, clip: bool, seed: int) -> Tensor:
    """Single frames with Gaussian noise, float32 [places * sigmas, ...]; the strengths of one frame share its draw."""
    generator = torch.Generator().manual_seed(seed)
    chosen = frames[torch.as_tensor(places)].to(torch.float32)
    noise = torch.randn(chosen.shape, generator=generator).to(chosen.device)
    scale = torch.as_tensor(WHITE * sigmas, dtype=torch.float32, device=chosen.device)
    noisy = (chosen[:, None] + scale[:, None, None, None] * noise[:, None]).flatten(0, 1)
    return noisy.clamp(0.0, WHITE) if clip else noisy


def _noisy_versions(policy: Policy, window: Window, places: Ints, noisy: Tensor) -> Versions:
    """A version for each noisy frame, those of one place in a row."""
    rows = policy.features(window.frames).repeat(1 + len(noisy), 1, 1)
    index = torch.as_tensor(places.repeat(len(noisy) // len(places)))
    rows[torch.arange(1, 1 + len(noisy)), index] = policy.features(noisy)
    return Versions(rows, places, int(places.min()))


def shuffle_order(total: int, first: int, last: int, rng: np.random.Generator) -> Ints:
    """Indices of ``total`` frames with those from first + 1 to last in another order."""
    if not 0 <= first <= last - 2 or last >= total:
        raise ValueError(f"cannot permute frames {first + 1} to {last} of {total}")
    order = np.arange(total)
    part = order[first + 1 : last + 1]
    while (order == np.arange(total)).all():  # the identity is no shuffle
        order[first + 1 : last + 1] = rng.permutation(part)
    return order


def _shuffled_versions(policy: Policy, window: Window, order: Ints) -> Versions:
    features = policy.features(window.frames)
    return Versions(torch.stack([features, features[torch.as_tensor(order)]]), np.array([LAST]), FIRST)


@torch.no_grad()
def replayed(policy: Policy, window: Window, features: Tensor, changed: int, feedback: bool) -> Tensor:
    """What the memory says at every step of several versions of a trajectory that differ from frame ``changed`` on."""
    count = features.shape[0]
    state: Any = policy.initial_state(1) if window.state is None else window.state
    if state is not None:
        state = state.expand(count, *state.shape[1:]).clone()
    actions, starts = window.last_action.expand(count, -1), window.is_init.bool().expand(count, -1)
    if not feedback:
        return policy.remember(features, actions, starts, state)[0]
    # Up to the first difference nothing has been chosen by the replay yet: the recorded actions lead there.
    head = slice(changed + 1)
    out, state = policy.remember(features[:, head], actions[:, head], starts[:, head], state)
    parts = [out]
    for t in range(changed + 1, features.shape[1]):
        out, state = policy.remember(features[:, t : t + 1], policy.greedy(out[:, -1:]), starts[:, t : t + 1], state)
        parts.append(out)
    return torch.cat(parts, 1)


class Examples(NamedTuple):
    """One trajectory, undisturbed (row 0) and disturbed in several ways: pictures, and what the agent then thought."""

    frames: NDArray[np.uint8]  # [R, F, S, S, 3], some frames of each version
    names: Ints  # [R, F], the index of each frame
    values: Floats  # [R, A] at the last step: Q-values minus their mean, or probabilities
    labels: tuple[str, ...]  # [R], what was done
    target: str
    n: int  # index of the last step


@torch.no_grad()
def examples(model: Any, window: Window, hits: Sequence[int] = (), seed: int = 0) -> Examples:
    """What noise of strength 1 on a frame does to the decision on the last frame of a window.

    There is a version for each frame of ``hits``; without any, the early frames are shuffled instead. The seed is that
    of the noise, or the order.

    Raises:
        ValueError: a hit lies outside the window, or the window is too short for a shuffle.
    """
    if hits and not 0 <= min(hits) <= max(hits) <= window.n:
        raise ValueError(f"hits must be indices from 0 to {window.n}, got {list(hits)}")
    policy, target = policy_of(model), resolve(model, "auto")
    with policy.evaluating():
        if hits:
            noisy = disturbed_frames(window.frames, np.array(hits), np.array([1.0]), False, seed)
            versions = _noisy_versions(policy, window, np.array(hits), noisy)
            names = [[0, hit, window.n] for hit in (hits[0], *hits)]
            pictures = window.frames[torch.tensor(names)]
            for row, hit in enumerate(hits):
                changed = torch.tensor(names[row + 1]) == hit
                pictures[row + 1, changed] = noisy[row].clamp(0, WHITE).round().to(torch.uint8)
            labels = ("clean", *(f"noise on frame {hit}" for hit in hits))
        else:
            order = shuffle_order(window.n + 1, FIRST, LAST, np.random.default_rng(seed))
            versions = _shuffled_versions(policy, window, order)
            late = list(range(max(LAST + 1, window.n - 2), window.n + 1))
            names = [[*early, *late] for early in (range(FIRST + 1, FIRST + 4), order[FIRST + 1 : FIRST + 4].tolist())]
            pictures, labels = window.frames[torch.tensor(names)], ("clean", "shuffled beginning")
        raw = replayed(policy, window, versions.features, versions.changed, False)[:, -1]
    values = outputs(model)(raw).double().cpu()
    values = values if target == "probs" else _centred(values)
    return Examples(pictures.cpu().numpy(), np.array(names), values.numpy(), labels, target, window.n)
