"""Both games side by side: the same states, the same actions, every step compared.

Half of the envs play at random from published first states. The others look for rare events: they
hold on to an action for long, or follow the oracle, and half of their episodes begin near an end of
the game or near the time limit.
"""

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.game import NUM_ACTIONS, Rules
from arcade_torch.envs_jax.oracles import make_oracle
from tests.parity.reference import resets, without_picture
from tests.parity.translation import Array, Translation, cast
from tests.parity.translations import translation_of

RANDOM_ENVS = 16
OTHER_ENVS = 16
STEPS = (
    640  # times 16 envs: 10,240 random steps a task, and whole episodes of all but the longest ones
)
NEAR = 12  # steps from the limit at which a hurried episode begins, at most
REWARD_TOLERANCE = 1e-6


class Pair(NamedTuple):
    """The same N states twice."""

    theirs: Any
    ours: Any


class Seen(NamedTuple):
    """What one step showed, [N] each."""

    done: Array  # an episode ended, in either game
    limit: Array  # at the time limit
    reward: Array  # the rewards differ
    ending: Array  # one game ended and the other did not
    flags: Array  # the reported flags differ
    state: Array  # the states differ, translated to ours
    back: Array  # the states differ, translated to theirs


@dataclass
class Tally:
    """Counts over all steps of one kind of play.

    Attributes:
        steps: steps of both games.
        episodes: episodes that ended.
        limits: those at the time limit.
        reward: steps whose rewards differ by more than a millionth.
        ending: steps at which one game ended alone.
        flags: steps whose terminated or truncated is not what the translation expects.
        state: steps after which the states differ.
        back: the same, after translating ours to theirs (mid-episode only).
    """

    steps: int = 0
    episodes: int = 0
    limits: int = 0
    reward: int = 0
    ending: int = 0
    flags: int = 0
    state: int = 0
    back: int = 0

    def add(self, seen: Seen, rows: slice) -> None:
        """Count one step of the envs in ``rows``."""
        counts = {name: int(mask[rows].sum()) for name, mask in seen._asdict().items()}
        self.steps += len(seen.done[rows])
        self.episodes += counts["done"]
        self.limits += counts["limit"]
        for name in ("reward", "ending", "flags", "state", "back"):
            setattr(self, name, getattr(self, name) + counts[name])

    @property
    def mismatches(self) -> dict[str, int]:
        """The kinds of mismatch that occurred."""
        kinds = ("reward", "ending", "flags", "state", "back")
        return {name: count for name, count in asdict(self).items() if name in kinds and count}


def differs(left: Any, right: Any, tolerance: float) -> Array:
    """Whether two states of one shape differ anywhere (bool scalar)."""

    def leaf(a: Array, b: Array) -> Array:
        if jnp.issubdtype(a.dtype, jnp.floating):
            return jnp.any(jnp.abs(a - b) > tolerance)
        return jnp.any(a != b)

    return jnp.stack(jax.tree.leaves(jax.tree.map(leaf, left, right))).any()


class SideBySide:
    """The published game and ours, compiled for one task."""

    def __init__(self, task: str, rules: Rules) -> None:
        self.game: Any = make(task, rules=rules)
        self.reference, self.params = without_picture(task)
        self.translation: Translation = translation_of(task)
        self.to_ours = partial(self.translation.to_ours, self.game)
        self.begin = jax.jit(self._begin, static_argnums=1)
        self.advance = jax.jit(self._advance)

    def _advance(self, key: Array, index: Array, pair: Pair, action: Array) -> tuple[Pair, Seen]:
        """One step of all envs; where an episode ended in either game, both begin the same new
        one.
        """
        envs = len(action)
        for_step, for_begin = jax.random.split(jax.random.fold_in(key, index))
        stepped, seen = jax.vmap(self._step)(jax.random.split(for_step, envs), pair, action)
        return Pair(*choose(seen.done, self._begin(for_begin, envs), stepped)), seen

    def _step(self, key: Array, pair: Pair, action: Array) -> tuple[Pair, Seen]:
        """One step of one env."""
        say, theirs = self.translation, pair.theirs
        for_them, for_us = jax.random.split(key)
        _, then, their_reward, their_done, info = self.reference.step_env(
            for_them, theirs, action, self.params
        )
        then = cast(theirs, {name: getattr(then, name) for name in theirs.__dataclass_fields__})
        before = say.inject(self.game, pair.ours, theirs, then)
        ours, reward, terminated, truncated = self.game.step(for_us, before, action)
        done = terminated | truncated
        flags = say.reported(self.game, ours, terminated, truncated)
        ours = say.adopt(self.game, ours, then)._replace(
            terminated=None, truncated=None
        )  # theirs say nothing of it
        back = cast(then, say.to_theirs(self.game, ours))
        either = done | their_done
        seen = Seen(
            done=either,
            limit=truncated,
            reward=jnp.abs(reward - their_reward) > REWARD_TOLERANCE,
            ending=done != their_done,
            flags=(flags[0] != (info["terminated"] > 0)) | (flags[1] != info["truncated"]),
            state=differs(self.to_ours(then), ours, say.tolerance),
            back=differs(then, back, say.tolerance) & ~either,
        )
        return Pair(then, self.to_ours(then) if say.resync else ours), seen

    def _begin(self, key: Array, envs: int) -> Pair:
        """First states: published ones, and half of those of the second half of the envs led near
        an end.
        """
        for_reset, for_hasten, for_near, for_which = jax.random.split(key, 4)
        theirs = resets(self.reference, for_reset, envs, self.params)
        ours = jax.vmap(self.to_ours)(theirs)
        hasten = partial(self.translation.hasten, game=self.game)
        near = jax.vmap(lambda key, ours: hasten(key, ours=ours))(
            jax.random.split(for_hasten, envs), ours
        )
        which = jax.random.uniform(for_which, (2, envs)) < 0.5
        hasty, late = which & (jnp.arange(envs) >= RANDOM_ENVS)
        ours = choose(hasty, near, ours)
        clock = self.game.max_steps - jax.random.randint(for_near, (envs,), 1, NEAR + 1)
        pushed = ours._replace(**{self.translation.clock: clock})
        ours = choose(late, pushed, ours)
        again = jax.vmap(
            lambda like, ours: cast(like, self.translation.to_theirs(self.game, ours))
        )(theirs, ours)
        return Pair(choose(hasty | late, again, theirs), ours)


def choose(mask: Array, yes: Any, no: Any) -> Any:
    """Rows of one pytree or another by a bool [N] mask."""

    def leaf(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (b.ndim - 1)), a, b)

    return jax.tree.map(leaf, yes, no)


class Actions:
    """Who plays which env: random ones first, then the stubborn and the wise in turns."""

    def __init__(self, game: Any, envs: int, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.oracle = make_oracle(game)
        self.kind = np.where(np.arange(envs) < RANDOM_ENVS, 0, 1 + np.arange(envs) % 2)
        self.hold = np.where(np.arange(envs) % 4 == 0, 0.98, 0.8)
        self.last = np.zeros(envs, np.int32)

    def next(self, ours: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """int32 [N]."""
        envs = len(is_init)
        fresh = self.rng.integers(NUM_ACTIONS, size=envs, dtype=np.int32)
        chance = self.rng.random(envs)
        wise = self.oracle.act(ours, is_init).astype(np.int32)
        stubborn = np.where(chance < self.hold, self.last, fresh)
        guided = np.where(chance < 0.9, wise, fresh)
        self.last = np.select([self.kind == 0, self.kind == 1], [fresh, stubborn], guided)
        return self.last


def walk(
    task: str, rules: Rules = "reference", steps: int = STEPS, seed: int = 0
) -> tuple[Tally, Tally]:
    """Compare a task over ``steps`` steps of all envs.

    Returns:
        Counts of the envs that play at random, and of the others.
    """
    envs = RANDOM_ENVS + OTHER_ENVS
    both = SideBySide(task, rules)
    actions = Actions(both.game, envs, seed)
    key, for_begin = jax.random.split(jax.random.PRNGKey(seed))
    pair = both.begin(for_begin, envs)
    is_init = np.ones(envs, bool)
    plain, others = Tally(), Tally()
    for index in range(steps):
        action = actions.next(jax.device_get(pair.ours), is_init)
        pair, compared = both.advance(key, np.int32(index), pair, action)
        seen = jax.device_get(compared)
        plain.add(seen, slice(0, RANDOM_ENVS))
        others.add(seen, slice(RANDOM_ENVS, None))
        is_init = seen.done
    return plain, others
