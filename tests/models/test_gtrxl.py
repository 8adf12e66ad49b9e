"""GTrXL is the paper's layer with rotated positions; its numbers are pinned."""

import pytest
import torch
from torch import Tensor, nn

from arcade_torch.models import make_memory
from arcade_torch.models.gtrxl import GRUGate
from tests.models.zoo import F64, assert_each_episode, pinned_pass, starts


def norm(x: Tensor, layer: nn.LayerNorm) -> Tensor:
    """Of one vector."""
    centred = x - x.mean()
    return centred / (centred.square().mean() + 1e-5).sqrt() * layer.weight + layer.bias


def gate(layer: GRUGate, x: Tensor, y: Tensor) -> Tensor:
    """Section 3.2 of the paper, from the single matrices."""
    w_r, w_z, w_g = layer.from_new.weight.chunk(3)
    u_r, u_z = layer.from_old.weight.chunk(2)
    r = torch.sigmoid(w_r @ y + u_r @ x)
    z = torch.sigmoid(w_z @ y + u_z @ x - layer.bias)
    h = torch.tanh(w_g @ y + layer.candidate_from_old.weight @ (r * x))
    return (1 - z) * x + z * h


def oracle(memory: nn.Module, x: Tensor) -> Tensor:
    """One query at a time, positions as complex rotations."""
    width = memory.hidden_size
    pairs = width // 2
    speed = 10_000.0 ** (-torch.arange(pairs, dtype=F64) / pairs)

    def turned(vector: Tensor, position: int) -> Tensor:
        numbers = torch.view_as_complex(vector.view(pairs, 2))
        return numbers * torch.polar(torch.ones_like(speed), position * speed)

    x = memory.embed(x)
    first, linear, _, last = memory.feedforward
    read = [norm(x_t, memory.attention_norm) for x_t in x]
    outputs = []
    for t in range(len(x)):
        window = range(max(0, t - memory.attention.window + 1), t + 1)
        q = turned(memory.attention.query(read[t]), t)
        scores = []
        for j in window:
            k = turned(memory.attention.key(read[j]), j)
            scores.append((q * k.conj()).sum().real / width**0.5)
        weights = torch.softmax(torch.stack(scores), 0)
        values = torch.stack([memory.attention.value(read[j]) for j in window])
        a = gate(memory.attention_gate, x[t], torch.relu(weights @ values))
        b = last(torch.relu(linear(norm(a, first))))
        outputs.append(gate(memory.feedforward_gate, a, torch.relu(b)))
    return torch.stack(outputs)


@pytest.mark.parametrize("sizes", [(4, 4), (3, 6)])
@pytest.mark.parametrize("window", [3, 128])
def test_it_is_the_papers_layer(sizes: tuple[int, int], window: int) -> None:
    memory = make_memory("gtrxl", *sizes, window=window, gate_bias=0.5).double()
    assert_each_episode(memory, lambda x: oracle(memory, x))


@pytest.mark.parametrize("window", [1, 2, 5])
def test_a_step_is_seen_for_exactly_the_window(window: int) -> None:
    memory = make_memory("gtrxl", 3, 4, window=window)
    x = torch.randn(1, 12, 3)
    changed = x.clone()
    changed[:, 4] += 1
    flags = starts((), length=12)
    y, _ = memory(x, memory.initial_state(1), flags)
    other, _ = memory(changed, memory.initial_state(1), flags)
    differs = (y != other).any(-1)[0]
    assert differs.nonzero().flatten().tolist() == list(range(4, 4 + window))


def test_it_begins_near_the_identity() -> None:
    memory = make_memory("gtrxl", 64, 64, gate_bias=20.0)
    x = torch.randn(2, 9, 64)
    y, _ = memory(x, memory.initial_state(2), torch.zeros(2, 9, dtype=torch.bool))
    torch.testing.assert_close(y, x, rtol=0, atol=1e-6)
    bias = make_memory("gtrxl", 4, 4).attention_gate.bias
    assert (bias == 2).all()


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass(make_memory("gtrxl", 2, 2, window=2))
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-6)


PINNED = [[-0.04906750, 0.02984912], [0.01142986, -0.09464781], [-0.28096070, 0.04029180]]
