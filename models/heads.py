"""What stands behind the memory: from its output to one number per action."""

import torch
from torch import nn

__all__ = ["HEADS", "make_head"]

HEADS = ("reference", "paper", "actor_critic", "linear", "plain")


def make_head(name: str, input_size: int, num_outputs: int) -> nn.Module:
    """Make an output head.

    Args:
        name: "reference": Linear to 256, Linear (no activation between, as in the published Q-networks);
            "paper": Linear to 256, Linear 256, LeakyReLU, LayerNorm, Linear (the paper's table; the LayerNorm has
            parameters, which the table leaves open); "actor_critic": the same with LayerNorm before LeakyReLU, as in
            the published PPO networks; "linear": one Linear, initial weights a tenth of torch's, bias 0 (small initial
            values, so that action gaps are not drowned by the noise of the start); "plain": one Linear.
        input_size: H.
        num_outputs: A.

    Returns:
        module [..., H] -> [..., A].

    Raises:
        ValueError: unknown name.
    """
    if name == "reference":
        return nn.Sequential(nn.Linear(input_size, 256), nn.Linear(256, num_outputs))
    if name == "paper":
        middle: tuple[nn.Module, ...] = (nn.Linear(256, 256), nn.LeakyReLU(inplace=True), nn.LayerNorm(256))
        return nn.Sequential(nn.Linear(input_size, 256), *middle, nn.Linear(256, num_outputs))
    if name == "actor_critic":
        middle = (nn.Linear(256, 256), nn.LayerNorm(256), nn.LeakyReLU(inplace=True))
        return nn.Sequential(nn.Linear(input_size, 256), *middle, nn.Linear(256, num_outputs))
    if name == "plain":
        return nn.Linear(input_size, num_outputs)
    if name == "linear":
        head = nn.Linear(input_size, num_outputs)
        with torch.no_grad():
            head.weight.mul_(0.1)
            head.bias.zero_()
        return head
    raise ValueError(f"head must be one of {', '.join(HEADS)}, got {name!r}")
