"""Memories read tensors on the device meta, which have shapes and no data: of what is too large to
be run, shapes and memory are found so.
"""

import pytest
import torch
from tensordict import TensorDict

from arcade_torch.models import MemoryModule, make_memory, make_network, memory_names


@pytest.mark.parametrize("name", memory_names())
def test_every_memory_gives_its_shapes(name: str) -> None:
    with torch.device("meta"):
        memory = make_memory(name, 6, 8)
        flags = torch.zeros(2, 5, dtype=torch.bool)
        y, state = memory(torch.zeros(2, 5, 6), memory.initial_state(2), flags)
        y.sum().backward()
    assert y.is_meta and y.shape == (2, 5, 8)
    first = make_memory(name, 6, 8).initial_state(2)
    for key, leaf in first.items(True, True):
        assert (state[key].shape, state[key].dtype) == (leaf.shape, leaf.dtype), key
    assert all(p.grad is None or p.grad.is_meta for p in memory.parameters())


def test_a_memory_module_and_a_network_do_too() -> None:
    with torch.device("meta"):
        module = MemoryModule(make_memory("gru", 6, 8), in_key="x", out_key="y")
        network = make_network("small", "gru")
    flags = torch.zeros(3, 1, dtype=torch.bool, device="meta")
    steps = TensorDict({"x": torch.zeros(3, 6, device="meta"), "is_init": flags}, [3])
    steps["memory"] = module.memory.initial_state(3)
    assert module(steps)["y"].shape == (3, 8)
    frames = torch.zeros(3, 128, 128, 3, dtype=torch.uint8, device="meta")
    last_action = torch.zeros(3, dtype=torch.int64, device="meta")
    seen = TensorDict({"pixels": frames, "last_action": last_action, "is_init": flags}, [3])
    seen["memory"] = network.initial_state(3)
    assert network(seen)["action_value"].shape == (3, 5)
