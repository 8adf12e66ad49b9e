"""Laws of sampling a policy."""

import pytest
import torch
from tensordict import TensorDict

from arcade_torch.agents.actor import CategoricalActor
from tests.agents.fakes import stream, toy_actor_critic
from tests.agents.test_actor import observation


class Fixed:
    """Always the same logits and value."""

    def __init__(self, logits):
        self.out = torch.tensor([*logits, 7.0])

    def __call__(self, pixels, last_action, is_init, state):
        return self.out.expand(pixels.shape[0], 1, -1), state

    def initial_state(self, batch_size):
        return TensorDict({}, [batch_size])

    def split(self, out):
        return out[..., :-1], out[..., -1]


def actor(logits, **options):
    return CategoricalActor(Fixed(logits), **({"generator": torch.Generator().manual_seed(0)} | options))


def act(player, n=20_000):
    return player.act(observation(n), player.initial_state(n))


def test_actions_are_drawn_with_the_probabilities_of_the_softmax_and_say_so():
    logits = [0.0, 1.0, -1.0, 2.0, 0.5]
    action, extras, _ = act(actor(logits))
    expected = torch.tensor(logits).softmax(-1)
    torch.testing.assert_close(torch.bincount(action, minlength=5) / 20_000, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(extras["action_log_prob"], expected.log()[action])
    assert (extras["state_value"] == 7.0).all()


def test_uniform_play_ignores_the_policy():
    player = actor([0.0, 9.0, 0.0, 0.0, 0.0])
    player.uniform = True
    torch.testing.assert_close(torch.bincount(act(player)[0]) / 20_000, torch.full((5,), 0.2), atol=0.01, rtol=0)


def test_greedy_takes_the_most_likely_and_of_equal_ones_the_lowest():
    action, extras, _ = act(actor([0.0, 3.0, 1.0, 3.0, 2.0], generator=None, greedy=True), 50)
    assert (action == 1).all() and extras["logits"].shape == (50, 5)


def test_draws_come_from_its_own_generator():
    before = torch.get_rng_state()
    first, again = (act(actor([0.0] * 5), 50)[0] for _ in range(2))
    other = act(actor([0.0] * 5, generator=torch.Generator().manual_seed(1)), 50)[0]
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_nan_logits_still_give_an_action():
    action, *_ = act(actor([float("nan")] * 5), 10)
    assert ((action >= 0) & (action < 5)).all()


def test_sampling_needs_a_generator():
    with pytest.raises(ValueError, match=r"torch\.Generator"):
        CategoricalActor(Fixed([0.0]))


def test_acting_step_by_step_records_what_the_whole_sequence_gives():
    network, s = toy_actor_critic(), stream(5, 9, seed=0)
    start = TensorDict({"actor": s.state, "critic": s.state.clone()}, [5])
    logits, value = network.split(network(s.pixels, s.last_action, s.is_init, start)[0])
    player, state = CategoricalActor(network, torch.Generator().manual_seed(0)), start
    for t in range(9):
        roots = {"pixels": s.pixels[:, t], "last_action": s.last_action[:, t], "is_init": s.is_init[:, t, None]}
        action, extras, state = player.act(TensorDict(roots, [5]), state)
        expected = logits[:, t].log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(extras["action_log_prob"], expected)
        torch.testing.assert_close(extras["state_value"], value[:, t])
