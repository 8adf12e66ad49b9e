"""One game at a time with a single fault of the published law taken out, to see what that fault is
worth.

The base is our game under ``rules="reference"``. A correction replaces its reset, or its step, or
its step where a condition on state and action holds, by those of the default rules.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.game import FIRE
from arcade_torch.envs_jax.tetris import rules as tetris
from arcade_torch.envs_jax.tetris.rules import GOAL, MAX_STEPS, TOP_OUT_REWARD

Correct = Callable[[Any, Any], None]
"""``(game, fixed)``: change ``game``, a copy of the reference rules, with parts of ``fixed``, the
default rules.
"""


def take_all(game: Any, fixed: Any) -> None:
    """Every correction at once."""
    game.reset, game.step = fixed.reset, fixed.step


def take_reset(game: Any, fixed: Any) -> None:
    """The first states of the default rules."""
    game.reset = fixed.reset


def take_step(game: Any, fixed: Any) -> None:
    """The steps of the default rules."""
    game.step = fixed.step


def take_step_where(condition: Callable[[Any, Any, Any], Any], game: Any, fixed: Any) -> None:
    """The steps of the default rules where ``condition(game, state, action)`` holds."""
    old = game.step

    def step(key: Any, state: Any, action: Any) -> Any:
        where = condition(game, state, action)
        both = fixed.step(key, state, action), old(key, state, action)
        return jax.tree.map(lambda yes, no: jnp.where(where, yes, no), *both)

    game.step = step


@contextmanager
def default_rules_in(*names: str) -> Iterator[None]:
    """Functions of the law of Tetris that read the default rules whatever the game says, while it
    is traced.
    """

    def fixed(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args: function(*args[:-1], "default")  # the rules come last in all of them

    with mock.patch.multiple(tetris, **{name: fixed(getattr(tetris, name)) for name in names}):
        yield


def take_parts(*names: str) -> Correct:
    """Functions of the law of Tetris as under the default rules."""

    def correct(game: Any, fixed: Any) -> None:
        reset, step = game.reset, game.step

        def reset_with(*args: Any) -> Any:
            with default_rules_in(*names):
                return reset(*args)

        def step_with(*args: Any) -> Any:
            with default_rules_in(*names):
                return step(*args)

        game.reset, game.step = reset_with, step_with

    return correct


def punish_at_the_limit(game: Any, fixed: Any) -> None:
    """T4 alone: topping out costs 1 at the time limit too."""
    old = game.step

    def step(*args: Any) -> Any:
        new, reward, terminated, truncated = old(*args)
        spared = new.terminal & (new.lines < GOAL) & (new.time >= MAX_STEPS)
        return new, reward + jnp.where(spared, TOP_OUT_REWARD, 0.0), terminated, truncated

    game.step = step


@dataclass(frozen=True)
class Fault:
    """Something the published law does and the default rules do not.

    Attributes:
        ids: its rows in results/differences.md.
        game: which game.
        correct: takes it out.
        planner: the rules that the state oracle reckons with: those of the corrected game where its
            plans depend on this fault.
    """

    ids: str
    game: str
    correct: Correct
    planner: str = "reference"

    def corrected(self, task: str) -> tuple[Any, Any]:
        """The game without the fault, and the game that its oracle believes to play."""
        fixed, game = make(task), copy.copy(make(task, rules="reference"))
        self.correct(game, fixed)
        return game, make(task, rules=self.planner)


def where(condition: Callable[[Any, Any, Any], Any]) -> Correct:
    """A correction of the step where a condition on game, state and action holds."""
    return partial(take_step_where, condition)


FAULTS = (
    Fault(
        "A1", "AutoEncode", where(lambda game, s, a: (s.timestep == game.level.cards) & (a != FIRE))
    ),
    Fault("A2", "AutoEncode", where(lambda game, s, a: s.given >= game.level.cards - 1), "default"),
    Fault("A4", "AutoEncode", where(lambda game, s, a: s.timestep >= game.max_steps - 1)),
    Fault("B1", "BattleShip", take_reset),
    Fault("B2", "BattleShip", take_step),
    Fault("K1", "Breakout", take_reset),
    Fault("K2", "Breakout", take_step),
    Fault("C1", "CartPole", take_step),
    Fault("C1", "NoisyCartPole", take_step),
    Fault("R1", "CountRecall", take_step, "default"),
    Fault("M3", "MineSweeper", take_reset),
    Fault("M4", "MineSweeper", take_step),
    Fault("N1, N2", "Navigator", take_reset, "default"),
    Fault("N3", "Navigator", take_step),
    Fault("S1", "Skittles", take_reset),
    Fault("S3", "Skittles", take_step),
    Fault("T1", "Tetris", take_parts("deal_order")),
    Fault("T2", "Tetris", take_parts("fall"), "default"),
    Fault("T3", "Tetris", take_parts("clear_rows")),
    Fault("T4", "Tetris", punish_at_the_limit),
)
