"""What the tests of whole networks share."""

import torch


def count(module):
    return sum(p.numel() for p in module.parameters())


def run(network, pixels, last_action, is_init, state):
    return network.remember(network.encode(pixels), last_action, is_init, state)


def inputs(batch=2, steps=5, size=32):
    pixels = torch.randint(0, 256, (batch, steps, size, size, 3), dtype=torch.uint8)
    return pixels, torch.randint(0, 5, (batch, steps)), torch.rand(batch, steps) < 0.3
