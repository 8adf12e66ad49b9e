"""Where MemoryModule keeps states: one a step while they are small, one a sequence when larger than
a frame.
"""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import QValueModule, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives.value import GAE

from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.models import MemoryBlock, MemoryModule, make_memory, memory_names
from tests.arcade_torch.stub import GAME
from tests.models.test_memory_module import Countdown

WINDOWS = ("attention", "gtrxl")
REMEMBERING = [name for name in memory_names() if name != "mlp"]
N, T = 6, 16


def make_critic(name, store):
    return TensorDictSequential(
        MemoryModule(make_memory(name, 3, 8), "observation", "remembered", store=store),
        TensorDictModule(nn.Linear(8, 1), in_keys=["remembered"], out_keys=["state_value"]),
    )


def rollout(critic, steps):
    env = TransformedEnv(Countdown(), InitTracker()).append_transform(
        get_primers_from_module(critic)
    )
    act = TensorDictModule(
        lambda x: torch.zeros(x.shape[:-1], dtype=torch.int64), ["observation"], ["action"]
    )
    with torch.no_grad():
        return env.rollout(steps, TensorDictSequential(critic, act), break_when_any_done=False)


@pytest.mark.parametrize(
    ("name", "hidden", "store"),
    [
        *((name, 512, "step") for name in memory_names() if name not in WINDOWS),
        *((name, 8, "step") for name in WINDOWS),
        *((name, hidden, "sequence") for name in WINDOWS for hidden in (128, 512)),
    ],
)
def test_only_states_larger_than_a_frame_are_kept_once_a_sequence(name, hidden, store):
    assert MemoryModule(make_memory(name, 3, hidden)).store == store
    other = "step" if store == "sequence" else "sequence"
    assert MemoryModule(make_memory(name, 3, hidden), store=other).store == other


def test_eight_layers_of_vectors_are_not_larger_than_a_frame():
    assert MemoryModule(MemoryBlock(4, 512, "lru", layers=8)).store == "step"


@pytest.mark.parametrize("name", REMEMBERING)
def test_sequences_that_begin_with_one_state_give_what_was_acted(name):
    critic = make_critic(name, "sequence")
    data = rollout(critic, 20)[:, 5:]  # begins in mid-episode, holds resets
    memory, states = critic[0], data.select(*critic[0].state_keys)[:, 0]
    assert data["is_init"][:, 1:].any(1).sum() >= 3 and not data["is_init"][:, 0].all()
    sequence = memory.begin_with(data.select("observation", "is_init"), states)
    with set_recurrent_mode(True), torch.no_grad():
        critic(sequence)
    torch.testing.assert_close(sequence["state_value"], data["state_value"], rtol=0, atol=1e-6)
    assert "next" not in sequence
    for key in memory.state_keys:
        assert sequence[key].stride(1) == 0 and sequence[key].data_ptr() == states[key].data_ptr()


@pytest.mark.parametrize("name", ["attention", "gdn"])
def test_shifted_gae_is_the_same_with_one_state_a_sequence(name):
    torch.manual_seed(3)
    every, once = make_critic(name, "step"), make_critic(name, "sequence")
    once.load_state_dict(every.state_dict())
    data = rollout(every, 18).exclude("state_value", "remembered", ("next", "state_value"))
    assert not data["is_init"][
        :, -1
    ].any()  # where TorchRL would call the frame after it a start, too
    advantages = []
    for critic in (every, once):
        gae = GAE(gamma=0.9, lmbda=0.8, value_network=critic, shifted=True, shifted_budget=8)
        with set_recurrent_mode(True):
            advantages.append(gae(data.clone())["advantage"])
    torch.testing.assert_close(*advantages, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["attention", "ttt"])
def test_a_window_of_our_collector_replays_from_its_initial_state(name):
    layers = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 8), nn.Tanh())
    encoder = TensorDictModule(
        lambda pixels: layers(pixels.float() / 255), ["pixels"], ["features"]
    )
    memory = MemoryModule(make_memory(name, 8, 8), "features", "hidden", store="sequence")
    head = TensorDictModule(nn.Linear(8, 5), ["hidden"], ["action_value"])
    policy = TensorDictSequential(encoder, memory, head, QValueModule(spec=Categorical(5)))
    collector = ArcadeCollector(ArcadeEnv(GAME, N, seed=2), policy, N * T, store_states=False)
    for _ in range(3):
        batch = collector.collect()
        assert all(key not in batch.keys(True) for key in memory.state_keys)
        again = TensorDict({key: batch[key] for key in ("pixels", "is_init")}, [N, T])
        with torch.no_grad(), set_recurrent_mode(True):
            policy(memory.begin_with(again, batch["initial_state"]))
        torch.testing.assert_close(again["action_value"], batch["action_value"], rtol=0, atol=1e-5)
    assert batch["is_init"].any() and any(
        (batch["initial_state", *key] != 0).any() for key in memory.state_keys
    )
    collector.shutdown()


@pytest.mark.parametrize("recurrent", [False, True])
@pytest.mark.parametrize("name", ["attention", "gdn", "ttt"])
def test_the_module_compiles_into_one_graph(name, recurrent):
    torch._dynamo.reset()
    module = MemoryModule(
        make_memory(name, 3, 4), "x", "y", store="step" if name == "gdn" else None
    )
    shape = (2, 5) if recurrent else (2,)
    state = module.memory.initial_state(shape)
    data = TensorDict(
        {"x": torch.randn(*shape, 3), "is_init": torch.rand(*shape, 1) < 0.3, "memory": state},
        shape,
    )
    with set_recurrent_mode(recurrent):
        compiled = torch.compile(module, fullgraph=True, backend="eager")
        ours, eager = compiled(data.clone()), module(data.clone())
    assert set(ours.keys(True, True)) == set(eager.keys(True, True))
    for key in eager.keys(True, True):
        torch.testing.assert_close(ours[key], eager[key])


def test_wrong_use_gets_one_clear_line():
    with pytest.raises(ValueError, match="'step', 'sequence' or None, got 'never'"):
        MemoryModule(make_memory("lru", 3, 4), store="never")
    module = MemoryModule(make_memory("lru", 3, 4), "x", "y")
    with pytest.raises(ValueError, match="a state of its own"):
        module.begin_with(TensorDict({}, [2, 5]), TensorDict({}, [2]))
    with pytest.raises(KeyError, match=r"no 'is_init'.*InitTracker"):
        module(TensorDict({"x": torch.zeros(2, 3)}, [2]))


def test_keys_may_be_nested_and_are_told_as_torchrl_writes_them():
    module = MemoryModule(
        make_memory("gru", 3, 4), ("seen",), ("out",), state_key=("policy", "memory")
    )
    assert module.in_keys == ["seen", ("policy", "memory", "h"), "is_init"]
    assert module.out_keys == ["out", ("next", "policy", "memory", "h")]
