"""The contract every game obeys: pure functions from state to state and from state to picture."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

import jax

Array = jax.Array
Rules = Literal["default", "reference"]
State = TypeVar("State")
Drawn = TypeVar("Drawn", contravariant=True)

NUM_ACTIONS = 5
ACTION_NAMES = ("up", "down", "left", "right", "fire")
UP, DOWN, LEFT, RIGHT, FIRE = range(NUM_ACTIONS)


class Game(abc.ABC, Generic[State]):
    """One game at one difficulty, picture size and rule set.

    The three methods are pure, can be compiled and vectorised over envs, and hold no state of their own. MDP and POMDP
    twins are the same game: only ``render`` is told which of the two the player sees.

    Attributes:
        id: Versioned identifier, such as ``"CartPoleEasy-v0"``.
        obs_size: Side of the picture in pixels, 128 or 256.
        rules: ``"default"`` (corrected) or ``"reference"`` (those of the published numbers).
        max_steps: Time limit in steps; reaching it truncates the episode.
        return_range: Lowest and highest undiscounted return an episode can have.
        num_actions: Always 5: up, down, left, right, fire.
        oracles: The scripted players there are, ``"state"``, ``"frames"`` or both: called with the game, each gives a
            player, see :mod:`arcade_torch.envs_jax.oracles`.
    """

    num_actions: ClassVar[int] = NUM_ACTIONS
    oracles: ClassVar[Mapping[str, Callable[[Any], Any]]] = {}
    id: str
    obs_size: int
    rules: Rules
    max_steps: int
    return_range: tuple[float, float]

    @abc.abstractmethod
    def reset(self, key: Array) -> State:
        """Draw the first state of an episode.

        Args:
            key: uint32 [2], a JAX random key.

        Returns:
            The state, a named tuple of arrays.
        """

    @abc.abstractmethod
    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array]:
        """Take one action.

        Args:
            key: uint32 [2], a JAX random key for this step alone.
            state: The state before the action.
            action: int32 scalar in 0..4.

        Returns:
            The new state, the reward (float32 scalar), whether the game itself ended (bool scalar), and whether the
            time limit was reached (bool scalar). Both flags may be true at once.
        """

    @abc.abstractmethod
    def render(self, state: State, partial: Array | bool) -> Array:
        """Draw a state.

        Args:
            state: The state to draw.
            partial: bool scalar, may be traced: true draws what the POMDP twin shows, false the MDP twin.

        Returns:
            uint8 [S, S, 3], rows downwards, RGB.
        """

    def step_autoreset(
        self, key: Array, state: State, action: Array
    ) -> tuple[State, State, tuple[Array, Array, Array]]:
        """Take one action in one env, and begin a new episode if that ended this one; ``vmap`` it for many envs.

        Args:
            key: uint32 [2], a JAX random key for this step alone.
            state: The state before the action.
            action: int32 scalar in 0..4.

        Returns:
            The state to go on with; the state that the action led to, which differs at an end alone and whose picture
            is the final observation; and reward, terminated, truncated as ``step`` gives them.
        """
        now, fresh = jax.random.split(key)
        stepped, reward, terminated, truncated = self.step(now, state, action)
        ended = terminated | truncated
        following = jax.tree.map(lambda new, old: jax.numpy.where(ended, new, old), self.reset(fresh), stepped)
        return following, stepped, (reward, terminated, truncated)

    def __repr__(self) -> str:
        """The call that makes this game again."""
        return f"make({self.id!r}, obs_size={self.obs_size}, rules={self.rules!r})"


class Screen(Protocol[Drawn]):
    """What draws a game of this package."""

    def draw(self, state: Drawn, partial: Array | bool) -> Array:
        """See :meth:`Game.render`."""


class LevelGame(Game[State]):
    """A game of this package; ``levels`` are the numbers of each difficulty by the bare name of its id.

    Args:
        level: Numbers of the difficulty.
        id: Versioned id.
        obs_size: 128 or 256.
        rules: ``"default"`` or ``"reference"``; each game says what the reference does otherwise.
    """

    levels: ClassVar[Mapping[str, Any]]
    screen: Screen[State]

    def __init__(self, level: Any, *, id: str, obs_size: int, rules: Rules) -> None:
        self.level, self.id, self.obs_size, self.rules = level, id, obs_size, rules

    def render(self, state: State, partial: Array | bool) -> Array:
        """See :meth:`Game.render`."""
        return self.screen.draw(state, partial)
