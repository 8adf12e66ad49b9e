"""The compiled functions of a game or a mixture of games, shared by all envs that play it. Loads no
torch.
"""

import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax import Game, MixedGames, resolve_id
from arcade_torch.envs_jax import make as make_game
from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome, choose_rows
from arcade_torch.envs_jax.mixture import Batched
from arcade_torch.envs_jax.settings import compiled
from arcade_torch.envs_jax.validation import format_value, plain

# Columns of ``Step.numbers``.
REWARD, EPISODE_REWARD, STEP_COUNT, TERMINATED, TRUNCATED = range(5)
NUM_NUMBERS = 5

# One compiled shape draws final observations: an eighth of the batch, at least 4 frames, of at most
# 8 different steps.
_SHARE = 8
_MIN_FRAMES = 4
_MAX_STEPS = 8
Spare = jax.Array | None
# bool [N] each: where the game has ended, and where the time limit was reached
Ended = tuple[jax.Array, jax.Array]


class Step(NamedTuple):
    """What the fused step computes."""

    # after the resets, so without flags of an end: the live state, so copy what is exported of it
    root: Batch
    final_state: Any  # the games' state before the resets
    # uint8 [N, S, S, 3] of the root; None where they were drawn into a canvas
    pixels: jax.Array | None
    # int32 [N, 5]: the outcome and the counts before the resets, in one array for one export. Of
    # the reward and of the episode's reward these are the bits of a float32, for a float32 counts
    # no steps beyond 2 ** 24.
    numbers: jax.Array


class CompiledGame:
    """A game, batched or not, or a mixture, and the steps of the bridge; each is compiled once per
    number of envs.

    Functions that draw take ``spare``, memory of the size of the frames, and draw into it; see
    ``FrameMemory``.
    """

    # arguments of ``compiled_game`` that give it; None: it was made by hand
    recipe: tuple[Any, ...] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is the shared one itself, and another process makes it again."""
        if self.recipe is None:
            raise TypeError(
                f"{self.batched.game!r} was made by hand and not by its id, so it cannot be copied "
                "or pickled"
            )
        return compiled_game, self.recipe

    def __init__(self, game: Game[Any] | Batched) -> None:
        self.batched: Batched = (
            game if isinstance(game, BatchedGame | MixedGames) else BatchedGame(game)
        )
        self.step = compiled(self._step, donate_argnums=2, keep_unused=True)
        self._step_into = compiled(self._flat_step_into, donate_argnums=0)
        self._structure: Any = None  # of a step, whose leaves ``_step_into`` gives
        self._calls_back: bool | None = None  # not known yet
        # canvases by shape: compiled functions when it was last used
        self._known: dict[tuple[int, ...], int] = {}
        self.reset_or_step = compiled(self._reset_or_step)
        self.step_only = compiled(self._step_only, donate_argnums=3, keep_unused=True)
        self.draw = compiled(
            lambda batch, spare: self.batched.render(batch), donate_argnums=1, keep_unused=True
        )
        draw_rows = (partial(_draw_rows, group) for group in self.batched.groups)
        self.draw_rows = tuple(
            compiled(draw, donate_argnums=4, keep_unused=True) for draw in draw_rows
        )

    def _step(self, batch: Batch, action: jax.Array, spare: Spare = None) -> Step:
        """Step, begin anew where an episode ended, draw once, and pack."""
        root, stepped, outcome, pixels = self.batched.step_auto(batch, action)
        return Step(self.batched.without_ends(root), stepped.state, pixels, _pack(stepped, outcome))

    def step_into(self, canvas: "Canvas", at: int, batch: Batch, action: Any) -> Step:
        """Step as ``step`` does and draw into ``canvas[:, at]``; whatever interrupts, the canvas
        keeps its memory.

        Args:
            canvas: Of shape [N, L, S, S, 3].
            at: Index on its second axis.
            batch: The live batch.
            action: int32 [N].

        Returns:
            The step without ``pixels``, which are in the canvas.
        """
        shape = canvas.memory.shape
        before = self._step_into._cache_size()
        if self._known.get(shape) == before:
            leaves = canvas.draw(self._step_into, at, batch, action)
        else:
            # Python traces and compiles: in a thread of its own, for Python's signals interrupt the
            # main thread alone.
            with ThreadPoolExecutor(1) as thread:
                leaves = thread.submit(canvas.draw, self._step_into, at, batch, action).result()
            # Known is what was found and not made: a second call may have arguments of another
            # kind, committed ones.
            if self._step_into._cache_size() == before:
                self._known[shape] = before
        step: Step = jax.tree.unflatten(self._structure, leaves)
        return step

    def _flat_step_into(
        self, memory: jax.Array, at: Any, batch: Batch, action: jax.Array
    ) -> tuple[jax.Array, ...]:
        """The memory, drawn into, and the other leaves of the step; flat, so that no Python runs to
        build the tuple.
        """
        step = self._step(batch, action)
        memory = jax.lax.dynamic_update_index_in_dim(memory, step.pixels, at, 1)
        leaves, self._structure = jax.tree.flatten(step._replace(pixels=None))
        return (memory, *leaves)

    def calls_back(self, batch: Batch) -> bool:
        """Whether a step of this batch runs Python code of a game, or what else may fail while it
        runs.
        """
        if self._calls_back is None:
            action = np.zeros(len(batch.step_count), np.int32)
            text = str(jax.make_jaxpr(self._step)(batch, action))
            self._calls_back = "callback" in text or "ffi_call" in text
        return self._calls_back

    def _step_only(
        self, batch: Batch, ended: Ended, action: jax.Array, spare: Spare = None
    ) -> tuple[Batch, Ended, jax.Array, jax.Array]:
        """Step and draw, without any reset; returns the batch, where it has ended, the frames and
        the numbers.
        """
        stepped, outcome, pixels = self.batched.step_render(
            self.batched.with_ends(batch, *ended), action
        )
        flags = (outcome.terminated, outcome.truncated)
        return self.batched.without_ends(stepped), flags, pixels, _pack(stepped, outcome)

    def _reset_or_step(
        self, batch: Batch, action: jax.Array, ended: jax.Array
    ) -> tuple[Batch, Outcome]:
        """Begin anew where ``ended`` (bool [N]) is true, and step elsewhere; nothing is drawn, no
        batch has flags.
        """
        stepped, outcome = self.batched.step(batch, action)
        stepped = self.batched.without_ends(stepped)
        # A row that begins anew has not stepped: it goes on from the random key it had, and gets
        # nothing.
        root = self.batched.reset_where(choose_rows(ended, batch, stepped), ended)
        return root, choose_rows(ended, jax.tree.map(jnp.zeros_like, outcome), outcome)


def _pack(stepped: Batch, outcome: Outcome) -> jax.Array:
    floats = (outcome.reward, stepped.episode_reward)
    bits = [
        jax.lax.bitcast_convert_type(jnp.asarray(column, jnp.float32), jnp.int32)
        for column in floats
    ]
    counts = (stepped.step_count, outcome.terminated, outcome.truncated)
    return jnp.stack([*bits, *(jnp.asarray(column, jnp.int32) for column in counts)], axis=-1)


def _draw_rows(
    group: BatchedGame[Any],
    states: list[Any],
    flags: jax.Array,
    index: jax.Array,
    first: int,
    spare: Spare,
) -> jax.Array:
    """Draw n envs, each after some step: ``index`` [2, n] is step and env; the states begin with
    the env ``first``.
    """
    step, row = index
    picked = jax.tree.map(lambda *leaves: jnp.stack(leaves)[step, row - first], *states)
    return jax.vmap(group.game.render)(picked, flags[row])


class Reused:
    """Up to ``most`` (2 or more) blocks of memory, each given again once nobody can see it: new
    ones cost page faults.

    A block is watched through the numpy array that was handed out over it. Whatever is made of that
    keeps it alive (views, tensors, views of tensors, arrays of JAX), so when it is gone, nobody
    looks.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._blocks: list[tuple[Any, weakref.ref[Any]]] = []

    def take(self, make: Callable[[], Any]) -> Any:
        """A block that nobody can see, or else a new one. It is to be handed out."""
        # a cache still has the latest
        for place, (block, seen) in reversed(list(enumerate(self._blocks))):
            if seen() is None:
                del self._blocks[place]
                return block
        return make()

    def hand_out(self, block: Any, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Remember that ``array`` lies over the block, and return it; the oldest block too many is
        forgotten.
        """
        self._blocks = [*self._blocks[1 - self._most :], (block, weakref.ref(array))]
        return array


class FrameMemory:
    """Lets compiled functions draw where they drew before, once nobody can see those frames any
    more.

    JAX stands behind ``Reused``: it does not write to memory that is seen from outside, but takes
    new. On a GPU nothing is reused: there memory is JAX's own to give again, and torch may read it
    later than Python says.
    """

    def __init__(self, shape: tuple[int, ...], device: jax.Device, most: int = 3) -> None:
        self._shape = shape
        self._device = device
        self._reuses = device.platform == "cpu"
        # 3: what a caller acts on, what that came from, and what is drawn next
        self._reused = Reused(most)

    def spare(self) -> Spare:
        """Memory to be given to the function that draws, once; None where nothing is reused."""
        new = partial(jnp.empty, self._shape, jnp.uint8, device=self._device)
        return self._reused.take(new) if self._reuses else None

    def show(self, frames: jax.Array) -> jax.Array | npt.NDArray[np.uint8]:
        """What may be handed out of the frames that were drawn: a read-only view, on a GPU the
        frames themselves.
        """
        return self._reused.hand_out(frames, np.asarray(frames)) if self._reuses else frames


class Canvas:
    """Memory of JAX on the CPU that steps draw into part by part, while arrays of numpy lie over
    it.

    JAX would not draw where it knows that somebody looks, so they are laid over the bare address.
    They keep the canvas alive, and the canvas the memory. Who draws answers for the parts that were
    shown.

    A function that draws is donated the memory and gives it back: between these two, nobody holds
    it. A signal that raises there (Ctrl-C) would let go of it, and whoever looks would read freed
    memory. Python handles signals between its own instructions only, so ``draw`` calls and keeps in
    one of them.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        memory = jnp.empty(shape, jnp.uint8, device=jax.devices("cpu")[0]).block_until_ready()
        self._results: deque[tuple[jax.Array, ...]] = deque([(memory,)], maxlen=1)
        self.address = memory.unsafe_buffer_pointer()
        self.__array_interface__ = {
            "shape": shape,
            "typestr": "|u1",
            "data": (self.address, False),
            "version": 3,
        }

    @property
    def memory(self) -> jax.Array:
        """Where is drawn, as the last function gave it back."""
        return self._results[0][0]

    def draw(
        self, function: Callable[..., tuple[jax.Array, ...]], *args: Any
    ) -> tuple[jax.Array, ...]:
        """Call a compiled function that draws.

        Args:
            function: Takes the memory, which it is donated, and ``args``; gives a flat tuple, the
                memory first.
            *args: What else it takes.

        Returns:
            What it gave but for the memory.
        """
        arguments = [(argument,) for argument in (self.memory, *args)]
        self._results.extend(map(function, *arguments))
        return self._results[0][1:]

    def wait(self) -> None:
        """Wait until ``memory``, which a function gave back that it was donated to, has been
        drawn.
        """
        if self.memory.block_until_ready().unsafe_buffer_pointer() != self.address:
            raise RuntimeError(
                "JAX did not draw where it was told to: report this, with the version of JAX"
            )


@lru_cache(maxsize=1)
def draws_in_place() -> bool:
    """Whether this version of JAX writes into memory of the CPU that it was donated."""
    canvas = Canvas((2, 2))
    drawn = jax.jit(lambda memory: memory.at[1].set(1), donate_argnums=0)(canvas.memory)
    return bool(drawn.unsafe_buffer_pointer() == canvas.address)


class FinalObservations:
    """The true last observations of ended episodes: keeps the states that steps led to, and draws
    many at once.

    Keeping the states of up to ``max_steps`` steps costs nothing; neither the host nor the device
    waits.
    """

    def __init__(
        self, compiled: CompiledGame, num_envs: int, max_steps: int, device: jax.Device
    ) -> None:
        batched = compiled.batched
        steps = min(max_steps, _MAX_STEPS)
        pairs = zip(compiled.draw_rows, batched.rows(num_envs), strict=True)
        self._games = [
            _OneGame(draw_rows, rows, steps, batched.game.obs_size, device)
            for draw_rows, rows in pairs
        ]
        self._split_states = batched.states
        self._states: dict[int, tuple[Any, ...]] = {}
        self._partial: jax.Array | None = None

    def add(self, index: int, final_state: Any, partial: jax.Array) -> None:
        """Keep the state that a step led to, before the resets, under a number."""
        self._states[index] = self._split_states(final_state)
        self._partial = partial

    def draw(
        self, wanted: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, jax.Array | np.ndarray]]:
        """Draw the observations that are wanted, and forget all steps.

        Args:
            wanted: bool [N, L], by env and by the number of the step; those steps must have been
                added.

        Returns:
            Portions: int64 [n] rows, int64 [n] steps, and frames uint8 [m, S, S, 3] on the device,
            of which the first n count. All at once, for on a GPU JAX would draw into memory that
            was given back and is still being read.
        """
        steps, rows = np.nonzero(wanted.T)
        portions = []
        for number, game in enumerate(self._games):
            own = (rows >= game.first) & (rows < game.last)
            for some_rows, some_steps in game.portions(rows[own], steps[own]):
                indices = np.unique(some_steps)
                states = [self._states[index][number] for index in indices.tolist()]
                frames = game.draw(
                    states, self._partial, np.searchsorted(indices, some_steps), some_rows
                )
                portions.append((some_rows, some_steps, frames))
        self._states.clear()
        return portions


class _OneGame:
    """Draws rows of the states of the envs ``first`` to ``last``, which play one game."""

    def __init__(
        self, draw_rows: Any, rows: slice, max_steps: int, obs_size: int, device: jax.Device
    ) -> None:
        self.first = rows.start
        self.last = rows.stop
        self._max_steps = max_steps
        self._draw_rows = draw_rows
        size = rows.stop - rows.start
        self._size = min(size, max(_MIN_FRAMES, size // _SHARE))
        # so many portions at once
        self._memory = FrameMemory((self._size, obs_size, obs_size, 3), device, most=8)

    def portions(
        self, rows: np.ndarray, steps: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Cut rows and their steps (in ascending order) into what one call draws."""
        while len(rows):
            numbers = np.unique(steps[: self._size])
            count = min(self._size, len(rows))
            if len(numbers) > self._max_steps:
                count = int(np.searchsorted(steps, numbers[self._max_steps]))
            yield rows[:count], steps[:count]
            rows = rows[count:]
            steps = steps[count:]

    def draw(
        self, states: list[Any], flags: Any, step: np.ndarray, row: np.ndarray
    ) -> jax.Array | np.ndarray:
        """One call; ``step`` counts in ``states``. What is short of the compiled shape is filled
        up.
        """
        states = states + [states[-1]] * (self._max_steps - len(states))
        index = np.empty((2, self._size), np.int32)
        index[:, : len(row)] = (step, row)
        index[:, len(row) :] = ((step[-1],), (row[-1],))
        return self._memory.show(
            self._draw_rows(states, flags, index, np.int32(self.first), self._memory.spare())
        )


def compiled_game(
    id: str | Sequence[str], obs_size: int, rules: str, options: dict[str, Any]
) -> CompiledGame:
    """Make a game with its compiled functions; equal arguments share them, so a second env compiles
    nothing.

    Several ids are a mixture, in which an id that stands there k times gets k shares, and every
    game gets the options.

    Raises:
        ValueError: Unknown id, size, rules or option value, or no id at all.
        TypeError: An option that one of the games does not have, or ids that are neither a string
            nor a list.
    """
    # what a bare name means may change
    ids = resolve_id(id) if isinstance(id, str) else tuple(_checked(id))
    obs_size = plain(obs_size)
    options = {name: plain(options[name]) for name in sorted(options)}
    try:
        compiled = _compile(ids, obs_size, rules, **options)
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        compiled = _compile.__wrapped__(ids, obs_size, rules, **options)
    compiled.recipe = (ids, obs_size, rules, options)
    return compiled


def _checked(ids: Any) -> Sequence[str]:
    """Refuse what is no list of ids."""
    if not isinstance(ids, Sequence) or isinstance(ids, bytes):
        raise TypeError(
            f"the env id is {format_value(ids)}, expected a string such as 'CartPoleEasy', or a "
            "list of them"
        )
    if not ids:
        raise ValueError("the list of env ids is empty: name at least one game")
    return [resolve_id(id) for id in ids]


@lru_cache(maxsize=64, typed=True)  # 1 == True, but means another
def _compile(
    ids: str | tuple[str, ...], obs_size: int, rules: str, /, **options: Any
) -> CompiledGame:
    if isinstance(ids, str):
        return CompiledGame(make_game(ids, obs_size=obs_size, rules=rules, **options))
    shares = Counter(ids)
    games = [make_game(id, obs_size=obs_size, rules=rules, **options) for id in shares]
    return CompiledGame(MixedGames(games, tuple(shares.values())))
