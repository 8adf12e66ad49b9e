"""Recurrent states that one module of a policy reads and another writes: replayed as they act."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import GRUModule, LSTMModule

from arcade_torch.models import MemoryModule, make_memory
from arcade_torch.tools import as_policy, counterfactual, saliency
from tests.tools.measures.toys import SIZE, ToyEnv, frames

WIDTH = 4
STARTS = torch.tensor(
    [[True, False, False, True, False, False], [False, True, False, False, False, False]]
)


def part(forward: Callable[..., Any], reads: list[Any], writes: list[Any]) -> TensorDictModule:
    """A module of a function."""
    return TensorDictModule(forward, reads, writes)


def encoder() -> TensorDictModule:
    """The mean of each quarter of a frame, up to 1."""
    return part(
        lambda x: x.float().reshape(*x.shape[:-3], WIDTH, -1).mean(-1) / 255, ["pixels"], ["e"]
    )


def lstm() -> LSTMModule:
    """TorchRL's memory."""
    return LSTMModule(WIDTH, WIDTH, in_key="e", out_key="r")


def gru() -> GRUModule:
    """The other one."""
    return GRUModule(WIDTH, WIDTH, in_key="e", out_key="r")


def lru() -> MemoryModule:
    """One of ours."""
    return MemoryModule(make_memory("gru", WIDTH, WIDTH), "e", "r", store="step")


def of_ours(memory: MemoryModule) -> Any:
    """The key of its recurrent state."""
    (key,) = memory.state_keys
    return key


def read_first() -> list[TensorDictModuleBase]:
    """Decides by the state before, and writes the next one elsewhere: a copy one step late."""
    return [
        encoder(),
        part(lambda e, h: 3 * h + 0.1 * e, ["e", "h"], ["action_value"]),
        part(lambda e: 1 * e, ["e"], [("next", "h")]),
    ]


def written_by_the_encoder() -> list[TensorDictModuleBase]:
    """The features are the next state."""
    write = part(lambda x: (x, x), ["e"], ["f", ("next", "h")])
    return [encoder(), write, part(lambda f, h: 3 * h + 0.1 * f, ["f", "h"], ["action_value"])]


def across() -> list[TensorDictModuleBase]:
    """A loop through three modules."""
    return [
        encoder(),
        part(lambda e, h: torch.cat([e, h], -1), ["e", "h"], ["both"]),
        part(lambda both: both[..., :WIDTH] + both[..., WIDTH:] / 2, ["both"], [("next", "h")]),
        part(lambda h: 2 * h, [("next", "h")], ["action_value"]),
    ]


def changed_after() -> list[TensorDictModuleBase]:
    """The next state is halved by a module that nothing else depends on."""
    cell = part(lambda e, h: (e + 2 * h, e + h), ["e", "h"], ["action_value", ("next", "h")])
    return [encoder(), cell, part(lambda h: h / 2, [("next", "h")], [("next", "h")])]


def in_place() -> list[TensorDictModuleBase]:
    """The state is moved on before it is read."""
    move = part(lambda e, h: e + h / 2, ["e", "h"], ["h"])
    return [encoder(), move, part(lambda h: 2 * h, ["h"], ["action_value"])]


def peek_after() -> list[TensorDictModuleBase]:
    """A head that reads the state before the last frame as well."""
    head = part(lambda r, h: r + h[..., -1, :], ["r", "recurrent_state_h"], ["action_value"])
    return [encoder(), lstm(), head]


def read_after() -> list[TensorDictModuleBase]:
    """A head that reads the state of the memory in place of its output."""
    head = part(lambda h: 2 * h[..., -1, :], [("next", "recurrent_state_h")], ["action_value"])
    return [encoder(), lstm(), head]


def peek_before() -> list[TensorDictModuleBase]:
    """A module in front of the memory that reads its state."""
    peek = part(lambda e, h: e + h[..., -1, :], ["e", "recurrent_state"], ["e"])
    return [encoder(), peek, gru(), part(lambda r: 2 * r, ["r"], ["action_value"])]


def peek_at_ours() -> list[TensorDictModuleBase]:
    """The same with a memory of ours."""
    memory = lru()
    head = part(lambda r, h: r + h.flatten(-1), ["r", of_ours(memory)], ["action_value"])
    return [encoder(), memory, head]


POLICIES = [
    read_first,
    written_by_the_encoder,
    across,
    changed_after,
    in_place,
    peek_after,
    read_after,
    peek_before,
    peek_at_ours,
]


def names_of(network: TensorDictModuleBase) -> dict[str, Any]:
    """The start of the state "h", and where the next one is written."""
    if "h" not in network.in_keys:
        return {}
    after = "h" if "h" in network.out_keys else ("next", "h")
    return {
        "state_keys": {"h": after},
        "initial_state": TensorDict({"h": torch.full((WIDTH,), 0.5)}, []),
    }


def acted(
    network: TensorDictModuleBase, pixels: Tensor, starts: Tensor, start: TensorDictBase
) -> Tensor:
    """The outputs [N, T, A] of the whole policy, called step by step as it acts."""
    state = start.clone()
    outputs = list[Tensor]()
    for t in range(pixels.shape[1]):
        begins = starts[:, t]
        state = start.clone().where(begins, state)
        step = TensorDict({"pixels": pixels[:, t], "is_init": begins[:, None]}, [len(pixels)])
        step = network(step.update(state))
        for key in start.keys(True, True):
            path = key if isinstance(key, tuple) else (key,)
            state[key] = step[key] if "h" in network.out_keys else step[("next", *path)]
        outputs.append(step["action_value"])
    return torch.stack(outputs, 1)


@pytest.mark.parametrize("parts", POLICIES, ids=lambda parts: parts.__name__)
def test_a_state_that_several_modules_share_is_replayed_as_they_act(
    parts: Callable[[], list[TensorDictModuleBase]],
) -> None:
    torch.manual_seed(0)
    network = TensorDictSequential(*parts())
    names = names_of(network)
    policy = as_policy(network, **names)
    pixels = frames(12).unflatten(0, (2, 6))
    start = policy.initial_state(2)
    features = policy.features(pixels, batch_ndim=2)
    with torch.no_grad():
        outputs, state = policy.unroll(features, None, STARTS, start)
        wanted = acted(network, pixels, STARTS, start)
        first, between = policy.unroll(features[:, :2], None, STARTS[:, :2], start)
        second, after = policy.unroll(features[:, 2:], None, STARTS[:, 2:], between)
    torch.testing.assert_close(outputs, wanted)
    torch.testing.assert_close(torch.cat([first, second], 1), wanted)
    assert not (wanted[:, 1] == wanted[:, 0]).all()
    for key in state.keys(True, True):
        torch.testing.assert_close(after[key], state[key])
    assert policy.splits
    measured = saliency(network, frames(4), **names).per_frame
    moving = frames(4).float().requires_grad_()
    outputs = acted(network, moving[None], torch.zeros(1, 4, dtype=torch.bool), start[:1])
    gradients = [torch.autograd.grad(v, moving, retain_graph=True)[0] for v in outputs[0, -1]]
    plain = torch.stack(gradients).square().sum((0, 2, 3, 4))
    np.testing.assert_allclose(measured, plain.numpy(), rtol=1e-4, atol=1e-12)


def test_a_copy_one_step_late_in_two_modules_rests_on_the_frame_before() -> None:
    def late(copy: bool) -> Any:
        parts = read_first()
        if copy:
            parts[1] = part(lambda e, h: h + 0 * e, ["e", "h"], ["action_value"])
        else:  # what was written is taken back
            parts.append(part(lambda h: 0 * h, [("next", "h")], [("next", "h")]))
            parts[1] = part(lambda e, h: e + 9 * h, ["e", "h"], ["action_value"])
        network = TensorDictSequential(*parts)
        start = TensorDict({"h": torch.zeros(WIDTH)}, [])
        return counterfactual(
            network, ToyEnv([5] * 8), episodes=8, donors=3, initial_state=start
        ).profile()

    assert (late(True) > 0).tolist() == [False, True, False, False, False]
    assert (late(False) > 0).tolist() == [True, False, False, False, False]


def test_an_output_that_nobody_names_is_no_entry() -> None:
    class Cell(nn.Module):
        def forward(self, e: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return e + 2 * h, e, e + h

    cell = TensorDictModule(Cell(), ["e", "h"], ["action_value", "_", ("next", "h")])
    start = TensorDict({"h": torch.zeros(WIDTH)}, [])
    shares = saliency(TensorDictSequential(encoder(), cell), frames(4), initial_state=start)
    assert (shares.per_frame > 0).all() and shares.maps.shape == (4, SIZE, SIZE)
