"""Shares of kinds of operation: they add up, and go to what the time was spent on."""

import time

import torch
from torch.nn import functional as F

from arcade_torch.tools.bench.kinds import KINDS, REST, kind_of, shares_of_kinds

CPU = torch.device("cpu")


def test_shares_add_up_and_backward_counts() -> None:
    x, weight = torch.randn(4, 8, 32, 32), torch.randn(16, 8, 3, 3, requires_grad=True)
    shares = shares_of_kinds(lambda: F.max_pool2d(F.conv2d(x, weight), 2).sum().backward(), CPU)
    assert set(shares) == {*KINDS, REST} and abs(sum(shares.values()) - 1) < 1e-9
    assert shares["convolutions"] > 0 and shares["pooling"] > 0
    assert shares["recurrence"] == 0


def test_time_between_operations_is_the_rest() -> None:
    shares = shares_of_kinds(lambda: (torch.randn(8, 8) @ torch.randn(8, 8), time.sleep(0.05)), CPU)
    assert shares[REST] > 0.9


def test_names_of_both_ways_to_measure() -> None:
    for name in ("aten::convolution", "aten::mkldnn_convolution", "aten::convolution_backward", "cudnn_convolution"):
        assert kind_of(name) == "convolutions"
    assert kind_of("arcade_torch::linear_scan_backward") == "recurrence"
    assert kind_of("aten::_foreach_sqrt") == REST
