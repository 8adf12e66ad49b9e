"""What TorchRL's ``Collector`` saves can be loaded; what is of another env or collector is refused in
one line.
"""

import warnings
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv

from arcade_torch import ArcadeCollector, ArcadeEnv
from tests.arcade_torch.stub import GAME
from tests.arcade_torch.test_from_jax import made

N, T = 4, 6


def stub_env(num_envs: int = N) -> ArcadeEnv:
    return ArcadeEnv(GAME, num_envs, seed=3)


def suite_env() -> Any:
    return made("plain", num_envs=N, seed=3)


def collector_of(env: Any) -> Collector:
    policy = TensorDictModule(torch.zeros_like, ["last_action"], ["action"])
    return Collector(env, policy, frames_per_batch=env.numel() * T, total_frames=-1)


def follows(first: TensorDictBase, second: TensorDictBase) -> bool:
    """Whether the steps of a batch go on where those of another have stopped."""
    after = first["next", "step_count"][..., -1, 0] * ~first["next", "done"][..., -1, 0]
    return torch.equal(after, second["step_count"][..., 0, 0])


@pytest.mark.parametrize("make", [stub_env, suite_env])
def test_a_collector_of_torchrl_loads_what_it_saved(make: Any) -> None:
    """It saves nothing of an env, which made loading fail: no run of a bare env could be resumed."""
    collector = collector_of(make())
    steps = collector.iterator()
    saved = collector.state_dict()
    before = next(steps).clone()
    for each in (collector, collector_of(make())):
        with pytest.warns(UserWarning, match="holds no env, .*: the episodes go on where they are"):
            each.load_state_dict(saved)
    assert follows(before, next(steps))
    torch.testing.assert_close(next(each.iterator())["step_count"], before["step_count"])


@pytest.mark.parametrize("make", [stub_env, suite_env])
def test_a_state_dict_of_something_else_is_still_refused(make: Any) -> None:
    with pytest.raises(RuntimeError, match="_extra_state"):
        make().load_state_dict({"weight": torch.zeros(1)})
    env = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.load_state_dict(env.state_dict())


def test_a_state_of_another_number_of_envs_is_refused_in_one_line() -> None:
    saved = stub_env(3).state_dict()
    with pytest.raises(ValueError, match=r"^the saved entry 'key' is of 3 envs, this env has 4$"):
        stub_env(4).load_state_dict(saved)


def test_a_loaded_collector_of_several_envs_begins_anew_after_a_reset() -> None:
    """TorchRL loads the envs, but acts on the observation from before: the guide says to reset."""
    seeds = [1, 2]
    make = [lambda seed=seed: ArcadeEnv(GAME, N, seed=seed) for seed in seeds]
    collector = collector_of(SerialEnv(2, make))
    steps = collector.iterator()
    next(steps)
    saved = collector.state_dict()
    other = collector_of(SerialEnv(2, make))
    other.load_state_dict(saved)
    other.reset()
    batch = next(other.iterator())
    assert torch.equal(batch["next", "step_count"], batch["step_count"] + 1)
    assert not batch["step_count"][:, :, 0].any()


def test_an_arcade_collector_names_what_it_cannot_load() -> None:
    saved = collector_of(stub_env()).state_dict()
    with pytest.raises(ValueError, match=r"is of no ArcadeCollector; .*policy_state_dict"):
        ArcadeCollector(stub_env(), None, N * T).load_state_dict(saved)


def test_a_state_taken_behind_shutdown_says_that_episodes_begin_anew() -> None:
    collector = ArcadeCollector(ArcadeEnv(GAME, N, seed=2), None, N * T)
    collector.collect()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        collector.state_dict()
    collector.shutdown()
    with pytest.warns(UserWarning, match=r"^a state_dict behind shutdown\(\) holds no episodes"):
        state = collector.state_dict()
    other = ArcadeCollector(ArcadeEnv(GAME, N, seed=5), None, N * T)
    other.load_state_dict(state)
    assert other.collect()["is_init"][:, 0].all()
