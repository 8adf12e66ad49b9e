"""TorchRL's methods that would lose something in silence, for the envs of the package."""

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from arcade_torch.process import warn
from arcade_torch.validation import warn_state_is_dropped


class BaseEnv(EnvBase):
    """What ``ArcadeEnv`` and the envs of ``from_jax`` share."""

    def rollout(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """TorchRL's ``rollout``, which warns if a policy wrote for the next step what was dropped,
        since no spec of the env names it: a recurrent state.

        Raises:
            ValueError: ``out`` has no entries; TorchRL fills those that are there.
        """
        out = kwargs.get("out")
        if out is not None and out.is_empty():
            raise ValueError(
                "out must be a batch of the same rollout, whose entries are written over; got one "
                "without entries, which would stay empty: leave out away the first time"
            )
        steps: TensorDictBase = super().rollout(*args, **kwargs)
        specs = (self.full_observation_spec, self.full_reward_spec, self.full_done_spec)
        carried = set()
        for spec in specs:
            carried.update(spec.keys(True, True))
        after = steps.get("next", None)  # TorchRL leaves out what ``out`` has no entry for
        dropped = set() if after is None else set(after.keys(True, True)) - carried
        if dropped:
            warn_state_is_dropped(*sorted(dropped, key=str))
        return steps

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Go on from what ``state_dict`` gave; an empty one, which TorchRL's ``Collector`` saves of
        an env, leaves the episodes as they are, with a warning.
        """
        if not state_dict:
            warn(
                "the state_dict holds no env, as that of TorchRL's Collector: the episodes go on "
                "where they are. ArcadeCollector saves them, or save env.state_dict() yourself"
            )
            strict = False
        return super().load_state_dict(state_dict, strict, assign)
