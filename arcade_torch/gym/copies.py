"""What Gymnasium's users do with an env besides stepping it: copy it, and read its time limit."""

import copy
from typing import Any


class Copyable:
    """An env whose copies and pickles walk the same path, and whose ``spec`` knows the game's time
    limit.
    """

    _batch: Any
    _spec: Any = None

    def __copy__(self) -> Any:
        """A copy that shares nothing: two envs with one state would move each other."""
        return copy.deepcopy(self)

    @property
    def spec(self) -> Any:
        """Gymnasium's description of the env, with the game's time limit, which Gymnasium itself
        need not keep.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = copy.deepcopy(spec)
            spec.max_episode_steps = self.time_limit
        self._spec = spec

    @property
    def time_limit(self) -> int:
        """The steps of the longest episode: by the reference rules one more than the game's limit,
        for there some games end a step late.
        """
        game = self._batch.game
        return int(game.max_steps + (game.rules == "reference"))
