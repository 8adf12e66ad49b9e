"""Our losses and returns are TorchRL's, on the same recurrent batch, values and gradients."""

import copy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import LSTMModule, QValueActor, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss, HardUpdate, LossModule, SoftUpdate, ValueEstimators
from torchrl.objectives import DQNLoss as TorchRLDQNLoss
from torchrl.objectives.value import GAE, TDLambdaEstimator
from torchrl.objectives.value.functional import (
    vec_generalized_advantage_estimate,
    vec_td_lambda_return_estimate,
)

from arcade_torch.agents import gae, q_lambda_return
from arcade_torch.agents.dqn import DQNLoss
from arcade_torch.agents.policy import make_actor
from arcade_torch.agents.ppo import PPOLoss
from arcade_torch.agents.pqn import PQNLoss
from tests.contracts.pomdp import ENVS, HIDDEN, STEPS, Eye, collected, explorer, network

GAMMA, LAM = 0.9, 0.7
CLOSE = {"rtol": 1e-5, "atol": 1e-5}
MEMORIES = ("lru", "gru", "mlp")


def gradients(loss: LossModule, value: torch.Tensor) -> dict[str, torch.Tensor]:
    """Gradients of a scalar, by the name of the parameter."""
    named = dict(loss.named_parameters())
    found = torch.autograd.grad(value, list(named.values()), allow_unused=True)
    return {name: grad for name, grad in zip(named, found, strict=True) if grad is not None}


def assert_same_gradients(
    ours: dict[str, torch.Tensor], theirs: dict[str, torch.Tensor], factor: float = 1.0
) -> None:
    assert set(ours) == set(theirs) and any("block" in name or "weight_hh" in name for name in ours)
    for name, grad in ours.items():
        torch.testing.assert_close(
            grad, factor * theirs[name], **CLOSE, msg=lambda text, name=name: f"{name}: {text}"
        )


def for_torchrl(batch: TensorDictBase) -> TensorDictBase:
    """A batch from which TorchRL's ``DQNLoss`` reads the right next values.

    It evaluates ("next", ...) as sequences of their own. The batch therefore has to hold the
    recurrent state *after* every step, as a collector stores it; and a next observation has to
    begin with it wherever the root observation began an episode, or else the memory runs on from
    the final observation of one episode into the next. TorchRL's ``GAE`` marks these places itself,
    its TD estimators do not. (Recurrent mode is switched on by losses.)
    """
    batch = batch.clone()
    batch["next", "is_init"] = batch["is_init"]
    return batch


def without_gradient(loss: TorchRLDQNLoss) -> None:
    """Keep the gradient out of TorchRL's targets.

    The loss first runs the network over the root observations, which writes its states under
    "next", and these lead a gradient into the next values: the parameters are detached there, the
    states are not.
    """
    loss.value_estimator.value_estimate = torch.no_grad()(loss.value_estimator.value_estimate)


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_pqn_loss_is_half_of_torchrls_dqn_loss_with_td_lambda(memory: str) -> None:
    torch.manual_seed(1)
    greedy, policy = explorer(memory)
    batch = collected(policy)  # asserts a termination and a truncation inside
    ours = PQNLoss(copy.deepcopy(greedy))
    ours.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    theirs = TorchRLDQNLoss(
        greedy, delay_value=False, loss_function="l2", action_space="categorical"
    )
    theirs.make_value_estimator(ValueEstimators.TDLambda, gamma=GAMMA, lmbda=LAM)
    without_gradient(theirs)
    one, two = ours(batch)["loss"], theirs(for_torchrl(batch))["loss"]
    torch.testing.assert_close(one, 0.5 * two, **CLOSE)
    assert_same_gradients(gradients(ours, one), gradients(theirs, two), 0.5)
    if memory != "mlp":  # what the mark is for
        assert abs(float((theirs(batch)["loss"] - two).detach())) > 1e-4


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_dqn_loss_with_targets_is_half_of_torchrls(memory: str) -> None:
    """Right after an update of the targets: later, TorchRL's target network reads states that the
    online one wrote.
    """
    torch.manual_seed(1)
    greedy, policy = explorer(memory)
    batch = collected(policy)
    ours = DQNLoss(copy.deepcopy(greedy), delay_value=True)
    theirs = TorchRLDQNLoss(
        greedy, delay_value=True, loss_function="l2", action_space="categorical"
    )
    ours.make_value_estimator(gamma=GAMMA, lmbda=0.0)
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    without_gradient(theirs)
    one, two = ours(batch)["loss"], theirs(for_torchrl(batch))["loss"]
    torch.testing.assert_close(one, 0.5 * two, **CLOSE)
    assert_same_gradients(gradients(ours, one), gradients(theirs, two), 0.5)


class PopulationNormalised(ClipPPOLoss):
    """TorchRL's loss, with advantages normalised by the population deviation."""

    def _standardize_advantage(
        self, advantage: torch.Tensor, tensordict: TensorDictBase
    ) -> torch.Tensor:
        return (advantage - advantage.mean()) / advantage.std(unbiased=False)


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_ppo_loss_is_torchrls_clipped_loss_with_its_gae(memory: str) -> None:
    torch.manual_seed(1)
    actor = make_actor(network(memory, "logits", "actor"))
    critic = network(memory, "state_value", "critic")
    batch = collected(TensorDictSequential(critic, actor)).exclude(
        "state_value", ("next", "state_value")
    )
    ours = PPOLoss(
        copy.deepcopy(actor), copy.deepcopy(critic), critic_coeff=0.5, entropy_coeff=0.01
    )
    ours.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    theirs = PopulationNormalised(
        actor,
        critic,
        normalize_advantage=True,
        loss_critic_type="l2",
        clip_value=True,
        critic_coeff=0.25,  # ours is half the squared error
        entropy_coeff=0.01,
    )
    with set_recurrent_mode(True):
        estimated = GAE(gamma=GAMMA, lmbda=LAM, value_network=critic)(batch.clone())
    with torch.no_grad():
        present = ours.value_estimator(batch.clone())
    for key in ("advantage", "value_target", "state_value"):
        torch.testing.assert_close(present[key], estimated[key], **CLOSE)
    with torch.no_grad():  # away from ratio 1, so that clipping matters
        for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
            move = 0.1 * torch.randn_like(a)
            a.add_(move), b.add_(move)
    one, two = ours(present), theirs(estimated)
    assert float(one["clip_fraction"]) > 0
    names = ["loss_objective", "loss_critic", "loss_entropy"]
    for name in names:
        torch.testing.assert_close(one[name], two[name], **CLOSE)
    total = [sum(out[name] for name in names) for out in (one, two)]
    assert_same_gradients(gradients(ours, total[0]), gradients(theirs, total[1]))  # type: ignore[arg-type]


@given(
    seed=st.integers(0, 10**6),
    rows=st.integers(1, 4),
    steps=st.integers(
        2, 20
    ),  # TorchRL's vectorised functions fail on one step, and where gamma * lambda is nearly 0
    gamma=st.floats(0.1, 1),
    lam=st.floats(0.1, 1),
    ends=st.floats(0, 1),
)
def test_returns_and_advantages_are_torchrls(
    seed: int, rows: int, steps: int, gamma: float, lam: float, ends: float
) -> None:
    g = torch.Generator().manual_seed(seed)
    reward, value, after = (
        torch.randn(rows, steps, generator=g, dtype=torch.float64) for _ in range(3)
    )
    terminated, truncated = (torch.rand(rows, steps, generator=g) < ends / 2 for _ in range(2))
    column = [x.unsqueeze(-1) for x in (after, reward, terminated | truncated, terminated)]
    returns = vec_td_lambda_return_estimate(
        gamma, lam, column[0], column[1], done=column[2], terminated=column[3]
    )
    found = q_lambda_return(reward, after, terminated, truncated, gamma, lam)
    torch.testing.assert_close(found, returns.squeeze(-1).to(found.dtype), **CLOSE)
    advantage, target = vec_generalized_advantage_estimate(
        gamma, lam, value.unsqueeze(-1), column[0], column[1], done=column[2], terminated=column[3]
    )
    found = gae(reward, value, after, terminated, truncated, gamma, lam)
    torch.testing.assert_close(found, advantage.squeeze(-1).to(found.dtype), **CLOSE)
    torch.testing.assert_close(found + value, target.squeeze(-1).to(found.dtype), **CLOSE)


@pytest.fixture(params=[PQNLoss, DQNLoss])
def make(request: pytest.FixtureRequest) -> type[PQNLoss]:
    return request.param  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def gru() -> tuple[nn.Module, TensorDictBase]:
    """A network with a GRU, and a batch that it collected."""
    torch.manual_seed(1)
    greedy, policy = explorer("gru")
    return greedy, collected(policy)


def test_a_loss_takes_tensors_by_name_and_in_the_order_of_its_in_keys(make, gru):
    greedy, batch = gru
    loss = make(greedy)
    expected = loss(batch)
    named = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys}
    for value, key in zip(loss(**named), loss.out_keys, strict=True):
        torch.testing.assert_close(value, expected[key])
    loss.in_keys = list(reversed(loss.in_keys))
    for value, key in zip(loss(*[batch[key] for key in loss.in_keys]), loss.out_keys, strict=True):
        torch.testing.assert_close(value, expected[key])


def test_reductions_and_kinds_of_actions_agree(make, gru):
    greedy, batch = gru
    mean, total, every = (
        make(greedy, reduction=reduction)(batch)["loss"] for reduction in ("mean", "sum", "none")
    )
    assert every.shape == (ENVS, STEPS)
    torch.testing.assert_close(every.mean(), mean)
    torch.testing.assert_close(every.sum(), total)
    one_hot = batch.clone()
    one_hot["action"] = nn.functional.one_hot(batch["action"], 5)
    torch.testing.assert_close(make(greedy)(one_hot)["loss"], mean)


@pytest.mark.parametrize(
    "key", ["pixels", "action", "is_init", ("next", "reward"), ("next", "pixels")]
)
def test_a_missing_entry_is_named_in_one_line(make, gru, key):
    greedy, batch = gru
    with pytest.raises(KeyError) as caught:
        make(greedy)(batch.exclude(key))
    text = str(caught.value)
    assert "\n" not in text and all(
        part in text for part in ([key] if isinstance(key, str) else key)
    )


def test_entries_can_have_other_names(make, gru):
    greedy, batch = gru
    expected = make(greedy)(batch)["loss"]
    names = {"reward": "payoff", "terminated": "over", "truncated": "cut", "action": "move"}
    other, loss = batch.clone(), make(greedy)
    for old, new in names.items():
        other.rename_key_("action", new) if old == "action" else other.rename_key_(
            ("next", old), ("next", new)
        )
    loss.set_keys(**names)
    torch.testing.assert_close(loss(other)["loss"], expected)
    assert "move" in loss.in_keys and ("next", "payoff") in loss.in_keys


def test_targets_come_from_any_estimator(make, gru):
    greedy, batch = gru
    found = {}
    for kind, options in (("TD0", {}), ("TD1", {}), ("TDLambda", {"lmbda": LAM})):
        loss = make(greedy)
        loss.make_value_estimator(getattr(ValueEstimators, kind), gamma=GAMMA, **options)
        found[kind] = loss(batch)["loss"]
    for kind, lam in (("TD0", 0.0), ("TD1", 1.0), ("TDLambda", LAM)):
        loss = make(greedy)
        loss.make_value_estimator(gamma=GAMMA, lmbda=lam)
        torch.testing.assert_close(loss(batch)["loss"], found[kind])
    loss.make_value_estimator(TDLambdaEstimator(gamma=GAMMA, lmbda=LAM, value_network=None))
    torch.testing.assert_close(loss(batch)["loss"], found["TDLambda"])
    with pytest.raises((NotImplementedError, KeyError, TypeError)):
        loss.make_value_estimator(ValueEstimators.GAE)


@pytest.mark.parametrize(
    "updater",
    [
        lambda loss: SoftUpdate(loss, eps=0.5),
        lambda loss: HardUpdate(loss, value_network_update_interval=1),
    ],
    ids=["soft", "hard"],
)
def test_updaters_move_the_targets(make, gru, updater):
    greedy, batch = gru
    loss = make(copy.deepcopy(greedy), delay_value=True)
    updates = updater(loss)
    before = loss(batch)["target_mean"]
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(0.5)
    torch.testing.assert_close(loss(batch)["target_mean"], before)  # the targets still
    for _ in range(2):  # HardUpdate counts first
        updates.step()
    assert abs(float(loss(batch)["target_mean"] - before)) > 0.01


def test_a_stock_value_actor_with_an_lstm_learns(make):
    torch.manual_seed(1)
    states = ["h", "c"]
    body = TensorDictSequential(
        TensorDictModule(Eye(), ["pixels"], ["features"]),
        LSTMModule(
            8,
            HIDDEN,
            in_keys=["features", *states],
            out_keys=["remembered", *(("next", state) for state in states)],
        ),
        TensorDictModule(nn.Linear(HIDDEN, 5), ["remembered"], ["action_value"]),
    )
    actor = QValueActor(body, in_keys=body.in_keys, action_space="categorical")
    batch = collected(actor)
    loss = make(actor, delay_value=make is DQNLoss)
    value = loss(batch)["loss"]
    grads = gradients(loss, value)
    assert all(float(grad.abs().sum()) > 0 for name, grad in grads.items() if "weight_hh" in name)
    with torch.no_grad():  # the oracle: one more step from each stored state
        following = batch["next"].select("pixels", *states)
        following["is_init"] = torch.zeros_like(batch["is_init"])
        next_value = actor(following)["action_value"].amax(-1)
    outcome = (batch["next", key].squeeze(-1) for key in ("reward", "terminated", "truncated"))
    reward, terminated, truncated = outcome
    target = q_lambda_return(reward, next_value, terminated, truncated, GAMMA, LAM)
    loss = make(actor)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    expected = 0.5 * (batch["chosen_action_value"].squeeze(-1) - target).square().mean()
    torch.testing.assert_close(loss(batch)["loss"].detach(), expected.detach(), **CLOSE)


@pytest.mark.parametrize("memory", ["gru", "lru", "mlp"])
def test_a_loss_takes_flat_slices_and_starts_anew_where_they_were_cut(make, memory):
    torch.manual_seed(1)
    greedy, policy = explorer(memory)
    batch = collected(policy)
    sampler = SliceSampler(slice_len=4, traj_key=("collector", "traj_ids"), strict_length=False)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(ENVS * STEPS), sampler=sampler, batch_size=32
    )
    buffer.extend(batch.reshape(-1))
    flat = buffer.sample()
    starts = flat["is_init"].flatten().nonzero().flatten().tolist()
    assert flat.ndim == 1 and len(starts) > 4
    loss = make(greedy, reduction="none")
    whole = loss(flat)["loss"].flatten()
    apart = [
        loss(flat[a:b])["loss"].flatten()
        for a, b in zip(starts, [*starts[1:], len(flat)], strict=True)
    ]
    torch.testing.assert_close(whole, torch.cat(apart), **CLOSE)
