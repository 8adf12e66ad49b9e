"""State contamination: what one disturbed past observation does to the decisions after it.

A greedy trajectory is recorded; frame j is replaced by itself plus noise (on the [0, 1] scale of
pixels), the memory replays it, and k steps later the outputs are compared with those of the
undisturbed replay. A memory-free agent is untouched for k >= 1; noise on the decision's own frame
(k = 0) is the ceiling. ``shuffle`` permutes early frames instead, each of which stays a frame that
training has seen.

By default the recorded actions and start flags are replayed (teacher forcing), so that nothing but
the observation reaches the memory; with ``feedback`` the previous action is the replay's own, as in
the published code.

Source: POPGym Arcade (ICML 2026), recurrent state contamination. Its code adds noise of standard
deviation 1 to pixels in 0..255, which is sigma = 1/255 here.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.measures import arguments, masked
from arcade_torch.tools.measures.bootstrap import Array
from arcade_torch.tools.measures.envs import one_hot
from arcade_torch.tools.measures.frames import check_range, float_type, pictures, white_of
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.policy import (
    Policy,
    Progress,
    Target,
    as_policy,
    outputs,
    resolve,
)
from arcade_torch.tools.measures.windows import (
    MAX_STEPS,
    MIN_STEPS,
    Twin,
    Window,
    greedy_windows,
    held_out,
    play,
    resolve_agent,
)
from arcade_torch.tools.text import counted

Ints = NDArray[np.int64]

SIGMAS = (0.1, 0.3, 1.0)  # on the [0, 1] scale of pixels
DELAYS = (0, 1, 2, 5, 10, 20, 50, 100)  # steps
POINTS_AN_EPISODE = 4
# a shuffle permutes the frames behind the first of these, up to the last
FIRST = 1
LAST = 10


@dataclass(frozen=True)
class Contamination:
    """How decisions of one checkpoint change; NaN where the episode ended before the decision."""

    sigmas: Array  # float64 [S]; one NaN for shuffled frames
    delays: Ints  # int64 [K], steps from the disturbance (its last frame) to the decision
    flip: Array  # float64 [P, S, K], 1 where the best action changed
    # float64 [P, S, K], ``||A' - A||_inf / (max A - min A)`` with A the outputs minus their mean
    change: Array
    kl: Array  # float64 [P, S, K], KL(pi || pi') in nats for policies; NaN for Q-values
    points: Ints  # int64 [P, 2], trajectory and index of the disturbed frame
    clean_error: float  # largest difference that replacing a frame by itself made to any output
    skipped: int  # trajectories too short for a start point
    target: str  # which outputs

    def mean(self, measure: Literal["flip", "change", "kl"]) -> Array:
        """Mean over start points, float64 [S, K]; NaN where there is none."""
        values = np.ma.masked_invalid(getattr(self, measure))
        return np.asarray(values.mean(axis=0).filled(np.nan))

    def counts(self) -> Ints:
        """Start points behind every mean, int64 [S, K]."""
        return np.asarray(np.isfinite(self.flip).sum(axis=0), dtype=np.int64)


@torch.no_grad()
def contamination(
    agent: Any,
    env: Any = None,
    *,
    sigmas: Sequence[float] = SIGMAS,
    delays: Sequence[int] = DELAYS,
    starts: int = 200,
    clip: bool = False,
    feedback: bool = False,
    shuffle: bool = False,
    seed: int = 0,
    observability: Twin | None = None,
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> Contamination:
    """Noise on one past observation, for a grid of strengths and delays.

    Args:
        agent: as for `recall_density`, and so are ``env``, ``observability``, ``cap`` and
            ``target``.
        sigmas: standard deviations of Gaussian noise on the [0, 1] scale; all share the same draw.
        delays: steps from the disturbed frame to the decision.
        starts: disturbed frames P, at most four an episode, drawn uniformly from the frames before
            its last.
        clip: keep noisy pixels in their range (the published code does not).
        feedback: let the replay choose the previous actions itself.
        shuffle: permute frames 2 to 10 in place of adding noise, once a trajectory; actions and
            start flags stay in their order, delays count from frame 10, ``sigmas`` becomes one NaN.
            On a POMDP another order may rightly change what the agent believes: draw conclusions on
            MDPs only.
        seed: of episodes, start points and noise.
        progress: called with (start points done, starts).
        **names: keywords of `as_policy`; ``white`` is what 1 means for ``sigmas``.

    Raises:
        ValueError: an option is out of range, or no episode was long enough.
    """
    arguments.check_strengths("sigmas", sigmas)
    arguments.check_whole("delays", delays)
    arguments.check_flags(clip=clip, feedback=feedback, shuffle=shuffle)
    arguments.check_played(seed, observability, starts=(starts, 1), cap=(cap, MIN_STEPS))
    player, env = resolve_agent(agent, env, observability, **names)
    disturbance = Shuffle() if shuffle else Noise(np.array(sigmas, np.float64), clip)
    steps = np.unique(np.array(delays, np.int64))
    disturber = Disturber(
        player, output_of_actions(player, target), disturbance, steps, starts, feedback, seed
    )
    episodes = 4 * math.ceil(starts / disturbance.points_an_episode) + 16
    disturber.run(greedy_windows(player, env, episodes=episodes, seed=seed, cap=cap), progress)
    return disturber.result()


def output_of_actions(model: Any, target: Target) -> str:
    """The output that is compared; a ``ValueError`` if it says nothing of actions."""
    name = resolve(model, target)
    if name == "value":
        raise ValueError(
            "decisions are compared by their actions: target must be q, logits or probs, not value"
        )
    return name


class Versions(NamedTuple):
    """Disturbed versions of a trajectory, as features."""

    features: Tensor  # [V, T, E]
    places: Ints  # int64 [points], the frames that delays are counted from
    changed: int  # index of a frame before which all versions are the trajectory as it was


@dataclass(frozen=True)
class Noise:
    """Adds Gaussian noise of several strengths to single frames, a version each."""

    sigmas: Array
    clip: bool
    points_an_episode: int = POINTS_AN_EPISODE
    shortest: int = 2  # frames that a trajectory needs

    def versions(
        self, policy: Policy, window: Window, clean: Tensor, most: int, rng: np.random.Generator
    ) -> Versions:
        """Disturb up to ``most`` frames of a window, whose features are ``clean``."""
        count = min(self.points_an_episode, most, window.n)
        places = np.sort(rng.choice(window.n, count, replace=False))
        seed = int(rng.integers(2**62))
        white = white_of(window.frames, policy.white)
        frames = disturbed_frames(window.frames, places, self.sigmas, self.clip, seed, white)
        noisy = policy.features(frames)
        features = clean.repeat(len(noisy), 1, 1)
        features[np.arange(len(noisy)), places.repeat(len(self.sigmas))] = noisy
        return Versions(features, places, int(places.min()))


@dataclass(frozen=True)
class Shuffle:
    """Permutes the frames behind `FIRST`, up to `LAST`."""

    sigmas: Array = field(default_factory=lambda: np.array([np.nan]))
    points_an_episode: int = 1
    shortest: int = LAST + 1

    def versions(
        self, policy: Policy, window: Window, clean: Tensor, most: int, rng: np.random.Generator
    ) -> Versions:
        """Permute early frames of a window, whose features are ``clean``."""
        order = shuffle_order(window.n + 1, FIRST, LAST, rng)
        return Versions(clean[torch.from_numpy(order)][None], np.array([LAST]), FIRST)


class Changes(NamedTuple):
    """How decisions changed; the fields are those of `Contamination`."""

    flip: Array
    change: Array
    kl: Array


class Disturber:
    """Disturbs one trajectory after another, and gathers how the decisions change."""

    def __init__(
        self,
        model: Any,
        target: str,
        disturbance: Noise | Shuffle,
        delays: Ints,
        starts: int,
        feedback: bool,
        seed: int,
    ) -> None:
        self.model = model
        self.policy = as_policy(model)
        self.target = target
        self.disturbance = disturbance
        self.delays = delays
        self.starts = starts
        self.feedback = feedback
        self.rng = np.random.default_rng([seed, 1])
        self.changes = list[Changes]()
        self.points = list[tuple[int, int]]()
        self.clean_error = 0.0
        self.skipped = 0

    def run(self, windows: Iterable[Window], progress: Progress | None) -> None:
        """Disturb trajectories until there are enough start points."""
        with self.policy.evaluating():
            for number, window in enumerate(windows):
                if window.n + 1 < self.disturbance.shortest:
                    self.skipped += 1
                    continue
                self._disturb(number, window)
                if progress is not None:
                    progress(len(self.points), self.starts)
                if len(self.points) >= self.starts:
                    break

    def _disturb(self, number: int, window: Window) -> None:
        """Disturb a trajectory, replay its versions, and compare their decisions."""
        self.policy.check(window.frames, window.last_action, window.is_init, window.state)
        clean = self.policy.features(window.frames)
        most = self.starts - len(self.points)
        versions = self.disturbance.versions(self.policy, window, clean, most, self.rng)
        features = torch.cat([clean[None], versions.features])
        raw = replayed(self.policy, window, features, versions.changed, self.feedback)
        error = self._error(window, clean, raw[:1], versions.changed)
        self.clean_error = max(self.clean_error, error)
        decisions = versions.places[:, None, None] + self.delays
        self.changes.append(_compare(self.model, self.target, raw, decisions))
        self.points += [(number, int(place)) for place in versions.places]

    def _error(self, window: Window, clean: Tensor, raw: Tensor, changed: int) -> float:
        """What the machinery itself does to the outputs ``raw``: a frame in the middle is replaced
        by itself, encoded alone.
        """
        features = clean.clone()
        middle = window.n // 2
        features[middle] = self.policy.features(window.frames[middle : middle + 1])[0]
        again = replayed(self.policy, window, features[None], changed, self.feedback)
        return float(masked.differences(again, raw).max())

    def result(self) -> Contamination:
        """All changes; a ``ValueError`` if there is none."""
        if not any(np.isfinite(changes.flip).any() for changes in self.changes):
            wanted = (
                f"{self.disturbance.shortest} frames are needed, and {self.delays[0]} steps after "
                "the disturbed one"
            )
            episodes = self.skipped + len(self.changes)
            raise ValueError(f"none of {counted(episodes, 'episode')} was long enough: {wanted}")
        return Contamination(
            sigmas=self.disturbance.sigmas,
            delays=self.delays,
            flip=np.concatenate([changes.flip for changes in self.changes]),
            change=np.concatenate([changes.change for changes in self.changes]),
            kl=np.concatenate([changes.kl for changes in self.changes]),
            points=np.array(self.points, dtype=np.int64),
            clean_error=self.clean_error,
            skipped=self.skipped,
            target=self.target,
        )


def _compare(model: Any, target: str, raw: Tensor, decisions: Ints) -> Changes:
    """Compare rows 1... with row 0 at steps [points, 1, K]; the changes are [points, S, K]."""
    rows = np.arange(1, len(raw)).reshape(len(decisions), -1, 1)
    reached = torch.from_numpy(decisions < raw.shape[1])
    steps = np.minimum(decisions, raw.shape[1] - 1)
    clean = raw[0, steps]
    disturbed = raw[rows, steps]
    scalars = outputs(model, target)
    before = scalars(clean).double().cpu()
    after = scalars(disturbed).double().cpu()
    flip = (before.argmax(-1) != after.argmax(-1)).double()
    before = before.expand_as(after)
    kl = torch.full_like(flip, torch.nan)
    if target in ("logits", "probs"):
        logits = as_policy(model).logits
        p = logits(clean).double().cpu().log_softmax(-1).expand_as(after)
        q = logits(disturbed).double().cpu().log_softmax(-1)
        kl = masked.divergence(p, q)
        # a probability of 0 that stays 0 is an action that is masked out
        before = masked.hidden(before, p, q)
        after = masked.hidden(after, p, q)
    a, b = masked.centred(before, after)
    spread = masked.span(a)
    change = torch.where(spread > 0, (b - a).abs().nan_to_num(0.0).amax(-1) / spread, torch.nan)
    # where all actions tie there is no spread to measure by, and what stays the same is no change
    change = torch.where((before == after).all(-1), 0.0, change)

    def where_reached(values: Tensor) -> Array:
        return np.asarray(torch.where(reached, values, torch.nan).numpy())

    return Changes(where_reached(flip), where_reached(change), where_reached(kl))


@dataclass(frozen=True)
class Example:
    """One decision: what an agent saw before it, as it was (row 0) and disturbed, and what it made
    of it.
    """

    # [R, T, H, W, 3], pictures, noise cut to their range; the decision is taken on the last
    frames: NDArray[np.uint8]
    order: Ints  # [R, T], the step of the trajectory at which each frame was seen
    hits: Ints  # [R], index of the noisy frame, -1 in rows without one
    # float64 [R, A], outputs on the last frame minus their mean, NaN for actions that are masked
    # out; of probabilities as they are
    values: Array
    target: str  # which outputs
    sigma: float  # standard deviation of the noise


@torch.no_grad()
def contamination_example(
    agent: Any,
    env: Any = None,
    *,
    horizon: int = 10,
    sigma: float = 1.0,
    clip: bool = False,
    feedback: bool = False,
    shuffle: bool = False,
    seed: int = 0,
    observability: Twin | None = None,
    target: Target = "auto",
    **names: Unpack[Names],
) -> Example:
    """The paper's picture: the beginning of one episode, undisturbed and disturbed, and the
    decision at its end.

    The decision comes ``horizon`` steps after the start, with ``shuffle`` after frame 10. Noise of
    strength ``sigma`` hits the first frame after the start, one in the middle, or the last before
    the decision, a row each. Everything else is as for `contamination`; a ``ValueError`` if
    ``horizon`` is below 2, or no episode was long enough.
    """
    arguments.check_strengths("sigma", [sigma])
    arguments.check_flags(clip=clip, feedback=feedback, shuffle=shuffle)
    arguments.check_played(seed, observability, horizon=(horizon, 2))
    player, env = resolve_agent(agent, env, observability, **names)
    policy = as_policy(player)
    output = resolve(player, target)
    n = horizon + LAST * shuffle
    windows, _ = play(player, env, seed=held_out(seed), keep=n + 1, max_steps=n + 1)
    w = next((window for window in windows if window.n == n), None)
    if w is None:
        raise ValueError(
            f"none of {counted(len(windows), 'episode')} was long enough: {n + 1} frames are needed"
        )
    hits = np.array([-1] if shuffle else np.unique(np.linspace(1, n - 1, 3, dtype=np.int64)))
    order = np.tile(np.arange(n + 1), (1 + len(hits), 1))
    if shuffle:
        order[1] = shuffle_order(n + 1, FIRST, LAST, np.random.default_rng(seed))
    versions = w.frames[torch.from_numpy(order)].to(float_type(w.frames))
    white = white_of(w.frames, policy.white)
    if not shuffle:
        versions[range(1, len(order)), hits] = disturbed_frames(
            w.frames, hits, np.array([sigma]), clip, seed, white
        )
    with policy.evaluating():
        features = policy.features(versions.flatten(0, 1)).unflatten(0, order.shape)
        raw = replayed(policy, w, features, FIRST, feedback)[:, -1]
        values = outputs(player, output)(raw).double().cpu()
    values = values if output == "probs" else masked.centred(values, values)[0]
    drawn = pictures(versions.flatten(0, 1), policy.channels, white)
    drawn = drawn.reshape(*order.shape, *drawn.shape[1:])
    return Example(drawn, order, np.array([-1, *hits]), values.numpy(), output, sigma)


def disturbed_frames(
    frames: Tensor, places: Ints, sigmas: Array, clip: bool, seed: int, white: float = 255.0
) -> Tensor:
    """Single frames with Gaussian noise, floats [places * sigmas, ...]; the strengths of one frame
    share its draw, which no default of torch changes, and 1 stands for ``white``.
    """
    generator = torch.Generator("cpu").manual_seed(seed)
    chosen = frames[torch.from_numpy(places)].to(float_type(frames))
    noise = torch.randn(chosen.shape, generator=generator, dtype=torch.float32, device="cpu")
    scale = torch.from_numpy(white * sigmas).to(chosen).reshape(-1, *[1] * (frames.ndim - 1))
    noisy = (chosen[:, None] + scale * noise.to(chosen)[:, None]).flatten(0, 1)
    if clip:
        check_range(chosen, white)
    return noisy.clamp(0.0, white) if clip else noisy


def shuffle_order(total: int, first: int, last: int, rng: np.random.Generator) -> Ints:
    """Indices of ``total`` frames with those from first + 1 to last in another order."""
    if not 0 <= first <= last - 2 or last >= total:
        raise ValueError(f"cannot permute frames {first + 1} to {last} of {total}")
    order = np.arange(total)
    part = order[first + 1 : last + 1]
    while (order == np.arange(total)).all():  # the identity is no shuffle
        order[first + 1 : last + 1] = rng.permutation(part)
    return order


@torch.no_grad()
def replayed(
    policy: Policy, window: Window, features: Tensor, changed: int, feedback: bool
) -> Tensor:
    """What the memory says at every step of trajectories that differ from frame ``changed`` on."""
    count = features.shape[0]
    # Up to the first difference nothing has been chosen by the replay yet: the recorded actions
    # lead there.
    begin = changed + 1 if feedback else features.shape[1]
    state: Any = policy.initial_state(1) if window.state is None else window.state
    if state is not None:
        state = state.expand(count, *state.shape[1:]).clone()
    actions = window.last_action.expand(count, *window.last_action.shape)
    starts = window.is_init.bool().expand(count, -1)
    out, state = policy.remember(features[:, :begin], actions[:, :begin], starts[:, :begin], state)
    masked.refuse_nan(out)
    parts = [out]
    for t in range(begin, features.shape[1]):
        action = policy.greedy(out[:, -1:])
        if actions.ndim == 3:
            action = one_hot(action, actions.shape[-1]).to(actions)
        out, state = policy.remember(features[:, t : t + 1], action, starts[:, t : t + 1], state)
        masked.refuse_nan(out)
        parts.append(out)
    return torch.cat(parts, 1)
