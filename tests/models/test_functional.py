"""Networks run with parameters that a loss holds: targets, buffers in their place, and stacks under
vmap.
"""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.func import functional_call, stack_module_state
from torchrl.modules import QValueModule, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import DQNLoss, SoftUpdate
from torchrl.objectives.value import GAE

from arcade_torch.models import MemoryBlock, make_actor_critic, make_network, memory_names
from tests.few import few_memories

NAMES = memory_names()
N, T = 3, 6


def batch(network, steps=T):
    """Random data [N, T] as a collector gives it, with a termination, a truncation, and starts
    behind them.
    """
    done = torch.zeros(N, steps, 1, dtype=torch.bool)
    done[0, 2] = done[1, 3] = True
    is_init = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1)
    is_init[2, 0] = True

    def frames():
        return torch.randint(0, 256, (N, steps, 32, 32, 3), dtype=torch.uint8)

    action = torch.randint(0, 5, (N, steps))
    root = {
        "pixels": frames(),
        "last_action": action.roll(1, 1),
        "is_init": is_init,
        "action": action,
    }
    data = TensorDict(root, [N, steps])
    following = {
        "pixels": frames(),
        "last_action": action,
        "is_init": torch.zeros_like(is_init),
        "done": done,
    }
    first = (torch.arange(N) == 0)[:, None, None]
    ends = {"terminated": done & first, "truncated": done & ~first}
    data["next"] = TensorDict(following | ends | {"reward": torch.randn(N, steps, 1)}, [N, steps])
    for key in getattr(network, "state_keys", ()):
        state = network.initial_state([N, steps])[key[-2:]]
        data[key] = torch.rand_like(state) if state.is_floating_point() else state + 2
        data["next", *key] = data[key]
    return data


def gradient(module):
    return sum(float(p.grad.abs().sum()) for p in module.parameters() if p.grad is not None)


@pytest.mark.parametrize("store", ["step", "sequence"])
@pytest.mark.parametrize("name", [*NAMES, "feedforward"])
def test_a_stock_loss_with_targets_trains_the_memory_and_moves_its_targets(name, store):
    options = {"memory_options": {"window": 4}} if name == "attention" else {}
    network = make_network("small", name, store=store, **options)
    policy = TensorDictSequential(network, QValueModule(action_space="categorical"))
    loss = DQNLoss(policy, action_space="categorical", delay_value=True, double_dqn=True)
    loss.make_value_estimator(gamma=0.9)
    updater = SoftUpdate(loss, eps=0.5)
    loss(batch(network))["loss"].backward()
    assert (
        gradient(network.encoder) > 0 and gradient(network.block) > 0 and gradient(network.head) > 0
    )
    before = loss.target_value_network_params.clone()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(1)
    updater.step()
    moved = loss.target_value_network_params - before
    leaves = moved["module", "0", "block"].values(True, True)
    assert all((leaf - 0.5).abs().max() < 1e-4 for leaf in leaves if leaf.numel())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", ["sequences", "stored states", "one step"])
def test_two_stacked_networks_equal_the_two_apart_values_and_gradients(name, what):
    options = {"memory_options": {"window": 4}} if name == "attention" else {}
    store = "step" if what == "stored states" else "sequence"
    networks = [
        make_network("small", name, store=store, hidden_size=8, **options).double()
        for _ in range(2)
    ]
    data = batch(networks[0])
    data = data[:, 1] if what == "one step" else data
    data = data.apply(lambda x: x.double() if x.is_floating_point() else x)
    parameters, buffers = stack_module_state(networks)

    def outputs(parameters, buffers):
        return functional_call(networks[0], (parameters, buffers), (data.copy(),))["action_value"]

    with set_recurrent_mode(what != "one step"):
        together = torch.vmap(outputs)(parameters, buffers)
        direction = torch.randn_like(together)
        (together * direction).sum().backward()
        for i, network in enumerate(networks):
            alone = network(data.copy())["action_value"]
            torch.testing.assert_close(together[i], alone, rtol=0, atol=1e-6)
            names, weights = zip(*network.named_parameters(), strict=True)
            grads = torch.autograd.grad(alone, weights, direction[i])
            for key, grad in zip(names, grads, strict=True):
                torch.testing.assert_close(parameters[key].grad[i], grad, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", [*NAMES, "feedforward"])
def test_plain_tensors_a_step_and_a_sequence_give_the_same_and_the_primer_has_the_state(name):
    network = make_network("small", name)
    data = batch(network).exclude(*network.state_keys)
    with torch.no_grad():
        out, last = network.remember(
            network.encode(data["pixels"]),
            data["last_action"],
            data["is_init"].squeeze(-1),
            network.initial_state(N),
        )
        with set_recurrent_mode(True):
            torch.testing.assert_close(network(data.copy())["action_value"], out)
        state = network.initial_state(N)
        for t in range(T):
            step = data[:, t].exclude("next").update({"memory": state})
            network(step)
            torch.testing.assert_close(step["action_value"], out[:, t], rtol=0, atol=1e-5)
            state = step.get(("next", "memory"), state)
    for key in network.state_keys:
        torch.testing.assert_close(state[key[1:]], last[key[1:]], rtol=0, atol=1e-5)
    primer = get_primers_from_module(network, warn=False)
    assert set(network.state_keys) == (
        set(primer.primers.keys(True, True)) if network.state_keys else set()
    )
    assert bool(network.state_keys) == (name not in ("mlp", "feedforward"))
    assert network.out_keys == ["action_value", *(("next", *key) for key in network.state_keys)]
    assert {key.split(".")[0] for key in network.state_dict()} == {"encoder", "block", "head"}


def test_actor_and_critic_write_their_outputs_and_states_and_the_critic_works_alone():
    network = make_actor_critic("small", "gru", towers=2)
    data = batch(network).exclude("next")
    step = network(data[:, 0])
    assert step["logits"].shape == (N, 5) and step["state_value"].shape == (N, 1)
    assert step["next", "memory", "actor", "layer0", "h"].shape == (N, 128)
    assert set(network.out_keys) <= set(step.keys(True, True))
    keys = set(get_primers_from_module(network, warn=False).transforms[0].primers.keys(True, True))
    keys |= set(get_primers_from_module(network, warn=False).transforms[1].primers.keys(True, True))
    assert (
        keys
        == {("memory", "actor", "layer0", "h"), ("memory", "critic", "layer0", "h")}
        <= set(network.in_keys)
    )
    with set_recurrent_mode(True):
        whole = network(data.copy())
        out, _ = network.remember(
            network.encode(data["pixels"]),
            data["last_action"],
            data["is_init"].squeeze(-1),
            network.initial_state(N),
        )
        torch.testing.assert_close(torch.cat([whole["logits"], whole["state_value"]], -1), out)
        torch.testing.assert_close(network.critic(data.copy())["state_value"], whole["state_value"])
    critic = make_actor_critic("small", "gru", store="step", towers=2).critic
    with set_recurrent_mode(True):
        assert (
            GAE(gamma=0.9, lmbda=0.8, value_network=critic)(batch(critic))["advantage"]
            .isfinite()
            .all()
        )


@pytest.mark.parametrize("memory", ["gru", "attention", "mlp"])
def test_tensors_can_be_passed_by_name(memory):
    network = make_network("small", memory)
    pixels, flags = torch.zeros(2, 32, 32, 3, dtype=torch.uint8), torch.ones(2, 1, dtype=torch.bool)
    outputs = network(pixels=pixels, last_action=torch.zeros(2, dtype=torch.int64), is_init=flags)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    assert outputs[0].shape == (2, 5) and len(outputs) == len(network.out_keys)


def test_a_missing_entry_is_named():
    with pytest.raises(KeyError, match="pixels"):
        make_network("small", "gru")(
            TensorDict({"is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
        )


def compilations(function, inputs):
    """How often a compiler is called for the inputs, one after the other."""
    torch._dynamo.reset()
    count = []

    def backend(graph, example_inputs):
        count.append(len(graph.graph.nodes))
        return graph.forward

    compiled = torch.compile(
        function, backend=backend, fullgraph=True
    )  # fullgraph: no way back to eager
    for arguments in inputs:
        compiled(*arguments)
    return len(count)


def problem(block, steps):
    return torch.randn(2, steps, 4), block.initial_state(2), torch.rand(2, steps) < 0.2


@pytest.mark.parametrize("name", few_memories(NAMES))
def test_two_hundred_calls_of_one_shape_compile_once(name):
    block = MemoryBlock(4, 8, name)
    assert compilations(block, [problem(block, 12)] * 200) == 1


@pytest.mark.parametrize("name", few_memories(NAMES))
def test_twenty_lengths_compile_no_more_than_three_times(name):
    block = MemoryBlock(4, 8, name)
    assert compilations(block, [problem(block, steps) for steps in range(6, 26)]) <= 3


@pytest.mark.parametrize("name", ["lru", "gru", "attention"])
def test_loss_and_gradients_of_one_shape_compile_once(name):
    network = make_network("small", name, hidden_size=8)
    features, flags = torch.randn(2, 12, 128), torch.rand(2, 12) < 0.2
    actions, state = torch.randint(0, 5, (2, 12)), network.initial_state(2)

    def loss(features):
        return network.remember(features, actions, flags, state)[0].square().mean()

    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    weights = [
        p
        for p in [*network.block.parameters(), *network.head.parameters()]
        if isinstance(p, nn.Parameter)
    ]
    for _ in range(20):
        features = torch.randn_like(features)
        ours = torch.autograd.grad(compiled(features), weights)
        plain = torch.autograd.grad(loss(features), weights)
        torch.testing.assert_close(ours, plain)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
