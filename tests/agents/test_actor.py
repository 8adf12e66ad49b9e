"""Laws of epsilon-greedy acting."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from arcade_torch.agents.actor import EpsilonGreedyActor
from tests.agents.fakes import ACTIONS, ToyNetwork, stream


class Constant(nn.Module):
    """Always the same Q-values."""

    def __init__(self, q):
        super().__init__()
        self.q = torch.tensor(q)

    def forward(self, pixels, last_action, is_init, state):
        return self.q.expand(pixels.shape[0], 1, -1), state

    def initial_state(self, batch_size):
        return TensorDict({}, [batch_size])


def observation(n):
    return TensorDict(
        {"pixels": torch.zeros(n, 2, 2, 3, dtype=torch.uint8), "last_action": torch.zeros(n, dtype=torch.int64)}
        | {"is_init": torch.zeros(n, 1, dtype=torch.bool)},
        [n],
    )


def act(actor, n=20_000):
    return actor.act(observation(n), actor.initial_state(n))


def test_equal_values_go_to_the_lowest_action():
    action, _, _ = act(EpsilonGreedyActor(Constant([0.0, 2.0, 1.0, 2.0, 2.0]), greedy=True), 100)
    assert action.dtype == torch.int64 and (action == 1).all()


@pytest.mark.parametrize("epsilon", [0.0, 0.2, 1.0])
def test_every_action_has_a_share_of_epsilon_and_the_best_the_rest(epsilon):
    actor = EpsilonGreedyActor(Constant([0.0, 0.0, 1.0, 0.0, 0.0]), epsilon, torch.Generator().manual_seed(0))
    share = torch.bincount(act(actor)[0], minlength=ACTIONS) / 20_000
    expected = torch.full((ACTIONS,), epsilon / ACTIONS)
    expected[2] += 1 - epsilon
    torch.testing.assert_close(share, expected, atol=0.01, rtol=0)


def test_random_actions_are_independent_between_environments():
    actor = EpsilonGreedyActor(Constant([1.0, 0.0, 0.0, 0.0, 0.0]), 0.5, torch.Generator().manual_seed(0))
    explored = torch.stack([act(actor, 2)[0] != 0 for _ in range(4000)]).double()
    assert abs(torch.corrcoef(explored.T)[0, 1]) < 0.06


def test_greedy_never_explores():
    actor = EpsilonGreedyActor(Constant([0.0, 1.0, 0.0, 0.0, 0.0]), 1.0, torch.Generator().manual_seed(0), greedy=True)
    assert (act(actor)[0] == 1).all()


def test_draws_come_from_its_own_generator():
    def actions(seed, shift):
        torch.rand(shift)
        actor = EpsilonGreedyActor(Constant([0.0] * 5), 1.0, torch.Generator().manual_seed(seed))
        return act(actor, 50)[0]

    before = torch.get_rng_state()
    assert torch.equal(actions(3, 0), actions(3, 7))
    assert not torch.equal(actions(3, 0), actions(4, 0))
    torch.set_rng_state(before)
    actions(3, 0)
    assert torch.equal(torch.get_rng_state(), before)


def test_acting_step_by_step_gives_the_q_values_of_the_whole_sequence():
    network, s = ToyNetwork(), stream(5, 9, seed=0)
    actor, state = EpsilonGreedyActor(network, greedy=True, record_q=True), s.state
    expected, _ = network(s.pixels, s.last_action, s.is_init, s.state)
    for t in range(9):
        obs = TensorDict(
            {"pixels": s.pixels[:, t], "last_action": s.last_action[:, t], "is_init": s.is_init[:, t, None]}, [5]
        )
        action, extras, state = actor.act(obs, state)
        torch.testing.assert_close(extras["q_value"], expected[:, t])
        assert torch.equal(action, expected[:, t].argmax(-1))
        assert not state["h"].requires_grad


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="epsilon must lie"):
        EpsilonGreedyActor(Constant([0.0]), 1.5)
    with pytest.raises(ValueError, match=r"torch\.Generator"):
        EpsilonGreedyActor(Constant([0.0]), 0.1)
