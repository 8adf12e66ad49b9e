"""Policies that choose another action than the best of the outputs that a measure looks at."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

import arcade_torch
from arcade_torch.models import make_actor_critic, make_network
from arcade_torch.tools import (
    as_policy,
    beliefs,
    contamination,
    counterfactual,
    greedy_window,
    recall_density,
)
from arcade_torch.tools.measures.choices import refuse_other_choices
from arcade_torch.tools.measures.policy import Policy
from tests.tools.measures.test_silent_policies import MEASURES, Encoder, KnownEnv
from tests.tools.measures.toys import ToyEnv, linear_policy, window

REFUSED = r"^the policy must choose the best of its outputs, got action \d of value .*output_key"


def choosing(choose: Callable[[Tensor], Tensor]) -> TensorDictSequential:
    """A policy without memory with a chooser of its own."""
    torch.manual_seed(0)
    return TensorDictSequential(
        TensorDictModule(Encoder(), ["pixels"], ["features"]),
        TensorDictModule(nn.Linear(8, 3), ["features"], ["action_value"]),
        TensorDictModule(choose, ["action_value"], ["action"]),
    )


def worst(values: Tensor) -> Tensor:
    """The action that nobody would choose."""
    return values.argmin(-1)


def best(values: Tensor) -> Tensor:
    """What ``QValueModule`` does."""
    return values.argmax(-1)


DECISIONS = ("counterfactual", "contamination", "recall density")


@pytest.mark.parametrize("measure", DECISIONS)
def test_a_policy_that_chooses_otherwise_is_refused(measure: str) -> None:
    MEASURES[measure](choosing(best))
    with pytest.raises(ValueError, match=REFUSED):
        MEASURES[measure](choosing(worst))


def measure_in_batches(measure: str, policy: Any, env: ToyEnv, batches: int) -> None:
    """A measure over so many batches of an env that plays two episodes side by side."""
    episodes = 2 * batches
    if measure == "recall density":
        recall_density(policy, env, episodes=episodes)
    elif measure == "counterfactual":
        counterfactual(policy, env, episodes=episodes, donors=1)
    else:
        contamination(policy, env, delays=(0, 1), starts=1 if batches == 1 else 40)


@pytest.mark.parametrize("measure", DECISIONS)
def test_a_mask_behind_the_outputs_that_counts_late_is_refused(measure: str) -> None:
    """The first frames, on which a policy is tried, do not show it."""
    steps = 0

    def masked(values: Tensor) -> Tensor:
        nonlocal steps
        steps += 1
        return best(values) if steps % 6 else worst(values)

    with pytest.raises(ValueError, match=REFUSED):
        measure_in_batches(measure, choosing(masked), ToyEnv([9, 9]), 1)


@pytest.mark.parametrize("measure", DECISIONS)
def test_another_choice_in_a_later_batch_is_refused(measure: str) -> None:
    """Before: the first batch of episodes alone was looked at."""

    class Later(ToyEnv):
        batches = 0

        def reset(self) -> TensorDict:
            self.batches += 1
            return super().reset()

    env = Later([9, 9])

    def late(values: Tensor) -> Tensor:
        return best(values) if env.batches < 2 else worst(values)

    with pytest.raises(ValueError, match=REFUSED):
        measure_in_batches(measure, choosing(late), env, 2)
    assert env.batches == 2


def test_a_mask_that_is_written_is_named_and_measured() -> None:
    torch.manual_seed(0)

    def mask(values: Tensor) -> Tensor:
        return values.index_fill(-1, torch.tensor([1]), -torch.inf)

    policy = TensorDictSequential(
        TensorDictModule(Encoder(), ["pixels"], ["features"]),
        TensorDictModule(nn.Linear(8, 3), ["features"], ["logits"]),
        TensorDictModule(mask, ["logits"], ["masked"]),
        TensorDictModule(best, ["masked"], ["action"]),
    )
    with pytest.raises(ValueError, match=REFUSED):
        counterfactual(policy, ToyEnv([5, 6]), episodes=2, donors=1)
    named: dict[str, Any] = {"output_key": "masked", "output_kind": "logits"}
    counterfactual(policy, ToyEnv([5, 6]), episodes=2, donors=1, **named)


def test_what_rests_on_actions_alone_takes_any_choice() -> None:
    env = KnownEnv([5] * 8)
    beliefs(choosing(worst), env, episodes=8)
    first = greedy_window(choosing(worst), ToyEnv([5]), seed=1)
    assert not torch.equal(first.action, greedy_window(choosing(best), ToyEnv([5]), seed=1).action)


@pytest.mark.parametrize("memory", ["lru", "mlp"])
@pytest.mark.parametrize("make", [make_network, make_actor_critic])
def test_a_chooser_behind_a_network_of_ours_is_asked(make: Any, memory: str) -> None:
    """Such a network was cut in two, and its own best action taken for the policy's."""
    torch.manual_seed(0)
    network = make("small", memory)
    output = "logits" if make is make_actor_critic else "action_value"
    env = arcade_torch.make("SignpostEasy", num_envs=1, observability="partial", seed=1)

    def policy(choose: Callable[[Tensor], Tensor]) -> TensorDictSequential:
        return TensorDictSequential(network, TensorDictModule(choose, [output], ["action"]))

    window = greedy_window(network, env, seed=1)
    same = greedy_window(policy(best), env, seed=1)
    other = greedy_window(policy(worst), env, seed=1)
    assert as_policy(policy(best)).splits
    assert torch.equal(same.action, window.action)
    assert other.action[0] != window.action[0]
    assert torch.equal(greedy_window(policy(best), env, seed=1, white=255).action, window.action)
    with pytest.raises(ValueError, match=REFUSED):
        recall_density(policy(worst), env, episodes=1)
    recall_density(policy(best), env, episodes=1)


class OwnAgent:
    """Somebody's agent, which acts by itself."""

    def __init__(self, choose: Callable[[Tensor], Tensor]) -> None:
        plain = linear_policy(0.5, dtype=torch.float32, pixel_scale=255.0)
        self.encode = plain.encode
        self.remember = plain.remember
        self.initial_state = plain.initial_state
        self.choose = choose

    def act(self, obs: Any, state: Any) -> tuple[Tensor, dict[str, Tensor], Any]:
        policy = Policy(self.encode, self.remember, self.initial_state)
        steps = len(obs["pixels"]), 1
        out, state = policy.unroll(
            policy.features(obs["pixels"])[:, None],
            obs["last_action"].reshape(steps),
            obs["is_init"].reshape(steps),
            state,
        )
        return self.choose(out[:, 0]), {}, state


@pytest.mark.parametrize("measure", DECISIONS)
def test_an_agent_that_chooses_otherwise_is_refused(measure: str) -> None:
    MEASURES[measure](OwnAgent(best))
    with pytest.raises(ValueError, match=REFUSED):
        MEASURES[measure](OwnAgent(worst))


def test_equal_outputs_may_be_chosen_from_at_will() -> None:
    values = torch.tensor([[0.5, 0.5, 0.2], [-torch.inf, 0.1, 0.1]])
    refuse_other_choices(values, torch.tensor([1, 2]))
    with pytest.raises(ValueError, match=r"got action 0 of value -inf where action 1 has 0.1"):
        refuse_other_choices(values, torch.tensor([1, 0]))
    with pytest.raises(ValueError, match=r"got action 3 of value none where action 0 has 0.5"):
        refuse_other_choices(values, torch.tensor([3, 2]))


def test_a_policy_acts_in_evaluation_mode_and_is_left_in_its_own() -> None:
    policy = choosing(best)
    modes = list[bool]()

    class Tells(nn.Module):
        def forward(self, values: Tensor) -> Tensor:
            modes.append(self.training)
            return best(values)

    own = TensorDictSequential(*policy[:2], TensorDictModule(Tells(), ["action_value"], ["action"]))
    frames = window(1).frames
    flags = torch.ones(1, 1, dtype=torch.bool)
    as_policy(own).act(
        {"pixels": frames, "is_init": flags, "last_action": torch.zeros(1)}, TensorDict({}, [1])
    )
    assert modes == [False] and own.training
