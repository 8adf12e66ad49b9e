"""What the tests of the bridge compare batches with."""

import torch
from tensordict import TensorDictBase


def assert_same(one: TensorDictBase, two: TensorDictBase) -> None:
    """Same keys, same bits."""
    keys = set(one.keys(True, True))
    assert keys == set(two.keys(True, True))
    different = [key for key in keys if not torch.equal(one[key], two[key])]
    assert not different, different
