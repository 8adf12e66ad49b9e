"""Beliefs: which hidden facts can be read off the recurrent state of an agent.

A game names the facts of its states (`Game.facts`): the cells of the mines, the sign, a velocity.
Greedy episodes give, at each step, a fact, the recurrent state after the frame of that step, and
the features that the encoder makes of this frame alone. A linear probe (ridge regression, for
classes on one-hot targets) is fitted to read the fact off the state; another reads it off the
features. The first says what the agent knows, the second what it sees.

Episodes, not steps, are divided: a half fits the probes, a quarter chooses their penalty, and a
quarter, which neither saw, is scored. The score is the share of the loss of a constant guess that
the probe saves,

    score = 1 - sum(loss of the probe) / sum(loss of the guess).

For numbers the loss is the squared error and the guess the mean of the fitted episodes, so that the
score is R2; for classes the loss is 1 where the class is wrong and the guess the most frequent
class, so that the score is (accuracy - chance) / (1 - chance). 1 is perfect, 0 is a guess, and a
probe that learned what does not hold is below 0. The losses of a fact with several cells are summed
over the cells that vary, numbers in units of their standard deviation.

A probe shows what a linear function can read, not what the agent uses: for that there are
counterfactual exchanges (`arcade_torch.tools.measures.counterfactual`).
"""

from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import NDArray

from arcade_torch.agents.checked import require, whole_from
from arcade_torch.tools.measures.arguments import check_played
from arcade_torch.tools.measures.beliefs.recording import (
    CLASSES,
    MIN_EPISODES,
    Floats,
    Ints,
    Recording,
    record,
)
from arcade_torch.tools.measures.beliefs.ridge import Ridge
from arcade_torch.tools.measures.bootstrap import Array, Interval, percentile_interval, resampled
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.policy import Progress
from arcade_torch.tools.measures.windows import Twin, resolve_agent

Source = Literal["state", "frame"]
SOURCES: tuple[Source, ...] = ("state", "frame")
PENALTIES = tuple(10.0**power for power in range(-6, 4))
"""Of which the one with the least squared error on held-out episodes is taken, for classes too: the
share of right classes in few episodes is too coarse to choose by. The last gives the guess.
"""
LARGEST = 2048
"""Side of the largest matrix that is decomposed: of states that are wider at most so many steps fit
a probe, drawn at random.
"""
DRAWS = 2000  # of the bootstrap


@dataclass(frozen=True)
class Beliefs:
    """Losses of the probes of one checkpoint, summed over cells; F facts, E scored episodes, T
    steps. A step that an episode does not have has the loss 0 everywhere.
    """

    names: NDArray[Any]  # str [F]
    is_class: NDArray[np.bool_]  # [F], whether the loss is 0 or 1, or the squared error
    cells: Ints  # [F], how many cells of the fact vary
    guess_loss: Array  # float64 [F, E, T], of the best constant guess
    state_loss: Array  # float64 [F, E, T], NaN for an agent without a recurrent state
    frame_loss: Array  # float64 [F, E, T]
    constant: NDArray[Any]  # str [...], facts that are the same in all episodes, left out
    state_width: int  # numbers of the recurrent state; 0 without memory
    frame_width: int  # features of a frame
    episodes: int  # all that were recorded

    def score(self, fact: str, source: Source = "state", confidence: float = 0.95) -> Interval:
        """The score of a fact with its bootstrap interval over the scored episodes.

        Args:
            fact: one of ``names``.
            source: what the fact is read off.
            confidence: of the interval.

        Raises:
            ValueError: no such fact.
        """
        loss, guess = self._losses(fact, source)
        value, low, high = _scores(loss.sum(-1)[:, None], guess.sum(-1)[:, None], confidence)
        return Interval(float(value[0]), float(low[0]), float(high[0]))

    def by_step(
        self, fact: str, source: Source = "state", confidence: float = 0.95
    ) -> tuple[Array, Array, Array]:
        """Score and the ends of its interval at every step, each float64 [T].

        NaN where a guess is never wrong. Everything else is as for `score`.
        """
        loss, guess = self._losses(fact, source)
        return _scores(loss, guess, confidence)

    def _losses(self, fact: str, source: Source) -> tuple[Array, Array]:
        """The losses [E, T] of a probe and of the guess."""
        names = self.names.tolist()
        require(source in SOURCES, "source", source, f"one of {', '.join(SOURCES)}")
        require(fact in names, "fact", fact, f"one of {', '.join(names)}")
        place = names.index(fact)
        loss = self.state_loss if source == "state" else self.frame_loss
        return loss[place], self.guess_loss[place]


def _scores(loss: Array, guess: Array, confidence: float) -> tuple[Array, Array, Array]:
    """Scores of losses [E, K] and their intervals over episodes, each [K]."""
    count, columns = loss.shape
    (picks,) = resampled([np.arange(count, dtype=np.float64)], DRAWS, np.random.default_rng(0))
    times = np.zeros((DRAWS, count))
    np.add.at(times, (np.arange(DRAWS)[:, None], picks.astype(np.int64)), 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = 1 - loss.sum(0) / guess.sum(0)
        drawn = 1 - (times @ loss) / (times @ guess)
    values[~np.isfinite(values)] = np.nan
    low = np.full(columns, np.nan)
    high = np.full(columns, np.nan)
    for column in range(columns):
        finite = drawn[np.isfinite(drawn[:, column]), column]
        interval = percentile_interval(values[column], finite, confidence, count > 1)
        low[column] = interval.low
        high[column] = interval.high
    return values, low, high


def beliefs(
    agent: Any,
    env: Any = None,
    *,
    episodes: int = 128,
    max_steps: int = 128,
    seed: int = 0,
    observability: Twin | None = None,
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> Beliefs:
    """Read hidden facts off the recurrent state of an agent, and off its frames.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, a TensorDict
            policy or anything else that `as_policy` takes.
        env: one with ``facts()``, as an ``ArcadeEnv`` has; by default 16 of the agent's own game.
        episodes: greedy episodes.
        max_steps: steps of each that are looked at, from its beginning.
        seed: of the episodes, which training never sees, and of their division.
        observability: another twin than the one trained on (without ``env``).
        progress: called with (episodes played, episodes).
        **names: keywords of `as_policy`.

    Returns:
        Arrays.

    Raises:
        ValueError: an option is out of range, the env names no facts, or all of them are constant.
    """
    check_played(seed, observability, episodes=(episodes, MIN_EPISODES), max_steps=(max_steps, 1))
    player, env = resolve_agent(agent, env, observability, **names)
    recording = record(
        player, env, episodes=episodes, max_steps=max_steps, seed=seed, progress=progress
    )
    return beliefs_of(recording, seed=seed)


def beliefs_of(recording: Recording, seed: int = 0) -> Beliefs:
    """The same of a recording of your own.

    Args:
        recording: at least eight episodes.
        seed: of the division into episodes that fit, choose and score.

    Raises:
        ValueError: too few episodes, or no fact that varies.
    """
    whole_from(0, "seed", seed)
    episodes = len(recording.lengths)
    require(episodes >= MIN_EPISODES, "episodes", episodes, f"at least {MIN_EPISODES}")
    split = Split.of(recording.lengths, recording.states.shape[1], seed)
    width = recording.states.shape[-1]
    losses = list[dict[str, Array]]()
    names = list[str]()
    constant = list[str]()
    facts = list[Fact]()
    for name, values in recording.facts.items():
        fact = Fact.of(values, split)
        if not fact.values.shape[-1]:
            constant.append(name)
            continue
        names.append(name)
        facts.append(fact)
        guess = _tabled(fact.guess_loss(split), split)
        frame = _tabled(probe_loss(recording.features, fact, split), split)
        state = np.full_like(frame, np.nan)
        if width:
            state = _tabled(probe_loss(recording.states, fact, split), split)
        losses.append({"guess": guess, "frame": frame, "state": state})
    if not facts:
        raise ValueError(
            f"nothing to read: {', '.join(constant)} are the same in all {episodes} episodes; play "
            "more of them"
        )
    return Beliefs(
        names=np.array(names),
        is_class=np.array([fact.is_class for fact in facts]),
        cells=np.array([fact.values.shape[-1] for fact in facts], dtype=np.int64),
        guess_loss=np.stack([loss["guess"] for loss in losses]),
        state_loss=np.stack([loss["state"] for loss in losses]),
        frame_loss=np.stack([loss["frame"] for loss in losses]),
        constant=np.array(constant, dtype=str),
        state_width=width,
        frame_width=recording.features.shape[-1],
        episodes=episodes,
    )


@dataclass(frozen=True)
class Split:
    """Which steps of which episodes fit a probe, choose its penalty, and are scored; each of the
    three is a mask [E, T].
    """

    fit: NDArray[np.bool_]
    choose: NDArray[np.bool_]
    score: NDArray[np.bool_]
    scored_episodes: Ints

    @classmethod
    def of(cls, lengths: Ints, steps: int, seed: int) -> "Split":
        """Divide episodes at random: a half, a quarter, a quarter."""
        count = len(lengths)
        order = np.random.default_rng([seed, 3]).permutation(count)
        exists = np.arange(steps) < lengths[:, None]
        masks = list[NDArray[np.bool_]]()
        for some in np.split(order, [count // 2, count // 2 + count // 4]):
            chosen = np.zeros(count, bool)
            chosen[some] = True
            masks.append(exists & chosen[:, None])
        fit, choose, score = masks
        return cls(fit, choose, score, np.flatnonzero(score.any(axis=1)))


@dataclass(frozen=True)
class Fact:
    """The cells of a fact that vary, and where each of them has a value."""

    values: NDArray[Any]  # [E, T, C], numbers in units of their standard deviation
    exists: NDArray[np.bool_]  # [E, T, C]
    is_class: bool

    @classmethod
    def of(cls, values: NDArray[Any], split: Split) -> "Fact":
        """The cells of an array [E, T, ...] that vary, where they have a value to fit."""
        flat = values.reshape(*values.shape[:2], -1)
        is_class = flat.dtype.kind in CLASSES
        missing = flat < 0 if is_class else np.isnan(flat)
        exists = ~missing & (split.fit | split.choose | split.score)[..., None]
        is_fitted = exists & split.fit[..., None]
        numbers: NDArray[Any] = flat.astype(np.int64 if is_class else np.float64)
        varying = list[int]()
        for cell in range(flat.shape[-1]):
            present = numbers[..., cell][exists[..., cell]]
            if is_fitted[..., cell].any() and (present != present[0]).any():
                varying.append(cell)
                if not is_class:
                    numbers[..., cell] = numbers[..., cell] / present.std()
        return cls(numbers[..., varying], exists[..., varying], is_class)

    def guess_loss(self, split: Split) -> Array:
        """The loss of the best constant guess of every cell, float64 [E, T, C], 0 where there is no
        value to score.
        """
        guesses = np.zeros(self.values.shape[-1], self.values.dtype)
        for cell in range(len(guesses)):
            fitted = self.values[..., cell][self.exists[..., cell] & split.fit]
            if self.is_class:
                classes, counts = np.unique(fitted, return_counts=True)
                guesses[cell] = classes[counts.argmax()]
            else:
                guesses[cell] = fitted.mean()
        return self.loss(np.broadcast_to(guesses, self.values.shape), split.score)

    def loss(self, predicted: NDArray[Any], where: NDArray[np.bool_]) -> Array:
        """The loss of predictions [E, T, C] at the steps ``where`` [E, T]; 0 elsewhere."""
        counts = self.exists & where[..., None]
        if self.is_class:
            return np.where(counts, predicted != self.values, False).astype(np.float64)
        difference = np.where(counts, predicted - self.values, 0.0)
        return np.asarray(difference**2)


def _tabled(loss: Array, split: Split) -> Array:
    """A loss [E, T, C] summed over cells, of the scored episodes alone."""
    return np.asarray(loss.sum(-1)[split.scored_episodes])


def probe_loss(inputs: Floats, fact: Fact, split: Split) -> Array:
    """The loss of probes that read a fact off inputs [E, T, D]: float64 [E, T, C].

    Cells that have values at the same steps share one regression.
    """
    patterns = fact.exists.reshape(-1, fact.values.shape[-1])
    _, groups = np.unique(patterns, axis=1, return_inverse=True)
    loss = np.zeros(fact.values.shape)
    for group in range(groups.max() + 1):
        cells = np.flatnonzero(groups.ravel() == group)
        part = Fact(fact.values[..., cells], fact.exists[..., cells], fact.is_class)
        loss[..., cells] = _probe_together(inputs, part, split)
    return loss


def _probe_together(inputs: Floats, fact: Fact, split: Split) -> Array:
    """`probe_loss` of cells that have values at the same steps."""
    exists = fact.exists[..., 0]
    rows = np.argwhere(exists & split.fit)
    if inputs.shape[-1] > LARGEST:
        rows = rows[np.random.default_rng(0).permutation(len(rows))[:LARGEST]]
    at = tuple(rows.T)
    targets = Targets.of(fact.values[at], fact.is_class)
    ridge = Ridge.of(inputs[at], targets.numbers(fact.values[at]))
    choosing = np.nonzero(exists & split.choose)
    wanted = targets.numbers(fact.values[choosing])
    errors = list[float]()
    for predicted in ridge.predict(inputs[choosing], PENALTIES):
        errors.append(float(((predicted - wanted) ** 2).sum()))
    best = PENALTIES[int(np.argmin(errors))]
    scored = np.nonzero(exists & split.score)
    predicted = np.zeros(fact.values.shape, fact.values.dtype)
    predicted[scored] = targets.decided(ridge.predict(inputs[scored], [best])[0])
    return fact.loss(predicted, split.score)


@dataclass(frozen=True)
class Targets:
    """How the cells of a fact are written as targets of a regression: numbers as they are, classes
    one-hot, side by side.
    """

    classes: tuple[Ints, ...]  # of each cell; empty for numbers

    @classmethod
    def of(cls, values: NDArray[Any], is_class: bool) -> "Targets":
        """For values [n, C] that a probe is fitted to."""
        classes = list[Ints]()
        if is_class:
            for column in values.T:
                classes.append(np.unique(column))
        return cls(tuple(classes))

    def numbers(self, values: NDArray[Any]) -> Array:
        """Values [n, C] as targets [n, M]."""
        if not self.classes:
            return values.astype(np.float64)
        columns = list[Array]()
        for column, classes in zip(values.T, self.classes, strict=True):
            columns.append((column[:, None] == classes).astype(np.float64))
        return np.concatenate(columns, axis=1)

    def decided(self, predicted: Array) -> NDArray[Any]:
        """The values [n, C] that predicted targets [n, M] stand for."""
        if not self.classes:
            return predicted
        columns = list[Ints]()
        begin = 0
        for classes in self.classes:
            end = begin + len(classes)
            columns.append(classes[predicted[:, begin:end].argmax(1)])
            begin = end
        return np.stack(columns, axis=1)
