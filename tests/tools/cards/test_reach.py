"""Gradient reach and context length of toys whose answer is known."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import make_memory
from arcade_torch.tools.cards.reach import context_length, gradient_reach


class DelayLine(nn.Module):
    """y_t = x_{t - k}, zeros before."""

    def __init__(self, delay: int) -> None:
        super().__init__()
        self.input_size = 3
        self.delay = delay

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        assert is_init[:, 0].all() and not is_init[:, 1:].any()
        padded = torch.cat([torch.zeros_like(x[:, :1]).repeat(1, self.delay, 1), x], dim=1)
        return padded[:, : x.shape[1]], state

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({}, batch_size=[batch_size])


class Decay(DelayLine):
    """h_t = rate h_{t-1} + x_t."""

    def __init__(self, rate: float) -> None:
        super().__init__(0)
        self.rate = rate

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = torch.zeros_like(x[:, 0])
        outputs = []
        for t in range(x.shape[1]):
            h = self.rate * h + x[:, t]
            outputs.append(h)
        return torch.stack(outputs, dim=1), state


class Deaf(DelayLine):
    """Outputs that depend on nothing."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        return torch.zeros_like(x), state


@pytest.mark.parametrize("delay", [0, 1, 7, 20])
def test_a_delay_line_reaches_exactly_its_delay_and_nowhere_else(delay: int) -> None:
    reach = gradient_reach(DelayLine(delay), lags=20)
    np.testing.assert_allclose(reach.norms, np.eye(21)[delay], atol=1e-12)
    assert reach.horizon() == reach.horizon(0.1) == delay
    context = context_length(DelayLine(delay), longest=80)
    assert (context.steps, context.exact) == (delay, True)


@pytest.mark.parametrize("rate", [0.5, 0.9])
def test_an_exponential_decay_reaches_back_at_its_rate(rate: float) -> None:
    reach = gradient_reach(Decay(rate), lags=40)
    np.testing.assert_allclose(reach.norms, rate ** np.arange(41), rtol=1e-9)
    assert reach.horizon(0.1) == int(np.log(0.1) / np.log(rate))


def test_what_counts_decides_the_context_of_a_decay() -> None:
    lengths = [context_length(Decay(0.5), 120, share).steps for share in (1e-2, 1e-4, 1e-8)]
    expected = [np.log(share) / np.log(0.5) for share in (1e-2, 1e-4, 1e-8)]
    np.testing.assert_allclose(lengths, expected, atol=3)  # random inputs differ in size
    faint = context_length(Decay(0.5), 120, 0.01)
    assert not faint.exact and faint.text.endswith("steps, fading out")
    assert context_length(Decay(1.0), 12).text == "12 steps or more"


def test_no_memory_is_zero_and_a_window_ends_where_it_ends() -> None:
    for memory in (make_memory("mlp", 3, 4), Deaf(0)):
        assert gradient_reach(memory, 8).horizon() == 0
        assert (context_length(memory, 8).steps, context_length(memory, 8).exact) == (0, True)
    assert not gradient_reach(Deaf(0), 8).norms.any()
    window = make_memory("attention", 4, 4, window=9)
    stack = make_memory("frame_stack", 4, 4, frames=5)
    for memory, steps in ((window, 8), (stack, 4)):
        context = context_length(memory, 30)
        assert (context.steps, context.exact) == (steps, True)
        assert gradient_reach(memory, 30).horizon(0.0001) == steps


def test_the_memory_itself_is_left_alone() -> None:
    memory: Any = make_memory("gru", 3, 4).train()
    before = {name: value.clone() for name, value in memory.state_dict().items()}
    gradient_reach(memory, 4)
    context_length(memory, 4)
    assert memory.training and next(memory.parameters()).dtype == torch.float32
    assert all(torch.equal(value, before[name]) for name, value in memory.state_dict().items())


def test_bad_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="lags"):
        gradient_reach(Deaf(0), -1)
    with pytest.raises(ValueError, match="threshold"):
        context_length(Deaf(0), 4, 1.0)
    memory = Deaf(0)
    memory.input_size = None  # type: ignore[assignment]
    with pytest.raises(ValueError, match="input_size of Deaf is None"):
        gradient_reach(memory)
