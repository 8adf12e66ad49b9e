"""TorchRL's own parts take the env and the collector as they are."""

import copy
import re
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, ReplayBuffer
from torchrl.envs import StepCounter, ToTensorImage, TransformedEnv
from torchrl.modules import (
    GRUModule,
    ProbabilisticActor,
    QValueModule,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.models import MemoryModule, make_memory
from tests.arcade_torch.same import assert_same
from tests.arcade_torch.stub import GAME

N, T = 6, 16


def stub_env(**options: Any) -> ArcadeEnv:
    return ArcadeEnv(GAME, N, **options)


def encoder() -> TensorDictModule:
    layers = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 8), nn.Tanh())
    module = TensorDictModule(lambda pixels: layers(pixels.float() / 255), ["pixels"], ["features"])
    module.layers = layers
    return module


def recurrent_policy() -> TensorDictSequential:
    torch.manual_seed(1)
    keys = {
        "in_keys": ["features", "recurrent_state", "is_init"],
        "out_keys": ["hidden", ("next", "recurrent_state")],
    }
    memory = GRUModule(input_size=8, hidden_size=8, **keys)
    head = TensorDictModule(nn.Linear(8, 5), ["hidden"], ["action_value"])
    greedy = QValueModule(spec=stub_env().action_spec_unbatched, action_space="categorical")
    return TensorDictSequential(encoder(), memory, head, greedy)


def test_a_recurrent_policy_gives_the_data_of_torchrls_collector_with_a_primer() -> None:
    policy = recurrent_policy()
    primed = TransformedEnv(stub_env(seed=2), get_primers_from_module(policy))
    stock = Collector(
        primed,
        policy,
        frames_per_batch=N * T,
        total_frames=4 * N * T,
        auto_register_policy_transforms=False,
    )
    ours = ArcadeCollector(stub_env(seed=2), policy, N * T, 4 * N * T)
    one, two = torch.cat(list(stock), 1), torch.cat(list(ours), 1)
    assert one["next", "done"].sum() > 10
    assert_same(two, one)


def test_a_collected_window_replays_in_recurrent_mode() -> None:
    policy = recurrent_policy()
    collector = ArcadeCollector(stub_env(seed=2), policy, N * T, 3 * N * T)
    for batch in collector:
        again = batch.select("pixels", "is_init", "recurrent_state").clone()
        with torch.no_grad(), set_recurrent_mode(True):
            policy(again)
        torch.testing.assert_close(again["action_value"], batch["action_value"])
    assert batch["recurrent_state"][:, 0].abs().sum() > 0


def test_large_states_can_be_left_out_of_the_storage() -> None:
    collector = ArcadeCollector(stub_env(), recurrent_policy(), N * T, store_states=False)
    for _ in range(2):
        batch = collector.collect()
    assert "recurrent_state" not in batch and ("next", "recurrent_state") not in batch.keys(True)
    assert batch["initial_state", "recurrent_state"].shape == (N, 1, 8)


def test_a_module_without_its_primer_is_explained() -> None:
    module = TensorDictModule(lambda memory: memory, ["memory"], [("next", "memory")])
    with pytest.raises(
        KeyError, match=r"the policy reads 'memory' and writes it .* make_tensordict_primer"
    ):
        ArcadeCollector(stub_env(), module, N * T).collect()


def critic_of(policy: TensorDictSequential, memory: nn.Module) -> TensorDictSequential:
    """A critic that reads the features of a policy with a memory."""
    return TensorDictSequential(policy[0], memory, ValueOperator(nn.Linear(8, 1), ["hidden"]))


@pytest.mark.parametrize("kind", ["gru of torchrl", "memory module"])
def test_two_memories_under_one_key_are_refused(kind: str) -> None:
    """As actor and critic have by default. Before: each read the state that the other had written,
    in silence.
    """
    policy = recurrent_policy()
    if kind == "memory module":
        one, other = (MemoryModule(make_memory("gru", 8, 8), "features", "hidden") for _ in "12")
        policy = TensorDictSequential(policy[0], one, *policy[2:])
    else:
        one, other = policy[1], recurrent_policy()[1]
    key = repr(one.in_keys[1])
    with pytest.raises(ValueError, match=rf"^state_key must be another .* under {re.escape(key)}"):
        ArcadeCollector(stub_env(), TensorDictSequential(critic_of(policy, other), policy), N * T)
    for same in (one, torch.compile(one), copy.copy(one)):  # one memory, and its state is one
        both = TensorDictSequential(critic_of(policy, same), policy)
        ArcadeCollector(stub_env(), both, N * T)


def test_a_resumed_recurrent_policy_goes_on_to_the_bit(tmp_path: Any) -> None:
    one = ArcadeCollector(stub_env(seed=2), recurrent_policy(), N * T, 4 * N * T)
    batches = iter(one)
    next(batches), next(batches)
    torch.save(one.state_dict(), tmp_path / "collector.pt")
    other_policy = recurrent_policy()
    nn.init.zeros_(other_policy[2].module.weight)
    two = ArcadeCollector(stub_env(seed=5), other_policy, N * T, 4 * N * T)
    two.load_state_dict(torch.load(tmp_path / "collector.pt", weights_only=True))
    for ours, theirs in zip(two, batches, strict=True):
        assert_same(ours, theirs)


def test_weights_are_live_and_others_can_be_copied_in() -> None:
    policy, other = recurrent_policy(), recurrent_policy()
    collector = ArcadeCollector(stub_env(), policy, N * T)
    collector.update_policy_weights_()
    collector.update_policy_weights_(policy)
    nn.init.ones_(other[2].module.weight)
    collector.update_policy_weights_(other)
    assert (policy[2].module.weight == 1).all()


def two_towers(first: str) -> tuple[TensorDictSequential, ProbabilisticActor, ClipPPOLoss]:
    """A policy of an actor and a critic whose first layers look alike, and their loss."""
    trunk = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 8), nn.Tanh())
    critic = TensorDictSequential(
        TensorDictModule(nn.Sequential(_Float(), copy.deepcopy(trunk)), ["pixels"], ["seen"]),
        ValueOperator(nn.Linear(8, 1), in_keys=["seen"]),
    )
    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(nn.Sequential(_Float(), trunk), ["pixels"], ["features"]),
            TensorDictModule(nn.Linear(8, 5), ["features"], ["logits"]),
        ),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    for weight in critic.parameters():
        nn.init.normal_(weight)
    towers = (critic, actor) if first == "critic" else (actor, critic)
    return TensorDictSequential(*towers), actor, ClipPPOLoss(actor, critic)


@pytest.mark.parametrize("first", ["critic", "actor"])
def test_a_trainer_hands_over_a_part_of_the_policy_that_already_acts(first: str) -> None:
    policy, actor, loss = two_towers(first)
    before = copy.deepcopy(policy.state_dict())
    collector = ArcadeCollector(stub_env(), policy, N * T)
    # what TorchRL's trainers of PPO, A2C and REINFORCE do behind every window
    collector.update_policy_weights_(TensorDict.from_module(loss.actor_network))
    collector.update_policy_weights_(actor)
    for name, weight in policy.state_dict().items():
        assert torch.equal(weight, before[name]), name


@pytest.mark.parametrize("first", ["critic", "actor"])
def test_weights_that_are_none_of_the_policy_change_nothing(first: str) -> None:
    policy = two_towers(first)[0]
    before = copy.deepcopy(policy.state_dict())
    collector = ArcadeCollector(stub_env(), policy, N * T)
    with pytest.raises(ValueError, match=r"^the weights have module\..* of the whole policy"):
        collector.update_policy_weights_(two_towers(first)[1])
    for name, weight in policy.state_dict().items():
        assert torch.equal(weight, before[name]), name


def test_transforms_work_on_the_stock_path() -> None:
    env = TransformedEnv(stub_env(seed=1), StepCounter(max_steps=3))
    env.append_transform(ToTensorImage(in_keys=["pixels"]))
    data = env.rollout(30, break_when_any_done=False)
    assert data["pixels"].shape == (N, 30, 3, 8, 8) and data["pixels"].dtype is torch.float32
    assert data["next", "step_count"].max() == 3
    assert (
        data["next", "truncated"].any()
        and (data["is_init"].squeeze(-1)[:, 1:] == data["next", "done"][:, :-1, 0]).all()
    )


def test_batches_go_into_a_memory_mapped_replay_buffer(tmp_path: Any) -> None:
    buffer = ReplayBuffer(storage=LazyMemmapStorage(2 * N, scratch_dir=tmp_path), batch_size=2)
    for batch in ArcadeCollector(stub_env(), None, N * T, 2 * N * T):
        buffer.extend(batch)
        expected = batch.clone()
    assert len(buffer) == 2 * N
    assert_same(buffer[N:], expected)


@pytest.mark.parametrize("step", ["step", "step_and_maybe_reset"])
def test_a_step_can_be_packed_as_a_parallel_env_without_buffers_does(step: str) -> None:
    env = stub_env()
    given = getattr(env, step)(env.rand_action(env.reset()))
    td = given if step == "step" else given[0]
    assert_same(td.consolidate(), td.clone())


def test_a_batch_can_be_packed_and_seen_as_one_row_of_steps() -> None:
    batch = next(iter(ArcadeCollector(stub_env(), recurrent_policy(), N * T)))
    assert_same(batch.consolidate(), batch.clone())
    assert_same(batch.view(-1), batch.reshape(-1))


def make_ppo(policy_net: nn.Module) -> tuple[ProbabilisticActor, ValueOperator, ClipPPOLoss]:
    body = TensorDictSequential(encoder(), TensorDictModule(policy_net, ["features"], ["logits"]))
    actor = ProbabilisticActor(
        body,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic_net = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 1))
    critic = ValueOperator(nn.Sequential(_Float(), critic_net), in_keys=["pixels"])
    return actor, critic, ClipPPOLoss(actor, critic)


class _Float(nn.Module):
    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return pixels.float() / 255


@pytest.mark.filterwarnings("ignore")
def test_torchrls_ppo_trainer_takes_the_collector() -> None:
    from torchrl.trainers.algorithms import PPOTrainer

    net = nn.Linear(8, 5)
    actor, critic, loss = make_ppo(net)
    collector = ArcadeCollector(stub_env(), actor, N * T, 3 * N * T)
    before = copy.deepcopy(net.state_dict())
    trainer = PPOTrainer(
        collector=collector,
        total_frames=3 * N * T,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        progress_bar=False,
        seed=0,
        num_epochs=1,
        gae=GAE(gamma=0.99, lmbda=0.95, value_network=critic),
    )
    trainer.train()
    assert trainer.collected_frames == 3 * N * T
    assert collector.closed
    assert not torch.equal(net.weight, before["weight"])
