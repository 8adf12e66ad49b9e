"""The PPO loss against one written from a step-by-step replay, number by number."""

import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import LossModule

from arcade_torch.agents.ppo import PPOConfig, PPOLoss, normalise
from tests.agents.fakes import Stream, replay, stream, toy_actor_critic
from tests.agents.test_gae import by_hand

GAMMA, LAM, CLIP = 0.9, 0.7, 0.2


def two_states(s: Stream, seed: int = 0) -> Stream:
    """The stream as an actor-critic would have acted it: a state for each tower."""
    g = torch.Generator().manual_seed(seed)
    other = TensorDict({"h": torch.randn(s.state["h"].shape, generator=g)}, s.state.batch_size)
    return dataclasses.replace(s, state=TensorDict({"actor": s.state, "critic": other}, s.state.batch_size))


def tower(s: Stream, name: str) -> Stream:
    return dataclasses.replace(s, state=s.state[name])


def acted(s: Stream, kind: str = "sequences", shift: float = 0.0, **options) -> tuple:
    """A network, the batch it could have acted (its log-probabilities moved by ``shift``), and its loss."""
    network = toy_actor_critic(3)
    logits, _ = replay(network.actor, tower(s, "actor"))
    log_prob = logits.log_softmax(-1).gather(-1, s.action.unsqueeze(-1)).squeeze(-1)
    noise = torch.randn(log_prob.shape, generator=torch.Generator().manual_seed(9))
    batch = s.sequences() if kind == "sequences" else stock(s)
    batch["action_log_prob"] = log_prob + shift * noise
    return network, batch, PPOLoss(network, GAMMA, LAM, clip=CLIP, **options)


def stock(s: Stream) -> TensorDict:
    batch = tower(s, "actor").stock()
    rows, steps = s.action.shape
    states = {}
    for name in ("actor", "critic"):
        states[name] = {"h": torch.full((rows, steps, 6), torch.nan)}
        states[name]["h"][:, 0] = s.state[name]["h"]
    return batch.set("memory", TensorDict(states, batch_size=[rows, steps]))


@pytest.mark.parametrize("kind", ["sequences", "stock"])
@pytest.mark.parametrize("time_limit", ["bootstrap", "terminal"])
def test_every_part_equals_the_one_written_out(kind, time_limit):
    s = two_states(stream(3, 7, seed=2))
    network, batch, loss = acted(s, kind, shift=0.4, time_limit=time_limit)
    window = loss.prepare(loss.read(batch))
    with torch.no_grad():
        network.critic.head.bias += 0.3  # the value has moved since, so that clipping it matters
        network.actor.head.bias += torch.linspace(-1, 1, 5)
    out = loss.compute(window)

    moved = {name: replay(getattr(network, name), tower(s, name))[0] for name in ("actor", "critic")}
    value_now = moved["critic"].squeeze(-1)
    value, after = value_now - 0.3, replay(network.critic, tower(s, "critic"))[1] - 0.3
    terminated = s.terminated | s.truncated if time_limit == "terminal" else s.terminated
    advantage = by_hand(s.reward, value, after, terminated, s.truncated, GAMMA, LAM)
    target = advantage + value
    mean = advantage.mean()
    deviation = math.sqrt(float(((advantage - mean) ** 2).mean()))
    policy = critic = entropy = 0.0
    for b in range(3):
        for t in range(7):
            p = moved["actor"][b, t].softmax(-1)
            entropy -= float((p * p.log()).sum()) / 21
            ratio = float(p[s.action[b, t]]) / math.exp(float(batch["action_log_prob"][b, t]))
            a = float(advantage[b, t] - mean) / (deviation + 1e-8)
            policy -= min(ratio * a, min(max(ratio, 1 - CLIP), 1 + CLIP) * a) / 21
            old, new = float(value[b, t]), float(value_now[b, t])
            held = old + min(max(new - old, -CLIP), CLIP)
            g = float(target[b, t])
            critic += 0.5 * max((new - g) ** 2, (held - g) ** 2) / 21
    expected = torch.tensor([policy, critic, entropy, policy + 0.5 * critic - 0.01 * entropy])
    actual = torch.stack([out.policy, out.value, out.entropy, out.loss]).detach()
    torch.testing.assert_close(actual, expected, atol=2e-5, rtol=2e-5)
    assert 0 < out.clip_share < 1 and out.kl > 0


def test_before_the_first_step_the_ratio_is_one_and_values_are_those_of_the_rollout():
    s = two_states(stream(4, 9, seed=3))
    network, batch, loss = acted(s)
    window = loss.prepare(loss.read(batch))
    out = loss.compute(window)
    assert (out.log_prob - batch["action_log_prob"]).abs().max() < 1e-5
    torch.testing.assert_close(out.state_value, replay(network.critic, tower(s, "critic"))[0].squeeze(-1))
    torch.testing.assert_close(out.state_value, window.extras["state_value"])
    assert out.clip_share == 0 and out.kl.abs() < 1e-6
    assert out.policy.abs() < 1e-5  # normalised advantages have mean 0


def test_advantages_do_not_depend_on_how_many_rows_are_read_at_once():
    s = two_states(stream(5, 8, seed=4, end_share=0.5))
    _, batch, loss = acted(s)
    window = loss.read(batch)
    whole, single = loss.prepare(window), loss.prepare(window, rows_at_once=2)
    torch.testing.assert_close(whole.extras["advantage"], single.extras["advantage"])
    assert whole.slot.shape[1] == 0 and window.slot.shape[1] > 0


def test_rows_of_a_prepared_window_keep_their_advantages():
    s = two_states(stream(4, 6, seed=5))
    _, batch, loss = acted(s)
    window = loss.prepare(loss.read(batch))
    rows = window.rows([2, 0])
    assert torch.equal(rows.extras["advantage"], window.extras["advantage"][[2, 0]])
    assert torch.equal(loss.compute(rows).log_prob, loss.compute(rows).log_prob)
    torch.testing.assert_close(loss.compute(rows).log_prob, loss.compute(window).log_prob[[2, 0]])


def test_a_gradient_reaches_both_towers_and_clipped_ratios_give_none_to_the_actor():
    s = two_states(stream(3, 6, seed=6))
    network, batch, loss = acted(s, entropy_weight=0.0)
    loss.compute(loss.prepare(loss.read(batch))).loss.backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())
    network, batch, loss = acted(s, entropy_weight=0.0)
    window = loss.prepare(loss.read(batch))
    sign = torch.sign(normalise(window.extras["advantage"]))
    far = window.with_extras(log_prob=window.extras["log_prob"] - sign)  # every ratio is beyond the clip, the good way
    loss.compute(far).loss.backward()
    assert all(p.grad is None or not p.grad.any() for p in network.actor.parameters())


def test_the_policy_part_is_that_of_torchrls_clip_ppo():
    """The same ratio and advantages through ClipPPOLoss, one step a row, without memory or value."""
    from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
    from torchrl.objectives import ClipPPOLoss

    s = two_states(stream(3, 6, seed=7))
    network, batch, loss = acted(s, shift=0.4)
    window = loss.prepare(loss.read(batch))
    ours = loss.compute(window)
    logits, _ = replay(network.actor, tower(s, "actor"))
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(torch.nn.Identity(), in_keys=["scores"], out_keys=["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["action"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        ),
    )
    critic = TensorDictModule(torch.nn.Linear(1, 1), in_keys=["value_in"], out_keys=["state_value"])
    theirs = ClipPPOLoss(actor, critic, clip_epsilon=CLIP, entropy_coeff=0.01, normalize_advantage=False)
    flat = {
        "scores": logits,
        "action": s.action,
        "action_log_prob": batch["action_log_prob"],
        "advantage": normalise(window.extras["advantage"]).unsqueeze(-1),
        "value_target": torch.zeros(3, 6, 1),
        "value_in": torch.zeros(3, 6, 1),
    }
    data = TensorDict(flat, batch_size=[3, 6]).reshape(-1)
    data["sample_log_prob"] = data["action_log_prob"]
    found = theirs(data)
    torch.testing.assert_close(ours.policy.detach(), found["loss_objective"].detach())
    torch.testing.assert_close(-0.01 * ours.entropy.detach(), found["loss_entropy"].detach())
    torch.testing.assert_close(ours.clip_share, found["clip_fraction"])


def test_it_is_a_torchrl_loss_with_its_keys():
    s = two_states(stream(2, 5, seed=8))
    network, batch, loss = acted(s)
    out = loss(batch)
    assert isinstance(loss, LossModule) and set(out.keys()) == set(loss.out_keys)
    parts = sum(v for k, v in out.items() if k.startswith("loss_"))
    torch.testing.assert_close(parts, loss.compute(loss.prepare(loss.read(batch))).loss)
    assert sorted(k for k, v in out.items() if v.requires_grad) == ["loss_critic", "loss_entropy", "loss_objective"]
    loss.set_keys(action_log_prob="before")
    torch.testing.assert_close(loss(batch.rename_key_("action_log_prob", "before"))["loss_critic"], out["loss_critic"])
    assert {id(p) for p in loss.parameters()} == {id(p) for p in network.parameters()}


def test_a_constant_advantage_stays_finite():
    assert torch.equal(normalise(torch.full((2, 3), 5.0)), torch.zeros(2, 3))


def test_the_defaults_are_the_papers():
    c = PPOConfig()
    assert (c.num_envs, c.num_steps, c.epochs, c.minibatches, c.gamma, c.lam) == (16, 128, 4, 16, 0.99, 0.95)
    assert (c.clip, c.entropy_weight, c.value_weight, c.max_grad_norm) == (0.2, 0.01, 0.5, 0.5)
    assert c.learning_rate_at(0, 10**7) == 1e-4 and c.learning_rate_at(10**7, 10**7) == 1e-10
    assert c.learning_rate_at(5 * 10**6, 10**7) == pytest.approx((1e-4 + 1e-10) / 2)
    assert c.epsilon_at(0, 10**7) is None and c.prefix == 0
