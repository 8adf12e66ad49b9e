"""Groups of envs in one batch: each plays as in a batch of its own, and a collector's state can be taken apart."""

from typing import Any

import pytest
import torch

from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.groups import join_collector_states, seed_groups, split_collector_state
from tests.arcade_torch.stub import GAME
from tests.arcade_torch.test_collector import Recurrent, assert_same, tensors

SEEDS, EACH, STEPS = (3, 8), 3, 8


def _collector(seeds: tuple[int, ...], context: int) -> ArcadeCollector:
    env = ArcadeEnv(GAME, EACH * len(seeds), seed=0)
    seed_groups(env, seeds)
    return ArcadeCollector(env, Recurrent(), env.num_envs * STEPS, context=context)


def _assert_rows(whole: ArcadeCollector, parts: list[ArcadeCollector], windows: int) -> int:
    """Collect the same with both; returns how many final frames stood in the pool."""
    finals = 0
    for _ in range(windows):
        batch = whole.collect()
        finals += int((batch["next", "frame_slot"][:, :-1] >= 0).sum())
        for part, rows in zip(parts, batch.split(EACH), strict=True):
            assert_same(tensors(part.collect()), tensors(rows))
    return finals


@pytest.mark.parametrize("context", [0, 3, 7])
def test_groups_play_alone_and_together_and_go_on_apart_and_joined(context: int) -> None:
    whole, parts = _collector(SEEDS, context), [_collector((seed,), context) for seed in SEEDS]
    finals = _assert_rows(whole, parts, 3)
    apart = [_collector((0,), context) for _ in SEEDS]
    for part, state in zip(apart, split_collector_state(whole.state_dict(), len(SEEDS)), strict=True):
        part.load_state_dict(state)
    joined = _collector(SEEDS, context)
    joined.load_state_dict(join_collector_states([part.state_dict() for part in parts]))
    finals += _assert_rows(whole, parts, 1)  # those that went on are where they were
    for windows in (1, 2):
        whole.load_state_dict(join_collector_states([part.state_dict() for part in parts]))
        finals += _assert_rows(whole, parts, windows)
    _assert_rows(joined, apart, 4)
    assert finals > 10


def test_taken_apart_and_put_together_is_the_same_state() -> None:
    whole = _collector(SEEDS, 3)
    whole.collect()
    state = join_collector_states(split_collector_state(whole.state_dict(), len(SEEDS)))
    again = _collector(SEEDS, 3)
    again.load_state_dict(state)
    assert_same(tensors(whole.collect()), tensors(again.collect()))


def test_a_state_from_before_the_first_window_can_be_taken_apart() -> None:
    whole = _collector(SEEDS, 3)
    parts = [_collector((0,), 3) for _ in SEEDS]
    for part, state in zip(parts, split_collector_state(whole.state_dict(), len(SEEDS)), strict=True):
        part.load_state_dict(state)
    _assert_rows(whole, parts, 1)


def test_a_group_of_one_is_seeded_as_an_env() -> None:
    env, other = ArcadeEnv(GAME, EACH, seed=5), ArcadeEnv(GAME, EACH, seed=6)
    seed_groups(other, [5])
    assert torch.equal(env.reset()["pixels"], other.reset()["pixels"])


def test_what_does_not_fit_is_refused() -> None:
    env = ArcadeEnv(GAME, 4, seed=0)
    with pytest.raises(ValueError, match="4 envs cannot be split evenly among 3 seeds"):
        seed_groups(env, (1, 2, 3))
    one, other = _collector((1,), 0), _collector((2,), 0)
    one.collect()
    states: list[Any] = [one.state_dict(), other.state_dict()]
    with pytest.raises(ValueError, match="the saved collectors differ in frames: 24, 0"):
        join_collector_states(states)
