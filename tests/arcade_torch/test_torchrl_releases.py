"""What TorchRL changes from release to release, and works alike under 0.14, 0.15 and the nightly
build.
"""

import importlib
import warnings
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch import ArcadeCollector, ArcadeEnv
from arcade_torch.compiled import CompiledGame
from arcade_torch.models import MemoryModule, make_memory
from tests.arcade_torch.stub import StubGame

N = 3
GAME = CompiledGame(StubGame(risk=0.2, max_steps=9))


def policy() -> TensorDictSequential:
    """Counts what it has seen: the actions depend on the whole episode."""
    torch.manual_seed(0)
    features = TensorDictModule(lambda x: x.float().mean((-3, -2)) / 255, ["pixels"], ["embed"])
    memory = MemoryModule(make_memory("gru", 3, 4))
    head = TensorDictModule(torch.nn.Linear(4, 5), ["embed_memory"], ["action_value"])
    act = TensorDictModule(lambda q: q.argmax(-1), ["action_value"], ["action"])
    return TensorDictSequential(features, memory, head, act)


def primed(module: TensorDictSequential) -> TransformedEnv:
    return TransformedEnv(ArcadeEnv(GAME, N, seed=3), get_primers_from_module(module))


@pytest.mark.parametrize("appended", ["by us", "by the collector"])
def test_a_memory_collects_the_same_whoever_appends_the_primer(appended: str) -> None:
    """A collector appends missing primers where it is asked to, from 0.15 on by default."""
    module = policy()
    by_us = appended == "by us"
    env = primed(module) if by_us else ArcadeEnv(GAME, N, seed=3)
    asked = None if by_us else True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        collector = Collector(
            env,
            module,
            frames_per_batch=N * 8,
            total_frames=N * 8,
            auto_register_policy_transforms=asked,
        )
        batch = next(iter(collector))
        collector.shutdown()
    ours = next(ArcadeCollector(ArcadeEnv(GAME, N, seed=3), module, N * 8).iterator())
    for key in ("action", ("memory", "h"), ("next", "reward"), "is_init"):
        assert torch.equal(batch[key], ours[key]), key


def test_a_given_state_counts_with_set_state_alone() -> None:
    """From 0.15 ``reset(td)`` ignores a state that is not meant; ours does under every release."""
    env = ArcadeEnv(GAME, N, seed=3, state_in_td=True)
    root = env.reset()
    for _ in range(3):
        root = env.step_and_maybe_reset(root.set("action", torch.ones(N, dtype=torch.int64)))[1]
    state = root["state"].clone()
    given = TensorDict({"state": state}, [N])
    again = env.reset(given.clone(), set_state=True)
    assert torch.equal(again["step_count"], root["step_count"])
    assert torch.equal(again["pixels"], root["pixels"])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        anew = env.reset(given.clone())
    honoured = any(
        issubclass(warning.category, FutureWarning) for warning in said
    )  # by 0.14, which says so
    assert torch.equal(
        anew["step_count"], root["step_count"] if honoured else torch.zeros_like(root["step_count"])
    )


@pytest.mark.parametrize("form", ["dense", "cat"])
def test_our_batches_are_dense_whatever_form_trajectories_have(form: str) -> None:
    """From 0.16 trajectory batches of TorchRL's collectors are "cat"; ours are [envs, time],
    always.
    """
    batch = next(ArcadeCollector(ArcadeEnv(GAME, N, seed=3), None, N * 8).iterator())
    assert batch.shape == (N, 8)
    if form == "cat":
        flat = batch.reshape(-1)
        ends = flat["next", "done"].squeeze(-1)
        ids = flat["collector", "traj_ids"]
        assert torch.equal(ids[1:] != ids[:-1], ends[:-1] | (torch.arange(1, N * 8) % 8 == 0))


@pytest.fixture
def container() -> Iterator[type]:
    omegaconf = importlib.util.find_spec("omegaconf")
    if omegaconf is None:
        pytest.skip("needs omegaconf, which Hydra brings")
    yield importlib.import_module("omegaconf").OmegaConf


def test_make_is_a_target_of_hydra(container: type) -> None:
    """Hydra hands over lists of its own (``ListConfig``), which are sequences and no lists."""
    config = container.create(  # type: ignore[attr-defined]
        {
            "id": ["CartPoleEasy", "MineSweeperEasy"],
            "num_envs": 4,
            "observability": "partial",
            "seed": 1,
        }
    )
    env = arcade_torch.make(**config)
    assert env.num_envs == 4 and len(env.games) == 2 and env.observability.all()
    instantiate = pytest.importorskip("hydra.utils").instantiate
    whole = container.create({"_target_": "arcade_torch.make", **config})  # type: ignore[attr-defined]
    assert instantiate(whole).reset()["pixels"].shape == (4, 128, 128, 3)
    one = container.create({"_target_": "arcade_torch.make", "id": "CartPoleEasy"})  # type: ignore[attr-defined]
    assert instantiate(one, num_envs=2).num_envs == 2
