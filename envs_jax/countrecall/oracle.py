"""Scripted players of CountRecall: a clairvoyant who spends the counter moves best, and one who
counts.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import DOWN, FIRE, UP
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer
from arcade_torch.envs_jax.render.suits import NO_CARD

Ints = npt.NDArray[np.int64]
NEVER = 9999  # more moves than any episode has
SKIP = -1


def right_answers(cards: Ints, queries: Ints) -> Ints:
    """The number asked for in each turn: int64 [N, turns], for packs int [N, turns]."""
    same = cards[:, None, :] == queries[:, :, None]
    earlier = np.tri(cards.shape[1], k=-1, dtype=bool)
    answers: Ints = (same & earlier).sum(2)
    return answers


def best_plan(wanted: Ints, budget: int) -> Ints:
    """Which turns to answer so that as many as possible are right within a budget of counter moves.

    ``cost[t][k, v]`` is the least number of moves that ends turn t with k right answers and the
    counter at v.

    Args:
        wanted: int64 [N, turns], the right answers.
        budget: Counter moves.

    Returns:
        int64 [N, turns]: the value to show in each turn, ``SKIP`` where any will do.
    """
    envs, turns = wanted.shape
    env = np.arange(envs)
    values = np.arange(wanted.max() + 1)
    cost = np.full((turns + 1, envs, turns + 1, len(values)), NEVER, np.int16)
    cost[0, :, 0] = values
    for t in range(turns):
        goal = wanted[:, t]
        way = np.abs(values - goal[:, None])[:, None, :]
        cost[t + 1] = cost[t]
        cost[t + 1, :, 1:] = np.minimum(cost[t, :, 1:], cost[t, env, :-1, goal][:, :, None] + way)

    reached = cost[turns].min(2) <= budget
    right = turns - reached[:, ::-1].argmax(1)
    value = cost[turns, env, right].argmin(1)
    plan = np.full((envs, turns), SKIP)
    for t in reversed(range(turns)):
        answered = cost[t, env, right, value] > cost[t + 1, env, right, value]
        plan[answered, t] = wanted[answered, t]
        value = np.where(answered, wanted[:, t], value)
        right = right - answered
    return plan


def towards(answer: npt.NDArray[Any], goal: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Move the counter to a goal, confirm where it is there or the goal is ``SKIP``."""
    confirms = (goal == SKIP) | (goal == answer)
    return np.where(confirms, FIRE, np.where(goal > answer, UP, DOWN)).astype(np.int32)


class StateOracle:
    """Sees both packs, future turns included: reaches the highest return that the step limit
    leaves.

    That is 1 for env deal on Easy and for most on Medium, but for a minority on Hard; the mean is
    near 0.96 there.
    """

    def __init__(self, game: Any) -> None:
        self.budget = game.move_budget
        self.plan: Ints = np.zeros((0, 0), np.int64)

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        if len(self.plan) != len(is_init):
            self.plan = np.full(seen.cards.shape, SKIP)
        if is_init.any():
            wanted = right_answers(seen.cards[is_init], seen.queries[is_init])
            self.plan[is_init] = best_plan(wanted, self.budget)
        turn = np.minimum(seen.timestep, seen.cards.shape[1] - 1)
        return towards(seen.answer, self.plan[np.arange(len(turn)), turn])


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: counts the cards of each suit as they are dealt.

    It always knows the right answer. What it cannot know is which answers will be asked for, and so
    whether the moves to a far one are better saved: it answers what is within ``3.5`` times the
    moves left per turn left, and a half.
    """

    def __init__(self, game: Any) -> None:
        super().__init__(game)
        self.budget = game.move_budget

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        self.counts = np.zeros((num_envs, self.level.suits), np.int64)  # cards dealt, by suit
        self.turns = np.zeros(num_envs, np.int64)  # turns left, this one included
        self.moves = np.zeros(num_envs, np.int64)  # counter moves left
        self.goal = np.zeros(num_envs, np.int64)
        self.fresh = np.ones(num_envs, bool)  # whether this frame begins a turn

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        envs = np.arange(len(frames))
        self.counts[is_init] = 0
        self.turns[is_init] = self.level.cards
        self.moves[is_init] = self.budget
        self.fresh[is_init] = True

        screen = self.screen
        card = screen.card.read(frames)
        query = screen.query.read(frames)
        answer = screen.counter.read(frames) + screen.counter_range[0]
        wanted = self.counts[envs, np.maximum(query - 1, 0)]
        distance = np.abs(wanted - answer)
        reach = 3.5 * self.moves / np.maximum(self.turns, 1) + 0.5
        worth = (distance <= self.moves) & (distance <= reach) & (card != NO_CARD)
        self.goal = np.where(self.fresh, np.where(worth, wanted, SKIP), self.goal)

        action = towards(answer, self.goal)
        self.fresh = (action == FIRE) & (card != NO_CARD)
        self.counts[envs[self.fresh], card[self.fresh] - 1] += 1
        self.turns -= self.fresh
        self.moves -= action != FIRE
        return action
