"""Before the first update, what a memory replays is what it acted, by every path from collector to
loss.

The difference in log-probability is the one number that finds experience and memory out of step:
rows that leak into each other, starts that are not marked, states that were not stored. Nothing
else does, training goes on in silence.
"""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import TransformedEnv
from torchrl.modules import (
    ActorValueOperator,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from arcade_torch.agents import PPOLoss, PQNLoss, make_actor, make_policy
from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.models import (
    ActorCriticNetwork,
    MemoryModule,
    MemoryNetwork,
    make_memory,
    memory_names,
)
from tests.agents.fakes import Stream, lambda_return, look_into, play
from tests.arcade_torch.stub import GAME
from tests.few import few_memories

N, T, WINDOWS, SLICE = 6, 16, 2, 4
CLOSE = {"rtol": 0.0, "atol": 1e-5}
Recipe = Callable[[TensorDictSequential], "Collector | ArcadeCollector"]


def make_agent(name: str) -> ActorValueOperator:
    torch.manual_seed(1)
    layers = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 8), nn.Tanh())
    encoder = TensorDictModule(
        lambda pixels: layers(pixels.float() / 255), ["pixels"], ["features"]
    )
    encoder.layers = layers
    memory = MemoryModule(make_memory(name, 8, 8), "features", "remembered", store="step")
    policy = ProbabilisticActor(
        TensorDictModule(nn.Linear(8, 5), ["remembered"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    value = ValueOperator(nn.Linear(8, 1), in_keys=["remembered"])
    return ActorValueOperator(TensorDictSequential(encoder, memory), policy, value)


def ours(policy: TensorDictSequential) -> ArcadeCollector:
    return ArcadeCollector(ArcadeEnv(GAME, N, seed=2), policy, N * T, WINDOWS * N * T)


def theirs(policy: TensorDictSequential) -> Collector:
    primer = get_primers_from_module(policy, warn=False)
    env = ArcadeEnv(GAME, N, seed=2)
    primed = env if primer is None else TransformedEnv(env, primer)
    return Collector(primed, policy, frames_per_batch=N * T, total_frames=WINDOWS * N * T)


def state_keys(module: nn.Module) -> list[tuple[str, ...]]:
    (memory,) = (part for part in module.modules() if isinstance(part, MemoryModule))
    return list(memory.state_keys)


def log_ratio(policy: TensorDictSequential, batch: TensorDictBase) -> float:
    """Largest difference between replayed and recorded log-probabilities."""
    with torch.no_grad(), set_recurrent_mode(True):
        again = policy.get_dist(batch.select(*policy.in_keys)).log_prob(batch["action"])
    return float((again - batch["action_log_prob"]).abs().max())


def slices(
    sampler: SliceSamplerWithoutReplacement | SamplerWithoutReplacement,
) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(N * T), sampler=sampler, batch_size=6 * SLICE
    )


def slice_sampler() -> SliceSamplerWithoutReplacement:
    return SliceSamplerWithoutReplacement(
        slice_len=SLICE, traj_key=("collector", "traj_ids"), strict_length=False
    )


@pytest.fixture(params=memory_names())
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("recipe", [ours, theirs], ids=["ArcadeCollector", "Collector"])
def test_a_collected_window_replays_and_so_do_slices_of_it(name: str, recipe: Recipe) -> None:
    policy = make_agent(name).get_policy_operator()
    collector, carried, cut = recipe(policy), False, 0
    states = state_keys(policy)
    for batch in collector:
        assert batch["is_init"][:, 1:].any()
        assert log_ratio(policy, batch) < CLOSE["atol"]
        carried |= any(bool((batch[key][:, 0] != 0).any()) for key in states)
        buffer = slices(slice_sampler())
        buffer.extend(batch.reshape(-1))
        for minibatch in buffer:
            assert log_ratio(policy, minibatch) < CLOSE["atol"]
            starts = minibatch["is_init"].flatten()
            cut += sum(int((minibatch[key][starts] != 0).any()) for key in states)
    collector.shutdown()
    assert name == "mlp" or (carried and cut > 0)


@pytest.mark.parametrize("name", few_memories(memory_names()))
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("sampler", ["slices", "steps"])
@pytest.mark.parametrize("checks", [True, False])
def test_torchrls_ppo_trainer_replays_slices_and_not_shuffled_steps(
    name: str, sampler: str, checks: bool
) -> None:
    agent = make_agent(name)
    for module in agent.modules():
        if isinstance(module, MemoryModule):
            module.recurrence.checks.enabled = checks
    policy, critic = agent.get_policy_operator(), agent.get_value_operator()
    loss = ClipPPOLoss(policy, critic)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic)

    def advantages(batch: TensorDictBase) -> TensorDictBase:
        with set_recurrent_mode(True):
            return gae(batch.exclude("state_value", ("next", "state_value")))

    trainer = PPOTrainer(
        collector=ours(policy),
        total_frames=WINDOWS * N * T,
        frame_skip=1,
        optim_steps_per_batch=None,
        num_epochs=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        gae=advantages,
        replay_buffer=slices(
            slice_sampler() if sampler == "slices" else SamplerWithoutReplacement()
        ),
        progress_bar=False,
        seed=0,
    )
    first: dict[int, float] = {}  # of every window, by the frames behind it

    def check(batch: TensorDictBase) -> TensorDictBase:
        if trainer.collected_frames not in first:
            first[trainer.collected_frames] = log_ratio(loss.actor_network, batch)
        return batch

    before = [p.detach().clone() for p in loss.parameters()]
    trainer.register_op("process_optim_batch", check)
    if checks and sampler == "steps" and name != "mlp":
        with pytest.raises(ValueError, match=r"where is_init is false: .*SliceSampler"):
            trainer.train()
        return
    trainer.train()
    assert list(first) == [N * T * window for window in range(1, WINDOWS + 1)]
    assert any(not torch.equal(p, old) for p, old in zip(loss.parameters(), before, strict=True))
    if sampler == "slices" or name == "mlp":
        assert max(first.values()) < CLOSE["atol"]
    else:  # the trap itself, unnoticed: no error, no warning, another policy
        assert min(first.values()) > 100 * CLOSE["atol"]


def test_gae_in_recurrent_mode_gives_the_values_that_were_acted(name: str) -> None:
    agent = make_agent(name)
    critic = agent.get_value_operator()
    collector = ours(agent)
    for batch in collector:
        acted = batch["state_value"].clone()
        with torch.no_grad():  # the oracle: one more step from each stored state
            following = batch["next"].select("pixels", *state_keys(critic))
            following["is_init"] = torch.zeros_like(batch["is_init"])
            next_value = critic(following)["state_value"]
        live, going_on = ~batch["next", "terminated"], ~batch["next", "done"]
        expected, advantage = torch.empty_like(acted), torch.zeros(N, 1)
        for t in reversed(range(T)):
            delta = (
                batch["next", "reward"][:, t] + 0.9 * next_value[:, t] * live[:, t] - acted[:, t]
            )
            expected[:, t] = advantage = delta + 0.9 * 0.8 * advantage * going_on[:, t]
        gae = GAE(gamma=0.9, lmbda=0.8, value_network=critic)
        with set_recurrent_mode(True):
            found = gae(batch.exclude("state_value", ("next", "state_value")))
        torch.testing.assert_close(found["state_value"], acted, **CLOSE)
        torch.testing.assert_close(found["advantage"], expected, **CLOSE)
    collector.shutdown()


# -- our networks and losses -----------------------------------------------------------------------


class Frames(nn.Module):
    """An encoder of the stub's frames."""

    obs_size, feature_size, amp = 8, 8, False

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(-3), nn.Linear(192, 8), nn.Tanh())

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.layers(pixels.float() / 255)
        return out


OVERLAP, Q, LOGITS = 4, ("action_value", "memory"), ("logits", ("memory", "actor"))


@pytest.mark.parametrize("outside", [True, None])
def test_a_collector_acts_step_by_step_whatever_the_mode_of_the_memory_is(outside: bool) -> None:
    """Before: a memory that reads sequences by default read a step of all envs as one."""
    policy = make_agent("lru").get_policy_operator()
    (memory,) = (part for part in policy.modules() if isinstance(part, MemoryModule))
    collected = []
    for by_default in (False, True):
        memory.recurrence.default_recurrent_mode = by_default
        torch.manual_seed(0)
        with set_recurrent_mode(outside if by_default else None):
            collected.append(ours(policy).collect()["action_log_prob"])
    assert torch.equal(*collected)


def make_memory_network(
    name: str, outputs: int, key: str, state: str | tuple[str, ...]
) -> MemoryNetwork:
    head = nn.Linear(8, outputs)
    return MemoryNetwork(Frames(), make_memory(name, 13, 8), head, out_key=key, state_key=state)  # type: ignore[arg-type]


def window(policy: TensorDictSequential, path: str) -> TensorDictBase:
    """The last of some windows, in mid-episode; all four paths from the env to the loss."""
    torch.manual_seed(2)
    env = ArcadeEnv(GAME, N, seed=2)
    if path == "Collector":
        primer = get_primers_from_module(policy, warn=False)
        primed = env if primer is None else TransformedEnv(env, primer)
        *_, batch = Collector(primed, policy, frames_per_batch=N * T, total_frames=WINDOWS * N * T)
        return batch
    if path == "iterated":
        *_, batch = ArcadeCollector(env, policy, N * T, WINDOWS * N * T)
        return batch
    collector = ArcadeCollector(env, policy, N * T, overlap=OVERLAP, final_frames=path)  # type: ignore[arg-type]
    for _ in range(WINDOWS):
        batch = collector.collect()
    return batch


paths = pytest.mark.parametrize("path", ["truncated", "all", "iterated", "Collector"])


@pytest.mark.parametrize("name", few_memories(memory_names()))
@paths
def test_the_loss_reads_the_q_values_that_were_acted_and_those_of_the_true_next_frames(
    name: str, path: str
) -> None:
    torch.manual_seed(1)
    network = make_memory_network(name, 5, *Q)
    policy = make_policy(network, epsilon=0.5)
    batch = window(policy, path)
    done = batch["next", "done"].squeeze(-1)
    assert (
        done[:, :-1].any() and not done[:, :-1].any(0).all() and batch["action_value"].std() > 1e-3
    )
    loss = PQNLoss(network)
    q, target, after = look_into(loss, batch)
    torch.testing.assert_close(q, batch["action_value"].detach(), **CLOSE)
    dense = (
        batch["next", "pixels"] if path != "truncated" else window(policy, "all")["next", "pixels"]
    )
    first = batch.get("initial_state", None)
    if first is None:
        stored = [(key, batch[key][:, 0]) for key in network.state_keys]
    else:
        stored = [(key, first[key]) for key in network.state_keys]
    state = TensorDict({}, [N])
    for key, value in stored:
        state[key] = value
    fields = {key: batch[key] for key in ("pixels", "action", "last_action")}
    flags = {key: batch["next", key].squeeze(-1) for key in ("reward", "terminated", "truncated")}
    s = Stream(**fields, **flags, is_init=batch["is_init"].squeeze(-1), final=dense, state=state)
    wanted = play(network, s)[1].amax(-1)  # one step of one row at a time
    kept = ~s.terminated
    torch.testing.assert_close(after[kept], wanted[kept], **CLOSE)
    expected = lambda_return(s.reward, wanted, s.terminated, s.truncated, 0.99, 0.95)
    torch.testing.assert_close(target, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", few_memories(memory_names()))
@paths
def test_the_loss_of_ppo_reads_the_policy_and_the_values_that_were_acted(
    name: str, path: str
) -> None:
    torch.manual_seed(1)
    critic = make_memory_network(name, 1, "state_value", ("memory", "critic"))
    network = ActorCriticNetwork(make_memory_network(name, 5, *LOGITS), critic)
    batch = window(make_policy(network), path)
    acted = batch["state_value"].detach().clone()
    loss = PPOLoss(make_actor(network.actor), network.critic)
    batch = loss.value_estimator(batch.exclude("state_value"))
    out = loss(batch)
    assert out["clip_fraction"] == 0 and float(out["kl_approx"]) < 1e-8 and acted.std() > 1e-3
    torch.testing.assert_close(batch["state_value"], acted, **CLOSE)
