"""Runs: their files, their ends, and going on to the bit."""

import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from arcade_torch.agents import (
    CheckpointError,
    NonFiniteError,
    RunFolderError,
    TrainConfig,
    evaluate,
    held_out_seed,
    load,
    preset,
    train,
    training,
)
from arcade_torch.agents import trainer as trainer_module
from arcade_torch.agents.metrics import paper_score
from arcade_torch.agents.runs.checkpoint import list_checkpoints, load_checkpoint
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.agents.runs.folder import EVAL_COLUMNS, METRIC_COLUMNS

CONFIG = preset(
    "smoke", env="CartPoleEasy-v0", total_frames=640, eval_every=256, checkpoint_every=128
)
WITH_OVERLAP = dataclasses.replace(
    CONFIG,
    memory="lru",
    pqn=dataclasses.replace(CONFIG.pqn, overlap=3, bootstrap="last", minibatches=8),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return folder, train(CONFIG, folder)


def weights(folder):
    return load_file(list_checkpoints(folder / "checkpoints")[0] / "weights.safetensors")


def assert_same_run(one: Path, other: Path):
    """Weights, numbers and evaluation are equal to the bit; only times differ."""
    mine, theirs = weights(one), weights(other)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    timeless = [c for c in METRIC_COLUMNS if c not in ("seconds", "fps")]
    rows = [
        [[row[c] for c in timeless] for row in read_csv(f / "metrics.csv")] for f in (one, other)
    ]
    assert rows[0] == rows[1]
    assert (one / "eval.csv").read_text() == (other / "eval.csv").read_text()
    finals = [json.loads((f / "eval.json").read_text()) for f in (one, other)]
    assert all(
        finals[0][k] == finals[1][k] for k in ("returns", "lengths", "mean", "train_max_ewm")
    )


def stop_after(updates, action):
    """A progress callback that acts once, after some updates."""

    def progress(row):
        if row["updates"] == updates:
            action()

    return progress


def assert_goes_on_to_the_bit(config: TrainConfig, folder: Path) -> Path:
    """Train once through and once interrupted after two updates; returns the folder of the
    second.
    """

    def stop() -> None:
        raise KeyboardInterrupt

    train(config, folder / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(config, folder / "parts", progress=stop_after(2, stop))
    train(config, folder / "parts", resume=True)
    assert_same_run(folder / "whole", folder / "parts")
    return folder / "parts"


def test_a_run_leaves_its_files(whole):
    folder, result = whole
    assert (result.status, result.frames) == ("finished", 640)
    rows = read_csv(folder / "metrics.csv")
    assert (
        tuple(rows[0]) == METRIC_COLUMNS and tuple(read_csv(folder / "eval.csv")[0]) == EVAL_COLUMNS
    )
    assert [int(r["frames"]) for r in rows] == list(range(64, 641, 64))
    assert [int(r["grad_steps"]) for r in rows] == [8 * i for i in range(1, 11)]
    assert [int(r["frames"]) for r in read_csv(folder / "eval.csv")] == [256, 512, 640]
    assert float(rows[0]["epsilon"]) == 1.0 and float(rows[-1]["epsilon"]) == 0.05
    assert float(rows[-1]["lr"]) < float(rows[0]["lr"])
    final = json.loads((folder / "eval.json").read_text())
    assert final["status"] == "finished" and len(final["returns"]) == len(final["lengths"]) == 4
    assert result.evaluation.mean == pytest.approx(sum(final["returns"]) / 4)
    points = [
        (int(r["frames"]), float(r["train_return_last"])) for r in rows if r["train_return_last"]
    ]
    assert result.train_max_ewm == pytest.approx(paper_score(*zip(*points, strict=True)))
    progress = json.loads((folder / "progress.json").read_text())
    assert (progress["frames"], progress["total_frames"], progress["status"]) == (
        640,
        640,
        "finished",
    )
    assert len(list_checkpoints(folder / "checkpoints")) == 2
    saved = json.loads((folder / "config.json").read_text())
    assert type(CONFIG).from_dict(saved["config"]) == CONFIG and saved["versions"]["torch"]


def test_an_evaluation_that_is_due_at_the_end_is_made_once(tmp_path):
    train(dataclasses.replace(CONFIG, total_frames=128, eval_every=64), tmp_path)
    assert [int(row["frames"]) for row in read_csv(tmp_path / "eval.csv")] == [64, 128]


def test_resuming_a_finished_run_returns_its_result_at_once(whole, monkeypatch):
    folder, result = whole
    monkeypatch.setattr(training, "Trainer", None)
    again = train(CONFIG, folder, resume=True)
    assert (again.frames, again.train_max_ewm) == (result.frames, result.train_max_ewm)
    assert again.evaluation.returns.tolist() == result.evaluation.returns.tolist()


@pytest.mark.parametrize("left", ["{", None])
def test_a_finished_run_whose_result_is_lost_is_evaluated_again_and_logged_once(
    whole, tmp_path, left
):
    run = shutil.copytree(whole[0], tmp_path / "run")
    (run / "eval.json").write_text(left) if left else (run / "eval.json").unlink()
    assert train(CONFIG, run, resume=True).status == "finished"
    assert_same_run(run, whole[0])


def test_a_folder_that_is_taken_is_refused_and_left_alone(whole, tmp_path):
    folder, _ = whole
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with pytest.raises(RunFolderError, match="resume=True"):
        train(CONFIG, folder)
    with pytest.raises(
        RunFolderError,
        match=r"another run; differing fields: pqn\.lam \(0\.8 != 0\.5\), seed \(0 != 3\)",
    ):
        pqn = dataclasses.replace(CONFIG.pqn, lam=0.5)
        train(dataclasses.replace(CONFIG, seed=3, pqn=pqn), folder, resume=True)
    with pytest.raises(RunFolderError) as error:
        train(preset("small"), folder, resume=True)
    command = f"arcade-torch train --config {folder}/config.json --out {folder} --resume"
    assert str(error.value).endswith(f" more; to go on with it: {command}")
    assert before == {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunFolderError, match="is not empty; choose another folder"):
        train(CONFIG, tmp_path, resume=True)


def test_a_bare_name_is_the_run_of_the_version_it_means(whole, monkeypatch):
    monkeypatch.setattr(training, "Trainer", None)
    assert (
        train(dataclasses.replace(CONFIG, env="CartPoleEasy"), whole[0], resume=True).status
        == "finished"
    )


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot write to"):
        train(CONFIG, tmp_path / "file" / "run")


def test_an_unknown_game_leaves_no_folder_behind(tmp_path):
    with pytest.raises(ValueError, match="CartPoleEasy"):
        train(dataclasses.replace(CONFIG, env="CartPolEasy"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_run_at_an_update_and_it_goes_on_to_the_bit(whole, tmp_path, number):
    handler = signal.getsignal(number)
    result = train(
        CONFIG, tmp_path / "run", progress=stop_after(3, lambda: os.kill(os.getpid(), number))
    )
    assert (result.status, result.frames, result.evaluation) == ("interrupted", 192, None)
    assert json.loads((tmp_path / "run" / "progress.json").read_text())["status"] == "interrupted"
    assert list_checkpoints(tmp_path / "run" / "checkpoints")[0].name == "frames-000000000192"
    assert signal.getsignal(number) is handler
    assert train(CONFIG, tmp_path / "run", resume=True).status == "finished"
    assert_same_run(tmp_path / "run", whole[0])
    rows = read_csv(tmp_path / "run" / "metrics.csv")
    clock = np.cumsum([64 / float(row["fps"]) for row in rows])  # goes on where it stood
    np.testing.assert_allclose([float(row["seconds"]) for row in rows], clock, rtol=1e-5)


def test_a_run_with_overlap_goes_on_to_the_bit(tmp_path):
    train(WITH_OVERLAP, tmp_path / "whole")
    stop = stop_after(4, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert train(WITH_OVERLAP, tmp_path / "parts", progress=stop).status == "interrupted"
    train(WITH_OVERLAP, tmp_path / "parts", resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")


def test_rows_after_the_checkpoint_are_not_kept_twice(whole, tmp_path):
    def crash():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(CONFIG, tmp_path / "run", progress=stop_after(5, crash))
    assert json.loads((tmp_path / "run" / "progress.json").read_text())["status"] == "failed"
    assert len(read_csv(tmp_path / "run" / "metrics.csv")) == 5  # the checkpoint is at 4
    train(CONFIG, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole[0])


def test_a_run_that_died_before_its_first_checkpoint_starts_again(whole, tmp_path):
    def crash():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(CONFIG, tmp_path / "run", progress=stop_after(1, crash))
    train(CONFIG, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole[0])


def test_a_damaged_newest_checkpoint_costs_only_the_way_since_the_one_before(whole, tmp_path):
    stop = stop_after(6, lambda: os.kill(os.getpid(), signal.SIGTERM))
    train(CONFIG, tmp_path / "run", progress=stop)
    newest = list_checkpoints(tmp_path / "run" / "checkpoints")[0]
    (newest / "trainer.pt").write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="going on from frames-000000000256"):
        train(CONFIG, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole[0])


def assert_a_nan_stops(config, folder, monkeypatch):
    """A weight becomes NaN behind the checkpoint of frame 128, which is what the run leaves."""
    made = []
    real = training.Trainer

    def spy(*args):
        made.append(real(*args))
        return made[-1]

    def poison():
        next(made[0].network.parameters()).data.view(-1)[0] = torch.nan

    words = (
        r"update 4 \(after 192 frames\): the loss is nan at gradient step 1 of .*last good "
        r"checkpoint is .*128"
    )
    with monkeypatch.context() as patched:
        patched.setattr(training, "Trainer", spy)
        with pytest.raises(NonFiniteError, match=words):
            train(config, folder, progress=stop_after(3, poison))
    names = [path.name for path in list_checkpoints(folder / "checkpoints")]
    assert names == ["frames-000000000128"]
    assert all(w.isfinite().all() for w in weights(folder).values())


def test_a_nan_stops_the_run_and_names_where(tmp_path, monkeypatch):
    assert_a_nan_stops(CONFIG, tmp_path / "run", monkeypatch)
    assert load(tmp_path / "run").frames == 128
    error = json.loads((tmp_path / "run" / "progress.json").read_text())["error"]
    assert "the loss is nan at gradient step 1 of 8" in error


def test_a_resumed_learner_keeps_the_tensor_that_its_step_size_is_on_a_gpu() -> None:
    """It took over the checkpoint's, which is on the CPU and which no graph reads."""
    trainer = training.Trainer(CONFIG)
    group, rate = trainer.learner.optimizer.param_groups[0], torch.tensor(0.5)
    group["lr"] = rate
    trainer.learner.load_state_dict(trainer.learner.state_dict())
    trainer.close()
    assert trainer.learner.optimizer.param_groups[0]["lr"] is rate


def test_averages_that_an_older_version_laid_out_otherwise_are_those_of_their_weights() -> None:
    """Adam's fused kernel pairs numbers by their place in memory, whatever the strides say."""
    trainer = training.Trainer(CONFIG)
    trainer.update()
    saved = trainer.learner.state_dict()["optimizer"]["state"]
    plain = {index: average["exp_avg"].clone() for index, average in saved.items()}
    reordered = [index for index, average in plain.items() if average.ndim == 4]
    assert reordered
    for index in reordered:
        for name in ("exp_avg", "exp_avg_sq"):
            saved[index][name] = saved[index][name].to(memory_format=torch.channels_last)
    trainer.learner.load_state_dict(trainer.learner.state_dict())
    trainer.close()
    averages = trainer.learner.optimizer.state
    for index, parameter in enumerate(trainer.learner.parameters):
        for name in ("exp_avg", "exp_avg_sq"):
            assert averages[parameter][name].stride() == parameter.stride()
        assert torch.equal(averages[parameter]["exp_avg"], plain[index])


def test_a_gpu_that_is_not_there_is_refused_in_one_line_and_leaves_no_folder_behind(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        ValueError,
        match=r"^device is 'cuda', but torch sees no GPU: .*, or use 'cpu'$",
    ):
        train(dataclasses.replace(CONFIG, device="cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_generator_that_is_saved_is_that_of_the_device_on_which_actions_are_drawn(monkeypatch):
    class Made(Exception):
        pass

    def stop(*_):
        raise Made

    monkeypatch.setattr(
        trainer_module, "pick_devices", lambda device: (torch.device(device), None), raising=False
    )
    monkeypatch.setattr(trainer_module, "build_network", lambda config: None)
    monkeypatch.setitem(trainer_module.LEARNERS, "pqn", stop)
    generators = [torch.Generator(), torch.Generator()]
    monkeypatch.setattr(torch.cuda, "default_generators", generators)
    trainer = object.__new__(training.Trainer)
    with pytest.raises(Made):
        trainer.__init__(dataclasses.replace(CONFIG, device="cuda:1"))
    assert trainer.random is generators[1]


KILLED = """
import sys
from arcade_torch.agents import TrainConfig, train
import json
train(TrainConfig.from_dict(json.loads(sys.argv[1])), sys.argv[2])
"""


def kill_and_resume(folder: Path, rng: random.Random, config: TrainConfig = CONFIG) -> int:
    """Start a run in another process, kill it at a random moment, go on here; returns how many rows
    it had left.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, json.dumps(config.to_dict()), str(folder)]
    )
    try:
        rows, deadline = rng.randint(1, config.num_updates - 1), time.monotonic() + 120
        log = folder / "metrics.csv"
        while process.poll() is None and not (log.is_file() and log.read_text().count("\n") > rows):
            assert time.monotonic() < deadline, "the run does not get on"
            time.sleep(0.002)
        time.sleep(rng.random() * 0.05)
    finally:
        process.kill()
        process.wait()
    left = len(read_csv(log))
    assert train(config, folder, resume=True).status == "finished"
    return left


@pytest.mark.parametrize("seed", [0])
def test_a_killed_run_goes_on_to_the_bit(whole, tmp_path, seed):
    kill_and_resume(tmp_path / "run", random.Random(seed))
    assert_same_run(tmp_path / "run", whole[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 14))
def test_a_run_killed_at_many_moments_goes_on_to_the_bit(whole, tmp_path, seed):
    kill_and_resume(tmp_path / "run", random.Random(seed))
    assert_same_run(tmp_path / "run", whole[0])


@pytest.mark.parametrize("threads", [0, 2])
def test_a_run_has_threads_and_draws_of_its_own_and_gives_back_those_it_found(threads):
    before, draws = torch.get_num_threads(), torch.get_rng_state()
    with training.own_settings(dataclasses.replace(CONFIG, seed=3, threads=threads)):
        assert torch.get_num_threads() == (threads or before) and torch.initial_seed() == 3
        torch.rand(1)
    assert torch.get_num_threads() == before and torch.equal(torch.get_rng_state(), draws)


def test_everything_that_a_run_draws_goes_by_its_seed():
    """Runs that share weights, actions, games or the order of minibatches are no two seeds."""
    one, other = (trainer_module.Trainer(dataclasses.replace(CONFIG, seed=seed)) for seed in (0, 1))
    states = [[t.random_state, t.shuffle.get_state()] for t in (one, other)]
    weights_of = [torch.cat([p.flatten() for p in t.network.parameters()]) for t in (one, other)]
    for mine, theirs in [*zip(*states, strict=True), weights_of]:
        assert not torch.equal(mine, theirs)
    other.random_state = one.random_state.clone()
    windows = []
    for trainer in (one, other):
        trainer.collector._generator.manual_seed(0)  # the same actions in other games
        with trainer._own_settings():
            windows.append(trainer.collector.collect(random=True))
        trainer.close()
    assert torch.equal(windows[0]["action"], windows[1]["action"])
    assert not torch.equal(windows[0]["pixels"], windows[1]["pixels"])


def test_the_same_seed_gives_the_same_run_and_another_seed_another(whole, tmp_path):
    train(CONFIG, tmp_path / "same")
    assert_same_run(tmp_path / "same", whole[0])
    train(dataclasses.replace(CONFIG, seed=1), tmp_path / "other")
    assert any(
        not torch.equal(w, v)
        for w, v in zip(
            weights(tmp_path / "other").values(), weights(whole[0]).values(), strict=True
        )
    )


def test_an_agent_is_loaded_from_a_run_or_a_checkpoint(whole):
    folder, result = whole
    newest, previous = list_checkpoints(folder / "checkpoints")
    agent = load(folder)
    assert agent.frames == result.frames and agent.config == CONFIG
    saved = load_file(newest / "weights.safetensors")
    assert all(torch.equal(v, saved[k]) for k, v in agent.network.state_dict().items())
    assert (
        load(newest).frames == 640
        and load(previous).frames == 512
        and load(folder / "checkpoints").frames == 640
    )
    again = evaluate(agent, episodes=4)
    assert again.returns.tolist() == result.evaluation.returns.tolist()


def test_the_weights_that_act_are_evaluated_saved_and_loaded(tmp_path):
    numbers = dataclasses.asdict(CONFIG.learner) | {"average_share": 0.5}
    config = dataclasses.replace(CONFIG, **{CONFIG.algorithm: type(CONFIG.learner)(**numbers)})
    result = train(config, tmp_path)
    agent, (newest, _) = load(tmp_path), list_checkpoints(tmp_path / "checkpoints")
    trained = load_checkpoint(newest).trainer["network"]
    assert any(
        not torch.equal(value, trained[name]) for name, value in agent.network.state_dict().items()
    )
    assert evaluate(agent, episodes=4).returns.tolist() == result.evaluation.returns.tolist()


def test_loading_nothing_says_what_was_found(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        load(tmp_path / "absent")
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="is not a folder"):
        load(tmp_path / "file")
    (tmp_path / "file").unlink()
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        load(tmp_path)


def test_bad_evaluation_arguments_are_named(whole):
    agent = load(whole[0])
    for change, words in (
        ({"episodes": 0}, "episodes"),
        ({"seed": -1}, "seed"),
        ({"observability": "half"}, "'full'"),
    ):
        with pytest.raises(ValueError, match=words):
            evaluate(agent, **change)


def test_evaluation_seeds_are_none_of_training():
    most = preset("paper", seed=2**30 - 1).seed
    seeds = [held_out_seed(seed) for seed in (0, 1, 2**30 - 1)]
    assert min(seeds) > most and len(set(seeds)) == 3
    with pytest.raises(ValueError, match="seed"):
        held_out_seed(2**30)
