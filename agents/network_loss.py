"""What the losses share: networks whose weights the loss holds, also in a copy and after a move."""

import copy
from collections.abc import Callable
from typing import Any, Literal, Self

from tensordict import TensorDictParams
from torchrl.objectives import LossModule

from arcade_torch.envs_jax.validation import kind_of

__all__ = ["NetworkLoss", "Reduction", "check_actor"]

Reduction = Literal["mean", "sum", "none"]
"""How a loss makes one number of those of all steps."""


def check_actor(network: Any) -> None:
    """Refuse (TypeError) what draws no actions."""
    if not hasattr(network, "get_dist"):
        raise TypeError(
            "actor_network must be a probabilistic TensorDict module, such as a "
            f"ProbabilisticActor; got {kind_of(network)} (of an ActorValueOperator: "
            "get_policy_operator(), get_value_operator())"
        )


class NetworkLoss(LossModule):
    """A loss that, if it is functional, holds the parameters of networks that stand beside it.

    The networks go on acting with the very tensors that the loss trains: in a copy of both as well,
    and after ``to(...)``, where TorchRL's losses leave the buffers of the networks behind.
    """

    functional = True
    network_names: tuple[str, ...] = ()

    def _apply(self, fn: Callable[..., Any], *args: Any) -> Self:
        """Convert all tensors, those of the networks too."""
        converted: Self = super()._apply(fn, *args)
        for name in self.network_names:
            params = self._modules.get(f"{name}_params", None)
            if isinstance(params, TensorDictParams):
                params.to_module(getattr(self, name))
        return converted

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy whose networks hold its own parameters, as those of this loss do.

        TensorDicts copy themselves by ``clone``, which takes no part in this: a network that is
        copied together with its loss, or that an estimator holds, would be one that nobody trains.
        """
        for params in self.children():
            if isinstance(params, TensorDictParams):
                leaves = params._param_td.apply(lambda leaf: copy.deepcopy(leaf, memo))
                memo[id(params)] = TensorDictParams(leaves, no_convert=True)
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        copied.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return copied
