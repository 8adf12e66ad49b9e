"""The compiled functions of a game or a mixture of games, shared by all envs that play it. Loads no
torch.
"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import chain
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome, choose_rows
from arcade_torch.envs_jax.game import Game
from arcade_torch.envs_jax.mixture import MixedGames
from arcade_torch.envs_jax.registry import games_of
from arcade_torch.envs_jax.registry import make as make_game
from arcade_torch.envs_jax.settings import compiled
from arcade_torch.envs_jax.validation import format_value, plain
from arcade_torch.frame_memory import Canvas, Spare

# Columns of ``Step.numbers``.
REWARD, EPISODE_REWARD, STEP_COUNT, TERMINATED, TRUNCATED = range(5)
NUM_NUMBERS = 5

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

    def __init__(self, game: Game[Any] | BatchedGame[Any]) -> None:
        self.batched = game if isinstance(game, BatchedGame) else BatchedGame(game)
        self.step = compiled(self._step, donate_argnums=2, keep_unused=True)
        self._step_into = compiled(self._flat_step_into, donate_argnums=0)
        self._structure: Any = None  # of a step, whose leaves ``_step_into`` gives
        self._calls_back: bool | None = None  # None until it is asked for
        # canvases by shape: how many functions were compiled when it was last used
        self._counts: dict[tuple[int, ...], int] = {}
        self.reset_or_step = compiled(self._reset_or_step)
        self.step_only = compiled(self._step_only, donate_argnums=3, keep_unused=True)
        self.draw = compiled(
            lambda batch, spare: self.batched.render(batch), donate_argnums=1, keep_unused=True
        )
        # one a game
        self.draw_rows = tuple(
            compiled(partial(_draw_rows, group), donate_argnums=4, keep_unused=True)
            for group in self.batched.groups
        )

    def _step(self, batch: Batch, action: jax.Array, spare: Spare = None) -> Step:
        """Step, begin anew where an episode ended, draw once, and pack."""
        root, stepped, outcome, pixels = self.batched.step_autoreset(batch, action)
        return Step(
            self.batched.without_ends(root), stepped.state, pixels, pack_numbers(stepped, outcome)
        )

    def step_into(self, canvas: Canvas, at: int, batch: Batch, action: Any) -> Step:
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
        if self._counts.get(shape) == before:
            leaves = canvas.draw(self._step_into, at, batch, action)
        else:
            # Python traces and compiles: in a thread of its own, for Python's signals interrupt the
            # main thread alone.
            with ThreadPoolExecutor(1) as thread:
                leaves = thread.submit(canvas.draw, self._step_into, at, batch, action).result()
            # A second call may have arguments of another kind (committed ones) and compile again,
            # so a shape counts as compiled only after a call that compiled nothing.
            if self._step_into._cache_size() == before:
                self._counts[shape] = before
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
        """Whether a step of this batch calls Python or foreign code of a game, which may fail while
        the step runs.
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
        return self.batched.without_ends(stepped), flags, pixels, pack_numbers(stepped, outcome)

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


def pack_numbers(stepped: Any, outcome: Any) -> jax.Array:
    """``Step.numbers``: the columns, as int32.

    Args:
        stepped: Has ``episode_reward`` and ``step_count`` [N], before any reset.
        outcome: Has ``reward``, ``terminated``, ``truncated`` [N].
    """
    columns = [
        _bits(outcome.reward),
        _bits(stepped.episode_reward),
        jnp.asarray(stepped.step_count, jnp.int32),
        jnp.asarray(outcome.terminated, jnp.int32),
        jnp.asarray(outcome.truncated, jnp.int32),
    ]
    return jnp.stack(columns, axis=-1)


def _bits(values: jax.Array) -> jax.Array:
    """The bits of float32 numbers, as int32."""
    return jax.lax.bitcast_convert_type(jnp.asarray(values, jnp.float32), jnp.int32)


def _draw_rows(
    group: BatchedGame[Any],
    states: list[Any],
    flags: list[jax.Array],
    index: jax.Array,
    first: int,
    spare: Spare,
) -> jax.Array:
    """Draw n envs, each after some step: ``index`` [2, n] is step and env; the states begin with
    the env ``first``, the flags of partial views with the env 0.
    """
    step, row = index
    picked = jax.tree.map(lambda *leaves: jnp.stack(leaves)[step, row - first], *states)
    return jax.vmap(group.game.render)(picked, jnp.stack(flags)[step, row])


def compiled_game(
    id: str | Sequence[str], obs_size: int, rules: str, options: dict[str, Any]
) -> CompiledGame:
    """Make a game with its compiled functions; equal arguments share them, so a second env compiles
    nothing.

    Several ids, in a list or joined by ``+``, are a mixture, in which an id that stands there k
    times gets k shares, and every game gets the options.

    Raises:
        ValueError: Unknown id, size, rules or option value, or no id at all.
        TypeError: An option that one of the games does not have, or ids that are neither a string
            nor a list.
    """
    # what a bare name means may change
    games = _resolved_ids(id)
    is_one = isinstance(id, str) and len(games) == 1  # a list of one is a mixture
    ids = games[0] if is_one else games
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


def _resolved_ids(ids: Any) -> tuple[str, ...]:
    """The games that are named, with their versions, each as often as it has shares; refuses what
    is no list of ids.
    """
    if isinstance(ids, str):
        return games_of(ids)
    if not isinstance(ids, Sequence) or isinstance(ids, bytes):
        raise TypeError(
            f"the env id is {format_value(ids)}, expected a string such as 'CartPoleEasy', or a "
            "list of them"
        )
    if not ids:
        raise ValueError("the list of env ids is empty: name at least one game")
    return tuple(chain.from_iterable(map(games_of, ids)))


@lru_cache(maxsize=64, typed=True)  # 1 == True, but means another
def _compile(
    ids: str | tuple[str, ...], obs_size: int, rules: str, /, **options: Any
) -> CompiledGame:
    if isinstance(ids, str):
        return CompiledGame(make_game(ids, obs_size=obs_size, rules=rules, **options))
    shares = Counter(ids)
    games = [make_game(id, obs_size=obs_size, rules=rules, **options) for id in shares]
    return CompiledGame(MixedGames(games, tuple(shares.values())))
