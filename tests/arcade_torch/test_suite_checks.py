"""An env of one's own that ``from_jax`` would step wrongly is refused when it is made, in one
line.
"""

from collections import namedtuple
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, Unbounded
from torchrl.envs import check_env_specs

from arcade_torch import from_jax
from arcade_torch.policies import random_actions
from arcade_torch.suite import Suite

N = 2
Choice = Categorical(3, shape=(N,))
Box = namedtuple("Box", "low high shape dtype", defaults=[np.float32])


class Count:
    """Counts to three; the tests break it in one place each."""

    def reset(self, key: Any) -> Any:
        return jnp.zeros(2), jnp.int32(0)

    def step(self, key: Any, state: Any, action: Any) -> Any:
        return jnp.ones(2) * state, state + 1, 1.0, state >= 3, {"text": "nobody reads it"}


def env_with(**methods: Any) -> Any:
    return type("Own", (Count,), methods)()


def made(env: Any, **options: Any) -> Any:
    return from_jax(env, num_envs=N, **{"action_spec": Choice, **options})


def giving(*values: Any) -> Any:
    """A step that gives these, as functions of the state, and an info."""
    return lambda self, key, state, action: (*(value(state) for value in values), {})


def sees(state: Any) -> Any:
    return jnp.ones(2)


def goes_on(state: Any) -> Any:
    return state + 1


def pays(state: Any) -> Any:
    return 1.0


def ends(state: Any) -> Any:
    return state >= 3


def env_that_shows(obs: Any) -> Any:
    """One whose observation is always this."""

    def reset(self: Any, key: Any) -> Any:
        return obs, 0

    return env_with(reset=reset, step=giving(lambda state: obs, goes_on, pays, ends))


class Keeps(Count):
    """Counts in Python, which JAX does once."""

    steps = 0

    def step(self, key: Any, state: Any, action: Any) -> Any:
        self.steps += 1
        return jnp.ones(2) * self.steps, state + 1, 1.0, False, {}


WRONG = {
    "type of the observation": (
        env_with(step=giving(lambda s: jnp.ones(2, jnp.int32), goes_on, pays, ends)),
        r"Own: step gives observation as int32 \[2\], wanted float32 \[2\]",
    ),
    "shape that broadcasts": (
        env_with(step=giving(lambda s: jnp.ones(1), goes_on, pays, ends)),
        r"Own: step gives observation as float32 \[1\], wanted float32 \[2\]",
    ),
    "type of the state": (
        env_with(step=giving(sees, lambda s: s + 0.5, pays, ends)),
        r"Own: step gives state as float32 \[\], wanted int32 \[\]",
    ),
    "structure of the state": (
        env_with(step=giving(sees, lambda s: {"count": s}, pays, ends)),
        "Own: step gives a state of another structure, with ..count..; wanted that of reset, an "
        "array with state",
    ),
    "several agents": (
        env_with(step=giving(sees, goes_on, lambda s: {"one": 1.0}, ends)),
        "step of Own gives a dict as a reward or an end, expected one number: envs of several",
    ),
    "ends of several": (
        env_with(step=giving(sees, goes_on, pays, lambda s: jnp.zeros(2, bool))),
        r"step of Own gives bool \[2\] as a reward or an end, expected one number",
    ),
    "done before reward": (
        env_with(step=giving(sees, goes_on, ends, pays)),
        "step of Own gives bool as the reward and float32 as an end, expected .* this order",
    ),
    "no info": (
        env_with(step=lambda self, key, state, action: (sees(state), state, 1.0, False)),
        "step of Own gives a tuple of 4, expected observation, state, reward, done",
    ),
    "one object, as Brax": (
        env_with(reset=lambda self, key: jnp.zeros(2)),
        "reset of Own gives a .*Tracer, expected a tuple of observation and state",
    ),
    "step without a key, as Jumanji": (
        env_with(step=lambda self, state, action: None),
        r"Own: step cannot be traced by JAX, .* takes 3 positional arguments but 4 were given",
    ),
    "if": (
        env_with(step=giving(sees, goes_on, lambda s: 1.0 if s > 1 else 0.0, ends)),
        "Own: step cannot be traced by JAX, wanted a pure .*; use jnp.where instead of if",
    ),
    "counts in Python": (Keeps(), "Keeps: step is another function when it is called again"),
    "chance of NumPy": (
        env_with(reset=lambda self, key: (jnp.zeros(2) + np.random.rand(2), jnp.int32(0))),
        "Own: reset is another function when it is called again, .* draw random numbers from the "
        "key",
    ),
    "bfloat16 to see": (
        env_that_shows(jnp.zeros(2, jnp.bfloat16)),
        "Own: reset shows observation as bfloat16, which torch does not share",
    ),
    "complex numbers to see": (
        env_that_shows(jnp.zeros(2, jnp.complex64)),
        "Own: reset shows observation as complex64, which torch does not share: give float32",
    ),
    "integers that tensordict does not clone": (
        env_that_shows(jnp.zeros(2, jnp.uint32)),
        "Own: reset shows observation as uint32, of which tensordict clones nothing, .* give int32",
    ),
    "half a byte to see": (
        env_that_shows(jnp.zeros(2, jnp.int4)),
        "Own: reset shows observation as int4, which torch does not share: give float32",
    ),
    "nothing to see": (
        env_that_shows({}),
        "Own: reset gives an observation without any array",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_an_env_that_would_be_stepped_wrongly_is_refused(name: str) -> None:
    env, message = WRONG[name]
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        made(env)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"params": 64}, "params is 64, expected those of the env: pass num_envs= by name"),
        ({"obs_key": "reward"}, "an entry 'reward', which is a key of the env itself"),
        ({"obs_key": "_step"}, "an entry '_step', which is a key of the env itself"),
        ({"obs_key": 7}, "obs_key is 7, expected a name"),
        ({"debug": "no"}, "debug is 'no', allowed: True, False"),
        ({"action_spec": Categorical(3, shape=(N, 2))}, r"several choices at once are Bounded\(0"),
        ({"action_spec": MultiCategorical((3, 4), shape=(N, 2))}, "action_spec is a MultiCateg"),
        ({"action_spec": Unbounded((N, 2), dtype=torch.int64)}, "is of integers without bounds"),
        ({"action_spec": Binary(4, shape=(N, 4))}, "action_spec is a Binary, expected"),
        ({"action_spec": Categorical(2, shape=(N,), dtype=torch.bool)}, "is of torch.bool, expect"),
    ],
)
def test_arguments_that_would_be_dropped_or_fail_later_are_refused(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        made(Count(), **options)


def test_a_name_for_one_array_is_not_dropped_where_there_are_several() -> None:
    tree = lambda s: {"a": jnp.zeros(2), "b": jnp.zeros(3)}  # noqa: E731
    env = env_with(
        reset=lambda self, key: (tree(0), jnp.int32(0)), step=giving(tree, goes_on, pays, ends)
    )
    with pytest.raises(ValueError, match=r"obs_key is 'seen', and the observation has .*: a, b"):
        made(env, obs_key="seen")


def test_names_with_a_slash_and_random_keys_of_both_styles_survive_a_snapshot() -> None:
    def look(state: Any) -> Any:
        return {"a/b": jnp.ones(2) * state["n"], "a": {"b": -jnp.ones(3) * state["n"]}}

    def begin(self: Any, key: Any) -> Any:
        half = jnp.bfloat16(0.5)
        state = {"n": jnp.float32(1), "key": jax.random.key(3), "c/d": half, "c": {"d": half * 3}}
        return look(state), state

    def step(self: Any, key: Any, state: Any, action: Any) -> Any:
        chance, following = jax.random.split(state["key"])
        count = jax.random.uniform(chance) + state["c/d"] * action
        state = {**state, "key": following, "n": count}
        return look(state), state, state["c"]["d"], False, {}

    env = made(env_with(reset=begin, step=step))
    root = env.reset()
    assert root["a/b"].shape == (N, 2) and root["a", "b"].shape == (N, 3)
    _, root = env.step_and_maybe_reset(root.set("action", torch.ones(N, dtype=torch.int64)))
    saved = env.get_state()
    assert (root["a/b"][:, 0] == -root["a", "b"][:, 0]).all()
    again = torch.zeros(N, dtype=torch.int64)
    expected = env.step(root.clone().set("action", again))["next"]
    another = made(env_with(reset=begin, step=step))
    given = another.step(another.set_state(saved).set("action", again))["next"]
    assert (given == expected).all() and (given["reward"] == 1.5).all()


def test_numbers_of_less_than_a_byte_survive_a_snapshot() -> None:
    def look(state: Any) -> Any:
        return jnp.stack([part.astype(jnp.float32).sum() for part in state.values()])

    def begin(self: Any, key: Any) -> Any:
        state = {"signed": jnp.full(3, -7, jnp.int4), "unsigned": jnp.full(3, 9, jnp.uint4)}
        return look(state), state

    def step(self: Any, key: Any, state: Any, action: Any) -> Any:
        state = {name: part + part.dtype.type(1) for name, part in state.items()}
        return look(state), state, 0.0, False, {}

    env = made(env_with(reset=begin, step=step))
    action = torch.zeros(N, dtype=torch.int64)
    _, root = env.step_and_maybe_reset(env.reset().set("action", action))
    saved = env.get_state()
    assert root["observation"][0].tolist() == [-18, 30]
    another = made(env_with(reset=begin, step=step))
    after = another.step(another.set_state(saved).set("action", action))["next"]
    assert after["observation"][0].tolist() == [-15, 33]


def test_integers_of_several_choices_arrive_as_integers_and_are_checked() -> None:
    class Table(Count):
        action_space = Box(0, 3, (2,), np.int32)

        def step(self, key: Any, state: Any, action: Any) -> Any:
            return jnp.arange(4.0)[action], state, action.sum(), False, {}

    env = from_jax(Table(), num_envs=N)
    assert env.action_spec.dtype is torch.int64
    generator = torch.Generator().manual_seed(0)
    drawn = [random_actions(env.action_spec, generator) for _ in range(50)]
    assert torch.stack(drawn).unique().tolist() == [0, 1, 2, 3]
    root = env.reset()
    step = env.step(root.set("action", torch.tensor([[0, 3], [2, 1]])))
    assert step["next", "observation"].tolist() == [[0, 3], [2, 1]]
    assert step["next", "last_action"].dtype is torch.int64
    with pytest.raises(ValueError, match="actions range from 0 to 4, allowed: 0 to 3"):
        env.step(root.set("action", torch.tensor([[0, 4], [2, 1]])))
    with pytest.raises(TypeError, match=r"action has dtype torch.float32, expected integers"):
        env.step(root.set("action", torch.zeros(N, 2)))


def test_random_actions_of_a_space_without_bounds_are_numbers() -> None:
    env = from_jax(env_with(action_space=Box(-np.inf, np.inf, (3,))), num_envs=N)
    assert env.rand_action()["action"].isfinite().all()
    with pytest.raises(ValueError, match="actions of Own have an infinite bound"):
        from_jax(env_with(action_space=Box(0, np.inf, (3,))), num_envs=N)


Space = namedtuple("Space", "n shape start", defaults=[(), 0])


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Space(4, (4,)), r"are a Space of 3 of shape \[4\], expected one choice: .*Bounded\(0, 1,"),
        (Space(3, start=1), r"begin at 1, expected 0: let step add 1, .*Categorical\(3, shape=\("),
    ],
)
def test_a_space_with_n_that_is_another_choice_is_refused(space: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"the actions of Own {message}"):
        from_jax(env_with(action_space=space), num_envs=N)
    assert from_jax(env_with(action_space=Space(3)), num_envs=N).action_spec.space.n == 3


def test_python_numbers_in_a_state_change_no_type_and_compile_nothing_twice() -> None:
    half = jnp.ones(2, jnp.float16)

    def begin(self: Any, key: Any) -> Any:
        return half, 0.0

    def step(self: Any, key: Any, state: Any, action: Any) -> Any:
        return half * state, state + jnp.float32(1), 1.0, state >= 2, {}

    # beside a Python number half stays half, beside the float32 of the next step it does not
    with pytest.raises(
        ValueError, match=r"step gives observation as float32 \[2\], wanted float16"
    ):
        made(env_with(reset=begin, step=step))

    def narrow(self: Any, key: Any, state: Any, action: Any) -> Any:
        obs, *rest = step(self, key, state, action)
        return obs.astype(half.dtype), *rest

    env = made(env_with(reset=begin, step=narrow))
    seen = env.rollout(5, break_when_any_done=False)["next", "observation"]
    assert seen.dtype is torch.float16 and seen[0, :, 0].tolist() == [0, 1, 2, 0, 1]
    assert env._batched.advance_and_begin_anew._cache_size() == 1


def test_a_class_in_the_place_of_an_env_is_refused_unless_it_needs_no_self() -> None:
    with pytest.raises(TypeError, match=r"env is the class Gymnax, expected .*: pass Gymnax\(\)"):
        made(Gymnax)

    class Static:
        reset = staticmethod(Count().reset)
        step = staticmethod(Count().step)

    assert Suite(Static).reset(jax.random.PRNGKey(0))[1] == 0


def test_no_limit_of_params_ends_every_step() -> None:
    for none in (None, float("inf")):
        assert Suite(Count(), {"max_steps": none}).max_steps is None
    for limit in (-1, 0):
        with pytest.raises(ValueError, match=f"params have max_steps {limit}, expected a time"):
            Suite(Count(), {"max_steps": limit})
        assert Suite(Count(), {"max_steps": limit}, max_steps=7).max_steps == 7


class Gymnax(Count):
    """Has gymnax's four functions."""

    reset_env = Count.reset
    step_env = Count.step


def test_a_wrapper_whose_step_would_be_passed_over_is_refused() -> None:
    class Wrapper:
        def __init__(self, env: Any) -> None:
            self._env = env

        def __getattr__(self, name: str) -> Any:
            return getattr(self._env, name)

        def step(self, key: Any, state: Any, action: Any) -> Any:
            obs, *rest = self._env.step(key, state, action)
            return obs * 0, *rest

    class Derived(Gymnax):
        def reset(self, key: Any) -> Any:
            return jnp.ones(2), jnp.int32(0)

    for env, name in ((Wrapper(Gymnax()), "step"), (Derived(), "reset")):
        with pytest.raises(TypeError, match=f"has a {name} of its own, but {name}_env is that of"):
            made(env)
    Suite(Wrapper(Count()))  # it has no step_env, so its own step counts
    Suite(Gymnax())


def test_a_mapping_of_params_names_its_time_limit_too() -> None:
    assert Suite(Count(), {"max_steps_in_episode": 7}).max_steps == 7
    assert Suite(Count(), {"speed": 7}).max_steps is None


def test_integers_that_python_counts_without_effect_are_allowed() -> None:
    class Calls(Count):
        calls = 0

        def step(self, key: Any, state: Any, action: Any) -> Any:
            self.calls += 1
            return super().step(key, state, action)

    Suite(Calls()).check(jax.ShapeDtypeStruct((), np.int32))


def test_whole_spaces_of_bounds_are_bounded() -> None:
    spec = from_jax(env_with(action_space=Box(-1, 1, (3,))), num_envs=N).action_spec
    assert isinstance(spec, Bounded) and spec.dtype is torch.float32


class Bandit:
    """Two arms, one step an episode, and nothing to remember."""

    def __init__(self, state: Any) -> None:
        self.state = state

    def reset(self, key: jax.Array) -> Any:
        return jax.random.uniform(key, (2,)), self.state

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        return jnp.zeros(2), state, action.astype(jnp.float32), True, {}


@pytest.mark.parametrize("state", [None, (), {"nothing": None}], ids=str)
def test_an_env_may_have_no_state(state: Any) -> None:
    env = from_jax(Bandit(state), num_envs=N, action_spec=Categorical(2, shape=(N,)))
    check_env_specs(env)
    env.set_state(env.get_state())
    steps = env.rollout(4, break_when_any_done=False)
    assert torch.equal(steps["next", "reward"].squeeze(-1), steps["action"].float())
    assert steps["is_init"].all()
    assert steps["observation"].unique().numel() == 2 * 4 * N
