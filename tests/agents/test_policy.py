"""How a network acts: explores, samples, is greedy; an agent is a policy."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import (
    Agent,
    build_network,
    evaluate,
    load,
    make_actor,
    make_policy,
    preset,
)
from arcade_torch.agents.policy import check_network
from arcade_torch.agents.runs.checkpoint import CheckpointError, save_checkpoint
from arcade_torch.models import make_network, memory_names
from arcade_torch.tools.measures.windows import resolve_agent
from tests.agents.fakes import ACTIONS, stream, toy_actor_critic, toy_network, with_two_states

MANY = 20_000


def q_policy(values, **options):
    """Always the same Q-values."""
    network = TensorDictModule(
        lambda x: torch.tensor(values).expand(len(x), -1), ["pixels"], ["action_value"]
    )
    return make_policy(network, **options)  # type: ignore[arg-type]


def sampler(logits, **options):
    """Always the same logits."""
    network = TensorDictModule(
        lambda x: torch.tensor(logits).expand(len(x), -1), ["pixels"], ["logits"]
    )
    return make_actor(network, **options)


def act(policy, n=MANY):
    return policy(TensorDict({"pixels": torch.zeros(n, 1)}, [n]))


def shares(out):
    return torch.bincount(out["action"], minlength=ACTIONS) / len(out)


@pytest.mark.parametrize("epsilon", [0.0, 0.2, 1.0])
def test_every_action_has_a_share_of_epsilon_and_the_best_the_rest(epsilon):
    policy = q_policy([0.0, 0.0, 1.0, 0.0, 0.0])
    policy[-1].eps.fill_(epsilon)  # as the training loop does
    expected = torch.full((ACTIONS,), epsilon / ACTIONS)
    expected[2] += 1 - epsilon
    with set_exploration_type(ExplorationType.RANDOM):
        torch.testing.assert_close(shares(act(policy)), expected, atol=0.01, rtol=0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert (act(policy)["action"] == 2).all()


def test_random_actions_are_independent_between_environments():
    policy = q_policy([1.0, 0.0, 0.0, 0.0, 0.0], epsilon=0.5)
    with set_exploration_type(ExplorationType.RANDOM):
        explored = torch.stack([act(policy, 2)["action"] != 0 for _ in range(3000)]).double()
    assert abs(torch.corrcoef(explored.T)[0, 1]) < 0.06


def test_actions_are_drawn_with_the_probabilities_of_the_softmax_and_say_so():
    logits = [0.0, 1.0, -1.0, 2.0, 0.5]
    with set_exploration_type(ExplorationType.RANDOM):
        out = act(sampler(logits))
    expected = torch.tensor(logits).softmax(-1)
    torch.testing.assert_close(shares(out), expected, atol=0.01, rtol=0)
    torch.testing.assert_close(out["action_log_prob"], expected.log()[out["action"]])


def test_nan_logits_still_give_an_action():
    with set_exploration_type(ExplorationType.RANDOM):
        out = act(sampler([float("nan")] * 5), 10)  # the learner then names the update
    assert ((out["action"] >= 0) & (out["action"] < 5)).all() and out[
        "action_log_prob"
    ].isnan().all()


@pytest.mark.parametrize(
    "policy",
    [
        q_policy([0.0, 2.0, 1.0, 2.0, 2.0], explore=False),
        sampler([0.0, 3.0, 1.0, 3.0, 2.0], deterministic=True),
    ],
)
def test_greedy_takes_the_best_and_of_equal_ones_the_lowest_and_draws_nothing(policy):
    before = torch.get_rng_state()
    out = act(policy, 50)
    assert out["action"].dtype == torch.int64 and (out["action"] == 1).all()
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("kind", ["q", "actor-critic"])
def test_acting_step_by_step_gives_the_outputs_of_the_whole_sequence(kind):
    s = stream(5, 9, seed=0)
    if kind == "q":
        network, start = toy_network(), s.state["memory"]
    else:
        network, s = toy_actor_critic(), with_two_states(s)
        start = s.state["memory"]
    whole, _ = network.remember(network.encode(s.pixels), s.last_action, s.is_init, start)
    policy, batch, state = make_policy(network, explore=False), s.sequences(), s.state
    for t in range(9):
        roots = {key: batch[key][:, t] for key in ("pixels", "last_action", "is_init")}
        out = policy(TensorDict(roots, [5]).update(state))
        if kind == "q":
            torch.testing.assert_close(out["action_value"], whole[:, t])
            assert torch.equal(out["action"], whole[:, t].argmax(-1))
        else:
            heads = network.by_head(whole[:, t])
            torch.testing.assert_close(out["state_value"], heads["state_value"])
            log_probs = heads["logits"].log_softmax(-1)
            log_prob = log_probs.gather(-1, out["action"].unsqueeze(-1)).squeeze(-1)
            torch.testing.assert_close(out["action_log_prob"], log_prob)
        state = out["next"].select(*s.state.keys())


@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_an_agent_is_a_policy_and_says_what_its_outputs_are(algorithm):
    config = preset("smoke", algorithm=algorithm, memory="gru")
    agent = Agent(config, build_network(config))
    env = arcade_torch.make("CartPoleEasy", num_envs=2, seed=0)
    env = TransformedEnv(env, get_primers_from_module(agent, warn=False))
    played, state = env.rollout(6, agent, break_when_any_done=False), agent.initial_state(2)
    for t in range(6):  # the other way to ask it
        roots = {key: played[key][:, t] for key in ("pixels", "last_action", "is_init")}
        action, extras, state = agent.act(TensorDict(roots, [2]), state)
        assert torch.equal(action, played["action"][:, t]) and extras
        for key, value in extras.items():
            written = played["action_value" if key == "q_value" else key][:, t]
            torch.testing.assert_close(value, written.reshape(value.shape))
    frames = torch.randint(256, (1, 3, 32, 32, 3), dtype=torch.uint8)
    last, flags = torch.zeros(1, 3, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.bool)
    out, _ = agent.network.remember(
        agent.network.encode(frames), last, flags, agent.initial_state(1)
    )
    assert agent.offers == (("logits", "probs", "value") if algorithm == "ppo" else ("q", "value"))
    assert agent.outputs(out, "value").shape == (1, 3, 1)
    if algorithm == "ppo":
        torch.testing.assert_close(
            agent.outputs(out, "probs"), agent.outputs(out, "logits").softmax(-1)
        )
        assert torch.equal(agent.outputs(out, "value"), out[..., -1:])
    else:
        assert torch.equal(agent.outputs(out, "q"), out)
        assert torch.equal(agent.outputs(out, "value"), out.amax(-1, keepdim=True))
    with pytest.raises(ValueError, match=r"offers: .*; got 'advantage'"):
        agent.outputs(out, "advantage")


@pytest.mark.parametrize(("device", "graphs"), [("cuda", False), ("cuda", True), ("cuda:3", False)])
def test_an_agent_of_a_gpu_is_loaded_and_plays_where_there_is_none(
    tmp_path, monkeypatch, device, graphs
):
    """Of one with a high index also where there are others."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device == "cuda:3")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: int(device == "cuda:3"))
    config = preset("smoke", env="SignpostEasy-v0", device=device, cuda_graphs=graphs)
    weights = build_network(replace(config, device="cpu", cuda_graphs=False)).state_dict()
    save_checkpoint(tmp_path / "checkpoints", config, 128, weights, {})
    agent = load(tmp_path)
    assert agent.config == config and next(agent.network.parameters()).device.type == "cpu"
    assert len(evaluate(agent, episodes=2).returns) == 2
    _, env = resolve_agent(agent, num_envs=2)
    assert env.device.type == "cpu"


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_a_network_is_of_its_configs_seed_and_size_whatever_was_drawn_before(algorithm):
    weights = []
    for seed, draws in ((1, 5), (1, 6), (2, 6)):
        torch.manual_seed(draws)
        before = torch.get_rng_state()
        network = build_network(preset("smoke", algorithm=algorithm, seed=seed, obs_size=256))
        assert torch.equal(torch.get_rng_state(), before)
        frame = torch.zeros(1, 256, 256, 3, dtype=torch.uint8)
        assert network.compress(frame).shape == (1, 8, 8, 48)
        weights.append(torch.cat([p.flatten() for p in network.parameters()]))
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize("memory", ["gru", "feedforward"])
def test_a_policy_has_as_many_actions_as_its_network_has_outputs(memory):
    network = make_network("small", memory, num_outputs=3, num_actions=3)
    roots = {
        "pixels": torch.zeros(200, 32, 32, 3, dtype=torch.uint8),
        "is_init": torch.ones(200, 1, dtype=torch.bool),
    }
    step = TensorDict(roots | {"last_action": torch.zeros(200, dtype=torch.int64)}, [200])
    with set_exploration_type(ExplorationType.RANDOM):
        assert set(make_policy(network, epsilon=1.0)(step.clone())["action"].tolist()) == {0, 1, 2}
        assert set(make_policy(network, epsilon=1.0, num_actions=2)(step)["action"].tolist()) == {
            0,
            1,
        }


@pytest.mark.parametrize("name", ["use_last_action", "zero_action_on_reset", "predicts"])
@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_an_option_that_is_true_or_false_takes_no_text(algorithm, name):
    with pytest.raises(ValueError, match=rf"^{name} must be True or False, got 'false'$"):
        build_network(preset("smoke", algorithm=algorithm, network_options={name: "false"}))


@pytest.mark.parametrize("name", ["hidden_size", "layers"])
def test_a_network_without_any_size_is_refused_in_one_line(name):
    with pytest.raises(ValueError, match=rf"^{name} must be at least 1 and at most \d+, got -4$"):
        build_network(preset("smoke", memory="gru", network_options={name: -4}))


def refusal_of(function, config):
    """What a function says of a config that it refuses."""
    with pytest.raises((ValueError, TypeError)) as refusal:
        function(config)
    return str(refusal.value)


@pytest.mark.parametrize("memory", ["gru", "attention", "mlstm"])
def test_without_data_a_memory_stores_what_it_stores_with_data(memory):
    network = make_network("small", memory=memory)
    with torch.device("meta"):
        assert make_network("small", memory=memory).store == network.store
        assert make_network("small", memory=memory, store="step").store == "step"


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_a_network_is_checked_as_it_is_built_but_without_weights_or_draws(algorithm):
    drawn = torch.random.get_rng_state()
    for memory in (*memory_names(), "feedforward"):
        check_network(preset("paper", memory=memory, algorithm=algorithm))
        options = {"memory_options": {"zork": 1}}
        wrong = preset("smoke", memory=memory, algorithm=algorithm, network_options=options)
        assert refusal_of(check_network, wrong) == refusal_of(build_network, wrong)
    huge = {"hidden_size": 2**15, "layers": 4}
    check_network(preset("smoke", memory="gru", algorithm=algorithm, network_options=huge))
    assert torch.equal(torch.random.get_rng_state(), drawn)


def test_weights_of_a_network_of_another_version_are_refused_with_what_to_do(tmp_path):
    """Actor and critic of the small preset had a tower each, and torch named all forty weights."""
    config = preset("smoke", algorithm="ppo", memory="lru")
    older = build_network(replace(config, network_options={"towers": 2}))
    save_checkpoint(tmp_path / "checkpoints", config, 0, older.state_dict(), {})
    with pytest.raises(CheckpointError, match="do not fit the network") as refusal:
        load(tmp_path)
    said = str(refusal.value)
    assert len(said) < 500 and "Missing key" in said
    assert said.endswith("train again, or use what made them")
