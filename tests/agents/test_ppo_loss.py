"""The PPO loss against one written from a step-by-step play, number by number."""

import math
import sys
from collections import OrderedDict
from dataclasses import replace
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import nn
from torchrl.modules import PopArtValueNorm, set_recurrent_mode
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule

import arcade_torch
from arcade_torch.agents import PPOConfig, PPOLoss, SequenceGAE, make_actor
from arcade_torch.agents.layout import as_steps
from arcade_torch.agents.learner import Training, epsilon_at, learning_rate_at
from arcade_torch.agents.ppo import PPO, ppo_objective
from arcade_torch.agents.returns import normalize
from arcade_torch.models import ActorCriticNetwork, make_actor_critic
from tests.agents.fakes import (
    ACTIONS,
    GAMMA,
    LAM,
    WIDTH,
    chosen,
    play,
    stream,
    summed_errors,
    toy_actor_critic,
    toy_network,
    with_two_states,
)

CLIP = 0.2
ESTIMATES = ("advantage", "value_target", "state_value")


def acted(s, form="sequences", shift=0.0, **options):
    """A network, the batch that it could have acted (its log-probabilities moved by ``shift``), and
    its loss.
    """
    network = toy_actor_critic(3)
    noise = torch.randn(s.action.shape, generator=torch.Generator().manual_seed(9))
    batch = getattr(s, form)()
    batch["action_log_prob"] = (
        chosen(play(network.actor, s)[0].log_softmax(-1), s.action) + shift * noise
    )
    loss = PPOLoss(make_actor(network.actor), network.critic, clip_epsilon=CLIP, **options)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return network, batch, loss


def normalise(advantage):
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)


def total(out):
    return out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]


@pytest.mark.parametrize("form", ["sequences", "stock"])
@pytest.mark.parametrize("seams", [0.0, 0.3])
@pytest.mark.parametrize("time_limit", ["bootstrap", "terminal"])
def test_every_part_equals_the_one_written_out(form, seams, time_limit):
    s = with_two_states(stream(3, 7, seed=2, seams=seams))
    network, batch, loss = acted(s, form, shift=0.4, time_limit=time_limit)
    batch = loss.value_estimator(batch)
    with torch.no_grad():
        network.critic.head.bias += 0.3  # the value has moved since, so that clipping it matters
        network.actor.head.bias += torch.linspace(-1, 1, 5)
    out = loss(batch)

    logits, (value_now, after) = (
        play(network.actor, s)[0],
        (x.squeeze(-1) for x in play(network.critic, s)),
    )
    value = value_now - 0.3
    terminated = s.terminated | s.truncated if time_limit == "terminal" else s.terminated
    advantage = summed_errors(s.reward, value, after - 0.3, terminated, s.cut, GAMMA, LAM)
    for key, wanted in zip(ESTIMATES, (advantage, advantage + value, value), strict=True):
        torch.testing.assert_close(batch[key].squeeze(-1), wanted, atol=1e-5, rtol=1e-5)
    mean = advantage.mean()
    deviation = math.sqrt(float(((advantage - mean) ** 2).mean()))
    policy = critic = entropy = 0.0
    for b in range(3):
        for t in range(7):
            p = logits[b, t].softmax(-1)
            entropy -= float((p * p.log()).sum()) / 21
            ratio = float(p[s.action[b, t]]) / math.exp(float(batch["action_log_prob"][b, t]))
            a = float(advantage[b, t] - mean) / (deviation + 1e-8)
            policy -= min(ratio * a, min(max(ratio, 1 - CLIP), 1 + CLIP) * a) / 21
            old, new = float(value[b, t]), float(value_now[b, t])
            held, g = old + min(max(new - old, -CLIP), CLIP), float(advantage[b, t] + value[b, t])
            critic += 0.5 * max((new - g) ** 2, (held - g) ** 2) / 21
    found = torch.stack(
        [out["loss_objective"], out["loss_critic"], out["loss_entropy"], out["entropy"]]
    ).detach()
    expected = torch.tensor([policy, 0.5 * critic, -0.01 * entropy, entropy])
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=2e-5)
    assert 0 < out["clip_fraction"] < 1 and out["kl_approx"] > 0


def test_before_the_first_step_the_ratio_is_one_and_values_are_those_of_the_rollout():
    s = with_two_states(stream(4, 9, seed=3))
    network, batch, loss = acted(s)
    out = loss(loss.value_estimator(batch))
    assert out["clip_fraction"] == 0 and abs(float(out["kl_approx"])) < 1e-6
    assert abs(float(out["loss_objective"].detach())) < 1e-5  # normalised advantages have mean 0
    torch.testing.assert_close(
        batch["state_value"], play(network.critic, s)[0], atol=1e-5, rtol=1e-5
    )


def test_advantages_do_not_depend_on_how_many_rows_are_read_at_once_and_rows_keep_theirs():
    s = with_two_states(stream(5, 8, seed=4, ends=0.5))
    network, batch, loss = acted(s)
    whole, parts = (
        SequenceGAE(network.critic, GAMMA, LAM, chunks=n)(batch.clone()) for n in (1, 3)
    )
    for key in ESTIMATES:
        torch.testing.assert_close(whole[key], parts[key])
    rows = torch.tensor([2, 0])
    assert torch.equal(whole[rows]["advantage"], whole["advantage"][rows])
    torch.testing.assert_close(loss(whole[rows])["entropy"], loss(whole[rows.flip(0)])["entropy"])


def test_an_estimate_by_given_parameters_is_that_of_a_critic_that_has_them():
    batch = with_two_states(stream(3, 7, seed=2)).sequences()
    critic, other = (toy_actor_critic(seed).critic for seed in (3, 4))
    estimator, wanted = SequenceGAE(critic, GAMMA, LAM), SequenceGAE(other, GAMMA, LAM)
    own = estimator(batch.clone())
    found = estimator(batch.clone(), params=TensorDict.from_module(other))
    for key in ESTIMATES:
        assert torch.equal(found[key], wanted(batch.clone())[key])
        assert torch.equal(estimator(batch.clone())[key], own[key])  # it has its own again
    assert not torch.equal(found["advantage"], own["advantage"])


def test_a_flat_sequence_gets_the_advantages_and_the_losses_of_a_batch_of_one():
    _, batch, loss = acted(with_two_states(stream(1, 8, seed=3)), "stock", shift=0.4)
    whole, flat = loss.value_estimator(batch.clone()), loss.value_estimator(batch[0].clone())
    for key in ESTIMATES:
        assert flat[key].shape == (8, 1) and torch.equal(flat[key], whole[key][0])
    for key, part in loss(whole).exclude("ESS").items():  # TorchRL's ESS counts rows
        torch.testing.assert_close(loss(flat)[key], part)


def test_without_estimates_the_loss_makes_them_and_leaves_the_batch_alone():
    _, batch, loss = acted(with_two_states(stream(3, 6, seed=5)))
    fresh = loss(batch)
    assert "advantage" not in batch
    torch.testing.assert_close(total(fresh), total(loss(loss.value_estimator(batch))))


def test_a_misspelt_time_limit_is_refused_when_estimator_or_loss_is_made():
    network = toy_actor_critic()
    for make in (
        partial(SequenceGAE, network.critic),
        partial(PPOLoss, make_actor(network.actor), network.critic),
    ):
        with pytest.raises(
            ValueError, match=r"^time_limit must be 'bootstrap' or 'terminal'; got 'Terminal'$"
        ):
            make(time_limit="Terminal")


@pytest.mark.parametrize("order", ["keys, estimator", "estimator, keys", "keys"])
def test_other_names_reach_the_estimator_whenever_they_are_set(order):
    network, batch, loss = acted(with_two_states(stream(3, 6, seed=5)))
    if order == "keys":
        loss.make_value_estimator()  # with the numbers of one that is made by itself
    wanted = loss.value_estimator(batch.clone())["advantage"]
    renamed = PPOLoss(make_actor(network.actor), network.critic)
    for what in order.split(", "):
        if what == "keys":
            renamed.set_keys(reward="pay", advantage="edge")
        else:
            renamed.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    found = renamed.value_estimator(batch.rename_key_(("next", "reward"), ("next", "pay")))
    assert torch.equal(found["edge"], wanted)


def test_a_gradient_reaches_both_towers_and_clipped_ratios_give_none_to_the_actor():
    s = with_two_states(stream(3, 6, seed=6))
    network, batch, loss = acted(s, entropy_coeff=0.0)
    batch = loss.value_estimator(batch)
    total(loss(batch)).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())
    network.zero_grad()
    batch["action_log_prob"] -= torch.sign(normalise(batch["advantage"])).squeeze(
        -1
    )  # beyond the clip, the good way
    total(loss(batch)).backward()
    assert all(p.grad is None or not p.grad.any() for p in network.actor.parameters())


@pytest.mark.parametrize("form", ["sequences", "stock"])
def test_objective_and_entropy_are_those_of_torchrls_own_loss(form):
    network, batch, ours = acted(with_two_states(stream(3, 6, seed=7)), form, shift=0.4)
    batch = ours.value_estimator(batch)
    found = ours(batch)
    theirs = ClipPPOLoss(
        make_actor(network.actor), network.critic, clip_epsilon=CLIP, normalize_advantage=False
    )
    from torchrl.modules import set_recurrent_mode

    from arcade_torch.agents.layout import as_steps

    steps = as_steps(batch, ours.inputs, "action", "action_log_prob", *ESTIMATES).copy()
    steps["advantage"] = normalise(steps["advantage"])
    with set_recurrent_mode(True):
        wanted = theirs(steps)
    for key in ("loss_objective", "loss_entropy", "clip_fraction"):
        torch.testing.assert_close(found[key], wanted[key])


@pytest.mark.parametrize("whole", [False, True], ids=["actor and critic", "whole"])
@pytest.mark.parametrize("form", ["sequences", "stock"])
def test_one_network_for_both_learns_as_two_with_its_weights(form, whole):
    s = stream(3, 6, seed=10)
    h = s.state["memory", "h"]

    def batch_and_loss(network, names, whole):
        state = TensorDict({"memory": {name: {"h": h} for name in names}}, s.state.batch_size)
        batch = getattr(replace(s, state=state), form)()
        batch["action_log_prob"] = torch.full(s.action.shape, -1.6)
        networks = (network,) if whole else (network.actor, network.critic)
        loss = PPOLoss(make_actor(networks[0]), *networks[1:], clip_epsilon=CLIP)
        loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
        return loss.value_estimator(batch), loss

    both = toy_network(
        3, 6, out_key="logits", value_key="state_value", state_key=("memory", "both")
    )
    apart = toy_actor_critic(3)
    for tower, rows in ((apart.actor, slice(0, 5)), (apart.critic, slice(5, 6))):
        tower.encoder.load_state_dict(both.encoder.state_dict())
        tower.block.load_state_dict(both.block.state_dict())
        with torch.no_grad():
            tower.head.weight.copy_(both.head.weight[rows])
            tower.head.bias.copy_(both.head.bias[rows])
    batch, loss = batch_and_loss(ActorCriticNetwork(both), ["both"], whole)
    other, wanted = batch_and_loss(apart, ["actor", "critic"], whole)
    for key in ESTIMATES:
        torch.testing.assert_close(batch[key], other[key])
    found, parts = loss(batch), wanted(other)
    for key in ("loss_objective", "loss_critic", "loss_entropy"):
        torch.testing.assert_close(found[key], parts[key])
    total(found).backward()
    total(parts).backward()
    for name, parameter in both.named_parameters():
        mine, theirs = (tower.get_parameter(name).grad for tower in (apart.actor, apart.critic))
        joined = torch.cat((mine, theirs)) if name.startswith("head") else mine + theirs
        torch.testing.assert_close(parameter.grad, joined)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in both.parameters()}


@pytest.mark.parametrize("memory", ["gru", "attention", "mlp"])
@pytest.mark.parametrize("towers", [1, 2])
def test_the_documented_call_works_for_one_tower_and_for_two(memory, towers):
    network = make_actor_critic("small", memory, towers=towers, hidden_size=16)
    env = arcade_torch.make("SignpostEasy", num_envs=2, seed=1)
    collector = arcade_torch.ArcadeCollector(env, make_actor(network), 12, final_frames="truncated")
    batch = collector.collect()
    collector.shutdown()
    parts = PPOLoss(make_actor(network.actor), network.critic)
    whole = PPOLoss(make_actor(network))
    assert {id(p) for p in parts.parameters()} == {id(p) for p in whole.parameters()}
    one = parts(batch.copy())
    other = whole(batch.copy())
    for key in parts.out_keys:
        torch.testing.assert_close(one[key], other[key])
    total(one).backward()
    gradients = [p.grad.clone() for p in network.parameters()]
    network.zero_grad()
    total(other).backward()
    for p, gradient in zip(network.parameters(), gradients, strict=True):
        torch.testing.assert_close(p.grad, gradient)


def test_a_critic_whose_memory_did_not_run_while_collecting_is_named():
    network = toy_actor_critic(3)
    batch = with_two_states(stream(4, 9, seed=3)).sequences()
    del batch["initial_state", "memory", "critic"]
    refused = r"^initial_state must hold .*critic.*while collecting[^\n]*$"
    with pytest.raises(ValueError, match=refused):
        SequenceGAE(network.critic)(batch)
    for key in ("advantage", "value_target", "state_value", "action_log_prob"):
        batch[key] = torch.zeros(4, 9)  # estimates of one's own, which take no pass of the critic
    with pytest.raises(ValueError, match=refused):
        PPOLoss(make_actor(network.actor), network.critic)(batch)


def test_torchrls_losses_train_actor_and_critic_of_one_tower():
    network = make_actor_critic("small", "gru", hidden_size=16)
    env = arcade_torch.make("SignpostEasy", num_envs=4, seed=1)
    collector = arcade_torch.ArcadeCollector(env, make_actor(network), 48, final_frames="truncated")
    options = {"normalize_advantage": False, "entropy_coeff": 0.01}
    ours = PPOLoss(make_actor(network.actor), network.critic, critic_coeff=0.5, **options)
    batch = ours.value_estimator(collector.collect())
    collector.shutdown()
    with torch.no_grad():  # the values move, so that clipping them is at work
        for parameter in network.parameters():
            parameter.add_(torch.full_like(parameter, 0.02))
    out = ours(batch)
    assert out["value_clip_fraction"] > 0

    steps = as_steps(batch, ours.inputs, "action", "action_log_prob", *ESTIMATES).copy()
    theirs = ClipPPOLoss(
        make_actor(network.actor),
        network.critic,
        loss_critic_type="l2",
        clip_value=True,
        critic_coeff=0.25,
        **options,
    )
    with set_recurrent_mode(True):
        expected = theirs(steps.copy())
        a2c = A2CLoss(make_actor(network.actor), network.critic)(steps.copy())
    for key in ("loss_objective", "loss_critic", "loss_entropy"):
        torch.testing.assert_close(out[key], expected[key])
    a2c["loss_critic"].backward()
    assert any(
        parameter.grad is not None and parameter.grad.any()
        for parameter in network.actor.block.parameters()
    )


def test_a_stored_value_is_never_taken_for_that_of_a_critic_that_writes_none():
    """It has no gradient, and the critic would not learn."""
    network, batch, loss = acted(with_two_states(stream(3, 6, seed=5)))
    batch = loss.value_estimator(batch)
    critic = toy_network(3, 1, out_key="guess", state_key=("memory", "critic"))
    with pytest.raises(KeyError, match="state_value"):
        PPOLoss(make_actor(network.actor), critic)(batch)


def test_a_loss_without_a_critic_needs_an_actor_that_writes_the_value():
    actor = make_actor(toy_actor_critic(3).actor)
    with pytest.raises(ValueError, match="critic_network must be given, unless"):
        PPOLoss(actor)


def test_the_entropy_bonus_fades_over_the_run():
    config = PPOConfig(
        num_envs=3, num_steps=6, epochs=2, minibatches=3, entropy_coeff=0.4, entropy_end=0.5
    )
    network = toy_actor_critic(3)
    training = Training(total_frames=36, generator=torch.Generator(), device=torch.device("cpu"))
    learner, seen = PPO(network, config, training), []
    learner.loss.register_forward_pre_hook(
        lambda loss, _: seen.append(round(float(loss.entropy_coeff), 4))
    )
    batch = with_two_states(stream(3, 6, seed=11)).sequences()
    batch["action_log_prob"] = torch.full((3, 6), -1.6)
    learner.update(batch, 0)
    learner.update(batch.exclude(*ESTIMATES), 18)
    assert seen == pytest.approx([0.4 * 0.5 ** (k / 12) for k in range(12)], abs=1e-4)


@pytest.mark.parametrize("form", ["sequences", "stock"])
def test_prediction_is_one_more_part_of_the_loss(form):
    network, batch, plain = acted(with_two_states(stream(3, 7, seed=11)), form, shift=0.4)
    batch = plain.value_estimator(batch)
    without, actor = plain(batch), network.actor
    with pytest.raises(KeyError, match="prediction_error"):
        PPOLoss(make_actor(actor), network.critic, prediction_coeff=0.5)(batch)
    actor.predictor = nn.Linear(WIDTH + ACTIONS, WIDTH)
    loss = PPOLoss(make_actor(actor), network.critic, clip_epsilon=CLIP, prediction_coeff=0.5)
    out = loss(batch)
    assert loss.out_keys[-1] == "loss_prediction"
    assert all(torch.equal(out[key], value) for key, value in without.items())
    with set_recurrent_mode(True):
        error = actor(as_steps(batch, loss.inputs))["prediction_error"]
    torch.testing.assert_close(out["loss_prediction"], 0.5 * error.mean())
    out["loss_prediction"].backward()
    parts = (actor.encoder, actor.block, actor.predictor, actor.head, network.critic)
    assert [any(p.grad is not None and p.grad.any() for p in m.parameters()) for m in parts] == [
        True
    ] * 3 + [False] * 2


def test_it_is_a_torchrl_loss_with_its_keys():
    network, batch, loss = acted(with_two_states(stream(2, 5, seed=8)))
    batch = loss.value_estimator(batch)
    out = loss(batch)
    assert isinstance(loss, LossModule) and set(out.keys()) == set(loss.out_keys)
    assert sorted(key for key, v in out.items() if v.requires_grad) == [
        "loss_critic",
        "loss_entropy",
        "loss_objective",
    ]
    assert {id(p) for p in loss.parameters()} == {id(p) for p in network.parameters()}
    loss.set_keys(sample_log_prob="before", advantage="edge", reward="pay")
    batch.rename_key_("action_log_prob", "before").rename_key_(("next", "reward"), ("next", "pay"))
    again = loss.value_estimator(batch.exclude("advantage"))
    torch.testing.assert_close(again["edge"], batch["advantage"])
    torch.testing.assert_close(total(loss(again)), total(out))


def test_advantages_are_normalised_and_a_constant_stays_finite():
    advantage = torch.randn(4, 5, 1)
    torch.testing.assert_close(normalize(advantage), normalise(advantage))
    assert torch.equal(normalize(torch.full((2, 3), 5.0)), torch.zeros(2, 3))


@pytest.mark.parametrize("counted", [0, 1, 2, 20])
def test_advantages_between_padding_are_normalised_as_if_there_were_none(counted):
    advantage = torch.randn(4, 5, 1)
    mask = (torch.randperm(20) < counted).view(4, 5, 1)
    wanted = torch.zeros(4, 5, 1)
    if counted:
        wanted[mask] = normalize(advantage[mask])
    advantage[~mask] = torch.nan
    torch.testing.assert_close(normalize(advantage, mask), wanted)


def parts_of(loss, batch):
    with torch.no_grad():
        return {key: value.clone() for key, value in loss(batch).items()}


@pytest.mark.parametrize("form", ["sequences", "stock"])
def test_a_norm_of_torchrl_divides_the_advantages_in_the_place_of_each_minibatchs_own(form):
    s = with_two_states(stream(3, 7, seed=12))
    network, batch, plain = acted(s, form, shift=0.4)
    norm = PopArtValueNorm(beta=0.5, epsilon=1e-8)
    loss = PPOLoss(
        make_actor(network.actor), network.critic, clip_epsilon=CLIP, advantage_norm=norm
    )
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    batch = loss.value_estimator(batch)
    norm.update(batch["advantage"])
    found, wanted = parts_of(loss, batch), parts_of(plain, batch)
    assert norm.debiasing_term == 0.5  # one update: a loss of estimated advantages gives none
    shifted = batch.copy().set("advantage", batch["advantage"] - batch["advantage"].mean())
    torch.testing.assert_close(parts_of(loss, shifted)["loss_objective"], wanted["loss_objective"])
    assert not torch.allclose(
        found["loss_objective"], wanted["loss_objective"]
    )  # it is not centred
    assert torch.equal(found["loss_critic"], wanted["loss_critic"])


def test_a_norm_learns_from_value_targets_where_the_loss_estimates_by_itself_in_training():
    network, batch, plain = acted(with_two_states(stream(3, 7, seed=12)))
    norm = PopArtValueNorm(beta=0.5, epsilon=1e-8)
    loss = PPOLoss(
        make_actor(network.actor), network.critic, clip_epsilon=CLIP, advantage_norm=norm
    )
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    loss(batch)
    torch.testing.assert_close(
        norm.scale(), plain.value_estimator(batch.copy())["value_target"].std(correction=0)[None]
    )
    loss.eval()(batch)
    assert norm.debiasing_term == 0.5


def test_the_learner_follows_the_deviation_of_its_windows():
    config = PPOConfig(
        num_envs=3, num_steps=6, epochs=2, minibatches=3, learning_rate=1e-9, advantage_decay=0.9
    )
    training = Training(total_frames=36, generator=torch.Generator(), device=torch.device("cpu"))
    learner, seen = PPO(toy_actor_critic(3), config, training), []
    window = with_two_states(stream(3, 6, seed=11)).sequences()
    window["action_log_prob"] = torch.full((3, 6), -1.6)
    advantage = torch.randn(3, 6, 1)
    advantage -= advantage.mean()
    estimates = {"value_target": torch.zeros(3, 6, 1), "state_value": torch.zeros(3, 6, 1)}
    for size in (1.0, 0.01):
        learner.loss._value_estimator.forward = lambda data, size=size: data.update(
            {"advantage": size * advantage, **estimates}
        )
        learner.update(window.copy(), 0)
        seen.append(learner.norm.scale().item())
    squares = 0.9 * 1.0 + 0.01**2  # without bias: weights .9 and 1 of 1.9
    deviation = advantage.std(correction=0).item()
    assert seen == pytest.approx([deviation, deviation * math.sqrt(squares / 1.9)], rel=1e-4)
    assert (
        PPO(toy_actor_critic(3), replace(config, advantage_decay=0.0), training).loss.advantage_norm
        is None
    )


def test_the_defaults_are_the_papers():
    c = PPOConfig()
    assert (c.num_envs, c.num_steps, c.epochs, c.minibatches, c.gamma, c.lam) == (
        16,
        128,
        4,
        16,
        0.99,
        0.95,
    )
    assert (c.clip, c.entropy_coeff, c.critic_coeff, c.max_grad_norm) == (0.2, 0.01, 0.5, 0.5)
    assert (c.entropy_end, c.advantage_decay) == (1.0, 0.0)
    assert learning_rate_at(c, 0, 10**7) == 1e-4 and learning_rate_at(c, 10**7, 10**7) == 1e-10
    assert learning_rate_at(c, 5 * 10**6, 10**7) == pytest.approx((1e-4 + 1e-10) / 2)
    assert epsilon_at(c, 0, 10**7) is None and c.steps_before == 0


def test_the_objective_is_a_function_of_tensors_with_the_clips_of_the_paper():
    old = torch.zeros(4)
    ratio = torch.tensor([1.5, 1.5, 0.5, 1.1])
    advantage = torch.tensor([1.0, -1.0, 1.0, 2.0])
    value = torch.tensor([1.0, 0.1, 0.0, -1.0])
    terms = ppo_objective(
        ratio.log(), old, advantage, value, torch.zeros(4), torch.ones(4), torch.tensor(0.2)
    )
    torch.testing.assert_close(terms["policy_loss"], -torch.tensor([1.2, -1.5, 0.5, 2.2]))
    torch.testing.assert_close(terms["value_loss"], 0.5 * torch.tensor([0.64, 0.81, 1.0, 4.0]))
    assert terms["clipped"].tolist() == [1, 1, 1, 0] and terms["value_clipped"].tolist() == [
        1,
        0,
        0,
        1,
    ]
    torch.testing.assert_close(terms["kl"], ratio - 1 - ratio.log())
    unclipped = ppo_objective(
        ratio.log(), old, advantage, value, None, torch.ones(4), torch.tensor(0.2)
    )
    torch.testing.assert_close(unclipped["value_loss"], 0.5 * (value - 1).square())
    assert not unclipped["value_clipped"].any()


def test_a_gradient_step_of_ppo_never_waits_for_the_device():
    """TorchRL's ``ClipPPOLoss`` tests its clip, a buffer, with ``if``: a wait on a GPU in every
    call.
    """
    _, batch, loss = acted(with_two_states(stream(3, 6, seed=5)))
    batch = loss.value_estimator(batch)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        total(loss(batch)).backward()
    names = {event.key for event in profiler.key_averages()}
    assert "aten::exp" in names and "aten::_local_scalar_dense" not in names


@pytest.mark.parametrize("named", [False, True], ids=["listed", "named"])
def test_an_actor_of_whatever_parts_gives_the_value_without_what_tensordict_gives_up(
    named, monkeypatch
):
    """``det_part`` warns from tensordict 0.15 on, and goes with 0.17."""

    def for_tensordict_alone(actor):
        assert sys._getframe(1).f_globals["__name__"].startswith("tensordict.")
        return actor._det_part

    gone = property(for_tensordict_alone)
    monkeypatch.setattr(ProbabilisticTensorDictSequential, "det_part", gone)
    s = with_two_states(stream(2, 5, seed=1))
    network, batch, _ = acted(s)
    parts = make_actor(network)
    if named:
        names = OrderedDict(zip(("network", "draw"), parts, strict=True))
        parts = ProbabilisticTensorDictSequential(names)
    loss = PPOLoss(parts)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    expected = PPOLoss(make_actor(network), network.critic)
    expected.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    ours, theirs = loss.value_estimator(batch.copy()), expected.value_estimator(batch.copy())
    for key in ESTIMATES:
        torch.testing.assert_close(ours[key], theirs[key])
    total(loss(ours)).backward()
