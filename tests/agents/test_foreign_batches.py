"""Batches of other people's pipelines give our losses the numbers of ours, or one line: other
shapes, dtypes and names of the entries, gradients left on what was stored, padding, copies.
"""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import PopArtValueNorm

from arcade_torch.agents import DQNLoss, PPOLoss, PQNLoss, make_actor
from arcade_torch.models import MemoryModule, make_memory
from tests.agents.fakes import (
    ACTIONS,
    GAMMA,
    LAM,
    WIDTH,
    stream,
    toy_actor_critic,
    toy_network,
    with_two_states,
)
from tests.agents.test_torchrl_batches import numbered

PARTS = ("loss_objective", "loss_critic", "loss_entropy")
NEXTS = ("reward", "terminated", "truncated", "done")
ENTRIES = ("action", "action_log_prob", "is_init", *[("next", name) for name in NEXTS])


def q_loss():
    loss = PQNLoss(toy_network(state_key=("memory", "actor")))
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return loss


def ppo_loss(**options):
    network = toy_actor_critic()
    loss = PPOLoss(make_actor(network.actor), network.critic, **options)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return loss


def ppo_batch(rows=4, steps=4, **options):
    """As many rows as steps: what is spread over the batch then fits, and nobody complains."""
    batch = numbered(with_two_states(stream(rows, steps, seed=5, **options)))
    log_prob = -1.6 + 0.2 * torch.randn(rows, steps, generator=torch.Generator().manual_seed(0))
    return batch.set("action_log_prob", log_prob)


def parts(out):
    return torch.stack([out[key].detach().double() for key in PARTS if key in out])


def total(out):
    return sum(part for name, part in out.items() if name.startswith("loss"))


def value(loss, batch):
    out = loss(batch)
    return parts(out) if "loss_objective" in out else out["loss"].detach().double()


LOSSES = pytest.mark.parametrize("make", [q_loss, ppo_loss])


def changed(key, change):
    batch = ppo_batch()
    return batch.set(key, change(batch[key]))


@LOSSES
def test_an_entry_may_have_a_last_dimension_of_one_or_none(make):
    loss = make()
    expected = value(loss, ppo_batch())
    for key in ENTRIES:
        has_one = ppo_batch()[key].ndim == 3
        other = changed(key, lambda x, has=has_one: x.squeeze(-1) if has else x.unsqueeze(-1))
        assert torch.equal(value(loss, other), expected), key


@LOSSES
def test_a_flat_sequence_may_have_them_too(make):
    row = ppo_batch()[0]
    expected = value(make(), row.clone())
    for key in ("action", "action_log_prob"):
        row[key] = row[key].unsqueeze(-1)
    assert torch.equal(value(make(), row), expected)


@LOSSES
def test_start_flags_of_sequences_may_have_no_last_dimension_of_one(make):
    batch = with_two_states(stream(4, 6, seed=5)).sequences()
    batch["action_log_prob"] = torch.full((4, 6), -1.6)
    expected = value(make(), batch.clone())
    assert batch["is_init"].shape == (4, 6, 1)
    batch["is_init"] = batch["is_init"].squeeze(-1)
    assert torch.equal(value(make(), batch), expected)


@LOSSES
@pytest.mark.parametrize("dtype", [torch.int32, torch.uint8, torch.float32])
def test_numbers_of_actions_may_be_of_any_dtype(make, dtype):
    other = changed("action", lambda x: x.to(dtype))
    assert torch.equal(value(make(), other), value(make(), ppo_batch()))


@LOSSES
def test_flags_may_be_bytes(make):
    other = ppo_batch()
    for key in ("is_init", *[("next", name) for name in NEXTS[1:]]):
        other[key] = other[key].to(torch.uint8)
    assert torch.equal(value(make(), other), value(make(), ppo_batch()))


@LOSSES
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_returns_of_rewards_in_half_precision_are_those_of_the_same_rewards_in_single(make, dtype):
    half = changed(("next", "reward"), lambda x: x.to(dtype))
    full = changed(("next", "reward"), lambda x: x.to(dtype).float())
    assert torch.equal(value(make(), half), value(make(), full))


@LOSSES
def test_a_lazy_stack_of_steps_is_read_like_one_batch(make):
    other = lazy_stack(list(ppo_batch().unbind(1)), 1)
    assert torch.equal(value(make(), other), value(make(), ppo_batch()))


@LOSSES
def test_a_batch_without_a_step_gets_one_line(make):
    batch = ppo_batch()
    for none in (batch[:0], batch[:, :0], batch[0, 0]):
        with pytest.raises(ValueError, match=r"^a batch must be \[\.\.\., L\] with L >= 1 steps; "):
            make()(none)


def test_one_step_without_a_target_gets_one_line():
    with pytest.raises(
        ValueError, match=r"^bootstrap must be 'next' where .* one step; got 'last'"
    ):
        PQNLoss(toy_network(), bootstrap="last")(stream(4, 1, seed=2).stock())


@LOSSES
def test_a_batch_whose_time_comes_first_is_refused_where_its_names_say_so(make):
    batch = ppo_batch().exclude("step_count", ("next", "step_count"), "collector")
    batch.names = ["env", "time"]
    expected = value(make(), batch.clone())
    turned = batch.transpose(0, 1).contiguous()
    with pytest.raises(ValueError, match=r"^time must be the last dimension .*; got \['time'"):
        make()(turned)
    assert torch.equal(value(make(), turned.transpose(0, 1)), expected)


@pytest.mark.parametrize("bad", [-0.1, 1.5, torch.ones(4, 1), "0.9"], ids=repr)
@pytest.mark.parametrize("name", ["gamma", "lmbda"])
def test_a_discount_that_is_none_is_refused_when_the_estimator_is_made(name, bad):
    for make in (q_loss().make_value_estimator, ppo_loss().make_value_estimator):
        with pytest.raises(ValueError, match=f"^{name} must be .*; got [^\n]*$"):
            make(**{name: bad})
        make(**{name: torch.tensor(0.5)})


# -- gradients ---------------------------------------------------------------------------------------


@LOSSES
def test_what_was_stored_is_no_way_for_a_gradient(make):
    loss = make()
    batch = loss.value_estimator(ppo_batch()) if make is ppo_loss else ppo_batch()
    leaves = []
    stored = ["action_log_prob", "advantage", "value_target", "state_value", ("next", "reward")]
    stored += [key for key in batch.keys(True, True) if key[0] == "memory"]
    for key in stored:
        if key in batch:
            leaves.append(batch[key].clone().requires_grad_())
            batch[key] = leaves[-1] * 1.0  # of a policy that was not called within no_grad()
    assert len(leaves) > 2
    out = loss(batch)
    total(out).backward()
    assert [leaf.grad for leaf in leaves] == [None] * len(leaves)
    assert all(p.grad is not None for p in loss.parameters())


def ppo_sequences():
    batch = with_two_states(stream(4, 4, seed=5)).sequences()
    return batch.set("action_log_prob", ppo_batch()["action_log_prob"])


@LOSSES
def test_a_first_state_is_no_way_for_a_gradient(make):
    batch = ppo_sequences()
    first = batch["initial_state", "memory", "actor", "h"].clone().requires_grad_()
    batch["initial_state", "memory", "actor", "h"] = first * 1.0
    total(make()(batch)).backward()
    assert first.grad is None


@LOSSES
@pytest.mark.parametrize("form", [ppo_batch, ppo_sequences])
def test_a_batch_is_as_it_was_behind_a_loss(make, form):
    """Also one that has to be read otherwise than it is written: flags of bytes, no truncated."""
    batch = form()
    for key in ("is_init", *[("next", name) for name in NEXTS[1:]]):
        batch[key] = batch[key].to(torch.uint8)
    del batch["next", "truncated"]
    batch["mask"] = torch.ones(4, 4, dtype=torch.bool)
    before = batch.clone()
    make()(batch)
    assert set(batch.keys(True)) - {"td_error"} == set(before.keys(True))
    for key, given in before.items(True, True):
        assert batch[key].dtype == given.dtype
        assert torch.equal(batch[key].nan_to_num(7), given.nan_to_num(7)), key


# -- names -------------------------------------------------------------------------------------------


def renamed(batch, names):
    for old, new in names.items():
        place = ("next",) if old in NEXTS else ()
        batch.rename_key_((*place, old), (*place, new))
    return batch


@LOSSES
def test_every_name_can_be_another(make):
    names = {name: f"other_{name}" for name in ("action", *NEXTS)}
    loss = make()
    loss.set_keys(**names)
    more = {"action_log_prob": "old"} if make is ppo_loss else {}
    if more:
        loss.set_keys(sample_log_prob="old")
    found = value(loss, renamed(ppo_batch(), names | more))
    assert torch.equal(found, value(make(), ppo_batch()))
    assert "action" not in loss.in_keys and "other_action" in loss.in_keys
    without = renamed(ppo_batch(), names | more).exclude(("next", "other_truncated"))
    assert torch.equal(value(loss, without), found)  # as done says


class Flat(nn.Module):
    """Frames as numbers."""

    def forward(self, pixels):
        return pixels.flatten(-3).float() / 255


def own_network(heads, store="step", **keys):
    """Somebody's own modules behind each other, with the memory's entries under their own names."""
    torch.manual_seed(0)
    parts = [
        TensorDictModule(Flat(), ["pixels"], ["features"]),
        MemoryModule(make_memory("mingru", 12, WIDTH), "features", "m", store=store, **keys),
    ]
    for name, width in heads.items():
        parts.append(TensorDictModule(nn.Linear(WIDTH, width), ["m"], [name]))
    return TensorDictSequential(*parts)


def sequences_of(batch):
    """The batch as ``collect()`` gives it, its next frames dense."""
    states = batch["memory", "actor"][:, 0].clone()
    rows = batch.exclude("memory").auto_batch_size_(1)
    return rows.set("initial_state", TensorDict({"memory": states}, [len(rows)]))


@pytest.mark.parametrize("burn_in", [0, 2])
@pytest.mark.parametrize("store", ["step", "sequence"])
@pytest.mark.parametrize("is_sequences", [True, False])
def test_start_flags_may_have_another_name(burn_in, store, is_sequences):
    key = ("agent", "starts") if is_sequences else "starts"
    batch = ppo_batch(steps=7)
    batch["memory"] = batch["memory", "actor"]
    if is_sequences:
        batch = sequences_of(ppo_batch(steps=7))
    found = []
    for name in ("is_init", key):
        loss = DQNLoss(own_network({"action_value": 5}, store, is_init_key=name), burn_in=burn_in)
        loss.set_keys(is_init=name)
        found.append(loss(batch.clone().rename_key_("is_init", name))["loss"])
    assert torch.equal(*found)


@pytest.mark.parametrize("key", ["starts", ("agent", "starts")], ids=str)
def test_start_flags_and_value_of_an_actor_critic_may_have_other_names(key):
    batch = ppo_batch()
    batch["memory"] = batch["memory", "actor"]
    found = []
    for name, worth in (("is_init", "state_value"), (key, ("agent", "worth"))):
        loss = PPOLoss(make_actor(own_network({"logits": 5, worth: 1}, is_init_key=name)))
        loss.set_keys(is_init=name, value=worth)
        found.append(parts(loss(batch.clone().rename_key_("is_init", name))))
    assert torch.equal(*found)


def test_a_critic_of_several_numbers_a_step_gets_one_line():
    width = 2
    batch = ppo_batch()
    batch["memory"] = batch["memory", "actor"]
    loss = PPOLoss(make_actor(own_network({"logits": 5, "state_value": width})))
    with pytest.raises(ValueError, match=f"^the entry 'state_value' of .*; got 'shape .{width}.'$"):
        loss(batch)


@LOSSES
@pytest.mark.parametrize("name", ["position", "initial_state", "extended"])
def test_an_observation_may_be_called_as_an_entry_of_ours(make, name):
    """Before: ``position``, which MuJoCo has, made a batch one that had been prepared."""
    other = ppo_batch().set(name, torch.ones(4, 4, 2))
    other["next", name] = torch.ones(4, 4, 2)
    assert torch.equal(value(make(), other), value(make(), ppo_batch()))


# -- padding -----------------------------------------------------------------------------------------


def padded(batch, key):
    """The batch as rows of one trajectory each; behind the end of one there is nothing of worth."""
    split = split_trajectories(batch.clone(), prefix="collector")
    mask = split["collector", "mask"].view(split.shape)
    assert not mask.all()
    for name in ("action_log_prob", "advantage", ("next", "reward")):
        if name in split:
            split[name][~mask] = torch.nan
    if key == "mask":
        split["mask"] = split["collector", "mask"]
        split = split.exclude(("collector", "mask"))
    return split


@LOSSES
@pytest.mark.parametrize("key", ["mask", ("collector", "mask")], ids=str)
def test_padding_is_no_part_of_loss_or_gradient(make, key):
    options = {"ends": 0.2}
    batch, loss = ppo_batch(steps=9, **options), make()
    if make is ppo_loss:
        batch = loss.value_estimator(batch)
    forms = [batch, padded(batch, key)]
    if make is not ppo_loss:
        forms.append(loss.prepare(padded(batch, key)))
    found = []
    for form in forms:
        out = loss(form)
        loss.zero_grad()
        total(out).backward()
        gradients = torch.cat([p.grad.flatten() for p in loss.parameters()])
        numbers = torch.stack([out[key].detach() for key in loss.out_keys])
        found.append((value(loss, form), gradients, numbers))
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], atol=1e-5, rtol=1e-5)


def test_padding_is_no_part_of_what_is_predicted():
    network = toy_actor_critic()
    network.actor.predictor = nn.Linear(WIDTH + ACTIONS, WIDTH)
    loss = PPOLoss(make_actor(network.actor), network.critic, prediction_coeff=1.0)
    rows = loss.value_estimator(ppo_batch(steps=6, ends=0.0))
    behind = rows[:, :2].clone()
    behind["is_init"] = torch.zeros_like(behind["is_init"])
    mask = torch.ones(4, 6, dtype=torch.bool)
    padded_rows = torch.cat([rows, behind], 1)
    padded_rows["collector", "mask"] = torch.cat([mask, ~mask[:, :2]], 1)
    assert (padded_rows[:, 6:]["pixels"] != 0).any()
    wanted = loss(rows)["loss_prediction"]
    torch.testing.assert_close(loss(padded_rows)["loss_prediction"], wanted)


@LOSSES
def test_shuffled_steps_are_refused_between_padding_too(make):
    batch = padded(ppo_batch(steps=9, ends=0.2), "mask")
    row = int(batch["mask"].sum(1).argmax())
    assert batch["mask"][row, :4].all()
    batch[row, 1:3] = batch[row, 1:3].flip(0)
    with pytest.raises(ValueError, match=r"must be that of whole sequences, never shuffled"):
        make()(batch)


@LOSSES
def test_a_step_counts_where_all_masks_say_so(make):
    """``mask`` of ``split_trajectories``, ``("collector", "mask")`` of a sampler that cuts it."""
    steps = torch.arange(9)
    rows = torch.tensor([9, 7, 5, 3])
    two, one = (ppo_batch(steps=9, ends=0.0) for _ in range(2))
    two["mask"] = (steps < rows.unsqueeze(1)).unsqueeze(-1)
    two["collector", "mask"] = (steps < 6).expand(4, -1).unsqueeze(-1)
    one["mask"] = (steps < rows.clamp_max(6).unsqueeze(1)).unsqueeze(-1)
    assert torch.equal(value(make(), two), value(make(), one))


@LOSSES
def test_a_batch_may_count_the_steps_of_its_observations_alone(make):
    other = ppo_batch().exclude(("next", "step_count"))
    assert "step_count" in other
    assert torch.equal(value(make(), other), value(make(), ppo_batch()))


@LOSSES
@pytest.mark.parametrize("is_flat", [True, False])
def test_slices_that_a_sampler_pads_count_as_those_that_it_does_not(make, is_flat):
    losses = []
    for pads in (True, False):
        sampler = SliceSampler(
            slice_len=4, traj_key=("collector", "traj_ids"), strict_length=False, pad_output=pads
        )
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(36), sampler=sampler, batch_size=24
        )
        batch = ppo_batch(steps=9, ends=0.3)
        zeros = {key: torch.zeros_like(batch[key]) for key in batch.keys(True, True)}
        batch.update({key: zero for key, zero in zeros.items() if key[0] == "memory"})
        loss = make()
        buffer.extend((loss.value_estimator(batch) if make is ppo_loss else batch).reshape(-1))
        torch.manual_seed(0)
        drawn = buffer.sample()
        assert ("collector", "mask") in drawn or not pads
        losses.append(value(loss, drawn if is_flat or not pads else drawn.reshape(-1, 4)))
    torch.testing.assert_close(*losses, atol=1e-6, rtol=1e-5)


def test_a_norm_of_advantages_learns_from_no_padding():
    scales = []
    for change in (lambda x: x, lambda x: padded(x, ("collector", "mask"))):
        norm = PopArtValueNorm(beta=0.9, epsilon=1e-8)
        ppo_loss(advantage_norm=norm)(change(ppo_batch(steps=9, ends=0.2)))
        scales.append(norm.scale())
    torch.testing.assert_close(*scales)


# -- copies ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_loss_estimates_with_the_critic_that_it_trains(copied):
    results = []
    for prepare in (lambda x: x, copied):
        loss = prepare(ppo_loss())
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.mul_(1.5)
        results.append(value(loss, ppo_batch()))
    assert torch.equal(*results)


def test_a_copy_of_a_loss_keeps_parts_that_two_networks_share():
    network = own_network({"logits": 5, "state_value": 1})
    loss = PPOLoss(make_actor(network), network)
    twin = copy.deepcopy(loss)
    assert len(list(twin.parameters())) == len(list(loss.parameters()))
    assert not {id(p) for p in twin.parameters()} & {id(p) for p in loss.parameters()}
