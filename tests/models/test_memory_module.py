"""MemoryModule keeps TorchRL's recurrent contract: collected, replayed, sliced and bootstrapped
like LSTMModule.
"""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    Categorical,
    Composite,
    LazyTensorStorage,
    SliceSampler,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import QValueModule, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives.value import GAE

from arcade_torch.models import MemoryBlock, MemoryModule, make_memory, memory_names


class Countdown(EnvBase):
    """Random observations; env i ends after 3 + i steps, by termination or (odd i) by
    truncation.
    """

    def __init__(self, num_envs=4):
        super().__init__(batch_size=[num_envs])
        self.observation_spec = Composite(
            observation=Unbounded((num_envs, 3)),
            left=Unbounded((num_envs, 1), dtype=torch.int64),
            shape=[num_envs],
        )
        self.action_spec = Categorical(2, shape=[num_envs])
        self.reward_spec = Unbounded((num_envs, 1))
        flag = Categorical(2, shape=[num_envs, 1], dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=[num_envs]
        )
        self.odd = (torch.arange(num_envs) % 2 == 1).unsqueeze(-1)

    def _observe(self, left):
        n = self.batch_size[0]
        return {"observation": torch.randn(n, 3), "left": left}

    def _reset(self, tensordict=None, **kwargs):
        n = self.batch_size[0]
        flags = {
            name: torch.zeros(n, 1, dtype=torch.bool)
            for name in ("done", "terminated", "truncated")
        }
        return TensorDict(self._observe(3 + torch.arange(n).unsqueeze(-1)) | flags, self.batch_size)

    def _step(self, tensordict):
        left = tensordict["left"] - 1
        done = left == 0
        flags = {"done": done, "terminated": done & ~self.odd, "truncated": done & self.odd}
        return TensorDict(
            self._observe(left) | flags | {"reward": torch.ones(len(left), 1)}, self.batch_size
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


class OnlyTwoMethods(nn.Module):
    """A third party's memory: no base class, no replay; episodes begin with a constant, or with a
    learned start.
    """

    def __init__(self, start=0.0):
        super().__init__()
        self.cell, self.start = (
            nn.GRUCell(8, 8),
            nn.Parameter(torch.zeros(8)) if start is None else start,
        )

    def initial_state(self, batch_size):
        start = torch.as_tensor(self.start).expand(batch_size, 8).clone()
        return TensorDict({"deep": {"h": start}}, batch_size=[batch_size])

    def forward(self, x, state, is_init):
        h, outputs = state["deep", "h"], []
        for t in range(x.shape[1]):
            h = self.cell(x[:, t], torch.where(is_init[:, t, None], self.start, h))
            outputs.append(h)
        return torch.stack(outputs, 1), TensorDict({"deep": {"h": h}}, batch_size=[len(x)])


MEMORIES = {name: (lambda name=name: make_memory(name, 8, 8)) for name in memory_names()}
MEMORIES["block"] = lambda: MemoryBlock(8, 8, "mingru", layers=2)
MEMORIES["block of mlp"] = lambda: MemoryBlock(8, 8, "mlp", layers=2)
MEMORIES["third party"] = OnlyTwoMethods


def make_policy(memory, state_key="memory"):
    return TensorDictSequential(
        TensorDictModule(nn.Linear(3, 8), in_keys=["observation"], out_keys=["features"]),
        MemoryModule(memory, in_key="features", out_key="remembered", state_key=state_key),
        TensorDictModule(nn.Linear(8, 2), in_keys=["remembered"], out_keys=["action_value"]),
        QValueModule(spec=Categorical(2)),
    )


def make_env(policy):
    env = TransformedEnv(Countdown(), InitTracker())
    primer = get_primers_from_module(policy, warn=False)
    return env if primer is None else env.append_transform(primer)


@pytest.fixture(params=MEMORIES)
def policy(request):
    torch.manual_seed(0)
    return make_policy(MEMORIES[request.param]())


def state_keys(policy):
    return policy[1].state_keys


def test_the_env_with_primers_passes_torchrls_own_check(policy):
    check_env_specs(make_env(policy))


def test_primers_are_found_and_prime_zeros_under_the_state_keys(policy):
    reset = make_env(policy).reset()
    keys = state_keys(policy)
    assert all((reset[key] == 0).all() for key in keys)
    assert {
        key for key in reset.keys(True, True) if isinstance(key, tuple) and key[0] == "memory"
    } == set(keys)


def test_primers_have_the_shape_and_dtype_of_the_models_state():
    module = MemoryModule(make_memory("lru", 3, 4).double(), in_key="x", out_key="y")
    spec = module.make_tensordict_primer().primers["memory", "h"]
    assert spec.shape == (4, 2) and spec.dtype == torch.float64


def replayed(policy, data):
    """The policy run again over stored data, in recurrent mode, from what the buffer holds."""
    with set_recurrent_mode(True), torch.no_grad():
        return policy(data.select("observation", "is_init", *state_keys(policy)))


def test_replay_equals_rollout_with_resets_inside_and_carried_states(policy):
    env = make_env(policy)
    collector = Collector(env, policy, frames_per_batch=4 * 11, total_frames=4 * 33)
    for i, data in enumerate(collector):
        assert data.batch_size == (4, 11) and data["is_init"][:, 1:].sum() >= 4
        if i and state_keys(policy):
            assert any((data[key][:, 0] != 0).any() for key in state_keys(policy))
        again = replayed(policy, data)
        torch.testing.assert_close(again["action_value"], data["action_value"], rtol=0, atol=1e-6)
        for key in state_keys(policy):
            torch.testing.assert_close(again["next", *key], data["next", *key], rtol=0, atol=1e-6)
    collector.shutdown()


def test_one_sequence_without_a_batch_and_extra_batch_dimensions_are_read_alike(policy):
    data = make_env(policy).rollout(8, policy, break_when_any_done=False)
    expected = replayed(policy, data)["action_value"]
    torch.testing.assert_close(replayed(policy, data[1])["action_value"], expected[1])
    torch.testing.assert_close(
        replayed(policy, data.reshape(2, 2, 8))["action_value"], expected.reshape(2, 2, 8, 2)
    )


def test_slices_cut_by_a_sampler_start_from_the_stored_state(policy):
    data = make_env(policy).rollout(20, policy, break_when_any_done=False)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(80, ndim=2),
        sampler=SliceSampler(slice_len=3, end_key=("next", "done"), cache_values=True),
        batch_size=24,
    )
    buffer.extend(data)
    cut = 0
    for _ in range(5):
        sample = buffer.sample()
        torch.testing.assert_close(
            replayed(policy, sample)["action_value"], sample["action_value"], rtol=0, atol=1e-6
        )
        cut += sum(
            int((sample[key][sample["is_init"].flatten()] != 0).any()) for key in state_keys(policy)
        )
    assert cut > 0 or not state_keys(policy)


def test_a_start_in_the_middle_loads_the_stored_state_and_nothing_from_before():
    module = MemoryModule(make_memory("mingru", 3, 4), in_key="x", out_key="y")
    x, h = torch.randn(1, 6, 3), torch.randn(1, 6, 4)
    flags = torch.zeros(1, 6, 1, dtype=torch.bool)
    flags[:, 3] = True
    with set_recurrent_mode(True):
        whole = module(TensorDict({"x": x, "is_init": flags, "memory": {"h": h}}, [1, 6]))["y"]
        rest = TensorDict(
            {"x": x[:, 3:], "is_init": flags[:, :3], "memory": {"h": h[:, 3:]}}, [1, 3]
        )
        torch.testing.assert_close(whole[:, 3:], module(rest)["y"])


def test_sequential_mode_forgets_at_a_start_and_recurrent_mode_does_not():
    module = MemoryModule(make_memory("gru", 3, 4), in_key="x", out_key="y")
    step = TensorDict(
        {
            "x": torch.randn(2, 3),
            "is_init": torch.tensor([[True], [False]]),
            "memory": {"h": torch.randn(2, 4)},
        },
        [2],
    )
    fresh = step.clone().set(("memory", "h"), torch.zeros(2, 4))
    same = (module(step.clone())["y"] == module(fresh)["y"]).all(-1)
    assert same.tolist() == [True, False]
    with set_recurrent_mode(True):
        one = module(step[:1].clone().reshape(1, 1))["y"]
    assert (one[0, 0] != module(fresh)["y"][0]).any()


@pytest.mark.parametrize("name", [name for name in memory_names() if name != "mlp"])
@pytest.mark.parametrize(("shifted", "vmap"), [(False, True), (False, False), (True, False)])
def test_gae_gives_the_advantages_of_a_loop_over_acted_values(name, shifted, vmap):
    critic = TensorDictSequential(
        MemoryModule(make_memory(name, 3, 8), in_key="observation", out_key="remembered"),
        TensorDictModule(nn.Linear(8, 1), in_keys=["remembered"], out_keys=["state_value"]),
    )
    env = TransformedEnv(Countdown(), InitTracker()).append_transform(
        get_primers_from_module(critic)
    )
    act = TensorDictModule(
        lambda x: torch.zeros(x.shape[:-1], dtype=torch.int64), ["observation"], ["action"]
    )
    data = env.rollout(16, TensorDictSequential(critic, act), break_when_any_done=False)
    # The oracle: values as they were acted, next values by one more step, advantages by a loop.
    with torch.no_grad():
        following = data["next"].select("observation", *critic[0].state_keys)
        following["is_init"] = torch.zeros_like(data["is_init"])
        next_value, value = critic(following)["state_value"], data["state_value"]
    live, expected, advantage = ~data["next", "terminated"], torch.empty_like(value), 0.0
    for t in reversed(range(16)):
        delta = data["next", "reward"][:, t] + 0.9 * next_value[:, t] * live[:, t] - value[:, t]
        expected[:, t] = advantage = delta + 0.72 * advantage * ~data["next", "done"][:, t]
    data = data.exclude("state_value", "remembered", ("next", "state_value"))
    gae = GAE(
        gamma=0.9,
        lmbda=0.8,
        value_network=critic,
        shifted=shifted,
        deactivate_vmap=not vmap,
        shifted_budget=8,
    )
    with set_recurrent_mode(True):
        gae(data)
    torch.testing.assert_close(data["advantage"], expected, rtol=0, atol=1e-5)


def test_gradients_reach_the_memory_through_time():
    module = MemoryModule(
        make_memory("lru", 3, 4), in_key="x", out_key="y", default_recurrent_mode=True
    )
    x = torch.randn(2, 5, 3, requires_grad=True)
    y = module(TensorDict({"x": x, "is_init": torch.zeros(2, 5, 1, dtype=torch.bool)}, [2, 5]))["y"]
    y[:, -1].sum().backward()
    assert (x.grad[:, 0] != 0).all() and all(p.grad is not None for p in module.parameters())


def test_actor_and_critic_keep_separate_states():
    pair = TensorDictSequential(
        MemoryModule(make_memory("gru", 3, 4), "observation", "a", state_key="actor_memory"),
        MemoryModule(make_memory("lru", 3, 4), "observation", "c", state_key=("critic", "memory")),
    )
    env = TransformedEnv(Countdown(), InitTracker()).append_transform(get_primers_from_module(pair))
    act = TensorDictModule(lambda a: (a.sum(-1) > 0).long(), ["a"], ["action"])
    data = env.rollout(5, TensorDictSequential(pair, act), break_when_any_done=False)
    assert data["actor_memory", "h"].shape == (4, 5, 4) and data["critic", "memory", "h"].shape == (
        4,
        5,
        4,
        2,
    )
    assert (data["actor_memory", "h"][:, 1] == data["next", "actor_memory", "h"][:, 0]).all()


def test_tensors_can_be_passed_by_name():
    module = MemoryModule(make_memory("mlp", 3, 4), in_key="x", out_key="y")
    y = module(x=torch.randn(2, 3), is_init=torch.zeros(2, 1, dtype=torch.bool))
    assert y.shape == (2, 4)


def test_wrong_flags_and_missing_time_get_one_clear_line():
    module = MemoryModule(make_memory("gru", 3, 4), in_key="x", out_key="y")
    with pytest.raises(ValueError, match=r"bool \[2, 1\], got \[2\]"):
        module(
            TensorDict({"x": torch.zeros(2, 3), "is_init": torch.zeros(2, dtype=torch.bool)}, [2])
        )
    with set_recurrent_mode(True), pytest.raises(ValueError, match="time"):
        module(TensorDict({"x": torch.zeros(3), "is_init": torch.zeros(1, dtype=torch.bool)}, []))
    with pytest.raises(KeyError, match="x"):
        module(TensorDict({"is_init": torch.zeros(2, 1, dtype=torch.bool)}, [2]))
    with pytest.raises(KeyError, match="memory"):
        MemoryModule(make_memory("gru", 3, 4), store="sequence").begin_with(
            TensorDict({}, [2, 5]), TensorDict({}, [2])
        )


@pytest.mark.parametrize("start", [1.0, None])
def test_a_memory_that_does_not_begin_with_zeros_or_learns_its_start_learns_from_what_it_acted(
    start,
):
    policy = make_policy(OnlyTwoMethods(start))
    if start is None:  # it begins with zeros, and moves
        nn.init.constant_(policy[1].memory.start, 0.5)
    data = make_env(policy).rollout(20, policy, break_when_any_done=False)
    assert policy[1].store == "sequence" and data["is_init"][:, 1:].any()
    torch.testing.assert_close(
        replayed(policy, data)["action_value"], data["action_value"], rtol=0, atol=1e-6
    )
    with pytest.raises(ValueError, match="zeros"):
        MemoryModule(OnlyTwoMethods(start), store="step")


@pytest.mark.parametrize("name", MEMORIES)
def test_autocast_around_a_module_changes_nothing_in_the_memory(name):
    module = MemoryModule(MEMORIES[name](), in_key="x", out_key="y")
    data = TensorDict(
        {"x": torch.randn(2, 5, 8).bfloat16(), "is_init": torch.zeros(2, 5, 1, dtype=torch.bool)},
        [2, 5],
    )
    exact = data.clone().set("x", data["x"].float())
    for mode in (False, True):
        with set_recurrent_mode(mode), torch.no_grad():
            expected = module(exact.clone())
            with torch.autocast("cpu", torch.bfloat16):
                got = module(data.clone())
        for key in module.out_keys if not mode or module.store == "step" else ["y"]:
            assert got[key].dtype == expected[key].dtype
            torch.testing.assert_close(got[key], expected[key], rtol=0, atol=0)


@pytest.mark.parametrize("name", MEMORIES)
def test_a_write_into_the_output_leaves_the_state_alone(name):
    memory = MEMORIES[name]()
    with torch.no_grad():
        y, state = memory(
            torch.randn(2, 1, 8), memory.initial_state(2), torch.zeros(2, 1, dtype=torch.bool)
        )
        before = state.clone()
        y.fill_(7.0)
    assert (state == before).all()


@pytest.mark.parametrize("sequences", [False, True])
def test_features_of_more_than_one_vector_a_step_are_refused(sequences):
    module = MemoryModule(make_memory("gru", 3, 4), in_key="seen", out_key="out")
    shape = (2, 6) if sequences else (2,)
    flags = torch.zeros(*shape, 1, dtype=torch.bool)
    agents = TensorDict({"seen": torch.ones(*shape, 5, 3), "is_init": flags}, shape)
    message = r"x is \[2, .*5, 3\] in a batch of shape .*, expected one vector a step"
    with set_recurrent_mode(sequences), pytest.raises(ValueError, match=message):
        module(agents)
    number = TensorDict({"seen": torch.ones(()), "is_init": flags[0].reshape(-1)[:1]}, [])
    with pytest.raises(
        ValueError, match=r"x is \[\] in a batch of shape \[\], expected one vector"
    ):
        module(number)


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.float32])
def test_start_flags_may_be_of_any_type(dtype):
    """Before: floats ended in a TypeError of torch, integers were refused as [B, T] that wanted a
    squeeze.
    """
    module = MemoryModule(make_memory("mingru", 3, 4), in_key="x", out_key="y")
    flags = torch.tensor([[[1], [0], [1], [0]]], dtype=dtype)
    steps = TensorDict({"x": torch.randn(1, 4, 3), "is_init": flags}, [1, 4])
    with set_recurrent_mode(True):
        given = module(steps.clone())["y"]
        assert torch.equal(given, module(steps.set("is_init", flags.bool()))["y"])


@pytest.mark.parametrize("name", memory_names())
def test_an_env_without_a_batch_is_read_step_by_step_as_a_sequence(name):
    torch.manual_seed(0)
    module = MemoryModule(make_memory(name, 3, 8), in_key="embed", out_key="out")
    x = torch.randn(5, 3)
    is_init = (torch.arange(5) % 3 == 0).unsqueeze(-1)
    state = TensorDict()
    acted = []
    for t in range(5):
        step = TensorDict({"embed": x[t], "is_init": is_init[t]}).update(state)
        module(step)
        state = step.get("next", TensorDict())
        acted.append(step["out"])
    rows = TensorDict({"embed": x[:1], "is_init": is_init[:1]}, [1])
    module(rows)
    for key in module.state_keys:
        assert step["next", *key].shape == rows["next", *key].shape[1:]
    sequence, _ = module.memory(x[None], module.memory.initial_state(1), is_init.T)
    torch.testing.assert_close(torch.stack(acted), sequence[0], atol=1e-5, rtol=1e-4)


def test_gae_is_exact_when_the_weights_have_moved_if_it_is_shifted_alone():
    torch.manual_seed(0)
    critic = TensorDictSequential(
        MemoryModule(make_memory("mingru", 3, 8), in_key="observation", out_key="remembered"),
        TensorDictModule(nn.Linear(8, 1), in_keys=["remembered"], out_keys=["state_value"]),
    )
    act = TensorDictModule(
        lambda x: torch.zeros(x.shape[:-1], dtype=torch.int64), ["observation"], ["action"]
    )
    data = make_env(critic).rollout(
        16, TensorDictSequential(critic, act), break_when_any_done=False
    )
    with torch.no_grad():
        for weight in critic.parameters():
            weight += 0.3 * torch.randn_like(weight)
    kept = ["observation", "is_init", "done", "terminated", "truncated", *critic[0].state_keys]
    # step by step: every next observation behind the state that these weights lead to
    advantage = torch.zeros(4, 1)
    deltas = []
    state = data[:, 0].select(*critic[0].state_keys)
    for t in range(16):
        with torch.no_grad():
            step = critic(data[:, t].select("observation", "is_init").update(state))
            state = step["next"].select(*critic[0].state_keys)
            following = data[:, t]["next"].select("observation").update(state)
            following["is_init"] = torch.zeros(4, 1, dtype=torch.bool)
            after = critic(following)["state_value"] * ~data["next", "terminated"][:, t]
            deltas.append(data["next", "reward"][:, t] + 0.9 * after - step["state_value"])
    expected = []
    for t in reversed(range(16)):
        advantage = deltas[t] + 0.72 * advantage * ~data["next", "done"][:, t]
        expected.insert(0, advantage)
    off = {}
    for shifted in (True, False):
        batch = data.select(*kept, "next").exclude(("next", "state_value"))
        gae = GAE(gamma=0.9, lmbda=0.8, value_network=critic, shifted=shifted, shifted_budget=8)
        with set_recurrent_mode(True):
            gae(batch)
        error = (batch["advantage"] - torch.stack(expected, 1)).abs()
        error[:, -1][data["is_init"][:, -1]] = 0  # shifted is off there, too
        off[shifted] = float(error.max())
    assert off[True] < 1e-5
    assert off[False] > 1e-2
