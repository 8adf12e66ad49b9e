"""Every algorithm with every memory: acting is learning, updates work, a saved moment goes on to the bit."""

import io

import pytest
import torch

from arcade_torch.agents import Agent, NonFiniteError, preset
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.algorithms import ALGORITHMS
from arcade_torch.agents.config import GROUPS
from arcade_torch.agents.plain import from_plain, to_plain
from arcade_torch.agents.run_folder import METRIC_COLUMNS
from arcade_torch.agents.trainer import Trainer
from arcade_torch.models import memory_names

MEMORIES = [*memory_names(), "feedforward"]
ENVS, STEPS = 4, 12
NUMBERS = {"num_envs": ENVS, "num_steps": STEPS, "minibatches": 2, "warmup_steps": STEPS, "epochs": 1}
REPLAY = {"replay_frames": 150, "batch_sequences": 4, "learning_starts": 4, "target_every": 2}
MORE = {"pqn": {}, "ppo": {}, "dqn": REPLAY}
TIMES = ("seconds", "fps")


def config(algorithm, memory="gru", env="CartPoleEasy", **changes):
    numbers = NUMBERS | MORE[algorithm] | changes.pop(algorithm, {})
    options = {"hidden_size": 16, "feedforward_size": 16} | changes.pop("network_options", {})
    changes = {"total_frames": 10 * ENVS * STEPS, "observability": "partial", "network_options": options} | changes
    return preset("smoke", algorithm=algorithm, memory=memory, env=env, **changes, **{algorithm: numbers})


def saved(trainer):
    """A checkpoint as it would stand in the file."""
    stream = io.BytesIO()
    torch.save(to_plain({"weights": trainer.network.state_dict(), "state": trainer.state_dict()}), stream)
    stream.seek(0)
    return from_plain(torch.load(stream, weights_only=True))


def without_times(row):
    return {key: value for key, value in row.items() if key not in TIMES}


def assert_replays(trainer, batch):
    """What the loss computes from the stored window is what the actor saw, before the first gradient step."""
    loss = trainer.learner.loss
    window = loss.read(batch)
    if trainer.config.algorithm == "ppo":
        prepared = loss.prepare(window, rows_at_once=2)
        out = loss.compute(prepared)
        pairs = [(out.log_prob, batch["action_log_prob"]), (out.state_value, batch["state_value"])]
        pairs.append((prepared.extras["state_value"], batch["state_value"]))
    else:
        pairs = [(loss.compute(window).q_value, batch["q_value"])]
    for replayed, acted in pairs:
        assert acted.std() > 1e-4 and (replayed - acted).abs().max() < 1e-5


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_acting_is_learning_and_a_saved_moment_goes_on_to_the_bit(algorithm, memory, monkeypatch, tmp_path):
    trainer, rows = Trainer(config(algorithm, memory), tmp_path), []
    if algorithm != "ppo":
        trainer.actor.record_q = True
    trainer.warm_up()
    collected = []
    collect = trainer.collector.collect
    monkeypatch.setattr(trainer.collector, "collect", lambda: collected.append(collect()) or collected[-1])
    learn, checked = trainer.learner.learn, []

    def check_then_learn(batch, frames):
        with torch.no_grad():
            assert_replays(trainer, batch)
        checked.append(bool(batch["next", "done"][:, :-1].any()))
        return learn(batch, frames)

    monkeypatch.setattr(trainer.learner, "learn", check_then_learn)
    trainer.update()
    moment = saved(trainer)
    rows = [trainer.update() for _ in range(2)]
    assert any(checked), "a window must hold an episode's end"
    again = Trainer(config(algorithm, memory), tmp_path)
    if algorithm != "ppo":
        again.actor.record_q = True
    again.load(moment["weights"], moment["state"])
    assert [without_times(again.update()) for _ in range(2)] == [without_times(row) for row in rows]
    mine, theirs = again.network.state_dict(), trainer.network.state_dict()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    assert any(not torch.equal(moment["weights"][name], theirs[name]) for name in theirs)


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_three_updates_of_another_game_are_finite_and_train_every_parameter(algorithm, memory):
    trainer = Trainer(config(algorithm, memory, "MineSweeperEasy"))
    trainer.warm_up()
    before = {name: value.clone() for name, value in trainer.network.named_parameters()}
    for _ in range(3):
        row = trainer.update()
    assert set(row) <= set(METRIC_COLUMNS)
    assert all(torch.tensor(float(value)).isfinite() for value in row.values() if value is not None)
    still = [name for name, value in trainer.network.named_parameters() if torch.equal(value, before[name])]
    assert not still


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("what", ["weight", "reward"])
def test_nan_is_found_in_the_update_in_which_it_appears(algorithm, what, monkeypatch):
    trainer = Trainer(config(algorithm))
    trainer.update()
    if what == "weight":
        next(trainer.network.parameters()).data.view(-1)[0] = torch.nan
    else:
        collect = trainer.collector.collect
        monkeypatch.setattr(trainer.collector, "collect", lambda: _with_nan_reward(collect()))
    with pytest.raises(NonFiniteError, match=rf"update 2 \(after {ENVS * STEPS} frames\)"):
        trainer.update()


def _with_nan_reward(batch):
    batch["next", "reward"][0, -1] = torch.nan
    return batch


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_mixed_batch_holds_half_of_each_twin(algorithm):
    trainer = Trainer(config(algorithm, observability="mixed"))
    assert trainer.env.observability.tolist() == [False, False, True, True]
    trainer.update()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gamma_zero_learns_rewards(algorithm):
    trainer = Trainer(config(algorithm, **{algorithm: {"gamma": 0.0}}))
    loss = trainer.learner.loss
    window = loss.read(trainer.collector.collect())
    target = loss.prepare(window).extras["value_target"] if algorithm == "ppo" else loss.compute(window).target
    torch.testing.assert_close(target, window.reward, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("stored", [False, True])
def test_dqn_waits_for_its_replay_and_then_learns_from_it(stored, tmp_path):
    numbers = {"context": 2, "learning_starts": 8, "target_every": 0, "targets": "stored" if stored else "recompute"}
    trainer = Trainer(config("dqn", dqn=numbers), tmp_path)
    first, second = trainer.update(), trainer.update()
    assert "loss" not in first and first["grad_steps"] == 0 and first["replay_frames"] == ENVS * (STEPS + 2)
    assert second["loss"] > 0 and second["grad_steps"] == 2 and second["replay_frames"] == 2 * ENVS * (STEPS + 2)
    for _ in range(3):
        row = trainer.update()
    assert row["replay_frames"] == 2 * ENVS * (STEPS + 2)  # 150 frames hold two windows
    assert not tmp_path.exists() or not list(tmp_path.iterdir())  # small: nothing on disk before a checkpoint


def test_a_mapped_replay_trains_like_one_in_memory(tmp_path):
    one, other = (Trainer(config("dqn", dqn={"replay_ram": ram}), tmp_path / str(ram)) for ram in (0, 10**9))
    rows = [[without_times(trainer.update()) for _ in range(3)] for trainer in (one, other)]
    assert rows[0] == rows[1]
    assert one.learner.replay.mapped and list((tmp_path / "0").iterdir()) and not other.learner.replay.mapped


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_agent_says_what_its_outputs_are(algorithm):
    c = config(algorithm)
    agent = Agent(c, build_network(c))
    frames = torch.randint(256, (1, 3, 32, 32, 3), dtype=torch.uint8)
    last, flags = torch.zeros(1, 3, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.bool)
    out, _ = agent.network(frames, last, flags, agent.initial_state(1))
    assert agent.offers == (("logits", "probs", "value") if algorithm == "ppo" else ("q", "value"))
    assert agent.outputs(out, "value").shape == (1, 3, 1)
    if algorithm == "ppo":
        probs = agent.outputs(out, "probs")
        torch.testing.assert_close(probs, agent.outputs(out, "logits").softmax(-1))
        value, _ = agent.network.critic(frames, last, flags, agent.initial_state(1)["critic"])
        torch.testing.assert_close(agent.outputs(out, "value"), value)
    else:
        assert torch.equal(agent.outputs(out, "q"), out) and out.shape == (1, 3, 5)
        assert torch.equal(agent.outputs(out, "value")[..., 0], out.max(-1).values)
    with pytest.raises(ValueError, match=r"offers .*, not 'advantage'"):
        agent.outputs(out, "advantage")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_schedule_is_counted_in_frames(algorithm):
    numbers = GROUPS[algorithm]()
    total = 20_000_000
    fall = {"ppo": total}.get(algorithm, 2_000_000)
    start, end = numbers.learning_rate, numbers.learning_rate_end
    for frames in (0, fall // 2, fall, total):
        expected = end if frames >= fall else start + (end - start) * frames / fall
        assert numbers.learning_rate_at(frames, total) == pytest.approx(expected)
    if algorithm != "ppo":
        assert [numbers.epsilon_at(f, total) for f in (0, 4_000_000, 8_000_000, total)] == pytest.approx(
            [1.0, 0.525, 0.05, 0.05]
        )
    assert (total // numbers.frames_per_update, numbers.grad_steps_per_update) == (9_765, 64)
