"""Actors: policies that draw an action from the softmax of a network's logits."""

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor


class Choice(Categorical):
    """A categorical distribution that samples something even where logits are NaN.

    ``torch.multinomial`` stops the process there (on CUDA for good), before the learner can name
    the update.
    """

    deterministic_sample = Categorical.mode  # the name that TorchRL asks for

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw by the largest of ``logits + Gumbel noise``, int64 [*sample_shape, *batch]."""
        logits = self.logits.expand(*sample_shape, *self.logits.shape)
        return (logits - torch.empty_like(logits).exponential_().log()).argmax(-1)


def make_actor(network: TensorDictModuleBase, deterministic: bool = False) -> ProbabilisticActor:
    """A policy that samples from the softmax of ``logits``.

    Args:
        network: any TensorDict module that writes ``logits`` [*, A].
        deterministic: take the most likely action unless told otherwise (``set_exploration_type``).

    Returns:
        TorchRL's ``ProbabilisticActor``; writes ``action`` int64 [*] and ``action_log_prob``.
    """
    return ProbabilisticActor(
        network,
        in_keys=["logits"],
        distribution_class=Choice,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
        default_interaction_type=ExplorationType.DETERMINISTIC
        if deterministic
        else ExplorationType.RANDOM,
    )
