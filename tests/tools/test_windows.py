"""Windows of experience: they end where the ending action was chosen, and replaying them gives what
was acted.
"""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import arcade_torch
from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.tools import contamination, greedy_window, recall_density, saliency
from arcade_torch.tools.measures.windows import play

GAME = "MineSweeperEasy"


class Scripted:
    """Plays a fixed list of actions; its state counts the steps."""

    def __init__(self, actions: list[int]) -> None:
        self.actions = actions

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict(
            {"count": torch.zeros(batch_size, dtype=torch.int64)}, batch_size=[batch_size]
        )

    def act(
        self, obs: Any, state: TensorDict
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor], TensorDict]:
        count = state["count"]
        action = torch.tensor([self.actions[int(count) % len(self.actions)]])
        return action, {}, TensorDict({"count": count + 1}, batch_size=[1])


@pytest.fixture(scope="module")
def env() -> Any:
    return arcade_torch.make(GAME, num_envs=1, observability="partial")


@pytest.fixture(scope="module")
def agent() -> Agent:
    config = preset("smoke", env=GAME, observability="partial", memory="gru")
    return Agent(config, build_network(config).eval())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("actions", [[0], [4], [4, 3, 4, 1]])
def test_a_window_ends_with_the_frame_on_which_the_ending_action_was_chosen(
    env: Any, actions: list[int], seed: int
) -> None:
    window = greedy_window(Scripted(actions), env, seed=seed)
    env.set_seed(seed)
    obs = env.reset()
    for t in range(window.n + 1):
        assert torch.equal(window.frames[t], obs["pixels"][0]), t
        assert window.last_action[t] == obs["last_action"][0]
        obs = env.step(obs.set("action", torch.tensor([actions[t % len(actions)]])))["next"]
        assert bool(obs["done"]) == (t == window.n)
        assert window.reward[t] == obs["reward"]
    assert window.ended
    assert window.is_init.tolist() == [True] + [False] * window.n


def test_an_episode_that_is_too_long_is_cut_and_says_so(env: Any) -> None:
    window = greedy_window(Scripted([0]), env, seed=0, max_steps=5)
    assert window.n == 4 and not window.ended


def test_the_end_of_an_episode_can_be_kept_alone_with_the_state_before_it(env: Any) -> None:
    whole = greedy_window(Scripted([0]), env, seed=3)
    (end,), _ = play(Scripted([0]), env, seed=3, keep=4, first=[whole.n - 3])
    assert torch.equal(whole.frames[-4:], end.frames) and int(end.state["count"]) == whole.n - 3
    assert not end.is_init.any()


def test_the_saliency_of_a_kept_end_is_that_of_the_whole_episode(env: Any, agent: Agent) -> None:
    whole = greedy_window(agent, env, seed=3, max_steps=12)
    (end,), _ = play(agent, env, seed=3, keep=4, max_steps=12, first=[whole.n - 3])
    full, part = (
        saliency(agent, w.frames, w.last_action, w.is_init, w.state) for w in (whole, end)
    )
    np.testing.assert_allclose(part.output, full.output, atol=1e-5)
    np.testing.assert_allclose(part.maps, full.maps[-4:], rtol=1e-3, atol=1e-6 * full.maps.max())


def test_replaying_a_window_gives_the_values_that_were_acted_on(env: Any, agent: Agent) -> None:
    window = greedy_window(agent, env, seed=1, max_steps=12)
    with torch.no_grad():
        features = agent.network.encode(window.frames[None])
        q, _ = agent.network.remember(
            features, window.last_action[None], window.is_init[None], agent.initial_state(1)
        )
    assert torch.equal(q[0].argmax(-1), window.action)
    found = saliency(agent, window.frames, window.last_action, window.is_init, window.state)
    np.testing.assert_allclose(
        found.output, q[0, -1].numpy(), atol=0.02
    )  # training sees whole grey levels, saliency all


def test_the_first_env_of_a_batch_plays_the_episode_that_it_plays_alone(
    env: Any, agent: Agent
) -> None:
    (alone,), lengths = play(agent, env, seed=3, keep=12, max_steps=12)
    two = arcade_torch.make(GAME, num_envs=2, observability="partial")
    (first,), lengths_of_first = play(agent, two, seed=3, keep=12, max_steps=12, most=1)
    for name in ("frames", "last_action", "is_init", "action", "reward"):
        assert torch.equal(getattr(first, name), getattr(alone, name)), name
    assert lengths_of_first.tolist() == lengths.tolist() and first.ended == alone.ended


def test_a_batch_of_several_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"the batch size of env must be \[\] or \[1\], for one episode; got \[2\]"
    ):
        greedy_window(Scripted([0]), arcade_torch.make(GAME, num_envs=2))


@pytest.mark.parametrize("measure", [greedy_window, recall_density, contamination])
@pytest.mark.parametrize("env", [GAME, gymnasium.make("CartPole-v1")], ids=["id", "gymnasium"])
def test_what_is_no_environment_of_torchrl_is_refused_in_one_line(measure: Any, env: Any) -> None:
    with pytest.raises(TypeError, match=r"env is .*expected an environment of TorchRL"):
        measure(Scripted([0]), env)
