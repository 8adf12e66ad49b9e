"""The contract every game obeys: pure functions from state to state and from state to picture."""

import abc
from typing import Any, ClassVar, Generic, Literal, TypeVar

import jax

from arcade_torch.envs_jax.shown import shown

Array = jax.Array
Rules = Literal["default", "reference"]
State = TypeVar("State")

NUM_ACTIONS = 5
ACTION_NAMES = ("up", "down", "left", "right", "fire")
UP, DOWN, LEFT, RIGHT, FIRE = range(NUM_ACTIONS)
OBS_SIZES = (128, 256)
RULES: tuple[Rules, ...] = ("default", "reference")


class Game(abc.ABC, Generic[State]):
    """One game at one difficulty, picture size and rule set.

    The three methods are pure, can be compiled and vectorised over envs, and hold no state of their own. MDP and POMDP
    twins are the same game: only ``render`` is told which of the two the player sees.

    Attributes:
        id: Versioned identifier, such as ``"CartPoleEasy-v0"``.
        obs_size: Side of the picture in pixels, 128 or 256.
        rules: ``"default"`` (the corrected law) or ``"reference"`` (the law of the published numbers).
        max_steps: Time limit in steps; reaching it truncates the episode.
        return_range: Lowest and highest undiscounted return an episode can have.
        num_actions: Always 5: up, down, left, right, fire.
    """

    num_actions: ClassVar[int] = NUM_ACTIONS
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

    def __repr__(self) -> str:
        """The call that makes this game again."""
        return f"make({self.id!r}, obs_size={self.obs_size}, rules={self.rules!r})"


def check_choice(what: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Refuse a value outside a closed set.

    Args:
        what: Name of the option, for the message.
        value: What arrived.
        allowed: All values that are allowed.

    Raises:
        ValueError: ``value`` is not one of ``allowed``.
    """
    kinds = tuple({type(one) for one in allowed})
    if isinstance(value, bool) or not isinstance(value, kinds) or value not in allowed:
        raise ValueError(f"{what} is {shown(value)}, allowed: {', '.join(map(repr, allowed))}")
