"""Environments: ``make`` with arguments of any type, ``reset`` and ``step`` with any tensordict,
``set_state``.
"""

import functools
import random
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

import arcade_torch
from arcade_torch.envs_jax import make as make_game
from arcade_torch.envs_jax import registered_ids, resolve_id
from tests.fuzz.contract import attempt, fuzz
from tests.fuzz.hostile import FLOATS, NAMES, NUMBERS, OBJECTS, anything, names, seeds

pytestmark = pytest.mark.slow

FINE: dict[str, tuple[Any, ...]] = {
    "id": ("CartPoleEasy", "CartPoleEasy-v0", ["CartPoleEasy"], ("CartPoleEasy", "SignpostEasy")),
    "num_envs": (2,),
    "observability": ("full", "partial", None, torch.tensor([True, False])),
    "obs_size": (128,),
    "seed": (0, 7, None),
    "device": ("cpu", None, torch.device("cpu")),
    "rules": ("default", "reference"),
    "partial_obs": (None, None, True),
    "categorical_actions": (True, False),
    "state_in_td": (False, True),
    "task_in_td": (None, True, False),
    "debug": (False, True),
}
"""Values of few games and one size, so that nothing but the first compiles."""


def _value(rng: random.Random) -> Any:
    pool = rng.choice(
        (OBJECTS, NAMES, NUMBERS, FLOATS, ([], {}, [1], ["CartPoleEasy", 1], None, True, False))
    )
    return rng.choice(pool)


@functools.cache
def env(**options: bool) -> arcade_torch.ArcadeEnv:
    return arcade_torch.make("CartPoleEasy", num_envs=2, **options)


@fuzz(12_000)
@given(seeds)
def test_make_works_or_says_in_one_line_what_is_wrong(seed: int) -> None:
    rng = random.Random(seed)
    words = {
        name: rng.choice(values)
        for name, values in FINE.items()
        if rng.random() < 0.5 or name == "num_envs"
    }
    words["id"] = rng.choice(FINE["id"])
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name = rng.choice((*FINE, "gravity", "level", "id", "num_envs"))
        words[name] = _value(rng)
        if name == "num_envs" and type(words[name]) is int and 2 < words[name] < 10**6:
            words[name] = 2  # would be fine, and compile anew
    attempt("make", lambda: arcade_torch.make(**words))


@fuzz(2_000)
@given(
    st.sampled_from((("MineSweeperEasy", "mine_reward"), ("SkittlesEasy", "hit_reward"))),
    anything | st.floats(-1.1, 0.1),
)
def test_a_penalty_is_taken_or_refused(option: tuple[str, str], value: Any) -> None:
    attempt("envs_jax.make", lambda: make_game(option[0], **{option[1]: value}))


@fuzz(6_000)
@given(
    names
    | st.sampled_from(registered_ids())
    | st.builds("{}-v{}".format, names, st.integers(-1, 10**6))
)
def test_an_id_is_known_or_refused_with_a_hint(name: str) -> None:
    attempt("resolve_id", lambda: resolve_id(name))


@fuzz(3_000)
@given(anything)
def test_observability_is_changed_or_refused(value: Any) -> None:
    attempt("set_observability", lambda: env().set_observability(value))


def _tensor(rng: random.Random) -> Any:
    shape = rng.choice(((2,), (2,), (2,), (2, 1), (2, 5), (), (3,), (0,), (1,), (2, 5, 1), (2, 0)))
    kind = rng.randrange(12)
    if kind < 5:
        low, high = rng.choice(((0, 5), (0, 5), (-1, 6), (-(2**31), 2**31 - 1), (5, 6)))
        return torch.randint(low, high, shape)
    if kind == 5:
        return torch.rand(shape) * rng.choice((1.0, 5.0, 1e30, float("nan"), float("inf")))
    if kind == 6:
        dtypes = (
            torch.bool,
            torch.uint8,
            torch.int8,
            torch.int16,
            torch.int32,
            torch.float16,
            torch.bfloat16,
        )
        return torch.zeros(shape).to(
            rng.choice((*dtypes, torch.complex64, torch.float64, torch.uint16, torch.uint32))
        )
    if kind == 7:
        return np.zeros(shape, rng.choice((np.int64, np.float32, np.bool_, "U3")))
    if kind == 8:
        return TensorDict({"x": torch.zeros(2)}, [2])
    if kind == 9:
        return rng.choice(
            ("text", None, 3, -1, 2.5, [1, 2], [1, 2, 3], [[1], [2]], {"a": torch.zeros(2)})
        )
    if kind == 10:
        return (
            torch.zeros(shape).to_sparse() if rng.random() < 0.5 else torch.zeros(*shape, 2)[..., 0]
        )
    return torch.nn.functional.one_hot(torch.randint(0, 5, (2,)), 5).to(
        rng.choice((torch.int64, torch.bool, torch.float32))
    )


KEYS = (
    "action",
    "action",
    "action",
    "_reset",
    "_reset",
    "state",
    "pixels",
    "next",
    "done",
    "terminated",
    "_step",
    "x",
    "task",
)


def _tensordict(rng: random.Random) -> Any:
    if rng.random() < 0.03:
        return rng.choice((None, {}, {"action": torch.zeros(2)}, [], "text", 3, torch.zeros(2)))
    size = [2] if rng.random() < 0.9 else rng.choice(([], [3], [0], [2, 1]))
    td = TensorDict({}, batch_size=size)
    if rng.random() < 0.5 and size == [2]:
        td["action"] = torch.randint(0, 5, (2,))
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        try:  # what no tensordict can hold cannot arrive
            td.set(rng.choice(KEYS), _tensor(rng))
        except Exception:
            continue
    return td


@fuzz(8_000)
@given(seeds)
def test_step_takes_a_tensordict_or_refuses_it_and_goes_on_after(seed: int) -> None:
    rng = random.Random(seed)
    one = env(**rng.choice(({}, {"categorical_actions": False}, {"state_in_td": True})))
    td = _tensordict(rng)
    way = rng.choice(("step", "step", "step_and_maybe_reset"))
    attempt(f"env.{way}", lambda: getattr(one, way)(td))


@fuzz(5_000)
@given(seeds)
def test_reset_takes_a_tensordict_or_refuses_it(seed: int) -> None:
    rng = random.Random(seed)
    one = env(**rng.choice(({}, {"state_in_td": True})))
    td = _tensordict(rng)
    words = rng.choice(({}, {}, {"set_state": True}, {"set_state": False}))
    attempt("env.reset", lambda: one.reset(td, **words))


@fuzz(4_000)
@given(seeds)
def test_a_state_is_taken_whole_or_refused_and_the_env_stays_as_it_was(seed: int) -> None:
    rng = random.Random(seed)
    one = env()
    before = one.get_state()
    state: Any = before.clone()
    for _ in range(rng.choice((1, 1, 2))):
        keys = sorted(state.keys(True), key=str) if isinstance(state, TensorDict) else []
        kind = rng.randrange(8)
        if kind == 0 and keys:
            state = state.exclude(rng.choice(keys))
        elif kind == 1:
            state = rng.choice(
                (None, {}, state.to_dict() if keys else 3, "x", TensorDict({}, [2]), torch.zeros(2))
            )
        elif kind == 2 and keys:
            with suppress(NotImplementedError):  # of sparse tensors too
                state = state[:1] if rng.random() < 0.5 else torch.cat([state, state])
        elif keys:
            key = rng.choice(keys)
            old = state.get(key)
            new = _tensor(rng)
            # an earlier change may have put a sparse tensor there, of which torch does little
            if kind > 4 and isinstance(old, torch.Tensor) and old.layout is torch.strided:
                new = rng.choice(
                    (
                        old.to(torch.float64),
                        old.unsqueeze(-1),
                        old.new_full(old.shape, -1),
                        old.bool(),
                        old * 0,
                    )
                )
            try:
                state.set(key, new)
            except Exception:
                continue
    if not attempt("env.set_state", lambda: one.set_state(state)):
        after = one.get_state()
        assert all(torch.equal(before.get(key), after.get(key)) for key in before.keys(True, True))
    one.set_state(before)
