"""``ArcadeCollector`` on envs that are not ours: the data of TorchRL's collector, sequences, states
and what others do to the env.
"""

from typing import Any

import jax
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv

from arcade_torch import ArcadeCollector, from_jax
from arcade_torch.agents import PQNLoss
from arcade_torch.models import MemoryModule, make_memory
from arcade_torch.policies import random_actions
from arcade_torch.rollout_buffer import final_key
from tests.arcade_torch.test_from_jax import (
    N,
    NewWalk,
    Params,
    Plain,
    SixWalk,
    Tree,
    Walk,
    few_envs,
    made,
)

T = 10


def scripted(td: TensorDictBase, env: Any) -> TensorDictBase:
    """Actions that depend on the count, the last action and all that is seen."""
    seen = sum(td[key].reshape(N, -1).float().sum(1) for key in env.observation_keys)
    turn = torch.sin(seen + 3 * td["step_count"].squeeze(-1).float())
    last = td["last_action"].reshape(N, -1).float().sum(1)
    if env.action_spec.dtype is torch.int64:
        td["action"] = (10 + 5 * turn + last).long() % env.action_spec.space.n
    else:
        td["action"] = torch.stack([turn, -turn / 2 + last / 10], 1).clamp(-1, 1)
    td["value"] = td["episode_reward"] + 1
    return td


def policy_of(env: Any) -> Any:
    return lambda td: scripted(td, env)


def collector_of(name: str, **options: Any) -> ArcadeCollector:
    env = made(name, seed=3)
    return ArcadeCollector(env, policy_of(env), N * T, **options)


def different(one: TensorDictBase, two: TensorDictBase) -> list[Any]:
    keys = set(one.keys(True, True))
    assert keys == set(two.keys(True, True)), keys ^ set(two.keys(True, True))
    return [key for key in keys if not torch.equal(one[key], two[key])]


@few_envs
def test_iteration_gives_the_data_of_torchrls_collector(name: str) -> None:
    env = made(name, seed=3)
    options = {"frames_per_batch": N * T, "total_frames": 4 * N * T}
    stock = torch.cat(list(Collector(env, policy_of(env), **options)), 1)
    ours = torch.cat(list(collector_of(name, total_frames=4 * N * T)), 1)
    assert stock["next", "done"].sum() > N
    assert not different(ours, stock)


@few_envs
@pytest.mark.parametrize(("mode", "overlap"), [("all", 0), ("truncated", 4)])
def test_sequences_hold_the_data_of_a_rollout(name: str, mode: Any, overlap: int) -> None:
    env = made(name, seed=3)
    rollout = env.rollout(4 * T + overlap, policy_of(env), break_when_any_done=False)
    collector = collector_of(name, overlap=overlap, final_frames=mode)
    for window in range(4):
        batch = collector.collect()
        path = rollout[:, window * T : (window + 1) * T + overlap]
        for key in (*env.observation_keys, "action", "last_action", "is_init", "step_count"):
            assert torch.equal(batch[key], path[key]), key
        for key in ("reward", "terminated", "truncated", "episode_reward"):
            assert torch.equal(batch["next", key], path["next", key]), key
        assert_next_observations(batch, path, env, mode)


def assert_next_observations(batch: Any, path: TensorDictBase, env: Any, mode: str) -> None:
    """What follows every step whose successor is known is the rollout's."""
    terminated = path["next", "terminated"].squeeze(-1)
    for key in env.observation_keys:
        parts = (key,) if isinstance(key, str) else key
        expected = path["next", *parts]
        if mode == "all":
            assert torch.equal(batch["next", *parts], expected)
            continue
        dense = torch.cat([batch[key][:, 1:], batch[key][:, :1]], 1)
        for row, place in batch["final_mask"].nonzero().tolist():
            step = batch["final_index"][row, place]
            dense[row, step] = batch[final_key(key)][row, place]
        known = ~terminated
        assert torch.equal(dense[known], expected[known])


@few_envs
def test_a_saved_collector_goes_on_with_the_same_batches(name: str) -> None:
    one = collector_of(name, overlap=3)
    one.collect()
    saved = one.state_dict()
    expected = [one.collect().clone() for _ in range(2)]
    other = collector_of(name, overlap=3)
    other.load_state_dict(saved)
    for batch in expected:
        assert not different(other.collect(), batch)


@pytest.mark.parametrize(("name", "mode"), [("both", "all"), ("tree", "truncated")])
def test_what_is_written_to_a_batch_does_not_come_back_in_the_overlap(name: str, mode: Any) -> None:
    """Final observations of the overlap are among it, also where it is longer than a window."""
    plain = collector_of(name, overlap=T + 3, final_frames=mode)
    other = collector_of(name, overlap=T + 3, final_frames=mode)
    env = plain.env
    for window in range(3):
        expected = plain.collect()
        batch = other.collect()
        assert not different(used(batch, env), used(expected, env)), window
        for value in batch.values(True, True):
            if value.dtype is not torch.uint8:
                value.zero_()
    saved = other.state_dict()
    resumed = collector_of(name, overlap=T + 3, final_frames=mode)
    resumed.load_state_dict(saved)
    assert not different(used(resumed.collect(), env), used(plain.collect(), env))


def used(batch: TensorDict, env: Any) -> TensorDict:
    """A batch in which unused places of final observations are 0."""
    batch = batch.copy()
    if "final_mask" in batch:
        for key in env.observation_keys:
            final = batch[final_key(key)].clone()
            final[~batch["final_mask"]] = 0
            batch[final_key(key)] = final
    return batch


def test_random_actions_are_those_that_the_spec_allows() -> None:
    for name in ("done", "plain"):
        env = made(name)
        actions = ArcadeCollector(env, None, N * 50, seed=0).collect()["action"]
        assert actions.dtype is env.action_spec.dtype
        assert env.action_spec.unsqueeze(1).expand(N, 50, *actions.shape[2:]).is_in(actions)
        assert actions.unique().numel() >= 3


@pytest.mark.parametrize(
    ("dtype", "low", "high"),
    [
        (torch.uint8, 0, 255),
        (torch.int8, -128, 127),
        (torch.int8, -100, 100),
        (torch.int32, -(2**31), 2**31 - 1),
        (torch.float16, -60000.0, 60000.0),
        (torch.float32, -3.4e38, 3.4e38),
    ],
)
def test_random_actions_reach_over_the_whole_range_of_a_type(
    dtype: torch.dtype, low: float, high: float
) -> None:
    """The distance of such bounds is no number of the type: bytes were 0, every time."""
    spec = Bounded(low, high, shape=(1000,), dtype=dtype)
    actions = random_actions(spec, torch.Generator().manual_seed(0))
    assert actions.dtype is dtype and spec.is_in(actions)
    numbers = actions.double()
    eighth = (spec.space.high.double() - spec.space.low.double())[0] / 8
    assert numbers.min() < low + eighth and numbers.max() > high - eighth


def test_last_actions_of_double_precision_are_what_the_env_got() -> None:
    """JAX computes with float32: a reset, or a root, showed the rounded action, and the step before
    it the action as it was given.
    """
    spec = Bounded(-1, 1, shape=(N, 2), dtype=torch.float64)

    def act(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.sin(td["step_count"] + td["last_action"] + 0.1))

    env = from_jax(Plain(), num_envs=N, max_steps=6, action_spec=spec)
    rollout = env.rollout(2 * T + 3, act, break_when_any_done=False)
    assert torch.equal(rollout["next", "last_action"][:, :-1], rollout["last_action"][:, 1:])
    assert torch.equal(rollout["next", "last_action"], rollout["action"].float().double())
    collector = ArcadeCollector(env, act, N * T, 2 * N * T, seed=0, overlap=3)
    batch = torch.cat([batch.clone() for batch in collector], 1)
    assert not different(batch.exclude("collector"), rollout[:, 3:])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_actions_of_half_precision_are_stored(dtype: torch.dtype) -> None:
    spec = Bounded(-1, 1, shape=(N, 2), dtype=dtype)

    def act(td: TensorDictBase) -> TensorDictBase:
        wide = (td["step_count"] + td["last_action"]).float()
        return td.set("action", torch.sin(wide).to(dtype))

    env = from_jax(Plain(), num_envs=N, max_steps=6, action_spec=spec)
    rollout = env.rollout(T, act, break_when_any_done=False)
    batch = next(iter(ArcadeCollector(env, act, N * T, seed=0)))
    assert batch["action"].dtype is dtype
    assert not different(batch.exclude("collector"), rollout)


class Cut(SixWalk):
    """Truncated after three steps, though its params name a limit of eight."""

    def step_env(self, key: jax.Array, state: Any, action: jax.Array, params: Params) -> Any:
        state = self.move(key, state, action)
        return self.look(state), state, 0.0, False, state["time"] >= 3, {}


@pytest.mark.parametrize(("kind", "limit"), [(NewWalk, 50), (SixWalk, 50), (Cut, None)])
def test_an_env_may_truncate_before_the_limit_that_is_counted_here(
    kind: type[Walk], limit: int | None
) -> None:
    """Windows had places for the truncations at the limit alone, and stopped at any other."""
    env = from_jax(kind(), Params(goal=10**6), N, max_steps=limit)
    batch = ArcadeCollector(env, None, N * 40, final_frames="truncated").collect()
    truncated = batch["next", "truncated"].squeeze(-1)
    assert truncated[:, :-1].sum(1).min() >= 4
    for row in range(N):
        used = batch["final_index"][row][batch["final_mask"][row]].tolist()
        assert used == sorted({*truncated[row].nonzero().flatten().tolist(), 39})


class Named(Tree):
    """Observes two arrays, one under a name that is given."""

    def __init__(self, name: str) -> None:
        self.name = name

    def tree(self, obs: jax.Array, state: jax.Array) -> Any:
        return {"frame": obs, self.name: state}


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("mask", "truncated"),
        ("index", "none"),
        ("final_frame", "truncated"),
        ("initial_state", "all"),
        ("collector", "all"),
    ],
)
def test_observations_that_are_called_as_entries_of_a_batch_are_refused(
    name: str, mode: Any
) -> None:
    """``final_mask`` took the place of the final ``mask``, the policy's state that of
    ``initial_state``.
    """
    env = from_jax(Named(name), num_envs=N, max_steps=6)
    with pytest.raises(ValueError, match=f"^the env observes '{name}', .*[^\n]*$"):
        ArcadeCollector(env, None, N * T, final_frames=mode)
    if mode != "all":
        batch = ArcadeCollector(env, None, N * T, final_frames="all").collect()
        assert batch[name].shape == batch["next", name].shape == (N, T, 2)


def test_it_begins_anew_where_somebody_else_has_ended_episodes() -> None:
    """``step`` alone leaves episodes ended: the collector resets those and goes on with others."""
    collector = collector_of("terminated")
    collector.collect()
    env = collector.env
    root = env.observe()
    while not bool(root["done"].any()):
        step = env.step(root.set("action", torch.full((N,), 2)))
        root = env.observe()
        assert torch.equal(root["done"], step["next", "done"])
    ended = root["done"].squeeze(-1)
    counts = root["step_count"]
    first = collector.collect()
    assert torch.equal(first["is_init"][:, 0].squeeze(-1), ended)
    assert torch.equal(first["step_count"][:, 0], counts.masked_fill(ended.unsqueeze(-1), 0))


def test_a_saved_env_remembers_who_has_ended() -> None:
    env = made("terminated")
    root = env.reset()
    while not bool(root["done"].any()):
        env.step(root.set("action", torch.full((N,), 2)))
        root = env.observe()
    twin = made("terminated")
    twin.load_state_dict(env.state_dict())
    assert not different(twin.observe(), root)
    twin.reset(TensorDict({"_reset": root["done"]}, [N]))
    assert not twin.observe()["done"].any()


def test_our_loss_learns_from_sequences_of_a_memory() -> None:
    """The state before a window and the final observations stand where PQN's loss looks."""
    torch.manual_seed(0)
    env = made("terminated", seed=3)
    memory = MemoryModule(make_memory("gru", 2, 8), in_key="observation", out_key="h")
    values = TensorDictModule(nn.Linear(8, 3), in_keys=["h"], out_keys=["action_value"])
    act = TensorDictModule(lambda q: q.argmax(-1), in_keys=["action_value"], out_keys=["action"])
    network = TensorDictSequential(memory, values)
    policy = TensorDictSequential(memory, values, act)
    loss = PQNLoss(network)
    sequences = ArcadeCollector(env, policy, N * T, overlap=3, final_frames="truncated")
    stock = ArcadeCollector(made("terminated", seed=3), policy, N * T, overlap=3)
    for _ in range(3):
        batch = sequences.collect()
        one = loss(batch)["loss"]
        assert torch.isfinite(one)
        assert torch.allclose(one, loss(stock.collect())["loss"], atol=1e-6)


def test_what_it_cannot_do_is_said() -> None:
    with pytest.raises(ValueError, match="compress takes one array, and the env observes several"):
        collector_of("tree", compress=lambda frames: frames)
    env = made("done")
    primed = TransformedEnv(env)
    with pytest.raises(TypeError, match="TransformedEnv, expected an ArcadeEnv or what from_jax"):
        ArcadeCollector(primed, None, N * T)
