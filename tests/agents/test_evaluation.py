"""Evaluation plays one whole episode in each fresh environment."""

import warnings

import pytest
import scipy.stats
import torch
from tensordict import TensorDict

import arcade_torch
from arcade_torch.agents.evaluation import (
    EvalResult,
    evaluate,
    held_out_seed,
    make_env,
    make_eval_env,
)
from arcade_torch.agents.policy import make_policy
from arcade_torch.agents.presets import preset
from arcade_torch.models import make_network
from arcade_torch.tools import as_policy

EPISODES = 6


class Clock:
    """Acts by the number of steps it has seen in this episode, so its recurrent state matters."""

    def initial_state(self, batch_size):
        return TensorDict({"t": torch.zeros(batch_size, dtype=torch.int64)}, [batch_size])

    def act(self, obs, state):
        t = torch.where(obs["is_init"].squeeze(-1), 0, state["t"])
        return (t // 2) % 2 + 2, {}, TensorDict({"t": t + 1}, t.shape)


@pytest.fixture(scope="module")
def env():
    return make_eval_env(preset("small", env="CartPoleEasy"), EPISODES)


def by_hand(observability):
    """The same through TorchRL's own stepping."""
    env = arcade_torch.make(
        "CartPoleEasy", num_envs=EPISODES, observability=observability, seed=held_out_seed(3)
    )
    env.set_seed(held_out_seed(3), static_seed=True)
    returns, lengths = [0.0] * EPISODES, [0] * EPISODES
    done_before = torch.zeros(EPISODES, dtype=torch.bool)
    td, player = env.reset(), Clock()
    state = player.initial_state(EPISODES)
    while not done_before.all():
        action, _, state = player.act(td, state)
        step, td = env.step_and_maybe_reset(td.set("action", action))
        done = step["next", "done"].squeeze(-1)
        for i in range(EPISODES):
            if not done_before[i]:
                returns[i] += step["next", "reward"][i].item()
                lengths[i] += 1
        done_before |= done
    return returns, lengths


def test_it_gives_the_first_episode_of_every_environment(env):
    result = evaluate(Clock(), seed=3, env=env)
    returns, lengths = by_hand("full")
    assert result.returns.tolist() == pytest.approx(returns, abs=1e-5)
    assert result.lengths.tolist() == lengths
    assert len(set(lengths)) > 1


def test_the_same_seed_plays_the_same_episodes_and_another_seed_others(env):
    first, second, other = (evaluate(Clock(), seed=s, env=env) for s in (3, 3, 4))
    assert (
        first.lengths.tolist() == second.lengths.tolist()
        and first.returns.tolist() == second.returns.tolist()
    )
    assert first.lengths.tolist() != other.lengths.tolist()


def test_the_twin_can_be_chosen(env):
    class Looker(Clock):
        def act(self, obs, state):
            self.sums.append(int(obs["pixels"].sum()))
            return super().act(obs, state)

    seen = {}
    for twin in ("full", "partial"):
        player = Looker()
        player.sums = seen[twin] = []
        evaluate(player, observability=twin, seed=3, env=env)
    assert seen["full"] != seen["partial"]
    assert not env.observability.any(), "the environments were lent"
    env.set_observability("partial")  # as it would be of an agent trained on it
    player.sums = seen["as it is"] = []
    evaluate(player, seed=3, env=env)
    assert seen["as it is"] == seen["partial"] and env.observability.all()
    env.set_observability("full")


class Lost(Clock):
    """Decides by outputs, of which one is no number in the first two environments from step 5 on."""

    name = "q_value"

    def act(self, obs, state):
        action, _, after = super().act(obs, state)
        values = torch.nn.functional.one_hot(action, 5).float()
        values[:2, 0] = values[:2, 0].where(~self.is_lost(obs, state)[:2], torch.nan)
        return values.argmax(-1), {self.name: values}, after

    def is_lost(self, obs, state):
        return state["t"] >= 5


class LostLater(Lost):
    """The same from its second episode on, in an environment that ends soon."""

    def initial_state(self, batch_size):
        self.episodes = torch.zeros(batch_size, dtype=torch.int64)
        return super().initial_state(batch_size)

    def is_lost(self, obs, state):
        self.episodes += obs["is_init"].squeeze(-1)
        return self.episodes > 1


@pytest.mark.parametrize("name", ["q_value", "logits"])
def test_decisions_by_outputs_that_are_no_numbers_are_told(name, env):
    player = Lost()
    player.name = name
    with pytest.warns(UserWarning, match=r"NaN in 2 of 6 episodes"):
        assert len(evaluate(player, env=env).returns) == 6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate(Clock(), env=env)


def test_what_comes_behind_the_first_episode_counts_nowhere(env):
    """The last environments go on for so long that the first ones begin again, and end again."""

    def one_sided(player):
        class OneSided(player):
            def act(self, obs, state):
                action, extras, state = super().act(obs, state)
                action[:2] = 2  # falls at once
                return action, extras, state

        return OneSided()

    alone = evaluate(one_sided(Clock), seed=3, env=env)
    assert alone.lengths[:2].max() * 2 < alone.lengths.max()
    assert alone.lengths[:2].tolist() == lengths_of_the_first_fall()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate(one_sided(LostLater), seed=3, env=env)


def lengths_of_the_first_fall():
    """How long the first two poles stand where the cart is always pushed to one side."""
    fresh = make_eval_env(preset("small", env="CartPoleEasy"), EPISODES)
    fresh.set_seed(held_out_seed(3))
    td = fresh.reset()
    lengths = [0, 0]
    for step in range(1, 60):
        played, td = fresh.step_and_maybe_reset(
            td.set("action", torch.full((EPISODES,), 2, dtype=torch.int64))
        )
        for i in range(2):
            if not lengths[i] and played["next", "done"][i]:
                lengths[i] = step
    return lengths


def test_the_episodes_of_a_mixture_are_told_apart_with_their_lengths():
    returns, lengths = torch.arange(3.0).numpy(), torch.tensor([4, 5, 6]).numpy()
    result = EvalResult(returns, lengths, ("a-v0", "b-v0", "a-v0"))
    numbers = {game: (r.returns.tolist(), r.lengths.tolist()) for game, r in result.by_game.items()}
    assert numbers == {"a-v0": ([0, 2], [4, 6]), "b-v0": ([1], [5])}


def test_numbers_about_the_returns(env):
    result = evaluate(Clock(), seed=3, env=env)
    r = torch.tensor(result.returns)
    assert result.mean == pytest.approx(r.mean().item())
    assert result.std == pytest.approx(r.std().item(), abs=1e-6)
    quantile = scipy.stats.t.ppf(0.975, EPISODES - 1)
    assert result.ci == pytest.approx(quantile * r.std().item() / EPISODES**0.5, abs=1e-6)
    assert result.text.endswith(f"+- {result.ci:.3f} (95 %) over {EPISODES} episodes")


def test_an_environment_is_all_that_the_config_says_about_it(monkeypatch):
    options = {"obs_size": 256, "rules": "reference", "device": "cuda:1"}
    config = preset(
        "smoke",
        env="MineSweeperEasy",
        observability="mixed",
        env_options={"mine_reward": -1.0},
        **options,
    )
    monkeypatch.setattr(arcade_torch, "make", lambda *names, **asked: (names, asked))
    names, asked = make_env(config, 4, 7)
    assert names == ("MineSweeperEasy",) and asked.pop("observability").tolist() == [
        False,
        False,
        True,
        True,
    ]
    assert asked == {"num_envs": 4, "seed": 7, "mine_reward": -1.0} | options
    assert make_env(config, 4, 7, "partial")[1]["observability"] == "partial"


@pytest.mark.parametrize("player", ["runs/one", make_policy(make_network("small", "mlp"))])
def test_what_cannot_act_is_refused_in_one_line(player, env):
    says = f"^agent must be an agent.* got {type(player).__name__}: .*as_policy"
    with pytest.raises(TypeError, match=says):
        evaluate(player)
    with pytest.raises(TypeError, match=says):
        evaluate(player, env=env)


def test_who_says_no_game_needs_environments_of_ours():
    with pytest.raises(TypeError, match=r"^Clock does not say which game it plays: hand over env"):
        evaluate(Clock())
    for other in ("CartPoleEasy", torch.nn.Identity()):
        with pytest.raises(TypeError, match=r"^env must be environments of arcade_torch.make"):
            evaluate(Clock(), env=other)


def test_a_tensordict_policy_is_evaluated_in_evaluation_mode(env):
    policy = make_policy(make_network("small", "mlp"), explore=False)
    modes = []
    policy[0].register_forward_hook(lambda module, *_: modes.append(module.training))
    policy[0].encoder.register_forward_hook(lambda module, *_: modes.append(module.training))
    result = evaluate(as_policy(policy), env=env)
    assert len(result.returns) == EPISODES
    assert modes and not any(modes) and policy.training
