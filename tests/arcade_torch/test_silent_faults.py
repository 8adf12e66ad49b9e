"""What went wrong in silence: episode numbers given twice, torch's defaults in the storage, counts
above 2 ** 24.
"""

import copy
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer, Unbounded
from torchrl.envs import TensorDictPrimer

import arcade_torch
from arcade_torch import ArcadeCollector, ArcadeEnv
from arcade_torch.compiled import CompiledGame
from arcade_torch.envs_jax.validation import check_fits
from arcade_torch.rollout_buffer import TensorMemory
from tests.arcade_torch.stub import StubGame

N = 4
STEPS = 6
GAME = CompiledGame(StubGame(risk=0.2, max_steps=9))


def collector(**options: Any) -> ArcadeCollector:
    return ArcadeCollector(
        ArcadeEnv(GAME, N, seed=3), None, N * STEPS, total_frames=-1, seed=1, **options
    )


# -- episode numbers -------------------------------------------------------------------------------


def ids(batch: TensorDict) -> set[int]:
    return set(batch["collector", "traj_ids"].flatten().tolist())


@pytest.mark.parametrize("between", ["reset", "set_seed", "step", "collect"])
def test_an_episode_number_is_given_once(between: str) -> None:
    """Before: ``reset`` began with 0 again, and ``collect`` let two episodes share a number."""
    one = collector()
    windows = one.iterator()
    seen: set[int] = set()
    for _ in range(5):
        new = ids(next(windows))
        assert not seen & new
        seen |= new
        if between == "reset":
            one.reset()
        elif between == "set_seed":
            one.set_seed(7)
        elif between == "step":
            one.env.step_raw(torch.zeros(N, dtype=torch.int64))
        else:
            one.collect()


def test_an_older_state_and_a_hook_that_raises_give_new_numbers() -> None:
    one = collector()
    windows = one.iterator()
    next(windows)
    saved = one.state_dict()
    seen = ids(next(windows)) | ids(next(windows))
    one.load_state_dict(saved)
    again = ids(next(one.iterator()))
    assert not seen & again

    def refuse(batch: TensorDict) -> None:
        raise RuntimeError("told to")

    one.post_collect_hook = refuse
    with pytest.raises(RuntimeError, match="told to"):
        next(one.iterator())
    one.post_collect_hook = None
    assert not ids(next(one.iterator())) & (seen | again)


def test_numbers_go_on_where_nothing_came_between() -> None:
    one = collector()
    windows = one.iterator()
    first = next(windows)
    second = next(windows)
    runs_on = ~first["next", "done"][:, -1].squeeze(-1)
    assert runs_on.any()
    last = first["collector", "traj_ids"][:, -1]
    assert torch.equal(second["collector", "traj_ids"][runs_on, 0], last[runs_on])


def test_no_slice_spans_two_episodes_after_a_reset() -> None:
    """Before: 79 of 100 did; TorchRL's collector 0."""
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=3, traj_key=("collector", "traj_ids"))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(2000), sampler=sampler, batch_size=300
    )
    one = collector()
    windows = one.iterator()
    for _ in range(6):
        buffer.extend(next(windows).reshape(-1))
        one.reset()
    slices = buffer.sample().reshape(-1, 3)
    counts = slices["step_count"].squeeze(-1)
    assert torch.equal(counts[:, 1:], counts[:, :-1] + 1)


@pytest.mark.parametrize("between", ["nothing", "collect"])
def test_a_saved_collector_goes_on_with_its_numbers(between: str) -> None:
    one = collector()
    seen = ids(next(one.iterator()))
    if between == "collect":
        one.collect()
    saved = one.state_dict()
    other = collector()
    other.load_state_dict(saved)
    batch = next(other.iterator())
    assert torch.equal(
        next(one.iterator())["collector", "traj_ids"], batch["collector", "traj_ids"]
    )
    assert bool(seen & ids(batch)) == (between == "nothing")


# -- torch's defaults ------------------------------------------------------------------------------


@pytest.fixture(params=[torch.float64, torch.float16, torch.bfloat16, "meta"], ids=str)
def defaults(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Torch with another default dtype, or another default device."""
    before = torch.get_default_dtype()
    try:
        if request.param == "meta":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(request.param)
        yield request.param
    finally:
        torch.set_default_dtype(before)
        torch.set_default_device(None)


def layout(td: Any) -> dict[Any, Any]:
    return {key: (value.dtype, value.device.type) for key, value in td.items(True, True)}


@pytest.fixture(scope="module")
def wanted() -> dict[str, Any]:
    """What is stored by torch's first defaults."""
    return stored()


def stored() -> dict[str, Any]:
    one = collector(overlap=2)
    env = ArcadeEnv(GAME, N, seed=3, state_in_td=True)
    root = env.reset()
    action = torch.zeros(N, dtype=torch.int64, device="cpu")
    return {
        "sequences": layout(one.collect()),
        "transitions": layout(next(collector().iterator())),
        "truncated": layout(collector(final_frames="truncated").collect()),
        "root": layout(root),
        "step": layout(env.step(root.clone().set("action", action))),
        "state": layout(env.get_state()),
        "spec": layout(env.fake_tensordict()),
    }


def test_defaults_of_torch_change_nothing_of_what_is_stored(
    wanted: dict[str, Any], defaults: Any
) -> None:
    """Before: rewards were float64, float16 or bfloat16 against the spec."""
    assert stored() == wanted
    for entries in wanted.values():
        assert {device for _, device in entries.values()} == {"cpu"}
        assert all(
            dtype == torch.float32 for dtype, _ in entries.values() if dtype.is_floating_point
        )


def test_rewards_are_the_same_numbers_whatever_torch_takes_for_granted(defaults: Any) -> None:
    batch = collector().collect()
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)
    again = collector().collect()
    assert torch.equal(batch["next", "reward"], again["next", "reward"])
    assert torch.equal(batch["action"], again["action"])


# -- counts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["step", "fused", "collector", "gymnasium"])
def test_steps_are_counted_beyond_what_a_float32_holds(path: str) -> None:
    """Before: 16,777,217 was 16,777,216."""
    first = 2**24
    if path == "gymnasium":
        env = gymnasium.make_vec("arcade_torch/CartPoleEasy-v0", num_envs=2)
        env.reset(seed=0)
        batch = env.unwrapped._batch
        batch._batch = batch._batch._replace(step_count=np.full(2, first, np.int32))
        stepped = batch.step_and_reset(np.zeros(2, np.int32))[0]
        assert stepped.info["step_count"].tolist() == [first + 1] * 2
        return
    env = ArcadeEnv(CompiledGame(StubGame(risk=0.0, max_steps=2**30)), N, seed=3)
    env.reset()
    state = env.get_state()
    state["step_count"] += first
    root = env.set_state(state)
    assert root["step_count"].unique().tolist() == [first]
    if path == "collector":
        one = ArcadeCollector(env, None, N * 3)
        one.collect()
        env.set_state(state)
        batch = one.collect()
        assert batch["next", "step_count"][0].flatten().tolist() == [
            first + 1,
            first + 2,
            first + 3,
        ]
        assert batch["step_count"][0].flatten().tolist() == [first, first + 1, first + 2]
        return
    root["action"] = torch.zeros(N, dtype=torch.int64)
    stepped = (
        env.step(root)["next"] if path == "step" else env.step_and_maybe_reset(root)[0]["next"]
    )
    assert stepped["step_count"].unique().tolist() == [first + 1]


# -- sizes and actions -----------------------------------------------------------------------------


def test_a_batch_that_no_memory_holds_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before: ``make_vec(num_envs=2**21)`` ended in a MemoryError of 96 GiB."""
    for make in (
        arcade_torch.make,
        lambda id, num_envs: gymnasium.make_vec(f"arcade_torch/{id}", num_envs=num_envs),
    ):
        with pytest.raises(
            ValueError, match="num_envs is above 1048576, the most that a batch may hold"
        ):
            make("CartPoleEasy-v0", num_envs=2**21)
    with pytest.raises(
        ValueError,
        match=r"num_envs is 1048576: the frames of one step take 206 GB, this machine has",
    ):
        check_fits(2**20, 256)
    check_fits(64, 128)


@pytest.mark.parametrize(
    "wrong", [[0, 0, 0, 0, 0], [1, 1, 0, 0, 0], [0, 2, 0, 0, 0], [0, 1, 0, -1, 1]]
)
def test_what_is_not_one_hot_is_refused(wrong: list[int]) -> None:
    """Before: zeros were action 0, and of two ones the first counted."""
    env = ArcadeEnv(GAME, 2, categorical_actions=False)
    root = env.reset()
    right = torch.eye(5, dtype=torch.int64)[[3, 4]]
    assert env.step(root.clone().set("action", right))["next", "last_action"].tolist() == [3, 4]
    right[1] = torch.tensor(wrong)
    for step in (env.step, env.step_and_maybe_reset):
        with pytest.raises(
            ValueError, match=r"action of env 1 is .*, expected one-hot: a single 1 among zeros"
        ):
            step(root.clone().set("action", right))


# -- batches that are written to in place ----------------------------------------------------------


@pytest.mark.parametrize("mode", ["all", "truncated"])
def test_what_is_written_to_a_batch_does_not_come_back_in_the_overlap(
    mode: Any, tmp_path: Any
) -> None:
    """Before: rewards that were scaled in place were scaled twice where windows overlap."""
    plain = collector(overlap=3, final_frames=mode)
    scaled = collector(overlap=3, final_frames=mode)
    scaled._generator.set_state(plain._generator.get_state())
    for _ in range(3):
        expected = plain.collect()
        batch = scaled.collect()
        for key in expected.keys(True, True):
            assert torch.equal(batch[key], expected[key]), key
        for value in batch.values(True, True):
            if value.dtype is not torch.uint8:
                value.zero_()
    saved = scaled.state_dict()
    resumed = collector(overlap=3, final_frames=mode)
    resumed.load_state_dict(saved)
    assert torch.equal(resumed.collect()["next", "reward"], plain.collect()["next", "reward"])


@pytest.mark.parametrize("mode", ["all", "truncated", "none"])
def test_nothing_of_what_memory_held_before_is_seen_in_a_batch(
    mode: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"overlap": 3, "final_frames": mode}
    expected = collector(**options).collect()
    take = TensorMemory.take
    monkeypatch.setattr(TensorMemory, "take", lambda memory: take(memory).fill_(171))
    batch = collector(**options).collect()
    for key, value in expected.items(True, True):
        assert torch.equal(batch[key], value), key


def test_a_state_dict_does_not_change_when_the_collector_goes_on() -> None:
    """Also where storage is shared, and where the policy writes all its states into one tensor."""
    own = torch.zeros(N, 1)

    class Counting(nn.Module):
        in_keys = ("is_init", "count")
        out_keys = ("action", ("next", "count"))

        def make_tensordict_primer(self) -> TensorDictPrimer:
            return TensorDictPrimer(count=Unbounded((1,)))

        def forward(self, td: TensorDictBase) -> TensorDictBase:
            td["next", "count"] = own.copy_(td["count"] + 1)
            return td.set("action", own.squeeze(-1).long() % 5)

    for mode in ("all", "truncated"):
        one = ArcadeCollector(
            ArcadeEnv(GAME, N, seed=3),
            Counting(),
            N * STEPS,
            overlap=3,
            final_frames=mode,  # type: ignore[arg-type]
            return_same_td=True,
        )
        next(one.iterator()) if mode == "all" else one.collect()
        state = one.state_dict()
        del state["policy_state_dict"]
        before = copy.deepcopy(state)
        one.collect()
        assert_equal(state, before)


def assert_equal(one: Any, other: Any) -> None:
    """Nested dictionaries and lists of tensors and numbers."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert_equal(value, other[key])
    elif isinstance(one, list):
        for value, expected in zip(one, other, strict=True):
            assert_equal(value, expected)
    else:
        assert one == other


def test_no_two_entries_of_a_batch_and_no_two_batches_share_memory() -> None:
    """Before: ``batch["action"] += 1`` moved the last action that follows, and ``batch["task"] +=
    1`` those of all batches.
    """
    one = ArcadeCollector(ArcadeEnv(GAME, N, task_in_td=True), None, N * STEPS)
    windows = one.iterator()
    batches = [next(windows), next(windows)]
    entries = [value for batch in batches for value in batch.values(True, True)]
    places = [value.untyped_storage().data_ptr() for value in entries]
    for key in ("task", ("next", "task"), ("next", "last_action")):
        for batch in batches:
            assert places.count(batch[key].untyped_storage().data_ptr()) == 1, key
