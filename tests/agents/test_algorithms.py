"""Every algorithm in its trainer: acting is learning, updates work, a saved moment goes on to the
bit.
"""

import io
import math
import re
import sys
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import (
    DQNLoss,
    NonFiniteError,
    PPOLoss,
    PQNLoss,
    Trainer,
    learner,
    make_actor,
    preset,
)
from arcade_torch.agents.config import GROUPS
from arcade_torch.agents.learner import Training, move_mean
from arcade_torch.agents.runs.checkpoint import Checkpoint
from arcade_torch.agents.runs.folder import METRIC_COLUMNS
from arcade_torch.agents.trainer import LEARNERS
from arcade_torch.models import memory_names
from tests.agents.fakes import (
    GAMMA,
    LAM,
    chosen,
    look_into,
    stream,
    toy_actor_critic,
    toy_network,
    with_two_states,
)

MEMORIES = [*memory_names(), "feedforward"]
ENVS, STEPS = 4, 12
NUMBERS = {
    "num_envs": ENVS,
    "num_steps": STEPS,
    "minibatches": 2,
    "warmup_steps": STEPS,
    "epochs": 1,
}
REPLAY = {"replay_frames": 150, "batch_sequences": 4, "learning_starts": 4, "target_every": 2}
MORE = {"pqn": {"overlap": 2}, "ppo": {}, "dqn": REPLAY}
TIMES = ("seconds", "fps")
algorithms = pytest.mark.parametrize("algorithm", GROUPS)


def config(algorithm, memory="gru", env="CartPoleEasy", **changes):
    numbers = NUMBERS | MORE[algorithm] | changes.pop(algorithm, {})
    options = {"hidden_size": 16, "feedforward_size": 16}
    changes = {
        "total_frames": 10 * ENVS * STEPS,
        "observability": "partial",
        "network_options": options,
    } | changes
    return preset(
        "smoke", algorithm=algorithm, memory=memory, env=env, **changes, **{algorithm: numbers}
    )


def saved(trainer):
    """A checkpoint as it would stand in the file."""
    stream = io.BytesIO()
    torch.save({"weights": trainer.acting.state_dict(), "state": trainer.state_dict()}, stream)
    stream.seek(0)
    found = torch.load(stream, weights_only=True)
    return Checkpoint(trainer.config, trainer.frames, found["weights"], found["state"], Path())


def without_times(row):
    return {key: value for key, value in row.items() if key not in TIMES}


def assert_replays(loss, batch):
    """What the loss computes from the stored window is what was acted, before the first gradient
    step.
    """
    if "action_log_prob" in batch:
        found = loss(loss.value_estimator(batch.clone()))
        assert found["clip_fraction"] == 0 and float(found["kl_approx"]) < 1e-9
    else:  # nothing was explored: the actions are the best ones
        q = look_into(loss, batch)[0]
        taken = chosen(q, batch["action"][:, loss.burn_in :])
        assert q.std() > 1e-4 and (q.amax(-1) - taken).max() < 1e-5


@pytest.mark.parametrize(
    ("memory", "average_share"),
    [("attention", 0.0), ("gdn", 0.0), ("feedforward", 0.0), ("gru", 0.5)],
)
@algorithms
def test_acting_is_learning_and_a_saved_moment_goes_on_to_the_bit(
    algorithm, memory, average_share, monkeypatch, tmp_path
):
    greedy = (
        {} if algorithm == "ppo" else {"epsilon_start": 0.0, "epsilon_end": 0.0, "warmup_steps": 0}
    )
    if algorithm == "ppo" and average_share:  # the deviation of advantages is part of a moment, too
        greedy = {"advantage_decay": 0.9}
    what = config(algorithm, memory, **{algorithm: greedy | {"average_share": average_share}})
    trainer, ends = Trainer(what, tmp_path), []
    trainer.warm_up()
    update = trainer.learner.update

    def check_then_update(batch, frames):
        if trainer.updates == 0 or (algorithm == "ppo" and not average_share):
            with torch.no_grad():
                assert_replays(trainer.learner.loss, batch)
        ends.append(bool(batch["next", "done"][:, :-1].any()))
        return update(batch, frames)

    monkeypatch.setattr(trainer.learner, "update", check_then_update)
    trainer.update()
    moment, draws = saved(trainer), trainer.random_state
    rows = [trainer.update() for _ in range(3)]
    assert any(ends), "a window must hold an episode's end"
    again = Trainer(what, tmp_path)
    again.load(moment)
    assert torch.equal(again.random_state, draws)
    assert [without_times(again.update()) for _ in range(3)] == [without_times(row) for row in rows]
    for mine, theirs in ((again.network, trainer.network), (again.acting, trainer.acting)):
        mine, theirs = mine.state_dict(), theirs.state_dict()
        assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
        assert any(not torch.equal(moment.weights[name], theirs[name]) for name in theirs)


def test_a_mean_of_weights_has_the_statistics_of_what_is_trained() -> None:
    """Before: those of a batch norm stayed 0 and 1, by which it then acted and was evaluated."""
    network, mean = torch.nn.BatchNorm1d(2), torch.nn.BatchNorm1d(2)
    network(torch.randn(8, 2) + 3)
    move_mean(mean, network, 9.0)
    for name, statistic in network.named_buffers():
        assert torch.equal(mean.get_buffer(name), statistic)
    assert float(mean.running_mean.min()) > 0


@algorithms
def test_what_acts_is_a_mean_of_what_is_trained_that_grows_with_the_return(
    algorithm, monkeypatch, tmp_path
):
    trainer = Trainer(config(algorithm, **{algorithm: {"average_share": 0.5}}), tmp_path)
    trainer.warm_up()
    wanted = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    assert all(
        torch.equal(value, wanted[name]) for name, value in trainer.acting.state_dict().items()
    )
    monkeypatch.setattr(trainer.stats, "update", lambda *window: None)
    trainer.return_range = (0.0, 1.0)
    # Shares of new weights.
    for reached, newest in (
        (None, 1),
        (-1.0, 1),
        (0.5, 32 / 35),
        (1.0, 1 / 3),
        (7.0, 2 / 7),
    ):
        trainer.stats.smooth = reached
        trainer.update()
        trained = trainer.network.state_dict()
        for name, _ in trainer.network.named_parameters():
            wanted[name] = (1 - newest) * wanted[name] + newest * trained[name]
        torch.testing.assert_close(dict(trainer.acting.state_dict()), wanted)
    assert any(not torch.equal(value, trained[name]) for name, value in wanted.items())
    acts = {id(p) for p in trainer.policy.parameters()}
    assert acts == {id(p) for p in trainer.acting.parameters()}


@pytest.mark.parametrize(
    ("training_return", "span", "share"),
    [
        (None, (0.0, 1.0), 0.0),
        (-1.0, (-1.0, 1.0), 0.0),
        (0.0, (-1.0, 1.0), 0.5),
        (-0.5, (-1.0, 0.0), 0.5),
        (30.0, (0.0, 40.0), 0.75),
        (50.0, (0.0, 40.0), 1.0),
        (-2.0, (-1.0, 1.0), 0.0),
    ],
)
def test_a_return_counts_as_a_share_of_what_the_game_can_pay(training_return, span, share):
    """Before: the raw return, so no mean at all at 0 and below, and always the full one above 1."""
    assert learner.share_reached(training_return, span) == share


@pytest.mark.parametrize("training_return", [0.5, 0.7, 0.9, 1.0])
def test_the_window_grows_alike_near_the_highest_return_of_all_games(training_return):
    """Navigator, whose returns begin at -1, lost with a window by the bare share, which is longer."""
    positive = learner.window_share(training_return, (0.0, 1.0))
    assert positive == training_return**4
    assert learner.window_share(training_return, (-1.0, 1.0)) == pytest.approx(positive, abs=0.05)
    assert learner.window_share(-0.9, (-1.0, 0.0)) == pytest.approx(0.1**4)
    assert learner.window_share(None, (-1.0, 1.0)) == 0


def test_the_mean_goes_by_the_range_of_the_runs_own_game():
    trainer = Trainer(config("pqn", env="NavigatorEasy", pqn={"average_share": 0.5}))
    assert trainer.return_range == trainer.env.game.return_range and trainer.return_range[0] < -0.9


@pytest.mark.parametrize("span", [(0.0, 0.0), (0.0, math.inf), (-math.inf, 1.0)])
def test_a_mean_of_a_game_without_a_range_is_refused(span, monkeypatch):
    with pytest.raises(
        ValueError,
        match=r"average_share goes by .* but MineEasy-v0 has return_range .* or set it to 0",
    ):
        learner.check_return_range("MineEasy-v0", span)


def test_without_a_mean_the_same_weights_act_and_learn():
    trainer = Trainer(config("ppo", ppo={"average_share": 0.0}))
    assert trainer.acting is trainer.network and trainer.state_dict()["network"] is None


@pytest.mark.parametrize(
    ("algorithm", "memory"),
    [*(("pqn", memory) for memory in MEMORIES), ("ppo", "gru"), ("dqn", "gru")],
)
def test_updates_of_another_game_are_finite_and_train_every_parameter(algorithm, memory):
    trainer = Trainer(config(algorithm, memory, "MineSweeperEasy"))
    trainer.warm_up()
    before = {name: value.clone() for name, value in trainer.network.named_parameters()}
    for _ in range(2):
        row = trainer.update()
    assert set(row) <= set(METRIC_COLUMNS)
    assert all(torch.tensor(float(value)).isfinite() for value in row.values() if value is not None)
    still = [
        name
        for name, value in trainer.network.named_parameters()
        # a small step may be lost in the rounding of a large parameter
        if torch.equal(value, before[name]) and not value.grad.any()
    ]
    assert not still


UPDATE = {"num_envs": 4, "num_steps": 6, "epochs": 2, "minibatches": 2, "gamma": GAMMA, "lam": LAM}
UPDATE |= {
    "learning_rate": 1e-2,
    "learning_rate_end": 1e-3,
    "lr_decay_fraction": 1.0,
    "max_grad_norm": 0.05,
}
UPDATE_OF = {
    "pqn": {"overlap": 1, "bootstrap": "last"},
    "ppo": {"clip": 0.1, "critic_coeff": 0.7, "entropy_coeff": 0.3, "entropy_end": 0.5},
    "dqn": {
        "overlap": 0,
        "burn_in": 1,
        "batch_sequences": 4,
        "learning_starts": 4,
        "replay_frames": 24,
    },
}


def written_out(algorithm, network, limits, burn_in=0):
    """The loss that an update should use, every number spelled out."""
    if algorithm == "ppo":
        loss = PPOLoss(
            make_actor(network.actor), network.critic, clip_epsilon=0.1, critic_coeff=0.7, **limits
        )
    elif algorithm == "pqn":
        loss = PQNLoss(network, bootstrap="last", **limits)
    else:
        loss = DQNLoss(network, burn_in=burn_in, **limits)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return loss


@pytest.mark.parametrize("time_limit", ["bootstrap", "terminal"])
@pytest.mark.parametrize(
    ("algorithm", "targets"), [("pqn", ""), ("ppo", ""), ("dqn", "recompute"), ("dqn", "stored")]
)
def test_an_update_is_the_loop_written_out_with_every_number_of_the_config(
    algorithm, targets, time_limit
):
    """Rows in the order of the run's generator, fresh and clipped gradients, each step's own size,
    means of it all.
    """
    limits, two = {"time_limit": time_limit}, algorithm == "ppo"
    numbers = UPDATE | UPDATE_OF[algorithm] | limits | ({"targets": targets} if targets else {})
    s, (network, same) = (
        stream(4, 6, seed=6),
        ((toy_actor_critic if two else toy_network)(3) for _ in range(2)),
    )
    batch = (with_two_states(s) if two else s).sequences()
    if two:
        batch["action_log_prob"] = torch.full((4, 6), -1.6)
    training = Training(96, torch.Generator().manual_seed(3), torch.device("cpu"))
    row = LEARNERS[algorithm](network, GROUPS[algorithm](**numbers), training).update(
        batch.clone(), 24
    )

    loss, generator = (
        written_out(algorithm, same, limits, burn_in=1),
        torch.Generator().manual_seed(3),
    )
    optimizer = (
        torch.optim.Adam(loss.parameters(), eps=1e-5)
        if two
        else torch.optim.RAdam(loss.parameters())
    )
    if targets:
        torch.randperm(4, generator=generator)  # the draw from the replay: all there is
    if targets == "stored":
        batch["stored_target"] = look_into(written_out("dqn", same, limits), batch)[1]
    data, steps = loss.value_estimator(batch) if two else batch, []
    for k, rows in enumerate(
        rows for _ in range(2) for rows in torch.randperm(4, generator=generator).split(2)
    ):
        frames = 24 + 6 * k
        if two:
            loss.entropy_coeff.fill_(0.3 * 0.5 ** (frames / 96))
        out = loss(data[rows])
        total = sum(value for key, value in out.items() if key.startswith("loss"))
        parameters = list(loss.parameters())
        gradients = torch.autograd.grad(total, parameters)
        norm = sum(g.square().sum() for g in gradients).sqrt()
        assert norm > 0.05, "clipping must matter"
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient * (0.05 / norm)
        optimizer.param_groups[0]["lr"] = 1e-2 + (1e-3 - 1e-2) * frames / 96
        optimizer.step()
        steps.append({key: float(value.detach().mean()) for key, value in out.items()})
        steps[-1] |= {"loss": float(total.detach()), "grad_norm": float(norm)}
    for mine, theirs in zip(network.parameters(), same.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)
    wanted = {key: sum(step[key] for step in steps) / 4 for key in steps[0]}
    wanted["lr"] = 1e-2 + (1e-3 - 1e-2) * frames / 96
    if two:
        wanted |= {
            "policy_loss": wanted["loss_objective"],
            "value_loss": wanted["loss_critic"] / 0.7,
        }
        wanted |= {"kl": wanted["kl_approx"], "q_mean": float(data["state_value"].mean())}
        wanted["td_error"] = float(data["advantage"].abs().mean())
    assert {key: row[key] for key in wanted} == pytest.approx(wanted, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("overlap", [6, 0])
def test_warm_up_is_random_play_that_calibrates_and_an_episode_in_the_overlap_is_counted_once(
    overlap, monkeypatch
):
    numbers = {"overlap": overlap, "warmup_steps": overlap + STEPS + 7}
    trainer, seen = Trainer(config("pqn", pqn=numbers)), []
    collect = trainer.collector.collect

    def look(random=False):
        batch = collect(random=random)
        seen.append(
            (
                random,
                batch["pixels"][:, overlap:].flatten(0, 1).clone(),
                int(batch["next", "done"][:, overlap:].sum()),
            )
        )
        return batch

    monkeypatch.setattr(trainer.collector, "collect", look)
    trainer.warm_up()
    assert [random for random, *_ in seen] == [True, True]  # the overlap and 19 steps more
    frames = torch.cat([pixels for _, pixels, _ in seen]).float()
    encoder = trainer.network.encoder
    mean_patches = encoder.compress(encoder.mean.permute(1, 2, 0))
    torch.testing.assert_close(mean_patches, frames.mean(0))
    rows = [trainer.update() for _ in range(4)]
    assert rows[-1]["episodes"] == sum(ends for *_, ends in seen[2:]) > 0
    assert not any(random for random, *_ in seen[2:])
    assert [float(explorer.eps) for explorer in trainer.explorers] == pytest.approx(
        [rows[-1]["epsilon"]]
    )


@algorithms
@pytest.mark.parametrize("what", ["weight", "reward"])
def test_nan_is_found_in_the_update_in_which_it_appears(algorithm, what, monkeypatch):
    trainer = Trainer(config(algorithm))
    trainer.update()
    if what == "weight":
        next(trainer.network.parameters()).data.view(-1)[0] = torch.nan
    else:
        collect = trainer.collector.collect

        def poisoned():
            batch = collect()
            batch["next", "reward"][0, -1] = torch.nan
            return batch

        monkeypatch.setattr(trainer.collector, "collect", poisoned)
    words = "a reward is not finite" if what == "reward" else "nan"
    with pytest.raises(
        NonFiniteError, match=rf"update 2 \(after {ENVS * STEPS} frames\): .*{words}"
    ):
        trainer.update()


@algorithms
def test_weights_that_a_step_makes_infinite_are_named(algorithm, monkeypatch):
    trainer = Trainer(config(algorithm))
    step = trainer.learner.optimizer.step

    def explode(*args, **kwargs):
        step(*args, **kwargs)
        if trainer.learner.optimizer.state_dict()["state"][0]["step"] == 2:
            trainer.learner.parameters[-1].data.view(-1)[0] = torch.inf

    monkeypatch.setattr(trainer.learner.optimizer, "step", explode)
    with pytest.raises(
        NonFiniteError, match=r"update 1 \(after 0 frames\): the weights .* are not finite"
    ):
        trainer.update()


@algorithms
def test_a_mixed_batch_holds_half_of_each_twin(algorithm):
    trainer = Trainer(config(algorithm, observability="mixed"))
    assert trainer.env.observability.tolist() == [False, False, True, True]
    trainer.update()


@pytest.mark.parametrize(
    ("targets", "waits"),
    [
        ("recompute", {"learning_starts": 8}),
        ("recompute", {"batch_sequences": 8}),
        ("stored", {"learning_starts": 8}),
    ],
)
def test_dqn_waits_for_its_replay_and_then_learns_from_it(targets, waits, tmp_path):
    numbers = {"overlap": 2, "target_every": 0, "targets": targets} | waits
    trainer = Trainer(config("dqn", dqn=numbers), tmp_path)
    first, second = trainer.update(), trainer.update()
    assert (
        "loss" not in first
        and first["grad_steps"] == 0
        and first["replay_frames"] == ENVS * (STEPS + 2)
    )
    assert (
        second["loss"] > 0
        and second["grad_steps"] == 2
        and second["replay_frames"] == 2 * ENVS * (STEPS + 2)
    )
    for _ in range(2):
        row = trainer.update()
    assert row["replay_frames"] == 2 * ENVS * (STEPS + 2)  # 150 frames hold two windows
    assert len(list(tmp_path.iterdir())) == 2
    replay = trainer.learner.replay
    drawn = replay.sample(len(replay), torch.Generator())
    assert ("stored_target" in drawn) == (targets == "stored")


def test_dqn_learns_from_batch_sequences_of_old_and_new_windows(monkeypatch):
    numbers = UPDATE | UPDATE_OF["dqn"] | {"replay_frames": 48}
    training = Training(96, torch.Generator().manual_seed(3), torch.device("cpu"))
    learner = LEARNERS["dqn"](toy_network(3), GROUPS["dqn"](**numbers), training)
    read, prepare = [], learner.loss.prepare
    monkeypatch.setattr(
        learner.loss, "prepare", lambda batch: (read.append(batch), prepare(batch))[1]
    )
    batch = stream(4, 6, seed=6).sequences()
    for window in range(2):
        batch["next", "reward"] = torch.full((4, 6, 1), float(window))
        learner.update(batch, 24 * window)
    assert len(read[1]) == 4
    assert set(read[1]["next", "reward"].unique().tolist()) == {0.0, 1.0}


def test_stored_targets_are_those_of_the_network_that_collected_them():
    trainer = Trainer(
        config(
            "dqn", dqn={"overlap": 2, "target_every": 0, "targets": "stored", "learning_starts": 8}
        )
    )
    batch = trainer.collector.collect().clone()
    numbers = trainer.config.dqn
    whole = DQNLoss(trainer.network, time_limit=numbers.time_limit)  # without a burn-in
    whole.make_value_estimator(gamma=numbers.gamma, lmbda=numbers.lam)
    expected = look_into(whole, batch)[1]
    trainer.learner.update(batch, 0)
    assert "stored_target" not in batch
    drawn = trainer.learner.replay.sample(ENVS, torch.Generator())
    torch.testing.assert_close(drawn["stored_target"], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("every", [1, 2])
def test_the_target_network_is_renewed_every_so_many_updates(every):
    trainer = Trainer(config("dqn", dqn={"target_every": every}))
    seen = []
    for _ in range(4):
        before = trainer.network.head.weight.detach().clone()
        trainer.update()
        target = trainer.learner.loss.target_value_network_params["head", "weight"].data
        seen.append(torch.equal(target, before))
    assert seen == [number % every == 0 for number in range(4)]


def test_a_state_of_dqn_keeps_the_target_network_of_its_moment():
    trainer = Trainer(config("dqn", dqn={"target_every": 1}))
    trainer.update()
    target = trainer.learner.state_dict()["target"]
    before = {name: value.clone() for name, value in target.items()}
    trainer.update()
    assert not torch.equal(
        trainer.learner.state_dict()["target"]["head.weight"], before["head.weight"]
    )
    assert all(torch.equal(target[name], value) for name, value in before.items())


@pytest.mark.parametrize("memory", ["lru", "mingru", "gru"])
def test_an_update_opens_at_most_ten_files_which_the_architecture_page_names(memory):
    root, opened = Path(__file__).resolve().parents[2], {}
    trainer = Trainer(config("pqn", memory))
    batch = trainer.collector.collect()

    def look(frame, event, argument):
        file = Path(frame.f_code.co_filename).resolve()
        if event == "call" and file.parent in (root / "agents", root / "models"):
            opened[str(file.relative_to(root))] = None

    sys.setprofile(look)
    try:
        trainer.learner.update(batch, 0)
    finally:
        sys.setprofile(None)
    page = (
        (root / "docs" / "architecture.md").read_text().partition("What an update of PQN reads")[2]
    )
    table = (
        page.partition("\n\n|")[2]
        .partition("\n\n")[0]
        .replace("models/lru.py", f"models/{memory}.py")
    )
    named = re.findall(r"^\| `(\w+/\w+\.py)`", table, flags=re.MULTILINE)
    assert list(opened) == [file for file in named if file in opened] and 5 < len(opened) <= 10
