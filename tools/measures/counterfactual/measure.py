"""Counterfactual recall: whether a decision changes when a past frame is exchanged.

For a decision at step T and an earlier step t, frame t is exchanged for frame t of other episodes
of the same agent (the donors), the memory runs on, and the decision is compared with the one that
was taken. The share of donors that change it, over the lag ``T - t``, is a profile of what
decisions rest on. Nothing is differentiated: a policy whose probabilities are saturated has no
gradient to speak of, but an exchange still changes its decision.

Two numbers sum an agent up. Memory reliance: everything before the last frame is another episode's,
so that the recurrent state is; observation reliance: the last frame is (lag 0 of the profile).

Last actions and start flags stay as recorded, except before an exchanged state, which is that of
the donor's frames and the donor's actions. An exchange finds what a decision rests on, not all that
the memory holds: of two frames that hold the same fact, neither alone changes anything (exchange
blocks), and a donor's frame amid frames of another episode may be a sight that training never gave.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.measures.arguments import check_played
from arcade_torch.tools.measures.bootstrap import Array, Interval, pooled
from arcade_torch.tools.measures.contamination.measure import output_of_actions
from arcade_torch.tools.measures.frames import as_array
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.masked import differences, refuse_nan, refuse_single
from arcade_torch.tools.measures.policy import Policy, Progress, Target, as_policy, outputs
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
from arcade_torch.tools.text import counted

Ints = NDArray[np.int64]
Effect = Literal["flip", "distance", "change"]
NOBODY = -1  # index of a donor that is missing
# of exchanged versions that the memory runs at once, which bounds memory use: steps, and numbers
MOST_STEPS = 2**14
MOST_NUMBERS = 2**25


@dataclass(frozen=True)
class Counterfactual:
    """What exchanges did to the decisions of one checkpoint; NaN where there was no donor.

    The first axis is decisions D, the last donors K; L is the number of lags, from 0, the
    decision's frame, to those of the longest episode.
    """

    flip: Array  # float64 [D, L, K], 1 where another action is best
    distance: Array  # float64 [D, L, K], total variation between the distributions of actions
    # float64 [D, L, K], how far the value of the action that was taken moved, over the action gap
    change: Array
    differs: Array  # float64 [D, L, K], 1 where the exchanged frames truly differ
    memory_flip: Array  # float64 [D, K], the same four for an exchanged recurrent state
    memory_distance: Array
    memory_change: Array
    memory_differs: Array
    # float64 [D], probability of the action that was taken, in the distribution of `distance`
    certainty: Array
    lengths: Ints  # [D], frames of the episodes, up to the decision
    dropped: int  # episodes left out because they have fewer than three frames
    alone: int  # decisions at a step that no other episode has, so that no state can be exchanged
    clean_error: float  # largest difference that exchanging a frame for itself made to any output
    target: str  # which outputs

    def by_lag(self, effect: Effect = "flip", differing: bool = False) -> Array:
        """Mean over the donors of every decision, float64 [D, L].

        Args:
            effect: name of one of the three arrays.
            differing: over the donors alone whose frames truly differ.
        """
        return _over_donors(getattr(self, effect), self.differs, differing)

    def profile(self, effect: Effect = "flip", differing: bool = False) -> Array:
        """Mean over decisions, float64 [L]: what an exchange so many steps back does."""
        return _mean(self.by_lag(effect, differing), axis=0)

    def by_state(self, effect: Effect = "flip", differing: bool = False) -> Array:
        """As `by_lag`, for the recurrent state: float64 [D]."""
        return _over_donors(getattr(self, f"memory_{effect}"), self.memory_differs, differing)

    def memory_reliance(
        self, effect: Effect = "flip", differing: bool = False, confidence: float = 0.95
    ) -> Interval:
        """What an exchange of the recurrent state does, with an interval over decisions."""
        return _interval(self.by_state(effect, differing), confidence)

    def observation_reliance(
        self, effect: Effect = "flip", differing: bool = False, confidence: float = 0.95
    ) -> Interval:
        """What an exchange of the last frame does, with an interval over decisions."""
        return _interval(self.by_lag(effect, differing)[:, 0], confidence)


def _mean(values: Array, axis: int) -> Array:
    """Mean of the finite numbers along an axis; NaN where there is none."""
    return np.asarray(np.ma.masked_invalid(values).mean(axis=axis).filled(np.nan))


def _over_donors(values: Array, differs: Array, differing: bool) -> Array:
    """Mean over the last axis; if ``differing``, where ``differs`` is 1."""
    if differing:
        values = np.where(differs == 1, values, np.nan)
    return _mean(values, axis=-1)


def _interval(decisions: Array, confidence: float) -> Interval:
    """Bootstrap interval of the mean of decisions [D], resampled with replacement."""
    of_decisions = pooled(decisions.tolist(), confidence)
    return Interval(float(of_decisions.mean), float(of_decisions.low), float(of_decisions.high))


def counterfactual(
    agent: Any,
    env: Any = None,
    *,
    episodes: int = 64,
    donors: int = 4,
    block: int = 1,
    most_lags: int = MAX_STEPS,
    seed: int = 0,
    observability: Twin | None = None,
    end: End = "last",
    cap: int = MAX_STEPS,
    target: Target = "auto",
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> Counterfactual:
    """Exchange frames and recurrent states between greedy episodes of an agent.

    Args:
        agent: as for `recall_density`, and so are ``env``, ``observability``, ``end`` and ``cap``:
            with the same numbers both measures look at the same decisions.
        episodes: episodes played; every one has a decision, and is a donor for the others.
        donors: other episodes that a frame is taken from, drawn at random among those that have
            the step; a step that fewer have gives fewer.
        block: consecutive frames exchanged together, of which the lag names the last.
        most_lags: how far back frames are exchanged.
        seed: of the episodes and the donors; training never sees the episodes.
        target: outputs that are compared: ``q``, ``logits`` or ``probs``. The distribution of
            ``distance`` is the policy's; of Q-values it is their softmax in units of the action
            gap, in which the best action has e times the probability of the second. Values of
            ``change`` are Q-values, or logarithms of probabilities.
        progress: called with (decisions done, episodes).
        **names: keywords of `as_policy`.

    Returns:
        Arrays.

    Raises:
        ValueError: an option is out of range, this agent does not offer ``target``, or no two
            episodes have a step in common.
    """
    check_episodes(episodes, seed, end, cap, observability)
    check_played(seed, donors=(donors, 1), block=(block, 1), most_lags=(most_lags, 1))
    player, env = resolve_agent(agent, env, observability, **names)
    windows = greedy_windows(player, env, episodes=episodes, seed=seed, end=end, cap=cap)
    tell = None if progress is None else lambda count: progress(count, episodes)
    return counterfactual_of_windows(
        player,
        windows,
        donors=donors,
        block=block,
        most_lags=most_lags,
        seed=seed,
        target=target,
        progress=tell,
    )


@torch.no_grad()
def counterfactual_of_windows(
    model: Any,
    windows: Iterable[Window],
    *,
    donors: int = 4,
    block: int = 1,
    most_lags: int = MAX_STEPS,
    seed: int = 0,
    target: Target = "auto",
    progress: Callable[[int], None] | None = None,
    **names: Unpack[Names],
) -> Counterfactual:
    """The same over windows of experience of your own, each of another episode; the last frame of
    each is the decision's, and ``model`` anything that `as_policy` takes.

    ``progress`` is called with the number of decisions done. Everything else is as for
    `counterfactual`.
    """
    check_played(seed, donors=(donors, 1), block=(block, 1), most_lags=(most_lags, 1))
    policy = as_policy(model, **names)
    exchange = Exchange(policy, output_of_actions(policy, target), donors, block, most_lags)
    with exchange.policy.evaluating():
        exchange.read(windows)
        rng = np.random.default_rng([seed, 2])
        for index in range(len(exchange.tracks)):
            exchange.decide(index, rng)
            if progress is not None:
                progress(index + 1)
    return exchange.result()


@dataclass(frozen=True)
class Track:
    """What the memory saw of one episode; its frames are encoded, and gone."""

    features: Tensor  # [T, E]
    frame_ids: Ints  # [T], equal for equal frames
    last_action: Tensor  # int64 [T], or one-hot [T, A]
    is_init: Tensor  # bool [T]
    state: Any  # recurrent state before the first frame, batch of one
    first: int  # step of the episode at which it begins

    @classmethod
    def of(cls, policy: Policy, window: Window) -> "Track":
        """Encode a window."""
        policy.check(window.frames, window.last_action, window.is_init, window.state)
        return cls(
            features=policy.features(window.frames),
            frame_ids=_frame_ids(window.frames),
            last_action=window.last_action,
            is_init=window.is_init.bool(),
            state=policy.initial_state(1) if window.state is None else window.state,
            first=window.first,
        )

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self.frame_ids)

    @property
    def last(self) -> int:
        """Step of the episode at which the decision is taken."""
        return self.first + self.length - 1

    def steps(self, oldest: int, newest: int) -> slice:
        """Where the steps ``oldest`` to ``newest`` of the episode stand."""
        return slice(oldest - self.first, newest - self.first + 1)


def _frame_ids(frames: Tensor) -> Ints:
    """A number for each frame, int64 [T], by its content."""
    ids = np.zeros(len(frames), np.int64)
    for step, frame in enumerate(as_array(frames)):
        digest = hashlib.blake2b(frame.tobytes(), digest_size=8).digest()
        ids[step] = int.from_bytes(digest, "little", signed=True)
    return ids


class Effects(NamedTuple):
    """What exchanges did to one decision, each float64 of one shape."""

    flip: Array
    distance: Array
    change: Array
    differs: Array


class Exchange:
    """Exchanges frames and states between episodes, and gathers how decisions change."""

    def __init__(
        self, policy: Policy, target: str, donors: int, block: int, most_lags: int
    ) -> None:
        self.policy = policy
        self.target = target
        self.donors = donors
        self.block = block
        self.most_lags = most_lags
        self.tracks = list[Track]()
        self.by_frame = list[Effects]()  # [lags, K] of each decision
        self.by_state = list[Effects]()  # [K]
        self.certainty = list[float]()
        self.clean_error = 0.0
        self.dropped = 0

    def read(self, windows: Iterable[Window]) -> None:
        """Encode the episodes that are long enough."""
        for window in windows:
            if window.n + 1 < MIN_STEPS:
                self.dropped += 1
            else:
                self.tracks.append(Track.of(self.policy, window))

    def decide(self, index: int, rng: np.random.Generator) -> None:
        """Exchange everything before one decision, and compare."""
        others = [other for other in range(len(self.tracks)) if other != index]
        order = rng.permutation(np.array(others, np.int64))
        self.by_frame.append(self._exchange_frames(self.tracks[index], order))
        self.by_state.append(self._exchange_state(self.tracks[index], order))

    def _exchange_frames(self, track: Track, order: Ints) -> Effects:
        """Exchange the frames at every lag."""
        lags = min(track.length, self.most_lags)
        steps = min(MOST_STEPS, MOST_NUMBERS // track.features.shape[1])
        at_once = max(1, steps // (self.donors * track.length))
        parts = list[Effects]()
        for begin in range(0, lags, at_once):
            some = range(begin, min(lags, begin + at_once))
            parts.append(self._exchange_some_frames(track, order, some))
        joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
        return Effects(*joined)

    def _exchange_some_frames(self, track: Track, order: Ints, lags: range) -> Effects:
        """Exchange the frames at some lags, a version a donor, beside the episode as it was."""
        shape = (len(lags), self.donors)
        differs = np.full(shape, np.nan)
        versions = track.features.repeat(1 + differs.size, 1, 1)
        row = 1  # of the next version; row 0 is the episode as it was
        for place, lag in enumerate(lags):
            newest = track.last - lag
            oldest = max(track.first, newest - self.block + 1)
            there = track.steps(oldest, newest)
            donors = self._donors(order, oldest, newest)
            for number, donor in enumerate(donors):
                given = self.tracks[donor]
                taken = given.steps(oldest, newest)
                versions[row + number, there] = given.features[taken]
                differ = given.frame_ids[taken] != track.frame_ids[there]
                differs[place, number] = differ.any()
            row += self.donors
        raw = self._last_outputs(track, versions)
        if lags[0] == 0:
            alone = self._last_outputs(track, track.features[None])
            self.clean_error = max(self.clean_error, float(differences(raw[:1], alone).max()))
            self.certainty.append(self._certainty(raw[0]))
        return self._compare(raw[0], raw[1:], differs.ravel(), shape)

    def _exchange_state(self, track: Track, order: Ints) -> Effects:
        """Exchange all that came before the last frame: let donors play up to its step, and then
        show it.
        """
        differs = np.full(self.donors, np.nan)
        clean = self._last_outputs(track, track.features[None])
        raw = clean.repeat(self.donors, 1)
        for number, donor in enumerate(self._donors(order, track.last, track.last)):
            given = self.tracks[donor]
            past = slice(0, track.last - given.first)
            mixed = Track(
                features=torch.cat([given.features[past], track.features[-1:]]),
                frame_ids=np.append(given.frame_ids[past], track.frame_ids[-1:]),
                last_action=torch.cat([given.last_action[past], track.last_action[-1:]]),
                is_init=torch.cat([given.is_init[past], track.is_init[-1:]]),
                state=given.state,
                first=given.first,
            )
            raw[number] = self._last_outputs(mixed, mixed.features[None])[0]
            differs[number] = not _same_past(track, mixed)
        return self._compare(clean[0], raw, differs, differs.shape)

    def _donors(self, order: Ints, oldest: int, newest: int) -> Sequence[int]:
        """The first episodes of an order that have all of some steps."""
        donors = list[int]()
        for donor in order.tolist():
            track = self.tracks[donor]
            if track.first <= oldest and newest <= track.last:
                donors.append(donor)
            if len(donors) == self.donors:
                break
        return donors

    def _last_outputs(self, track: Track, versions: Tensor) -> Tensor:
        """What the memory says on the last frame of versions [V, T, E] of an episode, [V, R]."""
        count = len(versions)
        state = track.state
        if state is not None:
            state = state.expand(count, *state.shape[1:]).clone()
        actions = track.last_action.expand(count, *track.last_action.shape)
        starts = track.is_init.expand(count, -1)
        out, _ = self.policy.remember(versions, actions, starts, state)
        refuse_nan(out[:, -1])
        return out[:, -1]

    def _certainty(self, clean: Tensor) -> float:
        """The probability of the action that is taken."""
        _, distribution = self._read(clean, clean[None])
        return float(distribution[0, int(self.policy.greedy(clean))])

    def _read(self, clean: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Values of actions and their distribution, double [V, A], of outputs [V, R]."""
        refuse_single(outputs(self.policy, self.target)(raw))
        if self.target == "q":
            read = outputs(self.policy, "q")
            values = read(raw).double().cpu()
            best = read(clean).double().cpu().topk(2).values
            return values, (values / (best[0] - best[1])).softmax(-1)
        logits = self.policy.logits(raw).double().cpu()
        return logits.log_softmax(-1), logits.softmax(-1)

    def _compare(
        self, clean: Tensor, raw: Tensor, differs: Array, shape: tuple[int, ...]
    ) -> Effects:
        """Compare versions [V, R] with the decision as it was; NaN where ``differs`` [V] is."""
        before, clean_distribution = self._read(clean, clean[None])
        after, distribution = self._read(clean, raw)
        action = int(self.policy.greedy(clean))
        flip = (self.policy.greedy(raw) != action).double().cpu()
        distance = (distribution - clean_distribution).abs().sum(-1) / 2
        best = before[0].topk(2).values
        change = (after[:, action] - before[0, action]).abs() / (best[0] - best[1])
        # where the best actions tie there is no gap to measure by, and what stays the same has not
        # changed
        is_same = (after == before).all(-1)
        distance = torch.where(is_same, 0.0, distance)
        change = torch.where(is_same, 0.0, change)

        def where_exchanged(values: Tensor) -> Array:
            finite = values.isfinite().numpy() & np.isfinite(differs)
            return np.where(finite, values.numpy(), np.nan).reshape(shape)

        return Effects(
            where_exchanged(flip),
            where_exchanged(distance),
            where_exchanged(change),
            differs.reshape(shape),
        )

    def result(self) -> Counterfactual:
        """All decisions; a ``ValueError`` if none had a donor."""
        if not any(np.isfinite(effects.differs).any() for effects in self.by_frame):
            played = counted(len(self.tracks), "episode")
            raise ValueError(
                f"nothing can be exchanged: {played} of {MIN_STEPS} frames or more (and "
                f"{self.dropped} shorter), and two with a step in common are needed; play more "
                "episodes"
            )
        lags = max(len(effects.flip) for effects in self.by_frame)
        of_frames = [_padded(arrays, lags) for arrays in zip(*self.by_frame, strict=True)]
        of_states = [np.array(arrays) for arrays in zip(*self.by_state, strict=True)]
        flip, distance, change, differs = of_frames
        memory_flip, memory_distance, memory_change, memory_differs = of_states
        return Counterfactual(
            flip=flip,
            distance=distance,
            change=change,
            differs=differs,
            memory_flip=memory_flip,
            memory_distance=memory_distance,
            memory_change=memory_change,
            memory_differs=memory_differs,
            certainty=np.array(self.certainty),
            lengths=np.array([track.length for track in self.tracks], dtype=np.int64),
            dropped=self.dropped,
            alone=int(np.isnan(memory_differs).all(-1).sum()),
            clean_error=self.clean_error,
            target=self.target,
        )


def _same_past(track: Track, mixed: Track) -> bool:
    """Whether two episodes saw and did the same before their last frame, from the same state on."""
    same_frames = np.array_equal(track.frame_ids[:-1], mixed.frame_ids[:-1])
    same_actions = torch.equal(track.last_action[:-1], mixed.last_action[:-1])
    return same_frames and same_actions and _same_state(track.state, mixed.state)


def _same_state(state: Any, other: Any) -> bool:
    """Whether two states, tensors or TensorDicts, hold the same numbers; two that are None do."""
    return state is other or bool((state == other).all())


def _padded(arrays: Sequence[Array], lags: int) -> Array:
    """Arrays [lags_i, K] of decisions as one, [D, lags, K]; NaN beyond the first frame."""
    padded = np.full((len(arrays), lags, arrays[0].shape[1]), np.nan)
    for decision, array in enumerate(arrays):
        padded[decision, : len(array)] = array
    return padded
