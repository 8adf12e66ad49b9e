"""What Gymnasium's users do with an env besides stepping it: copy it, pickle it, read its time limit."""

import copy
from typing import Any


class Copyable:
    """An env that ``copy`` and ``pickle`` make again from its arguments and its state; both then walk the same path.

    A class that has this as a base calls ``_made_with`` in its constructor and names its own fields in ``_STATE``.
    """

    _STATE: tuple[str, ...] = ()
    _batch: Any
    _spec: Any = None

    def _made_with(self, **arguments: Any) -> None:
        self._arguments = arguments

    def __reduce__(self) -> tuple[Any, ...]:
        fields = {name: copy.copy(getattr(self, name)) for name in (*self._STATE, "_np_random", "_np_random_seed")}
        state = {"batch": self._batch.saved(), "fields": copy.deepcopy(fields), "spec": self._spec}
        return _made_again, (type(self), self._arguments, state)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        make, arguments = self.__reduce__()
        return make(*arguments)

    def __copy__(self) -> Any:
        return self.__deepcopy__({})

    @property
    def spec(self) -> Any:
        """Gymnasium's description of the env, with the game's time limit, which Gymnasium itself need not keep."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = copy.deepcopy(spec)
            game = self._batch.game
            spec.max_episode_steps = game.max_steps + (game.rules == "reference")  # whose ends come a step late
        self._spec = spec


def _made_again(kind: Any, arguments: dict[str, Any], state: dict[str, Any]) -> Any:
    env = kind(**arguments)
    env._batch.load(state["batch"])
    for name, value in copy.deepcopy(state["fields"]).items():
        setattr(env, name, value)
    env._spec = state["spec"]
    return env
