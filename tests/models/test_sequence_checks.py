"""A memory notices what it would learn or act from in silence: shuffled steps, cut sequences, no
primer.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import (
    EnvBase,
    InitTracker,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from arcade_torch.models import MemoryModule, make_memory, recurrence
from tests.models.test_memory_module import Countdown

N, T = 4, 24
TRAJECTORY = ("collector", "traj_ids")
REFUSED = (
    r"^(step_count|\('collector', 'traj_ids'\)) goes from \d+ to \d+ where is_init is false: "
    r"[^\n]*SliceSampler[^\n]*docs/guides/torchrl\.md[^\n]*check_sequences=False[^\n]*"
)
WARNED = r"^no recurrent state 'memory\.h' at a step whose is_init is false, .*primers[^\n]*$"


class Agent:
    """PPO of stock parts around a memory: actor, critic, loss."""

    def __init__(self, **options: Any) -> None:
        torch.manual_seed(0)
        common = TensorDictSequential(
            TensorDictModule(nn.Linear(3, 8), ["observation"], ["features"]),
            MemoryModule(make_memory("gru", 8, 8), "features", "remembered", **options),
        )
        self.actor = ProbabilisticActor(
            TensorDictSequential(
                common, TensorDictModule(nn.Linear(8, 2), ["remembered"], ["logits"])
            ),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        self.critic = TensorDictSequential(common, ValueOperator(nn.Linear(8, 1), ["remembered"]))
        self.loss = ClipPPOLoss(self.actor, self.critic)
        self.gae = GAE(gamma=0.99, lmbda=0.95, value_network=self.critic)

    def env(self, *transforms: Any) -> TransformedEnv:
        env: Any = Countdown(N)
        for transform in (
            InitTracker(),
            *transforms,
            get_primers_from_module(self.actor, warn=False),
        ):
            env = TransformedEnv(env, transform)
        return env

    def window(self, *transforms: Any) -> TensorDictBase:
        """What TorchRL's collector gives, with advantages."""
        collector = Collector(
            self.env(*transforms), self.actor, frames_per_batch=N * T, total_frames=N * T
        )
        batch = next(iter(collector))
        with set_recurrent_mode(True):
            return self.gae(batch)


def flat(batch: TensorDictBase) -> TensorDictBase:
    """Single steps in any order: what a script for networks without memory does."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(N * T), sampler=SamplerWithoutReplacement(), batch_size=N * T // 2
    )
    buffer.extend(batch.reshape(-1))
    return buffer.sample()


def windows(batch: TensorDictBase) -> TensorDictBase:
    """Whole rows in any order."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(N), sampler=SamplerWithoutReplacement(), batch_size=N // 2
    )
    buffer.extend(batch)
    return buffer.sample()


def slices(batch: TensorDictBase, kind: type[ReplayBuffer] = TensorDictReplayBuffer) -> Any:
    """Parts of episodes, one behind the other."""
    sampler = SliceSamplerWithoutReplacement(slice_len=3, traj_key=TRAJECTORY, strict_length=False)
    buffer = kind(storage=LazyTensorStorage(N * T), sampler=sampler, batch_size=N * T // 2)
    buffer.extend(batch.reshape(-1))
    return buffer.sample()


def padded(batch: TensorDictBase) -> TensorDictBase:
    """An episode a row, filled up with zeros."""
    return split_trajectories(batch, prefix="collector")


def learn(agent: Agent, batch: TensorDictBase) -> None:
    losses = agent.loss(batch)
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()


@pytest.mark.parametrize("transforms", [[], [StepCounter]], ids=["trajectories", "counts too"])
def test_a_stock_ppo_that_shuffles_steps_is_refused(transforms: list[Any]) -> None:
    """It learned from steps that do not follow each other, without a word."""
    agent = Agent()
    batch = agent.window(*(kind() for kind in transforms))
    with pytest.raises(ValueError, match=REFUSED):
        learn(agent, flat(batch))


def test_steps_that_only_a_count_tells_apart_are_refused() -> None:
    agent = Agent()
    batch = agent.window(StepCounter()).exclude("collector", ("next", "step_count"))
    with pytest.raises(ValueError, match=r"^step_count goes from"):
        learn(agent, flat(batch))
    cut = torch.cat((batch[:, :3], batch[:, 9:]), dim=1)
    cut["is_init"][:, 3] = False
    with pytest.raises(ValueError, match=r"^step_count goes from"):
        learn(agent, cut)


def test_one_sequence_alone_is_looked_at_too() -> None:
    module = MemoryModule(make_memory("gru", 3, 4), "seen", "out", default_recurrent_mode=True)
    batch = TensorDict({"seen": torch.ones(1, 4, 3)}, [1, 4])
    batch["is_init"] = torch.tensor([[True, False, False, False]]).unsqueeze(-1)
    batch["step_count"] = torch.tensor([[0, 1, 7, 8]]).unsqueeze(-1)
    with pytest.raises(ValueError, match="step_count goes from 1 to 7"):
        module(batch)


def test_slices_whose_starts_are_not_marked_are_refused() -> None:
    """TorchRL's ``ReplayBuffer`` marks none, its ``TensorDictReplayBuffer`` does."""
    agent = Agent()
    batch = agent.window(StepCounter())
    with pytest.raises(ValueError, match=REFUSED):
        learn(agent, slices(batch, ReplayBuffer))


@pytest.mark.parametrize("take", [windows, slices, padded, lambda batch: batch])
@pytest.mark.parametrize("transforms", [[], [StepCounter]], ids=["trajectories", "counts too"])
def test_windows_and_slices_are_read(take: Callable[[Any], Any], transforms: list[Any]) -> None:
    agent = Agent()
    batch = agent.window(*(kind() for kind in transforms))
    learn(agent, take(batch))
    assert agent.actor.module[0][0][0].module.weight.grad.abs().sum() > 0


def test_a_memory_without_state_reads_steps_in_any_order() -> None:
    memory = MemoryModule(make_memory("mlp", 8, 8), "features", default_recurrent_mode=True)
    memory(sequence([6, 4, 5]))


def test_an_argument_reads_shuffled_steps_anyway() -> None:
    agent = Agent(check_sequences=False)
    learn(agent, flat(agent.window(StepCounter())))


def sequence(order: list[int]) -> TensorDict:
    steps = len(order)
    flags = torch.zeros(2, steps, 1, dtype=torch.bool)
    entries = {"features": torch.randn(2, steps, 8), "is_init": flags}
    count = torch.tensor(order).expand(2, steps).unsqueeze(-1)
    return TensorDict({**entries, "step_count": count}, [2, steps])


def module(**options: Any) -> MemoryModule:
    return MemoryModule(
        make_memory("gru", 8, 8), "features", "remembered", default_recurrent_mode=True, **options
    )


def test_an_env_that_counts_several_steps_at_once_says_so_and_is_read() -> None:
    batch = sequence([0, 4, 8])
    with pytest.raises(ValueError, match=r"^step_count goes from"):
        module()(batch.clone())
    module()(batch.set(("next", "step_count"), batch["step_count"] + 4))


def test_on_a_gpu_the_host_waits_for_the_first_batch_of_a_shape_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = []
    any_flag = recurrence._any
    monkeypatch.setattr(recurrence, "_is_host", lambda _: False)
    monkeypatch.setattr(
        recurrence, "_any", lambda flags: looks.append(flags.shape) or any_flag(flags)
    )
    memory = module()
    for _ in range(3):
        memory(sequence([4, 5, 6]))
        memory(sequence([4, 5, 6, 7]))
    assert looks == [(2, 2), (2, 3)]
    with pytest.raises(ValueError, match=r"^step_count goes from 4 to 6 where"):
        memory(sequence([4, 6]))


def test_a_compiled_module_reads_whole_sequences_in_one_graph_and_looks_at_none() -> None:
    memory = module(store="sequence")
    compiled = torch.compile(memory, backend="eager", fullgraph=True)
    batch = sequence([4, 5, 6])
    expected = memory(batch.clone())["remembered"]
    torch.testing.assert_close(compiled(batch.clone())["remembered"], expected)
    compiled(sequence([6, 4, 5]))


def test_under_vmap_sequences_are_read_and_none_are_looked_at() -> None:
    memory = module(store="sequence")

    def remembered(batch: TensorDict) -> torch.Tensor:
        return memory(batch)["remembered"]

    batch = torch.stack([sequence([4, 5, 6]), sequence([6, 5, 4])])
    assert torch.vmap(remembered)(batch).shape == (2, 2, 3, 8)


# -- no primer -------------------------------------------------------------------------------------


def rollout(env: EnvBase, actor: TensorDictModule) -> TensorDictBase:
    with torch.no_grad():
        return env.rollout(T, actor, break_when_any_done=False)


def collected(env: EnvBase, actor: TensorDictModule) -> TensorDictBase:
    frames = {"frames_per_batch": N * T, "total_frames": N * T}
    return next(iter(Collector(env, actor, auto_register_policy_transforms=False, **frames)))


def serial(make: Callable[[], EnvBase]) -> EnvBase:
    return SerialEnv(2, make)


ENVS = {
    "TransformedEnv": lambda: TransformedEnv(Countdown(N), InitTracker()),
    "two of them": lambda: TransformedEnv(
        TransformedEnv(Countdown(N), InitTracker()), StepCounter()
    ),
    "SerialEnv": lambda: serial(lambda: TransformedEnv(Countdown(N), InitTracker())),
    "around SerialEnv": lambda: TransformedEnv(serial(partial(Countdown, N)), InitTracker()),
}


@pytest.mark.parametrize("run", [rollout, collected])
@pytest.mark.parametrize("env", ENVS.values(), ids=ENVS)
def test_a_missing_primer_is_noticed_once_wherever_it_is_missing(env: Any, run: Any) -> None:
    """It was only where nothing stands around one of our own envs."""
    agent = Agent()
    with pytest.warns(UserWarning, match=WARNED) as caught:
        run(env(), agent.actor)
        run(env(), agent.actor)
    assert len([one for one in caught if "no recurrent state" in str(one.message)]) == 1
    primed = TransformedEnv(env(), get_primers_from_module(agent.actor, warn=False))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="no recurrent state")
        run(primed, Agent().actor)


def test_episodes_of_one_step_and_memories_without_state_need_no_primer() -> None:
    flags = torch.ones(N, 1, dtype=torch.bool)
    step = TensorDict({"features": torch.randn(N, 8), "is_init": flags}, [N])
    without_state = MemoryModule(make_memory("mlp", 8, 8), "features", "remembered")
    assert without_state.state_keys == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MemoryModule(make_memory("gru", 8, 8), "features", "remembered")(step.clone())
        without_state(step.clone().set("is_init", ~flags))


def test_on_a_gpu_the_host_waits_for_the_first_steps_without_a_state_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = []
    monkeypatch.setattr(recurrence, "_is_host", lambda _: False)
    monkeypatch.setattr(recurrence, "_any", lambda flags: looks.append(flags) is not None)
    memory = MemoryModule(make_memory("gru", 8, 8), "features", "remembered")
    flags = torch.ones(N, 1, dtype=torch.bool)
    for _ in range(20):
        memory(TensorDict({"features": torch.randn(N, 8), "is_init": flags}, [N]))
    assert len(looks) == recurrence.STEPS_LOOKED_AT
