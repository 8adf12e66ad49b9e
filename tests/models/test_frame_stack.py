"""Frame stacking sees the last k inputs of the episode and nothing else; its numbers are pinned."""

import pytest
import torch
from torch.nn import functional as F

from arcade_torch.models import make_memory

F64 = torch.float64


@pytest.mark.parametrize("frames", [2, 4, 7])
def test_it_is_one_layer_on_the_last_inputs_of_the_episode(frames: int) -> None:
    memory = make_memory("frame_stack", 3, 5, frames=frames).double()
    x = torch.randn(2, 12, 3, dtype=F64)
    is_init = torch.zeros(2, 12, dtype=torch.bool)
    is_init[0, [0, 5]] = True
    is_init[1, 9] = True
    y, state = memory(x, memory.initial_state(2), is_init)
    for row in range(2):
        seen: list[torch.Tensor] = []
        for t in range(12):
            if is_init[row, t]:
                seen = []
            seen = [x[row, t], *seen][:frames]
            padded = seen + [torch.zeros(3, dtype=F64)] * (frames - len(seen))
            wanted = F.leaky_relu(memory.linear(torch.cat(padded)))
            torch.testing.assert_close(y[row, t], wanted, rtol=0, atol=1e-14)
        torch.testing.assert_close(state["h"][row], torch.stack(padded[:-1]), rtol=0, atol=0)


def test_nothing_older_than_its_frames_has_any_influence() -> None:
    memory = make_memory("frame_stack", 3, 5, frames=4)
    x = torch.randn(1, 10, 3, requires_grad=True)
    y, _ = memory(x, memory.initial_state(1), torch.zeros(1, 10, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(y[:, -1].square().sum(), x)
    reached = gradient[0].abs().sum(dim=-1) > 0
    assert reached.tolist() == [False] * 6 + [True] * 4


def test_fewer_than_two_frames_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^frames must be at least 2 .*got 1; 'mlp' sees one$"):
        make_memory("frame_stack", 3, 5, frames=1)


@torch.no_grad()
def test_one_forward_pass_is_pinned() -> None:
    memory = make_memory("frame_stack", 2, 2, frames=3).double()
    for number, parameter in enumerate(memory.parameters(), 1):
        places = torch.arange(parameter.numel(), dtype=F64)
        parameter.copy_(torch.sin(number + places).view_as(parameter))
    x = torch.cos(torch.arange(6, dtype=F64)).view(1, 3, 2)
    y, _ = memory(x, memory.initial_state(1), torch.zeros(1, 3, dtype=torch.bool))
    torch.testing.assert_close(y[0], torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-6)


PINNED = [[2.24206394, 1.33265915], [-0.00608858, -0.00993558], [0.19781761, -0.00930498]]
"""Of NumPy, one step at a time."""
