"""Patching: put the recurrent state of one episode into another, and see whose decision follows.

Greedy episodes are played side by side. At each step every episode that runs is also shown its
frame with the recurrent state of another that runs (the donor, at the same step); it then goes on
with its own. Of interest are the steps at which the two decide differently: the decision follows
the donor's state, stays with the frame, or becomes a third. A probe says what a state holds; this
says whether it is used.
"""

from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import SEED_LIMIT
from arcade_torch.tools.measures.arguments import check_played
from arcade_torch.tools.measures.beliefs.recording import check_seen, first_row
from arcade_torch.tools.measures.bootstrap import Array, Interval, pooled
from arcade_torch.tools.measures.choices import decide
from arcade_torch.tools.measures.envs import EpisodeBatch, keeps_generator
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.policy import FEW, Progress, policy_of
from arcade_torch.tools.measures.windows import Twin, held_out, keys_of, resolve_agent

Ints = NDArray[np.int64]
Outcome = Literal["follows", "stays", "other"]
OUTCOMES: tuple[Outcome, ...] = ("follows", "stays", "other")
NOBODY = -1  # the action of a donor that is missing
MIN_EPISODES = 2


@dataclass(frozen=True)
class Patches:
    """Decisions of E episodes at T steps, with their own state and with that of a donor; NOBODY
    where an episode has no such step or no donor, and at the first step, before which nothing was.
    """

    action: Ints  # [E, T]
    donor_action: Ints  # [E, T], the donor's decision at that step
    patched: Ints  # [E, T], the decision on the own frame with the donor's state

    def share(self, outcome: Outcome = "follows", confidence: float = 0.95) -> Interval:
        """Share of decisions that follow, stay or become a third, of those where the donor decides
        otherwise: mean over episodes with its bootstrap interval, NaN where there is none.
        """
        require(outcome in OUTCOMES, "outcome", outcome, f"one of {', '.join(OUTCOMES)}")
        counted = self.differs
        total = counted.sum(1)
        hits = (self._is(outcome) & counted).sum(1)
        shares = np.where(total > 0, hits / np.maximum(total, 1), np.nan)
        if np.isnan(shares).all():
            return Interval(float("nan"), float("nan"), float("nan"))
        of_episodes = pooled(shares.tolist(), confidence)
        ends = (of_episodes.mean, of_episodes.low, of_episodes.high)
        return Interval(*(float(end) for end in ends))

    def by_step(self, outcome: Outcome = "follows") -> Array:
        """The same share at every step over all episodes, float64 [T]."""
        counted = self.differs
        total = counted.sum(0)
        hits = (self._is(outcome) & counted).sum(0)
        return np.where(total > 0, hits / np.maximum(total, 1), np.nan)

    @property
    def differs(self) -> NDArray[np.bool_]:
        """Where there is a donor, and it decides otherwise: bool [E, T]."""
        exists: NDArray[np.bool_] = self.donor_action != NOBODY
        differs: NDArray[np.bool_] = exists & (self.donor_action != self.action)
        return differs

    def _is(self, outcome: Outcome) -> NDArray[np.bool_]:
        """Where a patched decision has an outcome."""
        follows: NDArray[np.bool_] = self.patched == self.donor_action
        stays: NDArray[np.bool_] = self.patched == self.action
        if outcome == "other":
            return ~follows & ~stays
        return follows if outcome == "follows" else stays


def patching(
    agent: Any,
    env: Any = None,
    *,
    episodes: int = 128,
    max_steps: int = 128,
    seed: int = 0,
    observability: Twin | None = None,
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> Patches:
    """Exchange recurrent states between greedy episodes of an agent, step by step.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, a TensorDict
            policy or anything else that `as_policy` takes.
        env: of two episodes or more, which are one another's donors; by default 16 of the agent's
            own game.
        episodes: greedy episodes.
        max_steps: steps of each that are looked at, from its beginning.
        seed: of the episodes, which training never sees, and of the donors.
        observability: another twin than the one trained on (without ``env``).
        progress: called with (episodes played, episodes).
        **names: keywords of `as_policy`.

    Returns:
        Actions.

    Raises:
        ValueError: an option is out of range, or the env holds a single episode.
    """
    check_played(seed, observability, episodes=(episodes, MIN_EPISODES), max_steps=(max_steps, 1))
    player, env = resolve_agent(agent, env, observability, **names)
    played = EpisodeBatch(env, keys_of(player))
    size = played.size
    require(size >= MIN_EPISODES, "the batch size of env", size, "at least 2, for donors")
    parts = list[Ints]()
    with policy_of(player).evaluating():
        for group in range(-(-episodes // size)):
            drawn = np.random.SeedSequence([seed, group]).generate_state(1)
            batch_seed = held_out(int(drawn[0]) % SEED_LIMIT)
            rng = np.random.default_rng([seed, group, 4])
            part = _patch_batch(player, played, batch_seed, max_steps, rng)
            parts.append(part[:, : episodes - group * size])
            if progress is not None:
                progress(min(episodes, (group + 1) * size), episodes)
    steps = max(part.shape[-1] for part in parts)
    padded = list[Ints]()
    for part in parts:
        missing = ((0, 0), (0, 0), (0, steps - part.shape[-1]))
        padded.append(np.pad(part, missing, constant_values=NOBODY))
    action, donor_action, patched = np.concatenate(padded, axis=1)
    return Patches(action, donor_action, patched)


@torch.no_grad()
@keeps_generator
def _patch_batch(
    agent: Any, played: EpisodeBatch, seed: int, max_steps: int, rng: np.random.Generator
) -> Ints:
    """The first episode of every env of a batch: own, donor's and patched actions [3, N, T]."""
    size = played.size
    playing = torch.ones(size, dtype=torch.bool, device="cpu")
    steps = list[Ints]()
    obs = played.reset(seed)
    state = agent.initial_state(size)
    seen = list[TensorDictBase]()
    while playing.any() and len(steps) < max_steps:
        if len(seen) < FEW:
            seen.append(first_row(obs))
        rows = playing.nonzero().flatten().numpy()
        donors = draw_donors(rows, size, rng)
        # before the decision itself: acting may change the state in place
        given = None if state is None else state[torch.from_numpy(donors)].clone()
        patched, _ = decide(agent, obs, given)
        action, state = decide(agent, obs, state)
        actions = np.full((3, size), NOBODY, np.int64)
        decided = action.cpu().numpy()
        actions[0, rows] = decided[rows]
        if steps and len(rows) > 1:
            actions[1, rows] = decided[donors][rows]
            actions[2, rows] = patched.cpu().numpy()[rows]
        steps.append(actions)
        obs, _, done = played.step(action)
        playing &= ~done.cpu()
    check_seen(agent, seen)
    return np.stack(steps, axis=-1)


def draw_donors(rows: Ints, size: int, rng: np.random.Generator) -> Ints:
    """For every env another one, drawn among those whose episodes run (``rows``); itself where
    there is none: int64 [size].
    """
    donors = np.arange(size)
    order = rng.permutation(rows)
    donors[order] = np.roll(order, 1)
    return donors
