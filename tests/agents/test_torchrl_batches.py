"""Batches as TorchRL's own tools make them: padded, sliced, flat, nested, weighted; what cannot be
read is refused.
"""

import pytest
import torch
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.postprocs import MultiStep
from torchrl.data.replay_buffers.samplers import SliceSampler

from arcade_torch.agents import DQNLoss, PPOLoss, PQNLoss, SequenceGAE, make_actor
from tests.agents.fakes import (
    GAMMA,
    LAM,
    chosen,
    lambda_return,
    look_into,
    play,
    stream,
    summed_errors,
    toy_actor_critic,
    toy_network,
    with_two_states,
)


def make_loss(network, kind=DQNLoss, **options):
    loss = kind(network, **options)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return loss


def numbered(s, zeros=False):
    """A stock batch with the counts of an env: steps since the episode began, and a number for each
    trajectory; its states are finite, at true starts zero.
    """
    batch, (rows, steps) = s.stock(), s.action.shape
    count, number = (
        torch.zeros(rows, steps, dtype=torch.int64),
        torch.zeros(rows, steps, dtype=torch.int64),
    )
    for b in range(rows):
        at = 0 if s.is_init[b, 0] else 3
        for t in range(steps):
            at = 0 if s.is_init[b, t] else at
            count[b, t], at = at, at + 1
    starts = s.is_init.clone()
    starts[:, 0] = True
    number.copy_((starts.flatten().cumsum(0) - 1).view(rows, steps))
    batch["step_count"], batch["next", "step_count"] = count.unsqueeze(-1), count.unsqueeze(-1) + 1
    batch["collector", "traj_ids"] = number
    for key in batch["memory"].keys(True, True):
        state = torch.rand_like(batch["memory", key]) + 0.1
        state[:, 0] = batch["memory", key][:, 0]
        batch["memory", key] = state.masked_fill(s.is_init.unsqueeze(-1) | zeros, 0.0)
    return batch


def slices(batch, length=4, count=6):
    """What a replay of single steps draws, flat; where it cut an episode it has set ``is_init``."""
    sampler = SliceSampler(slice_len=length, traj_key=("collector", "traj_ids"))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(500), sampler=sampler, batch_size=length * count
    )
    buffer.extend(batch.reshape(-1))
    return buffer.sample()


# -- trajectories padded with zeros ----------------------------------------------------------------


@pytest.mark.parametrize("key", ["mask", ("collector", "mask")])
@pytest.mark.parametrize("seams", [0.0, 0.3])
def test_the_last_step_of_a_padded_trajectory_reads_its_own_next_frame(key, seams):
    s = stream(4, 9, seed=5, ends=0.3, seams=seams)
    network, batch = toy_network(), numbered(s).exclude("step_count", ("next", "step_count"))
    q, after = play(network, s)
    wanted = lambda_return(s.reward, after.amax(-1), s.terminated, s.cut, GAMMA, LAM)
    prefix = "collector" if key == ("collector", "mask") else None
    split = split_trajectories(
        batch
        if prefix
        else batch.exclude("collector").set("traj_ids", batch["collector", "traj_ids"]),
        prefix=prefix,
    )
    mask = split[key].view(split.shape)
    assert not mask.all() and mask.sum() == s.action.numel()
    loss = make_loss(network)
    torch.testing.assert_close(
        look_into(loss, split)[1][mask], wanted.flatten(), atol=1e-5, rtol=1e-5
    )
    if prefix:  # by default TorchRL's losses look for no other mask
        error = chosen(q, s.action) - wanted
        means = {"loss": 0.5 * error.square(), "q_mean": chosen(q, s.action), "target_mean": wanted}
        out = loss(split)
        for name, each in (means | {"td_error": error.abs()}).items():
            torch.testing.assert_close(out[name].detach(), each.mean(), atol=1e-5, rtol=1e-5)


def test_advantages_of_padded_trajectories_are_those_of_the_window():
    s = with_two_states(stream(4, 9, seed=5))
    network, batch = toy_actor_critic(), numbered(s)
    value, after = (x.squeeze(-1) for x in play(network.critic, s))
    wanted = summed_errors(s.reward, value, after, s.terminated, s.cut, GAMMA, LAM)
    split = split_trajectories(batch, prefix="collector")
    found = SequenceGAE(network.critic, GAMMA, LAM)(split)["advantage"].squeeze(-1)
    torch.testing.assert_close(
        found[split["collector", "mask"].view(split.shape)], wanted.flatten(), atol=1e-5, rtol=1e-5
    )


def test_an_entry_called_mask_that_is_none_of_steps_changes_nothing():
    s, loss = stream(3, 7, seed=2), make_loss(toy_network())
    allowed = torch.rand(3, 7, 5) < 0.5  # of actions
    assert torch.equal(loss(s.stock().set("mask", allowed))["loss"], loss(s.stock())["loss"])


# -- what cannot be read ---------------------------------------------------------------------------


def readers(**options):
    """Everything that looks for next observations."""
    network = toy_network(out_key="state_value", outputs=1, **options)
    yield SequenceGAE(network, GAMMA, LAM)
    yield from (make_loss(toy_network(**options), kind) for kind in (PQNLoss, DQNLoss))


def test_steps_joined_to_n_steps_are_refused():
    batch = MultiStep(GAMMA, 3)(stream(3, 8, seed=1).stock())
    for read in readers():
        with pytest.raises(
            ValueError, match=r"^the batch must be .*lmbda.*; got 'steps_to_next_obs'$"
        ):
            read(batch.clone())


def test_a_batch_without_next_observations_says_how_they_get_there():
    s = stream(3, 8, seed=1)
    batch = s.stock()
    compact = batch.exclude(*[("next", key) for key in toy_network().in_keys if key != "is_init"])
    for read in readers():
        with pytest.raises(KeyError, match=r"compact_obs=False.*final_frames='all'"):
            read(compact.clone())


@pytest.mark.parametrize("shape", [(4, 9), (36,)])
def test_shuffled_steps_are_refused_and_ordered_ones_are_not(shape):
    batch = numbered(stream(4, 9, seed=3, ends=0.1))
    shuffled = batch.reshape(-1)[torch.randperm(36)].reshape(shape)
    for read in readers(store="step"):
        read(batch.clone())
        read(slices(batch, 2))
        read(split_trajectories(batch, prefix="collector"))
        with pytest.raises(ValueError, match=r"^step_count must be .*whole sequences.*; got "):
            read(shuffled.clone())


def test_steps_of_two_envs_that_count_on_are_refused():
    """A flat storage puts the rows one behind the other, and a slice may lie across the seam."""
    batch = numbered(stream(1, 8, seed=3, ends=0.0, seams=0.0))
    read_all = list(readers(store="step"))
    for read in read_all:
        read(batch.clone())
    batch["collector", "traj_ids"][:, 4:] += 1
    for read in read_all:
        with pytest.raises(ValueError, match=r"^\('collector', 'traj_ids'\) must be .*whole"):
            read(batch.clone())


@pytest.mark.parametrize("counted", ["step_count", "traj_ids"])
def test_an_episode_that_begins_unmarked_is_refused_where_a_memory_would_read_on(counted):
    """``NoopResetEnv`` steps in a reset: the first observation of an episode is none of the env's
    own starts.
    """
    batch = numbered(stream(3, 8, 0))
    if counted == "step_count":
        del batch["collector"]
    else:
        del batch["step_count"]
    make_loss(toy_network(0))(batch.clone())
    starts = batch["is_init"].squeeze(-1).clone()
    starts[:, 0] = False
    row, step = (int(x) for x in starts.nonzero()[0])
    assert batch["next", "done"][row, step - 1]
    batch["is_init"][row, step] = False
    with pytest.raises(ValueError, match=r"is_init must be true .* InitTracker"):
        make_loss(toy_network(0))(batch.clone())
    with pytest.raises(ValueError, match="is_init must be true"):
        SequenceGAE(toy_actor_critic(0).critic)(batch.clone())


def test_an_end_that_is_none_of_the_env_needs_no_start():
    """The end of a life: values end, while the episode and the memory go on."""
    batch = numbered(stream(3, 8, 0, ends=0.0))
    batch["next", "terminated"][:, 3] = True
    batch["next", "done"][:, 3] = True
    make_loss(toy_network(0))(batch)


def test_slices_that_begin_within_episodes_are_refused_where_their_states_would_be_dropped():
    batch = numbered(stream(4, 12, seed=3, ends=0.1))
    torch.manual_seed(0)
    flat = slices(batch)
    rows = flat.reshape(-1, 4)
    assert (rows["is_init"][:, 0, 0] & (rows["step_count"][:, 0, 0] > 0)).any()
    for form in (flat, rows):
        for read in readers(store="sequence"):
            with pytest.raises(ValueError, match=r"^store must be 'step' .*; got 'sequence'$"):
                read(form.clone())
        for read in readers(store="step"):
            read(form.clone())


def test_no_true_start_is_taken_for_the_cut_of_a_sampler():
    s = stream(4, 12, seed=3)
    for read in readers(store="sequence"):
        read(numbered(s))  # episodes begin with zeros
        stale = numbered(s)
        stale["memory", "h"] = (
            torch.rand_like(stale["memory", "h"]) + 0.1
        )  # or with what the one before left
        read(stale)
        read(s.sequences().set("step_count", torch.ones(4, 12, 1)).set("memory", stale["memory"]))
        nothing = slices(numbered(s, zeros=True), 2)  # no state is lost
        read(nothing)


def test_the_loss_of_an_actor_critic_refuses_dropped_states_too():
    network, s = toy_actor_critic(), with_two_states(stream(4, 12, seed=3, ends=0.1))
    batch = numbered(s).update({"action_log_prob": torch.full((4, 12), -1.6)})
    loss = PPOLoss(make_actor(network.actor), network.critic)
    batch = loss.value_estimator(batch)
    loss(batch)
    torch.manual_seed(0)
    with pytest.raises(ValueError, match=r"^store must be 'step' .*; got 'sequence'$"):
        loss(slices(batch))


def test_a_burn_in_of_a_flat_batch_of_slices_is_refused():
    batch = numbered(stream(4, 12, seed=3, ends=0.1))
    flat = slices(batch)
    loss = make_loss(toy_network(store="step"), burn_in=2)
    with pytest.raises(ValueError, match=r"^burn_in must be 0 .*reshape.*; got 2$"):
        loss(flat)
    loss(flat.reshape(-1, 4))
    one = numbered(stream(1, 6, seed=1, ends=0.0))
    torch.testing.assert_close(loss(one[0].clone())["loss"], loss(one)["loss"])


# -- shapes, weights, priorities -------------------------------------------------------------------


def weighing(batch, loss, weight, shape):
    """Each reduction of a loss with weights, against the plain errors."""
    each = loss(batch.clone())["loss"].detach()
    full = weight.reshape(
        len(weight), *[1] * (each.ndim - weight.ndim), *weight.shape[1:]
    ).expand_as(each)
    assert each.shape == shape
    wanted = {
        "none": each * full,
        "sum": (each * full).sum(),
        "mean": (each * full).sum() / full.sum(),
    }
    for how, value in wanted.items():
        loss.reduction = how
        torch.testing.assert_close(
            loss(batch.clone().set("priority_weight", weight))["loss"].detach(), value
        )


@pytest.mark.parametrize("burn_in", [0, 2])
def test_weights_fit_every_layout(burn_in):
    s, network = stream(4, 7, seed=6, ends=0.3), toy_network()
    s.is_init[1] = False
    torch.manual_seed(0)

    def loss():
        return make_loss(network, burn_in=burn_in, reduction="none")

    left = 7 - burn_in
    weighing(s.sequences(), loss(), torch.rand(4, 1).expand(4, left)[:, 0], (4, left))
    stock, weight = s.stock(), torch.rand(4, 7)
    for shape in ((4, 7), (2, 2, 7)):
        each = loss()(stock.clone().reshape(shape))["loss"]
        assert each.shape == (*shape[:-1], left)
        found = loss()(stock.clone().reshape(shape).set("priority_weight", weight.view(shape)))[
            "loss"
        ]
        torch.testing.assert_close(found, each * weight.view(shape)[..., burn_in:])
        with_one_more = stock.clone().reshape(shape).set("priority_weight", weight.view(*shape, 1))
        torch.testing.assert_close(loss()(with_one_more)["loss"], found)
    each = loss()(stock[1].clone())["loss"]
    assert each.shape == (left,)
    found = loss()(stock[1].clone().set("priority_weight", weight[1]))["loss"]
    torch.testing.assert_close(found, each * weight[1, burn_in:])
    rows = loss()
    assert rows(rows.prepare(stock))["loss"].shape == (4, left)


def test_batches_of_nested_envs_are_read_row_by_row():
    s = stream(6, 7, seed=7)
    nested = s.stock().reshape(2, 3, 7)
    for read in readers():
        out, wanted = read(nested.clone()), read(s.stock())
        for key in (
            ("loss", "q_mean") if "loss" in out else ("advantage", "value_target", "state_value")
        ):
            found = out[key] if key in ("loss", "q_mean") else out[key].view(6, 7, 1)
            assert torch.equal(found, wanted[key])
    assert SequenceGAE(toy_network(out_key="state_value", outputs=1))(nested)[
        "advantage"
    ].shape == (2, 3, 7, 1)


@pytest.mark.parametrize(("burn_in", "bootstrap"), [(0, "next"), (2, "next"), (0, "last")])
def test_priorities_are_written_where_torchrl_looks_for_them(burn_in, bootstrap):
    network, s = toy_network(), stream(4, 7, seed=8)
    kind = {"kind": PQNLoss, "burn_in": burn_in, "bootstrap": bootstrap}
    loss, steps = make_loss(network, **kind), slice(burn_in, 6 if bootstrap == "last" else 7)
    q, target, _ = look_into(loss, s.stock())
    wanted = (chosen(q, s.action[:, burn_in:])[:, : target.shape[1]] - target).abs()
    for form in (
        s.stock(),
        s.sequences(),
        s.stock().reshape(2, 2, 7),
        *[s.stock()[0]] * (not burn_in),
    ):
        loss(form)
        found, rows = form["td_error"], 1 if form.batch_size == (7,) else 4
        shape = (4, 7) if form.batch_size == (4,) else form.shape
        assert (
            found.shape == (*shape, 1) and not found.requires_grad
        )  # TorchRL's, so that it can go on with it
        found = found.reshape(rows, 7)
        torch.testing.assert_close(found[:, steps], wanted[:rows])
        outside = torch.cat((found[:, : steps.start], found[:, steps.stop :]), 1)
        mean = wanted[:rows].mean(1, keepdim=True)
        torch.testing.assert_close(outside, mean.expand_as(outside))  # none of their own
    data = loss.prepare(s.stock())
    before = set(data.keys())
    loss(data)
    loss(s.stock().lock_())
    assert set(data.keys()) == before
    loss.set_keys(priority="surprise")
    torch.testing.assert_close(
        loss(batch := s.stock())["td_error"], batch["surprise"][:, steps].mean()
    )


@pytest.mark.parametrize("kind", [PQNLoss, DQNLoss])
def test_an_env_that_does_not_tell_truncated_gives_done(kind):
    batch = stream(4, 12, seed=3).stock()
    loss = make_loss(toy_network(), kind)
    expected = loss(batch.clone())["loss"]
    assert (batch["next", "truncated"] & ~batch["next", "terminated"]).any()
    given = loss(batch.exclude(("next", "truncated")))["loss"]
    assert torch.equal(given, expected)
