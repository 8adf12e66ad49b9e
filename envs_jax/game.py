"""The contract every game obeys: pure functions from state to state and from state to picture."""

import abc
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.settings import fixed, may_be_nan, raw_key
from arcade_torch.envs_jax.validation import format_value

Array = jax.Array
Rules = Literal["default", "reference"]
State = TypeVar("State")
Drawn = TypeVar("Drawn", contravariant=True)

NUM_ACTIONS = 5
ACTION_NAMES = ("up", "down", "left", "right", "fire")
UP, DOWN, LEFT, RIGHT, FIRE = range(NUM_ACTIONS)
ENDS = ("terminated", "truncated")  # the flags of an end
ORACLES = ("state", "frames")  # what scripted players see
MEMORY_KINDS = {
    "recall": "what was seen once",
    "counting": "how often something was seen",
    "mapping": "where things lie that are covered again",
    "tracking": "where something is that moves unseen",
    "velocity": "where something is of which only the velocity is seen",
    "none": "nothing: a player without memory can earn the most",
}
"""What a POMDP twin can ask of a memory."""
# arguments of a game's class that are no options of ``make``
_NO_OPTIONS = ("level", "id", "obs_size", "rules")
# such a flag in a state that no wrapped method of ``Game`` gave, or of an episode that runs
UNSET: Any = None


def keeps_ends(state: Any) -> bool:
    """Whether a state is to say by itself that its episode has ended.

    It is if it is a named tuple with fields ``terminated`` and ``truncated`` that are bools, or
    None before a wrapped ``reset`` or ``step`` of :class:`Game` has set them.
    """
    if not set(ENDS) <= set(getattr(state, "_fields", ())):
        return False
    flags = (state.terminated, state.truncated)
    return all(flag is None or str(getattr(flag, "dtype", "")) == "bool" for flag in flags)


def _with_flags(state: Any) -> Any:
    """The state, which keeps ends, with false for flags that are None."""
    missing = [name for name in ENDS if getattr(state, name) is UNSET]
    return state._replace(**{name: jnp.bool_(False) for name in missing})


def stay(ended: Array, before: Any, after: Any) -> Any:
    """The tree ``before`` where ``ended`` (a bool, or bools [N] for leaves [N, ...]) is true,
    elsewhere ``after``.
    """

    def choose(old: Any, new: Any) -> Array:
        rest = (1,) * (jnp.ndim(new) - jnp.ndim(ended))
        return jnp.where(jnp.reshape(ended, jnp.shape(ended) + rest), old, new)

    return jax.tree.map(choose, before, after)


def _apart(state: Any) -> Any:
    """The state with leaves that share no memory, so that it can be donated."""
    seen: set[int] = set()

    def alone(leaf: Any) -> Array:
        is_second = id(leaf) in seen
        seen.add(id(leaf))
        is_traced = isinstance(leaf, jax.core.Tracer)
        return leaf if is_traced and not is_second else jnp.array(leaf)

    return jax.tree.map(alone, state)


def laid_out_as(guide: Array, tree: Any) -> Any:
    """The tree, of which every leaf may differ from device to device if ``guide`` may, a constant
    too.

    Under ``shard_map`` JAX keeps that in the type of an array, and a loop over states needs equal
    types. Elsewhere the tree is as it was.

    Args:
        guide: [], or [N] for leaves [N, ...].
        tree: Arrays.
    """
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return tree
    never = guide != guide  # which compilers know
    return stay(never, tree, tree)


def _wrap_reset(reset: Callable[..., Any]) -> Callable[..., Any]:
    """A game's ``reset`` under fixed settings; see :class:`Game`."""

    @functools.wraps(reset)
    def wrapped(self: Any, key: Any) -> Any:
        key = raw_key(key)
        state = reset(self, key)
        state = _with_flags(state) if keeps_ends(state) else state
        return _apart(laid_out_as(key[0], state))

    return fixed(wrapped)


def as_actions(action: Any, shape: tuple[int, ...]) -> Array:
    """Actions as int32 of a shape; a ValueError for what would broadcast or be rounded."""
    given = jnp.asarray(action)
    if given.shape != shape or not jnp.issubdtype(given.dtype, jnp.integer):
        raise ValueError(
            f"action is {given.dtype} {list(given.shape)}, expected integers {list(shape)}, one an "
            "env"
        )
    return given.astype(jnp.int32)


def _wrap_step(step: Callable[..., Any]) -> Callable[..., Any]:
    """A game's ``step`` under fixed settings, which changes nothing where the state has ended; see
    :class:`Game`.
    """

    @functools.wraps(step)
    def wrapped(self: Any, key: Any, state: Any, action: Any) -> Any:
        action = as_actions(action, ())
        if not keeps_ends(state):
            key = raw_key(key)
            return laid_out_as(key[0], step(self, key, state, action))
        runs = state.terminated is UNSET and state.truncated is UNSET
        state = _with_flags(state)
        after, reward, terminated, truncated = step(self, raw_key(key), state, action)
        after = after._replace(terminated=jnp.asarray(terminated), truncated=jnp.asarray(truncated))
        if runs:
            return after, reward, after.terminated, after.truncated
        ended = jnp.logical_or(state.terminated, state.truncated)
        after = stay(ended, state, after)
        return after, jnp.where(ended, jnp.float32(0), reward), after.terminated, after.truncated

    return fixed(wrapped)


def _wrap_render(render: Callable[..., Any]) -> Callable[..., Any]:
    """A game's ``render`` under fixed settings, which sees both flags; see :class:`Game`."""

    @functools.wraps(render)
    def wrapped(self: Any, state: Any, partial: Any) -> Any:
        return render(self, _with_flags(state) if keeps_ends(state) else state, partial)

    return fixed(wrapped)


def _wrap_facts(facts: Callable[..., Any]) -> Callable[..., Any]:
    """A game's ``facts`` under fixed settings; see :class:`Game`."""

    @functools.wraps(facts)
    def wrapped(self: Any, state: Any) -> Any:
        return facts(self, state)

    return may_be_nan(fixed(wrapped))


_WRAPPERS = {
    "reset": _wrap_reset,
    "step": _wrap_step,
    "render": _wrap_render,
    "facts": _wrap_facts,
}


class Game(abc.ABC, Generic[State]):
    """One game at one difficulty, picture size and rule set.

    The three methods are pure, can be compiled and vectorised over envs, and hold no state of their
    own. MDP and POMDP twins are the same game: only ``render`` is told which of the two the player
    sees. A fourth, ``facts``, may name what the state holds, for measures that ask what an agent
    knows.

    Whatever class is derived from this one, its methods are wrapped, so that they give the
    same bits under all settings of JAX (:mod:`arcade_torch.envs_jax.settings`), take keys of both
    styles, and give states whose leaves share no memory. Where the state is a named tuple with
    fields ``terminated`` and ``truncated``, ``UNSET`` by default, the wrapper sets them, and a step
    after an end changes nothing: state, frame and both flags stay, the reward is 0. For states
    without such fields ``BatchedGame`` does the same.

    Attributes:
        id: Versioned identifier, such as ``"CartPoleEasy-v0"``.
        obs_size: Side of the picture in pixels, 128 or 256.
        rules: ``"default"`` (corrected) or ``"reference"`` (those of the published numbers).
        max_steps: Time limit in steps; reaching it truncates the episode.
        return_range: Lowest and highest undiscounted return an episode can have.
        num_actions: Always 5: up, down, left, right, fire.
        oracles: The scripted players there are, ``"state"``, ``"frames"`` or both: called with the
            game, each gives a player, see :mod:`arcade_torch.envs_jax.oracles`.
        memory_kind: What the POMDP twin asks of a memory, a key of ``MEMORY_KINDS``; empty where
            nobody has said.
    """

    num_actions: ClassVar[int] = NUM_ACTIONS
    memory_kind: ClassVar[str] = ""
    oracles: ClassVar[Mapping[str, Callable[[Any], Any]]] = {}
    id: str
    obs_size: int
    rules: Rules
    max_steps: int
    return_range: tuple[float, float]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Wrap the methods of the contract that a class defines, or has of a base that is no
        game.
        """
        super().__init_subclass__(**kwargs)
        for name, wrap in _WRAPPERS.items():
            owner = next(base for base in cls.__mro__ if name in vars(base))
            if owner is cls or not issubclass(owner, Game):
                setattr(cls, name, wrap(vars(owner)[name]))

    @abc.abstractmethod
    def reset(self, key: Array) -> State:
        """Draw the first state of an episode.

        Args:
            key: uint32 [2], a JAX random key, or one of ``jax.random.key``.

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
            The new state, the reward (float32 scalar), whether the game itself ended (bool scalar),
            and whether the time limit was reached (bool scalar). Both flags may be true at once.
            After an end they stay as they were.
        """

    @abc.abstractmethod
    def render(self, state: State, partial: Array | bool) -> Array:
        """Draw a state.

        Args:
            state: The state to draw.
            partial: bool scalar, may be traced: true draws what the POMDP twin shows, false the MDP
                twin.

        Returns:
            uint8 [S, S, 3], rows downwards, RGB.
        """

    def facts(self, state: State) -> dict[str, Array]:
        """Name the facts of a state that a player may have to remember; by default none.

        Booleans and integers are classes, floats are numbers. An array of more than one element
        holds a fact for each of its cells. A negative integer and NaN mean that the fact has no
        value at this state, such as a card to be named while none is asked for.

        Args:
            state: Any state, the last of an episode too.

        Returns:
            Arrays by name: bool, integers or float32, of one shape at every state. They depend on
            the state alone, and not on what the player sees of it.
        """
        del state
        return {}

    @fixed
    def step_autoreset(
        self, key: Array, state: State, action: Array
    ) -> tuple[State, State, tuple[Array, Array, Array]]:
        """Take one action in one env, and begin a new episode if that ended this one; ``vmap`` it
        for many envs.

        Args:
            key: uint32 [2], a JAX random key for this step alone.
            state: The state before the action.
            action: int32 scalar in 0..4.

        Returns:
            The state to go on with; the state that the action led to, which differs at an end alone
            and whose picture is the final observation; and reward, terminated, truncated as
            ``step`` gives them.
        """
        now, fresh = jax.random.split(raw_key(key))
        stepped, reward, terminated, truncated = self.step(now, state, action)
        following = stay(terminated | truncated, self.reset(fresh), stepped)
        return following, stepped, (reward, terminated, truncated)

    def __repr__(self) -> str:
        """The call that makes this game again, with the options that it keeps under their names."""
        arguments = [repr(self.id), f"obs_size={self.obs_size}", f"rules={self.rules!r}"]
        for name in inspect.signature(type(self)).parameters:
            if name not in _NO_OPTIONS and hasattr(self, name):
                arguments.append(f"{name}={format_value(getattr(self, name))}")
        return f"make({', '.join(arguments)})"


class Screen(Protocol[Drawn]):
    """What draws a game of this package."""

    def draw(self, state: Drawn, partial: Array | bool) -> Array:
        """See :meth:`Game.render`."""


class LevelGame(Game[State]):
    """A game of this package; ``levels`` are the numbers of each difficulty by the bare name of its
    id.

    Args:
        level: Numbers of the difficulty.
        id: Versioned id.
        obs_size: 128 or 256.
        rules: ``"default"`` or ``"reference"``; each game says what the reference does otherwise.
    """

    levels: ClassVar[Mapping[str, Any]]
    screen: Screen[State]

    def __init__(self, level: Any, *, id: str, obs_size: int, rules: Rules) -> None:
        self.level = level
        self.id = id
        self.obs_size = obs_size
        self.rules = rules

    def render(self, state: State, partial: Array | bool) -> Array:
        """See :meth:`Game.render`."""
        return self.screen.draw(state, partial)


def check_ends(game: Any, steps: int) -> None:
    """Raise ValueError if an episode still runs after so many steps: one more than ``max_steps``,
    for by the reference rules some games end a step late.
    """
    if steps > game.max_steps:
        raise ValueError(
            f"{game.id}: an episode runs on after {steps} steps, and max_steps is "
            f"{game.max_steps}: step has to give truncated there"
        )
