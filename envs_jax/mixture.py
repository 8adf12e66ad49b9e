"""Several games in one batch: every env plays one of them, and all are stepped by one compiled
call.

The envs of a game stand side by side, so that a step is one vectorised step a game and no game is
computed for the envs of another. Frames, rewards and counts of all come out as if there were one
game.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome, with_flags
from arcade_torch.envs_jax.game import NUM_ACTIONS, UNSET, Array, Game
from arcade_torch.envs_jax.registry import mixture_id
from arcade_torch.envs_jax.render.screen import WORD
from arcade_torch.envs_jax.settings import compiled, raw_key


@dataclass(frozen=True)
class Mixture:
    """What several games have in common, under the names that a ``Game`` has for it.

    Attributes:
        games: The games; the task number of an env is an index into them.
        weights: How many shares of the envs each gets.
        num_actions: Always 5.
    """

    games: tuple[Game[Any], ...]
    weights: tuple[int, ...]
    num_actions: ClassVar[int] = NUM_ACTIONS

    @property
    def id(self) -> str:
        """The versioned ids in order, such as ``"2*BattleShipEasy-v0+TetrisEasy-v0"``."""
        ids = [game.id for game in self.games]
        return mixture_id(dict(zip(ids, self.weights, strict=True)))

    @property
    def obs_size(self) -> int:
        """Side of the picture in pixels, the same in all games."""
        return self.games[0].obs_size

    @property
    def rules(self) -> str:
        """The rule set, ``"mixed"`` where the games differ in it."""
        rules = {str(game.rules) for game in self.games}
        return rules.pop() if len(rules) == 1 else "mixed"

    @property
    def max_steps(self) -> int:
        """The longest time limit: no episode of any game is longer."""
        return max(game.max_steps for game in self.games)

    @property
    def return_range(self) -> tuple[float, float]:
        """Lowest and highest return that an episode of any game can have."""
        lowest = min(game.return_range[0] for game in self.games)
        highest = max(game.return_range[1] for game in self.games)
        return lowest, highest

    def __repr__(self) -> str:
        """The games and their shares."""
        return f"mixture({self.id!r}, obs_size={self.obs_size}, rules={self.rules!r})"


class MixedGames(BatchedGame[Any]):
    """Compiled functions over a batch in which every env plays one of several games.

    Has the methods of ``BatchedGame`` with the same meaning, so that the bridge takes either. In
    the ``Batch`` only ``state`` differs: a dictionary from versioned id to the states of the envs
    that play it, leaves [n, ...].

    Env ``i`` plays the same game at every step and in every episode, and with the same key it walks
    the very path that it walks in a batch of that game alone.

    Args:
        games: Different games with one picture size; the order is that of the task numbers.
        weights: How many shares of the envs each game gets; one each by default.

    Raises:
        ValueError: No game, a game given twice, pictures of several sizes, or weights that are not
            positive whole numbers, one a game.

    Example:
        >>> from arcade_torch.envs_jax import make
        >>> mixed = MixedGames([make("MineSweeperEasy"), make("TetrisEasy")], weights=(2, 1))
        >>> mixed.task(6).tolist()
        [0, 0, 0, 0, 1, 1]
    """

    game: Mixture  # type: ignore[assignment]  # says of itself what a game does

    def __init__(self, games: Sequence[Game[Any]], weights: Sequence[int] | None = None) -> None:
        shares = tuple(weights) if weights is not None else (1,) * len(games)
        _check(games, shares)
        self.game = Mixture(tuple(games), shares)
        self.groups = tuple(BatchedGame(game) for game in games)
        self._compile()

    def _compile(self) -> None:
        super()._compile()
        self._padded = compiled(self._pad)
        self._unpadded = compiled(self._unpad)

    def rows(self, num_envs: int) -> tuple[slice, ...]:
        """The envs of each game: contiguous, as the weights say, what is left over going to the
        earlier games.

        Args:
            num_envs: Envs in the batch.

        Returns:
            One slice a game; together they cover all envs in order.

        Raises:
            ValueError: There are too few envs for every game to get one.
        """
        total = sum(self.game.weights)
        rows = []
        first = 0
        for game, shares in zip(self.game.games, accumulate(self.game.weights), strict=True):
            last = math.ceil(num_envs * shares / total)
            if first == last:
                raise ValueError(
                    f"num_envs is {num_envs}, too few for {self.game.id}: {game.id} would get no "
                    f"env, {total} are enough"
                )
            rows.append(slice(first, last))
            first = last
        return tuple(rows)

    def task(self, num_envs: int) -> npt.NDArray[np.int64]:
        """The index of the game that each env plays, int64 [num_envs]."""
        sizes = [rows.stop - rows.start for rows in self.rows(num_envs)]
        return np.repeat(np.arange(len(self.groups)), sizes)

    def states(self, state: Any) -> tuple[Any, ...]:
        """The states of each game's own envs, in the order of the games."""
        return tuple(state[game.id] for game in self.game.games)

    def without_ends(self, batch: Batch) -> Batch:
        """See :meth:`BatchedGame.without_ends`."""
        running = []
        for group, part in zip(self.groups, self._parts(batch), strict=True):
            running.append(group.without_ends(part))
        return self._join(running)

    def with_ends(self, batch: Batch, terminated: Array, truncated: Array) -> Batch:
        """See :meth:`BatchedGame.with_ends`."""
        all_rows = self.rows(len(batch.step_count))
        flagged = []
        for group, part, rows in zip(self.groups, self._parts(batch), all_rows, strict=True):
            flagged.append(group.with_ends(part, terminated[rows], truncated[rows]))
        return self._join(flagged)

    def ends(self, batch: Batch) -> tuple[Array, Array]:
        """See :meth:`BatchedGame.ends`."""
        terminated = []
        truncated = []
        for group, part in zip(self.groups, self._parts(batch), strict=True):
            part_terminated, part_truncated = group.ends(part)
            terminated.append(part_terminated)
            truncated.append(part_truncated)
        return jnp.concatenate(terminated), jnp.concatenate(truncated)

    def _init(self, keys: Array, partial: Array) -> Batch:
        keys = raw_key(keys, ndim=2)
        partial = jnp.asarray(partial)
        parts = []
        for group, rows in zip(self.groups, self.rows(len(keys)), strict=True):
            parts.append(group.init(keys[rows], partial[rows]))
        return self._join(parts)

    def _step(self, batch: Batch, action: Array) -> tuple[Batch, Outcome]:
        batches = []
        outcomes = []
        for group, part in zip(self.groups, self._split(batch, action), strict=True):
            stepped, outcome = group.step(*part)
            batches.append(stepped)
            outcomes.append(outcome)
        return self._join(batches), _concatenate(outcomes)

    def _reset_where(self, batch: Batch, mask: Array) -> Batch:
        parts = []
        for group, part in zip(self.groups, self._split(batch, jnp.asarray(mask)), strict=True):
            parts.append(group.reset_where(*part))
        return self._join(parts)

    def _render(self, batch: Batch) -> Array:
        frames = []
        for group, part in zip(self.groups, self._parts(batch), strict=True):
            frames.append(group.render(part))
        if 3 * self.game.obs_size % WORD:
            return _join_bytes(*frames)
        joined: Array = jax.lax.platform_dependent(*frames, cuda=_join_words, default=_join_bytes)
        return joined

    def _facts(self, batch: Batch) -> dict[str, Array]:
        """The facts that all games name alike, with equal shapes and types.

        Raises:
            ValueError: The games have facts, and none that all share.
        """
        of_games = []
        for group, part in zip(self.groups, self._parts(batch), strict=True):
            of_games.append(group.facts(part))
        shared = dict[str, Array]()
        for name, first in of_games[0].items():
            values = [facts[name] for facts in of_games if name in facts]
            kinds = {(value.shape[1:], value.dtype) for value in values}
            if len(values) == len(of_games) and kinds == {(first.shape[1:], first.dtype)}:
                shared[name] = jnp.concatenate(values)
        if any(of_games) and not shared:
            raise ValueError(_no_shared_facts(self.game.games, of_games))
        return shared

    def pad(self, batch: Batch) -> Batch:
        """The batch with all leaves [N, ...]: states of a game are zero in the envs that play
        another.
        """
        padded: Batch = self._padded(batch)
        return padded

    def unpad(self, batch: Batch) -> Batch:
        """The inverse of ``pad``."""
        unpadded: Batch = self._unpadded(batch)
        return unpadded

    def _pad(self, batch: Batch) -> Batch:
        size = len(batch.step_count)
        state = {}
        for game, rows in zip(self.game.games, self.rows(size), strict=True):

            def padded(leaf: Array, rows: slice = rows) -> Array:
                return jnp.zeros((size, *leaf.shape[1:]), leaf.dtype).at[rows].set(leaf)

            state[game.id] = jax.tree.map(padded, batch.state[game.id])
        return batch._replace(state=state)

    def _unpad(self, batch: Batch) -> Batch:
        state = {}
        for game, rows in zip(self.game.games, self.rows(len(batch.step_count)), strict=True):
            state[game.id] = _rows_of(batch.state[game.id], rows)
        return batch._replace(state=state)

    def _split(self, batch: Batch, other: Array) -> list[tuple[Batch, Array]]:
        """The batch of each game, with its part of another array [N]."""
        all_rows = self.rows(len(batch.step_count))
        return [
            (part, other[rows]) for part, rows in zip(self._parts(batch), all_rows, strict=True)
        ]

    def _parts(self, batch: Batch) -> list[Batch]:
        """The batch of each game."""
        shared = batch._replace(state=None)
        pairs = zip(self.rows(len(batch.step_count)), self.states(batch.state), strict=True)
        return [_rows_of(shared, rows)._replace(state=state) for rows, state in pairs]

    def _join(self, batches: Sequence[Batch]) -> Batch:
        """The batch of all games from that of each."""
        shared: Batch = _concatenate(_without_states(batches))
        states = {}
        for game, batch in zip(self.game.games, batches, strict=True):
            states[game.id] = batch.state
        return shared._replace(state=states)


def _join_bytes(*frames: Array) -> Array:
    """The frames of all games, uint8 [N, S, S, 3], one game behind the other."""
    return jnp.concatenate(frames)


def _join_words(*frames: Array) -> Array:
    """The same by words of four bytes, as a GPU draws them: joined as bytes, every byte of a word
    would be drawn by itself, and frames would be copied.
    """
    words = []
    for game_frames in frames:
        rows = game_frames.shape[1]
        pixels = game_frames.reshape(len(game_frames), rows, -1, WORD)  # as the words were drawn
        words.append(jax.lax.bitcast_convert_type(pixels, jnp.uint32))
    joined = jax.lax.bitcast_convert_type(jnp.concatenate(words), jnp.uint8)
    return joined.reshape(-1, *frames[0].shape[1:])


def _without_states(batches: Sequence[Batch]) -> list[Batch]:
    """Batches without their states, all with flags of an end or none of them: one a game needs
    them, no other reads.
    """
    if all(batch.terminated is UNSET for batch in batches):
        return [batch._replace(state=None) for batch in batches]
    return [with_flags(batch._replace(state=None)) for batch in batches]


def _rows_of(tree: Any, rows: slice) -> Any:
    """Some rows of every leaf of a pytree."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def _concatenate(trees: Sequence[Any]) -> Any:
    """Put the rows of equal pytrees one after the other."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def _no_shared_facts(games: Sequence[Game[Any]], of_games: Sequence[dict[str, Array]]) -> str:
    """What is said where games of a mixture share no fact."""
    lists = []
    for game, facts in zip(games, of_games, strict=True):
        kinds = [f"{name} {value.dtype}{list(value.shape[1:])}" for name, value in facts.items()]
        lists.append(f"{game.id}: {', '.join(kinds) or 'none'}")
    return (
        f"the games of this batch have no fact in common ({'; '.join(lists)}): "
        "ask a batch of one game"
    )


def _check(games: Sequence[Game[Any]], weights: tuple[int, ...]) -> None:
    """Refuse games that cannot share a batch."""
    if not games:
        raise ValueError("the list of games is empty: name at least one")
    ids = [game.id for game in games]
    for id in ids:
        if ids.count(id) > 1:
            raise ValueError(f"{id} is in the list of games twice: give it once, with a weight")
    sizes = sorted({game.obs_size for game in games})
    if len(sizes) > 1:
        raise ValueError(
            f"games of one batch need one picture size, these have obs_size "
            f"{', '.join(f'{game.obs_size} ({game.id})' for game in games)}"
        )
    if len(weights) != len(games) or any(
        isinstance(w, bool) or not isinstance(w, int) or w < 1 for w in weights
    ):
        raise ValueError(
            f"weights are {weights!r}, expected {len(games)} whole numbers of 1 or more, one a game"
        )
