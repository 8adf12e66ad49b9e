"""What counts as a policy, and how its outputs are read."""

from typing import Any

import pytest
import torch
from torch import Tensor

from arcade_torch import make
from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.tools import Policy, as_policy, beliefs, counterfactual, patching
from arcade_torch.tools.measures.policy import outputs, policy_of, read_plain, resolve
from tests.tools.measures.toys import Net, linear_policy

OUT = torch.tensor([[1.0, 3.0, 2.0]])


def agent(algorithm: str) -> Agent:
    config = preset("smoke", memory="gru", algorithm=algorithm)
    return Agent(config, build_network(config).eval())


def test_a_wrapped_pair_can_be_read_as_anything() -> None:
    policy = linear_policy(0.5)
    assert outputs(policy, "q")(OUT) is OUT and outputs(policy)(OUT) is OUT
    torch.testing.assert_close(outputs(policy, "probs")(OUT), OUT.softmax(-1))
    assert outputs((policy.encode, policy.remember), "value")(OUT).tolist() == [[3.0]]


@pytest.mark.parametrize(("algorithm", "natural"), [("pqn", "q"), ("dqn", "q"), ("ppo", "probs")])
def test_agents_say_what_they_offer(algorithm: str, natural: str) -> None:
    asked = agent(algorithm)
    assert resolve(asked, "auto") == natural and natural in policy_of(asked).offers
    missing = "probs" if natural == "q" else "q"
    with pytest.raises(ValueError, match=f"not '{missing}': choose one of these"):
        outputs(asked, missing)


def test_an_actor_critic_is_read_by_its_own_rules() -> None:
    policy, out = (
        policy_of(agent("ppo")),
        torch.tensor([1.0, 3.0, 2.0, 0.0, 0.5, 99.0]),
    )  # five logits and a value
    assert outputs(policy, "value")(out).tolist() == [99.0]
    torch.testing.assert_close(outputs(policy, "probs")(out), out[:-1].softmax(-1))
    assert policy.greedy(out) == 1


def test_a_policy_acts_greedily_and_carries_its_state() -> None:
    policy, net = linear_policy(1.0, dtype=torch.float32), Net("gru", torch.float32)
    for player in (policy, policy_of(net)):
        state = player.initial_state(2)
        frames = torch.randint(256, (2, 3, 4, 4, 3), dtype=torch.uint8)
        picks = []
        for t in range(3):
            obs = {"pixels": frames[:, t], "last_action": torch.zeros(2, dtype=torch.int64)}
            action, _, state = player.act(obs | {"is_init": torch.full((2, 1), t == 0)}, state)
            picks.append(action)
        starts = torch.tensor([[True, False, False]] * 2)
        actions = torch.zeros(2, 3, dtype=torch.int64)
        out, _ = player.remember(
            player.encode(frames.flatten(0, 1)).unflatten(0, (2, 3)), actions, starts, state
        )
        assert torch.equal(torch.stack(picks, 1), out.argmax(-1))


def test_what_is_no_policy_is_refused() -> None:
    def encode(o: Tensor) -> Tensor:
        return o

    for wrong in (object(), (encode,), (encode, "remember"), torch.nn.Linear(2, 2)):
        with pytest.raises(TypeError, match="model must be an agent"):
            policy_of(wrong)
    with pytest.raises(
        ValueError, match="target must be one of q, logits, probs, value or auto, got 'Q'"
    ):
        outputs(linear_policy(0.5), "Q")
    assert policy_of(Policy(encode, lambda e, a, s, h: (e, h))).read is read_plain


class TorchGRU:
    """Two functions around ``torch.nn.GRU``, whose state is [layers, N, H]."""

    def __init__(self, layers: int) -> None:
        torch.manual_seed(0)
        self.gru = torch.nn.GRU(6 * 6 * 3, 8, num_layers=layers, batch_first=True)
        self.head = torch.nn.Linear(8, 5)
        self.layers = layers

    def encode(self, frames: Tensor) -> Tensor:
        return frames[..., ::24, ::24, :].float().flatten(1) / 255

    def layers_first(self, features: Tensor, last: Tensor, begins: Tensor, state: Any) -> Any:
        y, state = self.gru(features, state)
        return self.head(y), state

    def rows_first(self, features: Tensor, last: Tensor, begins: Tensor, state: Tensor) -> Any:
        y, state = self.gru(features, state.transpose(0, 1).contiguous())
        return self.head(y), state.transpose(0, 1)

    def in_a_tuple(self, features: Tensor, last: Tensor, begins: Tensor, state: Any) -> Any:
        y, state = self.gru(features, None if state is None else state[0])
        return self.head(y), (state, state)

    def start(self, size: int) -> Tensor:
        return torch.zeros(self.layers, size, 8)


@pytest.mark.parametrize("layers", [1, 2, 4])
def test_a_state_whose_first_axis_is_not_the_batch_is_refused(layers: int) -> None:
    """Beliefs read states of two layers as those of other envs, without a word; others ended in an
    IndexError of torch.
    """
    net = TorchGRU(layers)
    env = make("SignpostEasy", num_envs=4, observability="partial", seed=0)
    starts_with_layers = Policy(net.encode, net.layers_first, net.start)
    refused = [(net.encode, net.layers_first), starts_with_layers, (net.encode, net.in_a_tuple)]
    for policy in refused:
        for measure in (beliefs, patching, counterfactual):
            with pytest.raises(ValueError, match=r"\[\d, ...\], .*state.transpose\(0, 1\)") as info:
                measure(policy, env, episodes=8)
            assert "\n" not in str(info.value)
    fitting = Policy(net.encode, net.rows_first, lambda size: torch.zeros(size, layers, 8))
    assert beliefs(fitting, env, episodes=8).state_width == 8 * layers
    assert len(patching(fitting, env, episodes=8).action) == 8


def test_a_bare_module_is_told_how_it_becomes_a_policy_with_a_recurrent_state_too() -> None:
    """A module called as ``y, state = module(frames, state)`` that went as it was told ended inside
    of its own convolution, on a frame without time.
    """
    with pytest.raises(TypeError, match=r"TensorDictModule\(GRU.*your-own.md.*state") as info:
        as_policy(torch.nn.GRU(3, 4))
    assert "\n" not in str(info.value)
