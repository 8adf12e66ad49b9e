"""Our memories in Stable-Baselines3's ``RecurrentPPO``."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

pytest.importorskip("sb3_contrib", reason="needs the sb3 extra: pip install '.[sb3]'")

from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import DummyVecEnv

from arcade_torch.models import MemoryBlock, MemoryModule, make_memory, memory_names
from arcade_torch.models.sb3 import (
    CnnMemoryPolicy,
    FlatMemory,
    MemoryPolicy,
    MultiInputMemoryPolicy,
)
from tests.few import few_memories

B, T, D, H = 3, 11, 4, 8
every_memory = pytest.mark.parametrize("name", memory_names())


class Sign(gym.Env):
    """A sign at the first of four steps, which the last action has to repeat."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.sign, self.time = int(self.np_random.integers(2)), 0
        return np.array([2 * self.sign - 1, 0], np.float32), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        ends = self.time == 4
        reward = float(2 * (int(action) == self.sign) - 1) if ends else 0.0
        return np.array([0, self.time / 4], np.float32), reward, ends, False, {}


def agent(policy: Any = MemoryPolicy, env: Any = Sign, **kwargs: Any) -> RecurrentPPO:
    kwargs.setdefault("lstm_hidden_size", H)
    envs = DummyVecEnv([env] * 4)
    return RecurrentPPO(
        policy, envs, n_steps=16, batch_size=32, policy_kwargs=kwargs, seed=0, device="cpu"
    )


@every_memory
def test_a_sequence_is_read_as_our_module_reads_it(name: str) -> None:
    """Episodes that begin inside of it too, and any cut of it into pieces."""
    torch.manual_seed(0)
    flat = FlatMemory(make_memory(name, D, H), D)
    module = MemoryModule(flat.memory, in_key="x", out_key="y")
    x = torch.randn(B, T, D)
    starts = torch.rand(B, T) < 0.3
    starts[:, 0] = True
    data = TensorDict({"x": x, "is_init": starts.unsqueeze(-1)}, [B, T])
    with set_recurrent_mode(True):
        wanted = module(data)["y"]
    read = MemoryPolicy._process_sequence
    flags = starts.float()

    def states(rows: int) -> Any:
        return torch.zeros(1, rows, flat.hidden_size), torch.zeros(1, rows, flat.hidden_size)

    whole, _ = read(x.flatten(0, 1), states(B), flags.flatten(), flat)
    torch.testing.assert_close(whole.unflatten(0, (B, T)), wanted)
    state = states(B)
    for first, last in ((0, 1), (1, 2), (2, 7), (7, T)):
        piece, state = read(
            x[:, first:last].flatten(0, 1), state, flags[:, first:last].flatten(), flat
        )
        torch.testing.assert_close(piece.unflatten(0, (B, last - first)), wanted[:, first:last])


class BeginsWithOnes(nn.Module):
    """A leaky sum."""

    hidden_size = D

    def forward(self, x: Tensor, state: Any, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h = state["h"]
        outputs = []
        for t in range(x.shape[1]):
            h = torch.where(is_init[:, t, None], 1.0, h) / 2 + x[:, t]
            outputs.append(h)
        return torch.stack(outputs, 1), TensorDict({"h": h}, [len(h)])

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": torch.ones(batch_size, D)}, [batch_size])


@pytest.mark.parametrize("name", [*memory_names(), BeginsWithOnes])
def test_a_state_of_zeros_is_the_initial_one(name: Any) -> None:
    """Stable-Baselines3 knows no other; ``predict`` begins without a start flag, too."""
    flat = FlatMemory(make_memory(name, D, H) if isinstance(name, str) else name(), D)
    x = torch.randn(B, T, D)
    no = torch.zeros(B, T, dtype=torch.bool)
    y, _ = flat(x, torch.zeros(B, flat.hidden_size), no)
    wanted, _ = flat.memory(x, flat.memory.initial_state(B), no)
    torch.testing.assert_close(y, wanted)


@pytest.mark.parametrize("name", few_memories(memory_names()))
def test_it_is_trained_and_what_was_acted_is_replayed(name: str) -> None:
    model = agent(memory=name)
    _, callback = model._setup_learn(64)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, n_rollout_steps=16)
    for data in model.rollout_buffer.get(64):
        with torch.no_grad():
            value, log_prob, _ = model.policy.evaluate_actions(
                data.observations,
                data.actions.long().flatten(),
                data.lstm_states,
                data.episode_starts,
            )
        real = data.mask > 0.5  # sequences are filled up with zeros
        assert real.sum() == 64
        torch.testing.assert_close(log_prob[real], data.old_log_prob[real])
        torch.testing.assert_close(value.flatten()[real], data.old_values[real])
    before = [p.clone() for p in model.policy.lstm_actor.parameters()]
    model.learn(128)
    after = list(model.policy.lstm_actor.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) or not before


def test_a_saved_agent_goes_on_the_same(tmp_path: Path) -> None:
    model = agent(memory="lru", memory_options={})
    model.learn(64)
    model.save(tmp_path / "agent")
    loaded = RecurrentPPO.load(tmp_path / "agent")
    state = other = None
    env = Sign()
    obs, _ = env.reset(seed=3)
    for _ in range(3):
        action, state = model.predict(obs, state, deterministic=True)
        again, other = loaded.predict(obs, other, deterministic=True)
        assert action == again and np.array_equal(state[0], other[0])
        obs, *_ = env.step(action)
    model.policy.save(tmp_path / "policy")
    policy = MemoryPolicy.load(tmp_path / "policy")
    obs, _ = env.reset(seed=3)
    assert policy.predict(obs)[0] == model.predict(obs)[0]


def test_frames_dictionaries_shared_memories_and_ones_of_your_own() -> None:
    class Frames(Sign):
        observation_space = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)

        def reset(self, **kwargs: Any) -> Any:
            super().reset(**kwargs)
            return np.full((36, 36, 3), 255 * self.sign, np.uint8), {}

        def step(self, action: Any) -> Any:
            return np.zeros((36, 36, 3), np.uint8), *super().step(action)[1:]

    class Named(Sign):
        observation_space = gym.spaces.Dict({"a": Sign.observation_space})

        def reset(self, **kwargs: Any) -> Any:
            obs, info = super().reset(**kwargs)
            return {"a": obs}, info

        def step(self, action: Any) -> Any:
            obs, *rest = super().step(action)
            return {"a": obs}, *rest

    agent(CnnMemoryPolicy, Frames, memory="gru").learn(64)
    agent(MultiInputMemoryPolicy, Named, memory="mingru").learn(64)
    agent(memory="gru", shared_lstm=True, enable_critic_lstm=False).learn(64)
    agent(memory="gru", enable_critic_lstm=False).learn(64)
    agent(memory=MemoryBlock, memory_options={"memory": "lru", "layers": 2}).learn(64)


def test_what_cannot_be_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="unknown memory 'lstmm'"):
        agent(memory="lstmm")
    with pytest.raises(TypeError, match="has other options"):
        agent(memory="gru", memory_options={"window": 3})
    with pytest.raises(ValueError, match="n_lstm_layers is 2, expected 1"):
        agent(memory="gru", n_lstm_layers=2)


@pytest.mark.slow
def test_a_memory_learns_the_sign() -> None:
    model = RecurrentPPO(
        MemoryPolicy,
        DummyVecEnv([Sign] * 16),
        n_steps=32,
        batch_size=128,
        learning_rate=3e-3,
        policy_kwargs={"memory": "gru", "lstm_hidden_size": 32},
        seed=0,
        device="cpu",
    )
    model.learn(10_000)
    env = Sign()
    total = 0.0
    for seed in range(20):
        obs, _ = env.reset(seed=seed)
        state, ends = None, False
        while not ends:
            action, state = model.predict(obs, state, deterministic=True)
            obs, reward, ends, *_ = env.step(action)
            total += reward
    assert total == 20
