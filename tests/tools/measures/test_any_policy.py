"""TensorDict policies in the measures: replayed as they act, differentiated as by plain autograd."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import (
    ActorValueOperator,
    EGreedyModule,
    GRUModule,
    LSTMModule,
    ProbabilisticActor,
    QValueActor,
    QValueModule,
    ValueOperator,
    set_recurrent_mode,
)

from arcade_torch.agents import Agent, make_policy, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.models import MemoryModule, make_actor_critic, make_memory, make_network
from arcade_torch.tools import Policy, as_policy, saliency
from tests.tools.measures.toys import F64, SIZE, Net, frames

ACTIONS = 3
WIDTH = 8


class Cell(TensorDictModuleBase):
    """A recurrent module that nobody here has heard of: it knows single steps alone, and no start
    flags.
    """

    def __init__(self, start: bool = True) -> None:
        super().__init__()
        self.cell = nn.GRUCell(WIDTH, WIDTH)
        self.in_keys = ["features", "hidden"]
        self.out_keys = ["remembered", ("next", "hidden")]
        if start:
            self.make_tensordict_primer = self.primer

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        hidden = self.cell(tensordict["features"], tensordict["hidden"])
        return tensordict.set("remembered", hidden).set(("next", "hidden"), hidden)

    def primer(self) -> Any:
        from torchrl.data import Unbounded
        from torchrl.envs import TensorDictPrimer

        return TensorDictPrimer({"hidden": Unbounded(shape=(WIDTH,))}, default_value=0.5)


MEMORIES: dict[str, Callable[[], TensorDictModuleBase]] = {
    "LSTMModule": lambda: LSTMModule(
        input_size=WIDTH, hidden_size=WIDTH, num_layers=2, in_key="features", out_key="remembered"
    ),
    "GRUModule": lambda: GRUModule(
        input_size=WIDTH, hidden_size=WIDTH, in_key="features", out_key="remembered"
    ),
    "MemoryModule": lambda: MemoryModule(
        make_memory("lru", WIDTH, WIDTH), "features", "remembered", store="step"
    ),
    "MemoryModule, sequence": lambda: MemoryModule(
        make_memory("gru", WIDTH, WIDTH), "features", "remembered", store="sequence"
    ),
    "a cell": Cell,
    "none": lambda: TensorDictModule(nn.Linear(WIDTH, WIDTH), ["features"], ["remembered"]),
}


class Encoder(nn.Module):
    """Single frames of 4 x 4 pixels, HWC, to features; floats and whole numbers alike."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(SIZE * SIZE * 3, WIDTH)

    def forward(self, pixels: Tensor) -> Tensor:
        scaled = pixels.to(self.linear.weight.dtype) / 255
        return torch.tanh(self.linear(scaled.flatten(-3)))


def module(memory: str, kind: str = "q", seed: int = 0) -> TensorDictSequential:
    """A policy of stock parts with a memory, for values or for logits and a value."""
    torch.manual_seed(seed)
    body = [TensorDictModule(Encoder(), ["pixels"], ["features"]), MEMORIES[memory]()]
    head = nn.Linear(WIDTH, ACTIONS)
    nn.init.normal_(head.weight)
    if kind == "q":
        values = TensorDictModule(head, ["remembered"], ["action_value"])
        choose = QValueModule(action_space="categorical")
        explore = EGreedyModule(Categorical(ACTIONS), eps_init=1.0, eps_end=1.0)
        return TensorDictSequential(*body, values, choose, explore)
    logits = TensorDictModule(head, ["remembered"], ["logits"])
    actor = ProbabilisticActor(
        logits, in_keys=["logits"], distribution_class=torch.distributions.Categorical
    )
    critic = ValueOperator(nn.Linear(WIDTH, 1), in_keys=["remembered"])
    return TensorDictSequential(*body, actor, critic)


def act(policy: Policy, pixels: Tensor, starts: Tensor, state: Any) -> tuple[Tensor, Any]:
    """Actions of a policy over sequences [N, T], step by step; starts begin with the first state."""
    actions = []
    for t in range(pixels.shape[1]):
        begins = starts[:, t]
        fresh = policy.initial_state(len(begins))
        state = fresh.where(begins, state) if t and len(fresh.keys()) else state
        obs = {"pixels": pixels[:, t], "is_init": begins[:, None]}
        obs["last_action"] = torch.zeros(len(begins), dtype=torch.int64)
        action, _, state = policy.act(obs, state)
        actions.append(action)
    return torch.stack(actions, 1), state


STARTS = torch.tensor(
    [[True, False, False, True, False, False], [False, True, False, False, False, True]]
)


@pytest.mark.parametrize("kind", ["q", "logits"])
@pytest.mark.parametrize("memory", MEMORIES)
def test_sequences_give_what_acting_gave(memory: str, kind: str) -> None:
    policy = as_policy(module(memory, kind))
    assert (
        policy.splits
        and policy.offers
        == {
            "q": ("q", "value"),
            "logits": ("logits", "probs", "value"),
        }[kind]
    )
    pixels = frames(12).unflatten(0, (2, 6))
    first = policy.initial_state(2)
    if memory != "none":
        first = first.apply(torch.rand_like)
    actions, after = act(policy, pixels, STARTS, first)
    features = policy.features(pixels, batch_ndim=2)
    outputs, state = policy.unroll(features, None, STARTS, first)
    assert torch.equal(outputs.argmax(-1), actions)
    for key, value in after.items(True, True):
        torch.testing.assert_close(state[key], value, rtol=1e-5, atol=1e-6)
    halves = [policy.unroll(features[:, :2], None, STARTS[:, :2], first)]
    halves.append(policy.unroll(features[:, 2:], None, STARTS[:, 2:], halves[0][1]))
    joined = torch.cat([part for part, _ in halves], 1)
    torch.testing.assert_close(joined, outputs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_outputs_of_acting_are_those_of_the_module_itself(memory: str) -> None:
    network = module(memory)
    policy = as_policy(network)
    pixels = frames(5)[None]
    starts = torch.tensor([[True, False, False, True, False]])
    outputs, _ = policy.unroll(policy.features(pixels, batch_ndim=2), None, starts)
    state = policy.initial_state(1)
    for t in range(5):
        if starts[0, t]:
            state = policy.initial_state(1)
        step = TensorDict({"pixels": pixels[:, t], "is_init": starts[:, t, None]}, [1])
        with torch.no_grad():
            step = network(step.update(state))
        torch.testing.assert_close(step["action_value"], outputs[:, t], rtol=1e-5, atol=1e-6)
        state = policy.initial_state(1)
        for key in state.keys(True, True):
            state[key] = step["next", key] if isinstance(key, str) else step[("next", *key)]


def unrolled_lstm(network: TensorDictSequential, pixels: Tensor, begin: int) -> Tensor:
    """Action values at the last of the frames [T, ...], written out: two layers of LSTM cells that
    begin with zeros at frame ``begin``.
    """
    encoder, lstm, head = network[0].module, network[1].lstm, network[2].module
    hidden = [torch.zeros(WIDTH, dtype=F64) for _ in range(2)]
    cells = [torch.zeros(WIDTH, dtype=F64) for _ in range(2)]
    for t in range(begin, len(pixels)):
        x = encoder(pixels[t])
        for layer in range(2):
            weights = [getattr(lstm, f"{name}_l{layer}") for name in ("weight_ih", "weight_hh")]
            biases = [getattr(lstm, f"{name}_l{layer}") for name in ("bias_ih", "bias_hh")]
            gates = weights[0] @ x + biases[0] + weights[1] @ hidden[layer] + biases[1]
            i, f, g, o = gates.chunk(4)
            cells[layer] = f.sigmoid() * cells[layer] + i.sigmoid() * g.tanh()
            hidden[layer] = o.sigmoid() * cells[layer].tanh()
            x = hidden[layer]
    return head(x)


@pytest.mark.parametrize("begin", [0, 3])
def test_the_gradient_through_an_lstm_module_is_that_of_the_sequence_written_out(
    begin: int,
) -> None:
    network = module("LSTMModule").double()
    pixels = frames(6).to(F64).requires_grad_()
    values = unrolled_lstm(network, pixels, begin)
    gradients = torch.stack(
        [torch.autograd.grad(value, pixels, retain_graph=True)[0] for value in values]
    )
    starts = torch.arange(6) == begin
    measured = saliency(network, frames(6), is_init=starts, dtype=F64)
    np.testing.assert_allclose(measured.output, values.detach().numpy(), rtol=1e-6)
    np.testing.assert_allclose(measured.maps, gradients.square().sum((0, 4)).numpy(), rtol=1e-5)
    np.testing.assert_allclose(measured.per_frame, gradients.square().sum((0, 2, 3, 4)), rtol=1e-9)
    assert not measured.per_frame[:begin].any() and (measured.per_frame[begin:] > 0).all()


@pytest.mark.parametrize("memory", MEMORIES)
def test_gradients_equal_those_of_acting_and_stop_at_a_start(memory: str) -> None:
    network = module(memory).double()
    starts = torch.tensor([True, False, True, False, False])
    policy = as_policy(network)
    pixels = frames(5).to(F64).requires_grad_()
    state = policy.initial_state(1)
    for t in range(5):
        if starts[t]:
            state = policy.initial_state(1)
        step = TensorDict({"pixels": pixels[t][None], "is_init": starts[t].reshape(1, 1)}, [1])
        step = network(step.update(state))
        state = step["next"] if memory != "none" else state
    rows = [torch.autograd.grad(v, pixels, retain_graph=True)[0] for v in step["action_value"][0]]
    wanted = torch.stack(rows).square().sum((0, 2, 3, 4))
    measured = saliency(network, frames(5), is_init=starts, dtype=F64).per_frame
    np.testing.assert_allclose(measured, wanted.numpy(), rtol=1e-9, atol=1e-20)
    assert not measured[:2].any() and measured[-1] > 0
    if memory == "none":
        assert not measured[:-1].any()


OURS = {
    "values": ("pqn", lambda agent: make_policy(agent.network, explore=False)),
    "exploring": ("pqn", lambda agent: make_policy(agent.network)),
    "actor-critic": ("ppo", lambda agent: make_policy(agent.network)),
    "an agent's policy": ("ppo", lambda agent: agent.policy),
}


@pytest.mark.parametrize("name", OURS)
def test_a_wrapped_policy_of_ours_equals_the_agent_to_the_bit(name: str) -> None:
    algorithm, wrapped = OURS[name]
    config = preset("smoke", memory="gru", algorithm=algorithm)
    agent = Agent(config, build_network(config).eval())
    size = config.obs_size
    pixels = torch.randint(256, (4, size, size, 3), dtype=torch.uint8)
    starts = torch.tensor([True, False, False, False])
    actions = torch.tensor([0, 2, 1, 3])
    policy = as_policy(wrapped(agent))
    assert policy.splits
    for target in ("auto", "value"):
        old, new = (saliency(m, pixels, actions, starts, target=target) for m in (agent, policy))
        assert old.target == new.target
        np.testing.assert_array_equal(old.maps, new.maps)
        np.testing.assert_array_equal(old.output, new.output)


def test_a_policy_of_ours_takes_names_of_outputs_and_frames_too() -> None:
    network = make_actor_critic("small", "gru", store="step")
    policy = make_policy(network)
    pixels = torch.randint(256, (2, 128, 128, 3), dtype=torch.uint8)
    actions = torch.zeros(2, dtype=torch.int64)
    usual = saliency(policy, pixels, actions, white=255.0)
    named = saliency(policy, pixels, actions, output_key="logits", output_kind="logits")
    np.testing.assert_allclose(named.maps, usual.maps, rtol=1e-3, atol=1e-6 * usual.maps.max())
    assert named.target == usual.target == "probs"


def test_the_guides_sequence_equals_the_network_written_as_one() -> None:
    net = Net("gru", torch.float32)
    parts = TensorDictSequential(
        TensorDictModule(net.encode, ["pixels"], ["features"]),
        MemoryModule(net.memories[0], "features", "remembered", store="step"),
        TensorDictModule(net.head, ["remembered"], ["action_value"]),
        QValueModule(action_space="categorical"),
    )
    starts = torch.tensor([True, False, False, True, False])
    one, many = (saliency(model, frames(5), is_init=starts) for model in (net, parts))
    np.testing.assert_allclose(many.maps, one.maps, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(many.output, one.output, rtol=1e-6)


def test_a_policy_in_one_piece_has_frames_for_features_and_the_same_gradients() -> None:
    whole = make_network("small", "gru", store="step")
    network = TensorDictSequential(
        whole, TensorDictModule(nn.Identity(), ["action_value"], ["scores"])
    )
    policy = as_policy(network, output_key="scores", output_kind="q")
    assert not policy.splits
    pixels = torch.randint(256, (3, 128, 128, 3), dtype=torch.uint8)
    starts = torch.tensor([True, False, False])
    actions = torch.tensor([0, 1, 2])
    assert policy.features(pixels).shape == (3, 128 * 128 * 3)
    one, two = (saliency(model, pixels, actions, starts) for model in (whole.eval(), policy))
    np.testing.assert_allclose(two.maps, one.maps, rtol=1e-4, atol=1e-6 * one.maps.max())
    with pytest.raises(ValueError, match=r"^last_action must be handed over, this policy reads"):
        saliency(policy, pixels)


def test_a_value_beside_logits_is_looked_at_and_a_head_alone_is_not_taken_for_both() -> None:
    network = make_actor_critic("small", "mlp")
    pixels = torch.randint(256, (2, 128, 128, 3), dtype=torch.uint8)
    whole = saliency(network, pixels)
    actor = saliency(network.actor, pixels)
    assert whole.target == actor.target == "probs" and len(actor.output) == 5
    np.testing.assert_array_equal(whole.maps, actor.maps)
    assert as_policy(network.critic).offers == ("value",)


class InPlace(TensorDictModuleBase):
    """A cell whose next state takes the place of the one before, below a nested key."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(WIDTH, WIDTH)
        self.in_keys = ["features", ("m", "h")]
        self.out_keys = ["remembered", ("m", "h")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        hidden = self.cell(tensordict["features"], tensordict["m", "h"])
        return tensordict.set("remembered", hidden).set(("m", "h"), hidden)


def test_a_state_that_is_handed_over_stays_as_it_is() -> None:
    torch.manual_seed(0)
    network = TensorDictSequential(
        TensorDictModule(Encoder(), ["pixels"], ["features"]),
        InPlace(),
        TensorDictModule(nn.Linear(WIDTH, ACTIONS), ["remembered"], ["action_value"]),
    )
    start = TensorDict({"m": TensorDict({"h": torch.zeros(WIDTH)}, [])}, [])
    policy = as_policy(network, state_keys={("m", "h"): ("m", "h")}, initial_state=start)
    pixels = frames(4)[None]
    state = policy.initial_state(1)
    before = state.clone()
    actions, after = act(policy, pixels, torch.zeros(1, 4, dtype=torch.bool), state)
    outputs, replayed = policy.unroll(policy.features(pixels, batch_ndim=2), state=state)
    assert (state == before).all() and not (after == before).all()
    assert torch.equal(outputs.argmax(-1), actions)
    torch.testing.assert_close(replayed["m", "h"], after["m", "h"])
    assert not start["m", "h"].any()


def test_keys_are_told_apart_or_named() -> None:
    torch.manual_seed(0)
    encode = TensorDictModule(Encoder(), [("seen", "image")], ["features"])
    lstm = LSTMModule(
        input_size=WIDTH,
        hidden_size=WIDTH,
        in_keys=["features", ("m", "h"), ("m", "c")],
        out_keys=["remembered", ("next", "m", "h"), ("next", "m", "c")],
    )
    head = TensorDictModule(nn.Linear(WIDTH, ACTIONS), ["remembered"], ["scores"])
    network = TensorDictSequential(encode, lstm, head)
    with pytest.raises(ValueError, match=r"^the policy must write action_value, logits or probs"):
        as_policy(network)
    policy = as_policy(network, output_key="scores", output_kind="logits", action_key="move")
    assert policy.keys.pixels == ("seen", "image") and policy.keys.action == "move"
    assert policy.initial_state(2)["m", "h"].shape == (2, 1, WIDTH)
    names = {"output_key": "scores", "output_kind": "logits"}
    with_names = saliency(network, frames(3), **names)
    np.testing.assert_array_equal(with_names.maps, saliency(policy, frames(3)).maps)
    assert with_names.target == "probs"


def test_a_state_that_is_written_elsewhere_is_named_in_pairs() -> None:
    torch.manual_seed(0)
    cell = TensorDictModule(nn.GRUCell(WIDTH, WIDTH), ["features", "h"], ["h_after"])
    parts = [
        TensorDictModule(Encoder(), ["pixels"], ["features"]),
        cell,
        TensorDictModule(nn.Linear(WIDTH, ACTIONS), ["h_after"], ["action_value"]),
    ]
    network = TensorDictSequential(*parts)
    with pytest.raises(ValueError, match=r"got \['pixels', 'h'\] beside what is known"):
        as_policy(network)
    with pytest.raises(ValueError, match=r"must have a start, got none for \['h'\]"):
        as_policy(network, state_keys={"h": "h_after"})
    start = TensorDict({"h": torch.full((WIDTH,), 0.1)}, [])
    policy = as_policy(network, state_keys={"h": "h_after"}, initial_state=start)
    outputs, state = policy.unroll(policy.features(frames(3))[None])
    hidden = torch.full((1, WIDTH), 0.1)
    for frame in frames(3):
        hidden = cell.module(parts[0].module(frame[None]), hidden)
    torch.testing.assert_close(outputs[:, -1], parts[2].module(hidden))
    torch.testing.assert_close(state["h"], hidden)


def operators() -> dict[str, Callable[[TensorDictModuleBase, nn.Module], TensorDictModuleBase]]:
    """TorchRL's ways to put a body and a head together."""
    categorical = torch.distributions.Categorical

    def logits(head: nn.Module) -> TensorDictModule:
        return TensorDictModule(head, ["remembered"], ["logits"])

    def actor(head: nn.Module) -> ProbabilisticActor:
        return ProbabilisticActor(logits(head), in_keys=["logits"], distribution_class=categorical)

    def critic() -> ValueOperator:
        return ValueOperator(nn.Linear(WIDTH, 1), in_keys=["remembered"])

    def values(head: nn.Module) -> QValueActor:
        return QValueActor(head, in_keys=["remembered"], action_space="categorical")

    return {
        "QValueActor": lambda body, head: TensorDictSequential(body, values(head)),
        "one-hot": lambda body, head: TensorDictSequential(
            body, QValueActor(head, in_keys=["remembered"], action_space="one_hot")
        ),
        "ActorValueOperator": lambda body, head: ActorValueOperator(body, actor(head), critic()),
        "its policy": lambda body, head: ActorValueOperator(
            body, actor(head), critic()
        ).get_policy_operator(),
        "one sequence": lambda body, head: ProbabilisticTensorDictSequential(
            body,
            logits(head),
            ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=categorical),
        ),
        "other names": lambda body, head: ProbabilisticTensorDictSequential(
            body,
            TensorDictModule(head, ["remembered"], ["scores"]),
            ProbabilisticTensorDictModule(
                {"logits": "scores"}, ["action"], distribution_class=categorical
            ),
        ),
        "shares": lambda body, head: ProbabilisticTensorDictSequential(
            body,
            TensorDictModule(nn.Sequential(head, nn.Softmax(-1)), ["remembered"], ["probs"]),
            ProbabilisticTensorDictModule(["probs"], ["action"], distribution_class=categorical),
        ),
    }


@pytest.mark.parametrize("name", operators())
def test_torchrls_operators_are_read_alike(name: str) -> None:
    torch.manual_seed(0)
    body = TensorDictSequential(
        TensorDictModule(Encoder(), ["pixels"], ["features"]), MEMORIES["GRUModule"]()
    )
    head = nn.Linear(WIDTH, ACTIONS)
    nn.init.normal_(head.weight)
    policy = as_policy(operators()[name](body, head))
    pixels = frames(6)[None]
    starts = torch.tensor([[True, False, False, True, False, False]])
    actions, _ = act(policy, pixels, starts, policy.initial_state(1))
    steps = TensorDict({"pixels": pixels, "is_init": starts[..., None]}, [1, 6])
    with torch.no_grad(), set_recurrent_mode(True):
        logits = head(body(steps)["remembered"])
    target = "q" if "Q" in name or name == "one-hot" else "probs"
    wanted = logits if target == "q" else logits.softmax(-1)
    outputs, _ = policy.unroll(policy.features(pixels, batch_ndim=2), None, starts)
    assert policy.splits and policy.offers[0] in (target, "logits")
    torch.testing.assert_close(outputs, wanted, rtol=1e-5, atol=1e-6)
    assert torch.equal(actions, logits.argmax(-1))
    if target == "probs":
        again, _ = policy.unroll(
            policy.features(pixels, batch_ndim=2), None, starts, target="logits"
        )
        torch.testing.assert_close(again.softmax(-1), wanted, rtol=1e-5, atol=1e-6)


def test_a_compiled_policy_is_the_policy() -> None:
    network = module("GRUModule")
    compiled = torch.compile(network, backend="eager")
    plain, other = (saliency(model, frames(3)) for model in (network, compiled))
    np.testing.assert_array_equal(plain.maps, other.maps)


WRONG: dict[str, tuple[Any, dict[str, Any], type[Exception], str]] = {
    "a module": (nn.Linear(2, 2), {}, TypeError, r"got Linear: TensorDictModule\(Linear, "),
    "a number": (3, {}, TypeError, "^model must be an agent, a TensorDict policy"),
    "no start": (
        Cell(start=False),
        {"output_key": "remembered", "output_kind": "q"},
        ValueError,
        "^the recurrent state must have a start",
    ),
    "a name for a pair": (
        (lambda x: x, lambda e, a, i, s: (e, s)),
        {"state_keys": ["h"]},
        ValueError,
        "^state_keys say how a TensorDict policy is read",
    ),
    "frames that nothing depends on": (
        TensorDictModule(nn.Linear(2, 2), ["goal"], ["action_value"]),
        {"pixels_key": "pixels"},
        ValueError,
        r"^the policy must read the frames \('pixels'\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_wrapped_is_refused_in_one_line(name: str) -> None:
    model, names, error, message = WRONG[name]
    with pytest.raises(error, match=message) as caught:
        as_policy(model, **names)
    assert "\n" not in str(caught.value)


def test_a_distribution_of_values_is_refused_in_one_line() -> None:
    """Before: saliency ended in a mismatch of shapes inside of autograd."""
    atoms = nn.Sequential(nn.Flatten(), nn.Linear(12, 6), nn.Unflatten(-1, (3, 2)))
    policy = as_policy(TensorDictModule(atoms, ["pixels"], ["action_value"]))
    message = r"^the policy's output 'action_value' must be one number an action, .*got \[3, 2\]$"
    with pytest.raises(ValueError, match=message):
        policy.forward_frames(torch.zeros(1, 4, 2, 2, 3))


def test_evaluation_mode_is_on_while_it_runs_and_every_mode_comes_back() -> None:
    network = module("GRUModule")
    network.train()
    network[0].eval()
    policy = as_policy(network)
    modes: list[bool] = []
    network[2].register_forward_hook(lambda part, *_: modes.append(part.training))
    policy.forward_frames(frames(4).unflatten(0, (2, 2)).float())
    assert modes == [False] and network[2].training and not network[0].training


def test_the_outputs_of_frames_carry_gradients_to_them() -> None:
    policy = as_policy(module("LSTMModule"))
    pixels = frames(8).unflatten(0, (2, 4)).float().requires_grad_()
    outputs = policy.forward_frames(pixels)
    assert outputs.shape == (2, ACTIONS)
    (gradient,) = torch.autograd.grad(outputs.sum(), pixels)
    assert gradient.flatten(2).abs().sum(-1).gt(0).all()
