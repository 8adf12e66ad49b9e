"""TorchRL's collector of several processes, for machines whose cores one process does not fill."""

import functools

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.modules import QValueModule

import arcade_torch
from arcade_torch.models import MemoryModule, SmallEncoder, make_memory

N, T, WINDOWS = 4, 8, 3
KEYS = [
    "pixels",
    "is_init",
    "action",
    "action_value",
    ("next", "pixels"),
    ("next", "reward"),
    ("next", "done"),
]


def recurrent_policy() -> TensorDictSequential:
    torch.manual_seed(0)
    return TensorDictSequential(
        TensorDictModule(SmallEncoder(128), ["pixels"], ["features"]),
        MemoryModule(
            make_memory("mingru", 128, 16), in_key="features", out_key="remembered", store="step"
        ),
        TensorDictModule(nn.Linear(16, 5), ["remembered"], ["action_value"]),
        QValueModule(action_space="categorical"),
    )


def make_env(seed: int) -> arcade_torch.ArcadeEnv:
    return arcade_torch.make("SignpostEasy", num_envs=N, observability="partial", seed=seed)


def windows(
    env_or_envs: object, frames: int, policy: nn.Module, other: nn.Module
) -> list[TensorDictBase]:
    """The windows that a collector gives; after the first it gets other weights."""
    kind = MultiSyncCollector if isinstance(env_or_envs, list) else Collector
    collector = kind(
        env_or_envs,
        policy,
        frames_per_batch=frames,
        total_frames=WINDOWS * frames,
        auto_register_policy_transforms=True,
    )
    got = []
    for batch in collector:
        got.append(batch.clone())
        policy.load_state_dict(other.state_dict())
        collector.update_policy_weights_(TensorDict.from_module(policy))
    collector.shutdown()
    return got


@pytest.mark.timeout(300)
def test_each_process_gives_what_one_collector_gives() -> None:
    other = recurrent_policy()
    nn.init.normal_(other[2].module.weight, generator=torch.Generator().manual_seed(1))
    alone = [windows(make_env(seed), N * T, recurrent_policy(), other) for seed in (1, 2)]
    both = windows(
        [functools.partial(make_env, seed) for seed in (1, 2)], 2 * N * T, recurrent_policy(), other
    )
    assert all(batch["next", "done"].any() for batch in alone[0])
    assert not torch.equal(alone[0][0]["pixels"], alone[1][0]["pixels"])
    for window, batch in enumerate(both):
        assert batch.shape == (2, N, T)
        for worker in range(2):
            for key in KEYS:
                torch.testing.assert_close(batch[worker][key], alone[worker][window][key])
