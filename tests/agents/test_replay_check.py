"""``check_replay``: nothing for a batch that is read as it was acted, much for every way to go
wrong.
"""

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    GymEnv,
    InitTracker,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import (
    ActorValueOperator,
    EGreedyModule,
    GRUModule,
    LSTMModule,
    MaskedCategorical,
    NormalParamExtractor,
    ProbabilisticActor,
    QValueModule,
    TanhNormal,
    ValueOperator,
)
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import check_replay, make_policy
from arcade_torch.models import (
    MemoryModule,
    SmallEncoder,
    make_actor_critic,
    make_memory,
    make_network,
)

STEPS = 120
ROUNDING = 1e-5
WRONG = 1e-3
MEMORIES = {
    "LSTMModule": lambda: LSTMModule(
        input_size=16, hidden_size=16, in_key="features", out_key="remembered"
    ),
    "GRUModule": lambda: GRUModule(
        input_size=16, hidden_size=16, in_key="features", out_key="remembered"
    ),
    "ours": lambda: MemoryModule(make_memory("lru", 16, 16), "features", "remembered"),
    "no memory": lambda: TensorDictModule(nn.Linear(16, 16), ["features"], ["remembered"]),
}


class ForgetsWhileActing(MemoryModule):
    """Goes on from the last episode: it keeps its state to itself, and looks at no start."""

    state: Any = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.recurrent_mode:
            return super().forward(tensordict)
        step = tensordict.copy()
        if self.state is not None:
            step.update(self.state).set("is_init", torch.zeros_like(step["is_init"]))
        super().forward(step)
        self.state = step["next"].select(*self.state_keys).detach().clone()
        return tensordict.update(step.select(*self.out_keys))


class ForgetsWhileReplaying(MemoryModule):
    """Reads a sequence as if it were one episode."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        flags = tensordict["is_init"]
        if self.recurrent_mode:
            tensordict["is_init"] = torch.zeros_like(flags)
        return super().forward(tensordict).set("is_init", flags)


def policy_of(memory: nn.Module, kind: str = "stochastic") -> Any:
    """CartPole's frames of four numbers, a memory, and a head that draws or chooses."""
    torch.manual_seed(0)
    encode = TensorDictModule(nn.Linear(4, 16), ["observation"], ["features"])
    head = nn.Linear(16, 2)
    nn.init.normal_(head.weight)
    if kind == "stochastic":
        logits = TensorDictModule(head, ["remembered"], ["logits"])
        return ProbabilisticActor(
            TensorDictSequential(encode, memory, logits),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
    values = TensorDictModule(head, ["remembered"], ["action_value"])
    env = GymEnv("CartPole-v1", categorical_action_encoding=True)
    choose = QValueModule(spec=env.action_spec)
    explore = EGreedyModule(env.action_spec, eps_init=0.2, eps_end=0.2)
    return TensorDictSequential(encode, memory, values, choose, explore)


def make_policy_for_frames(memory: nn.Module) -> TensorDictSequential:
    """A greedy policy for our frames."""
    torch.manual_seed(0)
    return TensorDictSequential(
        TensorDictModule(SmallEncoder(128), ["pixels"], ["all_features"]),
        TensorDictModule(nn.Linear(128, 16), ["all_features"], ["features"]),
        memory,
        TensorDictModule(nn.Linear(16, 5), ["remembered"], ["action_value"]),
        QValueModule(action_space="categorical"),
    )


def cartpole(policy: nn.Module, primed: bool = True) -> TransformedEnv:
    env = TransformedEnv(
        GymEnv("CartPole-v1", categorical_action_encoding=True), InitTracker()
    ).append_transform(StepCounter())
    primer = get_primers_from_module(policy, warn=False)
    env.set_seed(0)
    return env.append_transform(primer) if primed and primer is not None else env


def collected(policy: nn.Module, **options: Any) -> TensorDictBase:
    collector = Collector(
        cartpole(policy, **options),
        policy,
        frames_per_batch=STEPS,
        total_frames=STEPS,
        auto_register_policy_transforms=False,
    )
    batch = next(iter(collector))
    collector.shutdown()
    assert batch["next", "done"].sum() > 2
    return batch


@pytest.mark.parametrize("kind", ["stochastic", "greedy"])
@pytest.mark.parametrize("memory", MEMORIES)
def test_what_was_acted_is_replayed_on_gymnasiums_cartpole(memory: str, kind: str) -> None:
    policy = policy_of(MEMORIES[memory](), kind)
    batch = collected(policy)
    before = batch.clone()
    assert check_replay(policy, batch) < ROUNDING
    assert check_replay(policy, split_trajectories(batch, prefix="collector")) < ROUNDING
    assert (batch == before).all()  # it is read, not written


def slices(batch: TensorDictBase) -> TensorDictBase:
    sampler = SliceSampler(slice_len=8, traj_key=("collector", "traj_ids"), strict_length=False)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(STEPS), sampler=sampler, batch_size=64
    )
    buffer.extend(batch)
    return buffer.sample()


@pytest.mark.parametrize("kind", ["stochastic", "greedy"])
@pytest.mark.parametrize("memory", ["LSTMModule", "GRUModule", "ours"])
def test_slices_are_replayed_and_shuffled_steps_are_not(memory: str, kind: str) -> None:
    policy = policy_of(MEMORIES[memory](), kind)
    batch = collected(policy)
    assert check_replay(policy, slices(batch)) < ROUNDING
    shuffled = batch[torch.randperm(STEPS)]
    assert check_replay(policy, shuffled) > WRONG
    unmarked = slices(batch).exclude("is_init")
    unmarked["is_init"] = torch.zeros(len(unmarked), 1, dtype=torch.bool)
    assert check_replay(policy, unmarked) > WRONG


@pytest.mark.filterwarnings("ignore:no recurrent state")
@pytest.mark.parametrize("memory", ["LSTMModule", "GRUModule", "ours"])
def test_without_a_primer_it_is_another_policy_that_acted(memory: str) -> None:
    policy = policy_of(MEMORIES[memory]())
    assert check_replay(policy, collected(policy, primed=False)) > WRONG


@pytest.mark.parametrize("kind", [ForgetsWhileActing, ForgetsWhileReplaying])
def test_a_policy_that_forgets_its_reset_is_noticed(kind: type[MemoryModule]) -> None:
    policy = policy_of(kind(make_memory("lru", 16, 16), "features", "remembered"))
    assert check_replay(policy, collected(policy)) > WRONG


@pytest.mark.parametrize("kind", ["collect", "iterate"])
@pytest.mark.parametrize("network", ["q", "actor-critic"])
def test_our_networks_and_collector_are_replayed(network: str, kind: str) -> None:
    torch.manual_seed(0)
    make = make_network if network == "q" else make_actor_critic
    policy = make_policy(make("small", "lru"))
    env = arcade_torch.make("SignpostEasy", num_envs=4, seed=3)
    collector = arcade_torch.ArcadeCollector(env, policy, 4 * 24, 4 * 96)
    batch = collector.collect() if kind == "collect" else next(iter(collector))
    assert check_replay(policy, batch) < 1e-4
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(1.5)
    assert check_replay(policy, batch) > WRONG


def test_any_output_may_be_compared_and_continuous_actions_are_those_that_were_taken() -> None:
    torch.manual_seed(0)
    memory = MEMORIES["GRUModule"]()
    parameters = TensorDictModule(
        nn.Sequential(nn.Linear(16, 2), NormalParamExtractor()), ["remembered"], ["loc", "scale"]
    )
    encode = TensorDictModule(nn.Linear(3, 16), ["observation"], ["features"])
    policy = ProbabilisticActor(
        TensorDictSequential(encode, memory, parameters),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    env = TransformedEnv(GymEnv("Pendulum-v1"), InitTracker())
    env = env.append_transform(get_primers_from_module(policy, warn=False))
    with torch.no_grad():
        batch = env.rollout(40, policy)
    assert check_replay(policy, batch) < 1e-4
    assert check_replay(policy, batch, key="loc") < ROUNDING
    batch["loc"][7] += 1
    assert check_replay(policy, batch, key="loc") == pytest.approx(1.0, abs=ROUNDING)


def actor_with_critic(kind: str) -> Any:
    """A critic beside the actor, or behind the memory that both read."""
    actor = policy_of(MEMORIES["ours"]())
    if kind == "beside":
        critic = ValueOperator(nn.Linear(4, 1), in_keys=["observation"])
        return TensorDictSequential(critic, actor)
    encode, memory, logits = actor[0]
    critic = ValueOperator(nn.Linear(16, 1), in_keys=["remembered"])
    head = ProbabilisticActor(
        logits,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    return ActorValueOperator(TensorDictSequential(encode, memory), head, critic)


@pytest.mark.parametrize("kind", ["beside", "behind"])
def test_a_critic_may_run_with_the_actor(kind: str) -> None:
    policy = actor_with_critic(kind)
    batch = collected(policy)
    assert check_replay(policy, batch) < ROUNDING
    batch["action_log_prob"][7] += 1
    assert check_replay(policy, batch) == pytest.approx(1.0, abs=ROUNDING)
    batch["action_log_prob"][7] -= 1
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(1.5)
    assert check_replay(policy, batch) > WRONG


def test_a_mask_of_actions_is_none_of_steps() -> None:
    memory = MEMORIES["ours"]()
    encode = TensorDictModule(nn.Linear(4, 16), ["observation"], ["features"])
    logits = TensorDictModule(nn.Linear(16, 3), ["remembered"], ["logits"])
    allowed = TensorDictModule(
        lambda x: torch.tensor([True, True, False]).expand(*x.shape[:-1], 3).clone(),
        ["observation"],
        ["mask"],
    )
    policy = ProbabilisticActor(
        TensorDictSequential(encode, memory, logits, allowed),
        in_keys=["logits", "mask"],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
    )
    assert check_replay(policy, collected(policy)) < ROUNDING


def test_start_flags_may_have_another_name() -> None:
    memory = MemoryModule(
        make_memory("lru", 16, 16), "features", "remembered", is_init_key="begins"
    )
    policy = policy_of(memory)
    env = TransformedEnv(
        GymEnv("CartPole-v1", categorical_action_encoding=True), InitTracker(init_key="begins")
    ).append_transform(get_primers_from_module(policy, warn=False))
    batch = env.rollout(STEPS, policy, break_when_any_done=False)
    assert batch["begins"].sum() > 2 and "is_init" not in batch
    assert check_replay(policy, batch) < ROUNDING
    batch["begins"] = torch.zeros_like(batch["begins"])
    assert check_replay(policy, batch) > WRONG


@pytest.mark.parametrize("skipped", [0, 1])
def test_steps_that_are_skipped_inside_of_the_primer_are_replayed(skipped: int) -> None:
    """Start flags and states that the env inside of ``ConditionalSkip`` writes are skipped too."""

    def batch(is_init_key: str) -> tuple[Any, TensorDictBase]:
        memory = MemoryModule(
            make_memory("gru", 16, 16), "features", "remembered", is_init_key=is_init_key
        )
        policy = make_policy_for_frames(memory)
        primer = get_primers_from_module(policy, warn=False)
        counter = StepCounter(step_count_key="all_steps")
        env: Any = arcade_torch.make("CartPoleEasy", num_envs=2)
        skip = ConditionalSkip(lambda step: step["all_steps"] % 2 == skipped)
        if is_init_key == "is_init":
            env = TransformedEnv(TransformedEnv(env, primer), skip, auto_unwrap=False)
            around = [counter]
        else:
            env = TransformedEnv(env, skip)
            around = [InitTracker(init_key=is_init_key), counter, primer]
        env = TransformedEnv(env, Compose(*around), auto_unwrap=False)
        return policy, env.rollout(60, policy, break_when_any_done=False)

    assert check_replay(*batch("begins")) < ROUNDING
    assert check_replay(*batch("is_init")) > WRONG


def test_a_batch_that_says_nothing_of_the_policy_is_refused_in_one_line() -> None:
    policy = policy_of(MEMORIES["ours"]())
    batch = collected(policy)
    with pytest.raises(ValueError, match=r"^the batch must hold one of \['action_log_prob', 'act"):
        check_replay(policy, batch.exclude("action_log_prob"))
    with pytest.raises(ValueError, match=r"^the batch must hold one of \['chosen'\]"):
        check_replay(policy, batch, key="chosen")
    with pytest.raises(KeyError, match="is_init"):
        check_replay(policy, batch.exclude("is_init"))
