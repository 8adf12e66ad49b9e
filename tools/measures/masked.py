"""Outputs of policies side by side, where actions that are masked out have minus infinity."""

import torch
from torch import Tensor

from arcade_torch.agents.checked import require

LEAST = -103.3
"""The logarithm of the smallest number of single precision: below it a softmax says 0."""


def refuse_nan(out: Tensor) -> None:
    """Refuse outputs that are no numbers: NaN and infinity are the best action of any comparison.

    Raises:
        ValueError: one of them is NaN, or infinity; minus infinity is an action that is masked out.
    """
    wrong = out.isnan() | (out == torch.inf)
    if bool(wrong.any()):
        got = "NaN" if bool(out.isnan().any()) else "infinity, where minus infinity is a mask"
        raise ValueError(
            f"the policy's outputs must be numbers, got {got}: its weights may hold some, its "
            "state may grow beyond all bounds, or it cannot read noisy pixels (clip=True keeps "
            "them in their range)"
        )


def refuse_no_action(values: Tensor) -> None:
    """Refuse outputs of actions [A] that are all masked out.

    Raises:
        ValueError: they are.
    """
    if not bool(values.isfinite().any()):
        raise ValueError(
            "the policy must allow an action at the decision that is explained, got minus infinity "
            f"for all: all of its {len(values)} actions are masked out"
        )


def refuse_single(values: Tensor) -> None:
    """Refuse outputs of a single action [..., A], among which there is no decision.

    Raises:
        ValueError: there are not two.
    """
    require(
        values.shape[-1] > 1, "the policy's outputs", values.shape[-1], "of two actions at least"
    )


def differences(values: Tensor, others: Tensor) -> Tensor:
    """The sizes of the differences; of equal infinities 0."""
    return torch.where(values == others, 0, (values - others).abs())


def are_near(values: Tensor, others: Tensor, share: float) -> bool:
    """Whether outputs differ by no more than a share of the size of those that are finite."""
    size = others.double().nan_to_num(posinf=0.0, neginf=0.0).norm()
    return float(differences(values.double(), others.double()).norm()) <= share * float(size)


def logarithms(probs: Tensor) -> Tensor:
    """The logarithms of probabilities; minus infinity of 0, without a gradient."""
    is_possible = probs > 0  # the gradient of log(0) is no number
    return torch.where(is_possible, probs, 1).log().masked_fill(~is_possible, -torch.inf)


def hidden(values: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """Outputs [..., A] with minus infinity for actions whose logarithms of probabilities are so in
    two situations, ``p`` and ``q``; where a single action has any probability nothing is hidden.
    """
    is_out = (p == -torch.inf) & (q == -torch.inf)
    is_choice = (~is_out).sum(-1, keepdim=True) > 1
    return torch.where(is_out & is_choice, -torch.inf, values)


def centred(values: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs of actions [..., A] in two situations, minus their means; NaN for actions that are
    masked out in one of them.
    """
    refuse_single(values)
    allowed = values.isfinite() & others.isfinite()
    values = torch.where(allowed, values, torch.nan)
    others = torch.where(allowed, others, torch.nan)
    return values - values.nanmean(-1, keepdim=True), others - others.nanmean(-1, keepdim=True)


def span(values: Tensor) -> Tensor:
    """The largest of outputs [..., A] minus the smallest, [...]; NaN do not count."""
    return values.nan_to_num(-torch.inf).amax(-1) - values.nan_to_num(torch.inf).amin(-1)


def divergence(p: Tensor, q: Tensor) -> Tensor:
    """KL(p || q) in nats [...] of logarithms of probabilities [..., A]; those that are 0 in q alone
    count as `LEAST`, since one of them makes any mean infinite.
    """
    q = torch.where(q == -torch.inf, LEAST, q)
    return torch.where(p == -torch.inf, 0.0, p.exp() * (p - q)).sum(-1)
