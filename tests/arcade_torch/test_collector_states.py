"""States of a collector, saved and loaded: of older versions, of windows that were lost, of
batches that somebody writes to.
"""

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn

from arcade_torch.collector import ArcadeCollector
from tests.arcade_torch.same import assert_same
from tests.arcade_torch.stub import LOCKSTEP
from tests.arcade_torch.test_collector import N, Recurrent, scripted, stub_collector


def loaded(state: dict[str, Any], **options: Any) -> ArcadeCollector:
    """Another collector, which has been used, with this state."""
    other = stub_collector(Recurrent(), seed=77, **options)
    other.collect()
    other.load_state_dict(state)
    return other


@pytest.mark.parametrize("mode", ["all", "truncated"])
def test_a_state_of_version_0_2_0_goes_on_to_the_bit(mode: Any) -> None:
    """It called frames by other names."""
    options = {"overlap": 3, "final_frames": mode}
    collector = stub_collector(Recurrent(), **options)
    collector.collect()
    state = collector.state_dict()
    older = {"observation/pixels": "pixels", "dense/pixels": "dense"}
    overlap = state["overlap"]
    buffers = {older.get(name, name): value for name, value in overlap["buffers"].items()}
    old = {"buffers": buffers, "final": overlap["final"]["final/pixels"]}
    state["overlap"] = overlap | old
    assert_same(loaded(state, **options).collect(), collector.collect())


class WritesOverItsState(Recurrent):
    """Right: the step behind gets another tensor."""

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        td = super().forward(td)
        td["memory", "sum"].copy_(td["next", "memory", "sum"])
        return td


def test_a_policy_that_writes_over_its_state_leaves_what_episodes_begin_with() -> None:
    ours = stub_collector(WritesOverItsState(), LOCKSTEP, store_states=False, overlap=3)
    other = stub_collector(Recurrent(), LOCKSTEP, store_states=False, overlap=3)
    starts = 0
    for _ in range(6):
        batch = ours.collect()
        assert_same(batch, other.collect())
        starts += int(batch["is_init"][:, 0].sum())
    assert starts >= 2 * N


def test_what_is_written_to_a_batch_changes_no_state_that_was_saved_before() -> None:
    collector = stub_collector(Recurrent(), overlap=3)
    collector.collect()
    state = collector.state_dict()
    expected = loaded(copy.deepcopy(dict(state)), overlap=3).collect()
    collector.collect().apply_(torch.Tensor.zero_)
    assert_same(loaded(state, overlap=3).collect(), expected)


def test_a_state_without_all_that_its_overlap_begins_with_is_refused() -> None:
    collector = stub_collector(Recurrent(), overlap=3)
    collector.collect()
    state = collector.state_dict()
    state["window_starts"] = []
    with pytest.raises(ValueError, match="has 0 states before its coming windows"):
        loaded(state, overlap=3)


def test_a_state_of_a_window_that_was_lost_begins_anew_where_the_env_is() -> None:
    fails = [False]

    def policy(td: TensorDictBase) -> TensorDictBase:
        if fails[0] and td["step_count"].max() > 4:
            raise RuntimeError("lost")
        return scripted(td)

    collector = stub_collector(policy)
    collector.collect()
    fails[0] = True
    with pytest.raises(RuntimeError, match="lost"):
        for _ in range(9):
            collector.collect()
    fails[0] = False
    other = stub_collector(scripted, seed=77)
    other.load_state_dict(collector.state_dict())
    assert_same(other.collect(), collector.collect())


def test_numbers_of_episodes_are_those_of_a_later_state() -> None:
    one = stub_collector(scripted)
    other = stub_collector(scripted, seed=77)
    batches = one.iterator()
    for _ in range(9):
        next(batches)
    next(other.iterator())
    other.load_state_dict(one.state_dict())
    key = ("collector", "traj_ids")
    assert torch.equal(next(other.iterator())[key], next(batches)[key])


def test_an_overlap_has_all_next_frames_also_behind_a_batch_without_them() -> None:
    collector = stub_collector(scripted, overlap=3, compact_obs=True)
    other = stub_collector(scripted, overlap=3)
    next(collector.iterator())
    other.collect()
    assert_same(collector.collect(), other.collect())


def test_a_state_that_a_policy_writes_into_one_tensor_stays_as_a_batch_has_it() -> None:
    """Also one that it only writes, and no primer begins."""
    tensor = torch.zeros(N, 1)

    class Notes(nn.Module):
        in_keys = ("step_count",)
        out_keys = ("action", ("next", "note"))

        def forward(self, td: TensorDictBase) -> TensorDictBase:
            td["next", "note"] = tensor.add_(1)
            return td.set("action", torch.zeros(N, dtype=torch.int64))

    collector = stub_collector(Notes())
    collector.collect()
    begun_with = collector.collect()["initial_state", "note"]
    assert torch.equal(begun_with, torch.full((N, 1), 8.0))
