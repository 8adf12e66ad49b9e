"""A session of play: keys in, frames, a caption and finished episodes out. Knows neither window nor
terminal.

Nothing moves on its own: one key, one step. The last picture of an episode stays until the next one
is asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from arcade_torch.agents.checked import require
from arcade_torch.compiled import CompiledGame
from arcade_torch.envs_jax import ACTION_NAMES, Game
from arcade_torch.envs_jax.registry import is_mixture
from arcade_torch.gym.batch import NumpyBatch, seed_keys
from arcade_torch.tools.play.captions import captioned
from arcade_torch.tools.text import counted

Frame = npt.NDArray[np.uint8]
End = Literal["terminated", "truncated", "abandoned"]

RESTART = "restart"
TOGGLE = "toggle"
NEXT = "next"
QUIT = "quit"
KEYS = (*ACTION_NAMES, RESTART, TOGGLE, NEXT, QUIT)
LEGEND = (
    "arrows and space play, P changes the twin, R restarts, Enter goes on after an end, Esc quits"
)


@dataclass(frozen=True)
class Attempt:
    """One episode, enough to play it again."""

    seed: int  # the episode is that of env 0 of an ``ArcadeEnv`` with this seed
    attempt: int  # 1, or more after restarts of the same episode
    # ``full``, ``partial``, ``both`` (side by side) or ``mixed`` (changed in mid-episode)
    observability: str
    actions: str  # one digit a step, 0 to 4
    total: float  # undiscounted return so far
    # ``terminated`` by the game, ``truncated`` by the time limit, or ``abandoned`` by the player
    end: End

    @property
    def steps(self) -> int:
        """Number of actions."""
        return len(self.actions)

    def __str__(self) -> str:
        return f"return {self.total:+.3f} in {counted(self.steps, 'step')}, {self.end}"


class Session:
    """One player at one game.

    ``seed`` and ``end`` (None while it runs) are those of the running episode; a ``closed`` session
    hears nothing.

    Args:
        game: what is played.
        seed: of the first episode; each further one has the next.
        partial: show the POMDP twin.
        both: show both twins, the MDP on the left.
        episodes: end after so many finished episodes; 0 for never.
        on_attempt: called with every episode that ended or was abandoned after its first step.

    Raises:
        ValueError: several games, a negative number of episodes, or a seed out of range.

    Example:
        >>> from arcade_torch.compiled import compiled_game
        >>> session = Session(compiled_game("MineSweeperEasy", 128, "default", {}))
        >>> session.press("right")
        >>> session.steps, session.frame.shape
        (1, (128, 128, 3))
    """

    end: Literal["terminated", "truncated"] | None
    _mixed: bool

    def __init__(
        self,
        game: CompiledGame,
        *,
        seed: int = 0,
        partial: bool = False,
        both: bool = False,
        episodes: int = 0,
        on_attempt: Callable[[Attempt], None] = lambda attempt: None,
    ) -> None:
        require(episodes >= 0, "episodes", episodes, "0 (no end) or more")
        played = game.batched.game.id
        require(not is_mixture(played), "the game", played, "one game, not several")
        self._batch = NumpyBatch(game, np.zeros(1, bool))
        self.partial = partial
        self.both = both
        self.seed = seed
        self.finished = 0
        self.closed = False
        self._episodes = episodes
        self._on_attempt = on_attempt
        self._attempt = 0
        self._begin(seed)

    @property
    def game(self) -> Game[Any]:
        """The game that is played."""
        return self._batch.game

    @property
    def state(self) -> Any:
        """The game's state, numpy leaves [1, ...]: what a state oracle sees."""
        return self._batch.state

    @property
    def steps(self) -> int:
        """Steps of the running episode."""
        return len(self._actions)

    @property
    def total(self) -> float:
        """Return of the running episode so far."""
        return float(self._batch.info["episode_reward"][0])

    def view(self, partial: bool) -> Frame:
        """What one twin shows now, uint8 [1, S, S, 3]."""
        return self._batch.draw(np.array([partial]))

    @property
    def frame(self) -> Frame:
        """What the player sees: uint8 [S, S, 3], or [S, 2 S, 3] with both twins."""
        return np.concatenate([self.view(partial)[0] for partial in self._twins], axis=1)

    @property
    def picture(self) -> Frame:
        """The frame, under the names of the twins that it shows."""
        return captioned(self.frame, self._twins)

    @property
    def _twins(self) -> tuple[bool, ...]:
        """Which twins are seen, by whether they are partial."""
        return (False, True) if self.both else (self.partial,)

    @property
    def caption(self) -> str:
        """Game, twin, return, steps and last reward in one line."""
        twin = "MDP | POMDP" if self.both else "POMDP" if self.partial else "MDP"
        numbers = (
            f"return {self.total:+.3f}  steps {self.steps}/{self.game.max_steps}  last "
            f"{self._reward:+.3f}"
        )
        why = {None: "", "terminated": "  over", "truncated": "  time is up"}[self.end]
        what_now = (
            f": Enter {'ends' if self._all_played() else 'for the next'}, Esc quits" if why else ""
        )
        return f"{self.game.id} {twin}  {numbers}{why}{what_now}"

    def press(self, key: str) -> None:
        """React to one of ``KEYS``."""
        require(key in KEYS, "key", key, f"one of {', '.join(KEYS)}")
        if self.closed:
            return
        if key == TOGGLE:
            if not self.both:
                self.partial = not self.partial
                self._mixed |= self.end is None
        elif key in ACTION_NAMES:
            if self.end is None:
                action = ACTION_NAMES.index(key)
                stepped = self._batch.step(np.array([action], np.int32))
                self._actions.append(action)
                self._reward = float(stepped.reward[0])
                if stepped.terminated[0] or stepped.truncated[0]:
                    self.end = "terminated" if stepped.terminated[0] else "truncated"
                    self.finished += 1
                    self._report(self.end)
        elif key == QUIT or (key == NEXT and self.end is not None and self._all_played()):
            self._abandon()
            self.closed = True
        elif key == NEXT and self.end is not None:  # leave the last picture
            self._begin((self.seed + 1) % 2**32)
        elif key == RESTART and self.end is None:  # what has ended counts
            self._abandon()
            self._begin(self.seed)

    def _begin(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self._attempt = self._attempt + 1 if seed == self.seed else 1
        self.seed = seed
        self._batch.reset(np.ones(1, bool), seed_keys(seed, 1))
        self._actions: list[int] = []
        self._reward = 0.0
        self._mixed = False
        self.end = None

    def _all_played(self) -> bool:
        return 0 < self._episodes <= self.finished

    def _abandon(self) -> None:
        """Report the running episode, if there is anything to report."""
        if self.end is None and self._actions:
            self._report("abandoned")

    def _report(self, end: End) -> None:
        twin = "partial" if self.partial else "full"
        if self._mixed:
            twin = "mixed"
        if self.both:
            twin = "both"
        actions = "".join(map(str, self._actions))
        self._on_attempt(Attempt(self.seed, self._attempt, twin, actions, self.total, end))
