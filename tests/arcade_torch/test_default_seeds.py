"""Workers that play the very same episodes, because 0 is everybody's seed, are told so once; honest
uses are not.
"""

import gc
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv

import arcade_torch
from arcade_torch import ArcadeCollector, default_seeds, process

SAID = "this env has the default seed, 0, and plays the very same episodes as"


@pytest.fixture(autouse=True)
def afresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(default_seeds, "_warned", False)
    monkeypatch.setattr(default_seeds, "_LIVE", {})
    yield


def make(**options: Any) -> arcade_torch.ArcadeEnv:
    return arcade_torch.make("CartPoleEasy", num_envs=2, **options)


def warnings_of(begin: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        begin()
    return [str(warning.message) for warning in said if SAID in str(warning.message)]


def test_two_workers_with_the_default_seed_are_told_once() -> None:
    """Before: they played the same episodes in silence."""
    env = SerialEnv(2, make)
    said = warnings_of(lambda: (env.reset(), env.reset()))
    assert len(said) == 1 and "another env of this process" in said[0] and "seed=i" in said[0]
    pixels = env.reset()["pixels"]
    assert torch.equal(pixels[0], pixels[1])
    env.close()


@pytest.mark.parametrize("cure", ["seeds", "set_seed"])
def test_the_cures_it_names_work_and_end_it(cure: str) -> None:
    if cure == "seeds":
        env = SerialEnv(2, [partial(make, seed=i) for i in range(2)])
    else:
        env = SerialEnv(2, make)
        env.set_seed(7)
    assert not warnings_of(env.reset)
    pixels = env.reset()["pixels"]
    assert not torch.equal(pixels[0], pixels[1])
    env.close()


def test_honest_uses_hear_nothing() -> None:
    def play() -> None:
        for _ in range(2):  # one after the other
            env = make()
            env.rollout(3)
            del env
            gc.collect()
        train, test = make(seed=0), make(seed=0)  # who says 0 means it
        train.reset(), test.reset()
        one, other = make(), arcade_torch.make("CartPoleEasy", num_envs=3)  # other sizes
        one.reset(), other.reset()
        next(ArcadeCollector(make(seed=3), None, 4).iterator())

    assert not warnings_of(play)


def test_a_worker_process_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(process.multiprocessing, "parent_process", lambda: object())
    make(seed=0).reset()
    assert not caplog.messages
    make().reset(), make().reset()
    assert len(caplog.messages) == 1 and "every worker process" in caplog.messages[0]


def test_twins_of_one_game_are_no_twins_of_each_other() -> None:
    mdp, pomdp = make(observability="full"), make(observability="partial")
    assert not warnings_of(lambda: (mdp.reset(), pomdp.reset()))


@pytest.mark.slow
def test_real_worker_processes_say_so(capfd: pytest.CaptureFixture[str]) -> None:
    """TorchRL ignores warnings in its workers: it has to be said otherwise."""
    env = ParallelEnv(2, make, mp_start_method="spawn")
    env.reset()
    env.close()
    assert SAID in capfd.readouterr().err


@pytest.mark.slow
def test_real_worker_processes_with_seeds_of_their_own_differ() -> None:
    env = ParallelEnv(2, [partial(make, seed=i) for i in range(2)], mp_start_method="spawn")
    pixels = env.reset()["pixels"]
    assert not torch.equal(pixels[0], pixels[1])
    env.close()
