"""``from_jax``: envs that are not ours, by gymnax's two functions."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from arcade_torch import from_jax
from arcade_torch.envs_jax.batch import env_keys
from arcade_torch.models import MemoryModule, make_memory
from tests.few import few

N = 5


class Space(NamedTuple):
    n: int


class Box(NamedTuple):
    low: float
    high: float
    shape: tuple[int, ...]


class Params(NamedTuple):
    goal: int = 6
    max_steps_in_episode: int = 8


class Walk:
    """A walk with noise: ends at the goal or, as an env that only knows ``done``, after eight
    steps.
    """

    default_params = Params()

    def action_space(self, params: Params) -> Space:
        return Space(3)

    def reset_env(self, key: jax.Array, params: Params) -> tuple[jax.Array, Any]:
        state = {"place": jax.random.randint(key, (), 0, 3), "time": 0}
        return self.look(state), state

    def look(self, state: Any) -> Any:
        return jnp.stack([state["place"], state["time"]]).astype(jnp.float32)

    def move(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        noise = jax.random.randint(key, (), 0, 2)
        return {"place": state["place"] + action - 1 + noise, "time": state["time"] + 1}

    def step_env(self, key: jax.Array, state: Any, action: jax.Array, params: Params) -> Any:
        state = self.move(key, state, action)
        done = (state["place"] >= params.goal) | (state["time"] >= params.max_steps_in_episode)
        return self.look(state), state, state["place"] * 0.5, done, {"discount": 1.0 - done}

    def step(self, key: jax.Array, state: Any, action: jax.Array, params: Params) -> Any:
        """Gymnax's own, with automatic resets: what a user's loop calls."""
        key_step, key_reset = jax.random.split(key)
        obs, after, reward, done, info = self.step_env(key_step, state, action, params)
        first, fresh = self.reset_env(key_reset, params)
        pick = lambda new, old: jnp.where(done, new, old)  # noqa: E731
        return pick(first, obs), jax.tree.map(pick, fresh, after), reward, done, info


class NewWalk(Walk):
    """The same with the functions of gymnax 1: ``step_env`` says ``terminated``."""

    def step_env(self, key: jax.Array, state: Any, action: jax.Array, params: Params) -> Any:
        state = self.move(key, state, action)
        return self.look(state), state, state["place"] * 0.5, state["place"] >= params.goal, {}

    def is_truncated(self, state: Any, params: Params) -> jax.Array:
        return state["time"] >= params.max_steps_in_episode


class SixWalk(Walk):
    """The same whose step gives both flags."""

    def step_env(self, key: jax.Array, state: Any, action: jax.Array, params: Params) -> Any:
        state = self.move(key, state, action)
        ends = (state["place"] >= params.goal, state["time"] >= params.max_steps_in_episode)
        return self.look(state), state, state["place"] * 0.5, *ends, {}


class Plain:
    """No params, frames of bytes, actions of two floats, no end of its own."""

    action_space = Box(-1.0, 1.0, (2,))

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        place = jax.random.uniform(key, (2,))
        return jnp.zeros((4, 4, 3), jnp.uint8), place

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        state = state + action
        frame = jnp.broadcast_to((state[0] * 10).astype(jnp.uint8), (4, 4, 3))
        return frame, state, state.sum(), False, {}


class Tree(Plain):
    """An observation of several arrays."""

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        obs, state = super().reset(key)
        return self.tree(obs, state), state

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        obs, state, *rest = super().step(key, state, action)
        return self.tree(obs, state), state, *rest

    def tree(self, obs: jax.Array, state: jax.Array) -> Any:
        return {"frame": obs, "body": {"place": state, "right": state > 0}}


ENVS = {
    "done": (Walk, {}),
    "terminated": (NewWalk, {}),
    "both": (SixWalk, {}),
    "plain": (Plain, {"max_steps": 6}),
    "tree": (Tree, {"max_steps": 6}),
}
all_envs = pytest.mark.parametrize("name", ENVS)
few_envs = pytest.mark.parametrize("name", few(ENVS, often=["both", "tree"]))


def made(name: str, num_envs: int = N, **options: Any) -> Any:
    kind, settings = ENVS[name]
    return from_jax(kind(), num_envs=num_envs, **settings, **options)


def rollout(env: Any, steps: int = 25, seed: int = 0) -> Any:
    torch.manual_seed(seed)
    return env.rollout(steps, break_when_any_done=False)


@few_envs
def test_torchrl_s_checker_passes(name: str) -> None:
    check_env_specs(made(name), seed=0)


def test_it_walks_the_paths_of_the_suite_s_own_loop_to_the_bit() -> None:
    """Gymnax's ``step`` with automatic resets, one env after the other."""
    data = rollout(made("done", seed=7))
    walk = Walk()
    step = jax.jit(walk.step)
    for env, key in enumerate(env_keys(7, N)):
        key, use = jax.random.split(key)
        obs, state = walk.reset_env(use, Params())
        for time, row in enumerate(data[env].unbind(0)):
            assert np.array_equal(row["observation"], obs), (env, time)
            key, use = jax.random.split(key)
            obs, state, reward, done, _ = step(use, state, int(row["action"]), Params())
            assert float(row["next", "reward"]) == float(reward)
            assert bool(row["next", "done"]) == bool(done)
    assert data["next", "done"].sum() >= N


@pytest.mark.parametrize("name", ["done", "terminated", "both"])
def test_ends_are_told_apart_and_the_final_observation_is_the_true_one(name: str) -> None:
    data = rollout(made(name), 60)
    place = data["next", "observation"][..., 0]
    time = data["next", "observation"][..., 1]
    assert torch.equal(data["next", "step_count"].squeeze(-1), time.long())
    terminated = data["next", "terminated"].squeeze(-1)
    truncated = data["next", "truncated"].squeeze(-1)
    assert torch.equal(truncated, time >= 8)
    at_the_goal = place >= 6
    if name == "done":  # at the limit it cannot be told whether the goal was reached too
        at_the_goal &= ~truncated
    assert torch.equal(terminated, at_the_goal)
    assert terminated.any() and truncated.any()
    assert torch.equal(data["next", "done"].squeeze(-1), terminated | truncated)
    following = data["is_init"][:, 1:].squeeze(-1)
    assert torch.equal(following, data["next", "done"][:, :-1].squeeze(-1))
    assert (data["observation"][:, 1:][following][:, 1] == 0).all()


@few_envs
def test_an_env_walks_the_same_path_in_every_batch(name: str) -> None:
    many, one = made(name, 7), made(name, 3)
    root, few = many.reset(), one.reset()
    for _ in range(20):
        action = many.rand_action(root)["action"]
        step, root = many.step_and_maybe_reset(root.set("action", action))
        small, few = one.step_and_maybe_reset(few.set("action", action[:3]))
        assert (step[:3] == small).all() and (root[:3] == few).all()


@few_envs
def test_the_fused_step_gives_the_bits_of_step_and_reset(name: str) -> None:
    one, twin = made(name), made(name)
    root, other = one.reset(), twin.reset()
    for _ in range(25):
        action = one.rand_action(root)["action"]
        step, root = one.step_and_maybe_reset(root.set("action", action))
        stepped = twin.step(other.set("action", action))
        assert (step["next"] == stepped["next"]).all()
        other = twin.maybe_reset(stepped["next"].exclude("reward"))
        assert (root.select(*other.keys(True, True)) == other).all()


def test_another_seed_compiles_nothing() -> None:
    env = made("both")
    before = env.reset()
    events = list[str]()
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: events.append(name))
    env.set_seed(1)
    after = env.reset()
    assert not [name for name in events if "backend_compile" in name]
    assert not (before == after).all()


@few_envs
def test_a_snapshot_determines_the_future(name: str) -> None:
    env = made(name)
    root = env.reset()
    for _ in range(4):
        _, root = env.step_and_maybe_reset(env.rand_action(root))
    state, actions = env.get_state(), [env.rand_action(root)["action"] for _ in range(12)]

    def follow(env: Any, root: Any) -> Any:
        steps = []
        for action in actions:
            step, root = env.step_and_maybe_reset(root.clone().set("action", action))
            steps.append(step.clone())
        return torch.stack(steps)

    expected = follow(env, root)
    another = made(name, seed=99)
    assert (follow(another, another.set_state(state)) == expected).all()
    with pytest.raises(ValueError, match="batch size"):
        made(name, 2).set_state(state)
    with pytest.raises(TypeError, match="get_state"):
        env.set_state(None)


@pytest.mark.parametrize("of", ["state", "state_dict"])
def test_a_snapshot_of_an_end_stays_at_the_end(of: str) -> None:
    env = made("done")
    td = env.reset()
    while not td["done"].any():
        td = env.step(env.rand_action(td))["next"].exclude("reward")
    assert not td["done"].all()
    another = made("done", seed=99)
    if of == "state":
        another.set_state(env.get_state())
    else:
        another.load_state_dict(env.state_dict())
    action = env.rand_action(td)["action"]
    expected = env.step(td.clone().set("action", action))["next"]
    assert torch.equal(expected["done"], td["done"])
    given = another.step(another.observe().set("action", action))["next"]
    assert (given == expected).all()
    with pytest.raises(ValueError, match="entry 'ends'"):
        env.set_state(env.get_state().set("ends", torch.zeros(N, 2, dtype=torch.int64)))


def test_an_env_shows_the_ends_at_which_its_episodes_wait() -> None:
    env = made("done")
    td = env.reset()
    while not td["done"].all():
        td = env.step(env.rand_action(td))["next"].exclude("reward")
    assert td["terminated"].any() and td["truncated"].any()
    seen = env.observe()
    assert all(torch.equal(seen[key], td[key]) for key in ("done", "terminated", "truncated"))


def test_observations_are_the_memory_of_jax_and_stay_as_they_are() -> None:
    env = made("plain")
    root = env.reset()
    assert root["pixels"].dtype == torch.uint8 and root["pixels"].shape == (N, 4, 4, 3)
    assert root["pixels"].data_ptr() == env._live.obs.unsafe_buffer_pointer()
    held = []
    for _ in range(6):
        step, root = env.step_and_maybe_reset(env.rand_action(root))
        held.append((step, step.clone()))
    assert all((step == copy).all() for step, copy in held)
    assert made("plain", obs_key="frame").reset()["frame"].shape == (N, 4, 4, 3)
    tree = made("tree").reset()
    assert tree["body", "place"].shape == (N, 2) and tree["body", "right"].dtype == torch.bool


def test_only_the_envs_that_are_asked_for_begin_anew() -> None:
    env = made("done")
    root = env.reset()
    for _ in range(3):
        _, root = env.step_and_maybe_reset(env.rand_action(root))
    rows = torch.tensor([True, False, True, False, False])
    before = root["observation"].clone()
    again = env.reset(root.clone().set("_reset", rows.unsqueeze(-1)))
    assert torch.equal(again["step_count"].squeeze(-1) == 0, rows)
    assert torch.equal(again["observation"][~rows], before[~rows])
    assert (again["observation"][rows][:, 1] == 0).all()


@all_envs
def test_envs_that_a_step_leaves_out_stay_where_they_are(name: str) -> None:
    env, twin = made(name), made(name)
    root, other = env.reset(), twin.reset()
    rows = torch.tensor([True, False, True, False, False])
    action = env.rand_action(root)["action"]
    step = env.step(root.clone().set("action", action).set("_step", rows.unsqueeze(-1)))["next"]
    whole = twin.step(other.set("action", action))["next"]
    assert (step[rows] == whole[rows]).all()
    assert (step["reward"][~rows] == 0).all() and (step["step_count"][~rows] == 0).all()
    kept = list(root.exclude("action").keys(True, True))
    assert (step[~rows].select(*kept) == root[~rows].select(*kept)).all()
    assert np.asarray(env._live.step_count).tolist() == rows.int().tolist()
    assert np.array_equal(env._live.key[~rows.numpy()], made(name)._live.key[~rows.numpy()])


def test_one_of_our_memories_acts_in_torchrl_s_collector() -> None:
    memory = MemoryModule(make_memory("gru", 2, 3), in_key="observation", out_key="logits")

    def policy(td: Any) -> Any:
        td = memory(td)
        return td.set("action", td["logits"].argmax(-1))

    env = TransformedEnv(made("done"), memory.make_tensordict_primer())
    collector = Collector(env, policy, frames_per_batch=N * 20, total_frames=N * 40)
    batches = list(collector)
    assert [tuple(batch.shape) for batch in batches] == [(N, 20)] * 2
    states = batches[0]["memory", "h"]
    first = batches[0]["is_init"].squeeze(-1)
    assert (states[first] == 0).all() and (states[~first] != 0).any()


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: from_jax(object()), TypeError, r"object has no reset\(key, ...\): .*gymnax"),
        (lambda: from_jax(Walk(), num_envs=0), ValueError, "num_envs"),
        (lambda: from_jax(Walk(), max_steps=0), ValueError, "max_steps is 0, expected 1 or more"),
        (lambda: from_jax(Walk(), max_steps="8"), TypeError, "max_steps"),
        (lambda: from_jax(Walk(), device="tpu"), ValueError, "device"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make: Any, error: Any, match: str) -> None:
    with pytest.raises(error, match=match) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_steps_and_spaces_that_are_not_gymnax_s_are_refused() -> None:
    class Short(Plain):
        def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
            return state, 0.0, False

    with pytest.raises(TypeError, match="step of Short gives a tuple of 3, expected observation"):
        from_jax(Short(), num_envs=2)

    class Spaceless(Plain):
        action_space = None

    with pytest.raises(ValueError, match=r"actions of Spaceless are a NoneType.*action_spec="):
        from_jax(Spaceless())
    env = from_jax(Spaceless(), num_envs=2, action_spec=Bounded(-1, 1, shape=(2, 2)))
    env.rollout(2)

    class Named(Plain):
        def reset(self, key: jax.Array) -> tuple[Any, Any]:
            obs, state = super().reset(key)
            return {"reward": obs}, state

        def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
            obs, *rest = super().step(key, state, action)
            return {"reward": obs}, *rest

    with pytest.raises(ValueError, match="entry 'reward', which is a key of the env itself"):
        from_jax(Named())


def test_wrong_actions_are_refused_in_one_line() -> None:
    env = made("done")
    root = env.reset()
    with pytest.raises(ValueError, match="actions range from 3 to 3, allowed: 0 to 2"):
        env.step(root.clone().set("action", torch.full((N,), 3)))
    with pytest.raises(TypeError, match="expected integers"):
        env.step(root.clone().set("action", torch.zeros(N)))
    floats = made("plain")
    with pytest.raises(ValueError, match=r"action has shape \[5, 3\], expected \[5, 2\]"):
        floats.step(floats.reset().set("action", torch.zeros(N, 3)))


def test_one_hot_actions_are_refused_when_the_env_is_made() -> None:
    with pytest.raises(
        TypeError, match="action_spec is an OneHot, expected Categorical or Bounded"
    ):
        from_jax(Walk(), num_envs=2, action_spec=OneHot(3, shape=(2, 3)))
    with pytest.raises(ValueError, match=r"action_spec has shape \[3\], expected \[2, ...\]"):
        from_jax(Walk(), num_envs=2, action_spec=Categorical(3, shape=(3,)))


# No arrays of JAX: second_device.py imports this file and looks for what is on the first device.
@pytest.mark.parametrize("entry", [{"": np.zeros(2)}, {"a": {"": np.zeros(2)}}])
def test_an_observation_entry_without_a_name_is_refused(entry: Any) -> None:
    """Before: TorchRL's collector stopped with 'NoneType' object is not iterable."""

    class Unnamed:
        def reset(self, key: jax.Array) -> Any:
            return {"b": jnp.zeros(1), **entry}, jnp.int32(0)

        def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
            return {"b": jnp.zeros(1), **entry}, state + 1, 0.0, state >= 2, {}

    spec = Categorical(3, shape=(2,))
    with pytest.raises(ValueError, match=r"an entry with an empty name.*give it a name"):
        from_jax(Unnamed(), num_envs=2, action_spec=spec)
