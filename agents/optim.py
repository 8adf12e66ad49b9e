"""The optimisers of the learners, behind a global-norm clip."""

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor, nn


def make_optimizer(
    parameters: Iterable[nn.Parameter], learning_rate: float, kind: Literal["radam", "adam"] = "radam"
) -> torch.optim.Optimizer:
    """RAdam (PQN, DQN; eps 1e-8) or Adam (PPO; eps 1e-5) with the constants of the paper: betas 0.9, 0.999, no decay.

    Args:
        parameters: what to train.
        learning_rate: initial step size; :func:`set_learning_rate` moves it.
        kind: which of the two.

    Returns:
        The optimiser, with the multi-tensor implementation where that is the faster one.

    Source: Liu et al., "On the variance of the adaptive learning rate and beyond", arXiv 1908.03265;
    Kingma & Ba, arXiv 1412.6980.
    """
    if kind == "adam":
        return torch.optim.Adam(list(parameters), lr=learning_rate, betas=(0.9, 0.999), eps=1e-5, foreach=True)
    return torch.optim.RAdam(list(parameters), lr=learning_rate, betas=(0.9, 0.999), eps=1e-8, foreach=True)


def set_learning_rate(optimizer: torch.optim.Optimizer, learning_rate: float) -> None:
    """Give every parameter group the same step size."""
    for group in optimizer.param_groups:
        group["lr"] = learning_rate


def clip_gradients(parameters: list[nn.Parameter], max_norm: float) -> Tensor:
    """Scale all gradients so that their joint norm is at most ``max_norm``.

    Args:
        parameters: trained parameters; those without a gradient are skipped.
        max_norm: largest allowed Euclidean norm, > 0.

    Returns:
        float32 scalar, the norm before clipping. It is not finite if any gradient is not.
    """
    return nn.utils.clip_grad_norm_(parameters, max_norm, foreach=True)
