"""Steering: move a recurrent state along the direction of one fact, and see whether the decision
follows.

`patching` puts the whole state of another episode (the donor) in place of the own. Here the state
moves only as far as the fact asks: by what states of that step differ on average between the own
value of the fact and the donor's, the least squares of states on the fact. That is the direction in
which states change with the reading of a linear probe, not the probe's weights, which also serve to
cancel what else the states hold (Haufe et al. 2014, NeuroImage 87). It is fitted to other episodes,
for each step anew: the states of many memories turn or fade from step to step. The control moves
the state equally far in a random direction.
"""

from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np
import torch
from numpy.typing import NDArray

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import SEED_LIMIT
from arcade_torch.tools.measures.arguments import check_played
from arcade_torch.tools.measures.beliefs.measure import Targets
from arcade_torch.tools.measures.beliefs.patching import NOBODY, Patches, draw_donors
from arcade_torch.tools.measures.beliefs.recording import (
    CLASSES,
    MIN_EPISODES,
    Floats,
    Ints,
    Recording,
    facts_of,
    record,
    shifted_state,
)
from arcade_torch.tools.measures.bootstrap import Array
from arcade_torch.tools.measures.choices import decide
from arcade_torch.tools.measures.envs import EpisodeBatch, keeps_generator
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.policy import Progress, policy_of
from arcade_torch.tools.measures.windows import Twin, held_out, keys_of, resolve_agent

Arm = Literal["state", "fact", "random"]
ARMS: tuple[Arm, ...] = ("state", "fact", "random")
MIN_FITTED = 16
"""A direction is fitted to so many episodes at least, and to twice as many as the fact has numbers
that can vary by themselves.
"""


@dataclass(frozen=True)
class Steering:
    """Decisions of E episodes at T steps on their own frames, with states that were moved for each
    of F facts; NOBODY where there is no such step, no donor with another value of the fact, or no
    direction.
    """

    names: NDArray[Any]  # str [F]; none for an agent without a recurrent state
    action: Ints  # [E, T], with the own state
    donor_action: Ints  # [E, T], the donor's decision at that step
    exchanged: Ints  # [E, T], with the donor's whole state
    moved: Ints  # [F, E, T], moved along the direction of the fact
    random: Ints  # [F, E, T], moved equally far at random

    def patches(self, fact: str, arm: Arm = "fact") -> Patches:
        """Decisions after a move, where the donor has another value of the fact: who follows the
        donor's decision is counted where that is another one.

        Args:
            fact: one of ``names``.
            arm: ``fact``: moved along its direction; ``random``: equally far at random; ``state``:
                the donor's whole state, at the same steps.

        Raises:
            ValueError: no such fact or arm.
        """
        names = self.names.tolist()
        require(arm in ARMS, "arm", arm, f"one of {', '.join(ARMS)}")
        require(fact in names, "fact", fact, f"one of {', '.join(names)}")
        place = names.index(fact)
        moved = self.moved[place]
        decided = {"state": self.exchanged, "fact": moved, "random": self.random[place]}[arm]
        donor_action = np.where(moved != NOBODY, self.donor_action, NOBODY)
        return Patches(self.action, donor_action, decided)


def steering(
    agent: Any,
    env: Any = None,
    *,
    episodes: int = 128,
    max_steps: int = 128,
    seed: int = 0,
    observability: Twin | None = None,
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> Steering:
    """Move the recurrent states of greedy episodes along the directions of all facts.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, a TensorDict
            policy or anything else that `as_policy` takes.
        env: one with ``facts()``, as an ``ArcadeEnv`` has, of two episodes or more, which are one
            another's donors; by default 16 of the agent's own game.
        episodes: greedy episodes that are moved; as many others give the directions.
        max_steps: steps of each that are looked at, from its beginning.
        seed: of the episodes, which training never sees, of donors and of random directions.
        observability: another twin than the one trained on (without ``env``).
        progress: called with (episodes played, all of them).
        **names: keywords of `as_policy`.

    Returns:
        Actions.

    Raises:
        ValueError: an option is out of range, or the env names no facts or holds a single episode.
    """
    check_played(seed, observability, episodes=(episodes, MIN_EPISODES), max_steps=(max_steps, 1))
    player, env = resolve_agent(agent, env, observability, **names)
    played = EpisodeBatch(env, keys_of(player))
    size = played.size
    require(size >= 2, "the batch size of env", size, "at least 2, for donors")

    def fitted(done: int, count: int) -> None:
        if progress is not None:
            progress(done, 2 * count)

    recording = record(
        player, env, episodes=episodes, max_steps=max_steps, seed=seed, progress=fitted
    )
    directions = Directions(recording)
    parts = list[Ints]()
    with policy_of(player).evaluating():
        for group in range(-(-episodes // size)):
            drawn = np.random.SeedSequence([seed, group, 5]).generate_state(1)
            batch_seed = held_out(int(drawn[0]) % SEED_LIMIT)
            rng = np.random.default_rng([seed, group, 6])
            part = _steer_batch(player, played, batch_seed, directions, max_steps, rng)
            parts.append(part[:, : episodes - group * size])
            if progress is not None:
                progress(episodes + min(episodes, (group + 1) * size), 2 * episodes)
    return _joined(parts, directions.names)


def _joined(parts: list[Ints], names: list[str]) -> Steering:
    """The batches of :func:`_steer_batch` as one; shorter ones are filled up."""
    steps = max(part.shape[-1] for part in parts)
    padded = list[Ints]()
    for part in parts:
        missing = ((0, 0), (0, 0), (0, steps - part.shape[-1]))
        padded.append(np.pad(part, missing, constant_values=NOBODY))
    action, donor_action, exchanged, *arms = np.concatenate(padded, axis=1)
    of_facts = np.array(arms, np.int64).reshape(2, -1, *action.shape)
    facts = np.array(names, dtype=str)
    return Steering(facts, action, donor_action, exchanged, of_facts[0], of_facts[1])


class Directions:
    """How the states of a recording differ, step by step, with each of its facts."""

    def __init__(self, recording: Recording) -> None:
        self.states = recording.states
        steps = recording.states.shape[1]
        self.alive = np.arange(steps) < recording.lengths[:, None]
        self.facts = dict[str, NDArray[Any]]()  # [E, T, C]
        self.targets = dict[str, Targets]()
        if not recording.states.shape[-1]:
            return  # nothing to steer
        for name, values in recording.facts.items():
            flat = flat_fact(values, 2)
            present = flat[self.alive & exists(flat)]
            if len(present) and (present != present[0]).any():
                self.facts[name] = flat
                self.targets[name] = Targets.of(present, flat.dtype.kind in CLASSES)

    @property
    def names(self) -> list[str]:
        """The facts that vary."""
        return list(self.facts)

    def slopes(self, name: str, step: int) -> Array | None:
        """By how much the state [D] at a step changes with each target number [M] of a fact, float
        [M, D], NaN for those that are the same in all episodes at this step; None where too few
        episodes tell.
        """
        if step >= self.states.shape[1]:
            return None
        values = self.facts[name][:, step]
        rows = self.alive[:, step] & exists(values)
        if rows.sum() < MIN_FITTED:
            return None
        numbers = self.targets[name].numbers(values[rows])
        varies = numbers.min(axis=0) < numbers.max(axis=0)
        numbers -= numbers.mean(axis=0)
        if rows.sum() < 2 * np.linalg.matrix_rank(numbers):
            return None
        states = self.states[rows, step].astype(np.float64)
        states -= states.mean(axis=0)
        slopes = np.full((len(varies), states.shape[1]), np.nan)
        slopes[varies] = np.linalg.pinv(numbers[:, varies]) @ states
        return slopes

    def moves(
        self, name: str, step: int, values: NDArray[Any], donors: Ints
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """How far the states [N, D] of a step move for their facts [N, ...] to become those of the
        donors, and for whom: where both have a value, not the same, and the way is known.
        """
        flat = flat_fact(values, 1)
        slopes = self.slopes(name, step)
        moves = np.zeros((len(flat), self.states.shape[-1]), np.float32)
        if slopes is None:
            return moves, np.zeros(len(flat), bool)
        there = exists(flat)
        is_other = there & there[donors] & (flat != flat[donors]).any(axis=-1)
        rows = np.flatnonzero(is_other)
        targets = self.targets[name]
        change = targets.numbers(flat[donors[rows]]) - targets.numbers(flat[rows])
        # not to or from a class that no episode had, at this step or at any
        has_no_slope = np.isnan(slopes).any(axis=1)
        is_class_known = (targets.decided(targets.numbers(flat)) == flat).all(axis=-1)
        is_known = ~change[:, has_no_slope].any(axis=1)
        is_known &= is_class_known[rows] & is_class_known[donors[rows]]
        moves[rows[is_known]] = change[is_known] @ np.nan_to_num(slopes)
        is_other[rows] = is_known
        return moves, is_other

    def at_random(self, moves: Floats, step: int, rng: np.random.Generator) -> Floats:
        """Moves [N, D] of the same lengths in random directions, of the numbers that vary."""
        drawn = rng.normal(size=moves.shape)
        states = self.states[self.alive[:, step], step]
        drawn *= states.min(axis=0, initial=np.inf) < states.max(axis=0, initial=-np.inf)
        lengths = np.linalg.norm(drawn, axis=1, keepdims=True)
        wanted = np.linalg.norm(moves, axis=1, keepdims=True)
        return np.asarray(drawn * wanted / np.where(lengths > 0, lengths, 1), np.float32)


def flat_fact(values: NDArray[Any], batch_ndim: int) -> NDArray[Any]:
    """The cells of a fact side by side, [..., C]."""
    return values.reshape(*values.shape[:batch_ndim], -1)


def exists(flat: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether all cells [..., C] have a value."""
    missing = flat < 0 if flat.dtype.kind in CLASSES else np.isnan(flat)
    return np.asarray(~missing.any(axis=-1), np.bool_)


@torch.no_grad()
@keeps_generator
def _steer_batch(
    agent: Any,
    played: EpisodeBatch,
    seed: int,
    directions: Directions,
    max_steps: int,
    rng: np.random.Generator,
) -> Ints:
    """The first episode of every env of a batch, [3 + 2 F, N, T]: own, donor's and exchanged
    decisions, then those moved for each fact, then those moved at random.
    """
    size = played.size
    count = len(directions.names)
    playing = torch.ones(size, dtype=torch.bool, device="cpu")
    steps = list[Ints]()
    before = dict[str, NDArray[Any]]()  # facts of the step before
    obs = played.reset(seed)
    state = agent.initial_state(size)
    while playing.any() and len(steps) < max_steps:
        rows = playing.nonzero().flatten().numpy()
        donors = draw_donors(rows, size, rng)
        facts = facts_of(played)
        actions = np.full((3 + 2 * count, size), NOBODY, np.int64)
        if steps and len(rows) > 1 and count:
            # before the decision itself: acting may change the state in place
            given = state[torch.from_numpy(donors)].clone()
            exchanged, _ = decide(agent, obs, given)
            actions[2, rows] = exchanged.cpu().numpy()[rows]
            for place, name in enumerate(directions.names):
                last = len(steps) - 1
                moves, is_other = directions.moves(name, last, before[name], donors)
                is_other &= playing.numpy()
                if is_other.any():
                    chance = directions.at_random(moves, last, rng)
                    for row, by in ((3 + place, moves), (3 + count + place, chance)):
                        decision, _ = decide(agent, obs, shifted_state(state, by))
                        actions[row, is_other] = decision.cpu().numpy()[is_other]
        action, state = decide(agent, obs, state)
        decided = action.cpu().numpy()
        actions[0, rows] = decided[rows]
        if steps and len(rows) > 1:
            actions[1, rows] = decided[donors][rows]
        steps.append(actions)
        before = facts
        obs, _, done = played.step(action)
        playing &= ~done.cpu()
    return np.stack(steps, axis=-1)
