"""Whole runs of every algorithm: files, an abrupt stop, a NaN, loading."""

import dataclasses
import json
import random
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.agents import (
    CheckpointError,
    evaluate,
    load,
    preset,
    train,
)
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.policy import build_network
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.models import check_memory, linear_scan, register_memory, registry
from tests.agents.test_training import (
    assert_a_nan_stops,
    assert_same_run,
    kill_and_resume,
    stop_after,
)

ALGORITHMS = ("ppo", "dqn")  # PQN: test_training
CHANGES = {
    "env": "CartPoleEasy-v0",
    "memory": "gru",
    "total_frames": 256,
    "checkpoint_every": 128,
    "eval_episodes": 4,
}
TARGET = {"dqn": {"target_every": 2}}


def config(algorithm, **more):
    return preset("smoke", algorithm=algorithm, **CHANGES, **more)


@pytest.fixture(scope="module", params=ALGORITHMS)
def whole(request, tmp_path_factory):
    """An uninterrupted run."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    what = config(request.param)
    return what, folder, train(what, folder)


def crash():
    raise ZeroDivisionError


@pytest.mark.parametrize("updates", [1, 3])
def test_an_abrupt_stop_before_and_after_a_checkpoint_costs_nothing_but_time(
    whole, tmp_path, updates
):
    what, folder, _ = whole
    with pytest.raises(ZeroDivisionError):
        train(what, tmp_path / "run", progress=stop_after(updates, crash))
    assert train(what, tmp_path / "run", resume=True).status == "finished"
    assert_same_run(tmp_path / "run", folder)


def test_a_killed_run_goes_on_to_the_bit_in_another_process(whole, tmp_path):
    what, folder, _ = whole
    kill_and_resume(
        tmp_path / "run", random.Random(5), what
    )  # three updates, the checkpoint is of two
    assert_same_run(tmp_path / "run", folder)


def test_a_replay_with_a_target_network_goes_on_to_the_bit(tmp_path):
    what = config("dqn", **TARGET)
    train(what, tmp_path / "whole")
    with pytest.raises(ZeroDivisionError):
        train(what, tmp_path / "parts", progress=stop_after(3, crash))
    train(what, tmp_path / "parts", resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")
    names = [
        sorted(p.name for p in (tmp_path / run / "replay").iterdir()) for run in ("parts", "whole")
    ]
    assert names[0] == names[1] and all(name.startswith("window-") for name in names[0])


@pytest.mark.parametrize("whole", ["dqn"], indirect=True)
def test_a_damaged_file_of_the_replay_costs_only_the_way_since_the_checkpoint_before(
    whole, tmp_path
):
    what, folder, _ = whole
    what = dataclasses.replace(what, checkpoint_every=64)
    with pytest.raises(ZeroDivisionError):
        train(what, tmp_path / "run", progress=stop_after(3, crash))
    newest = sorted((tmp_path / "run" / "replay").iterdir())[-1]
    newest.write_bytes(newest.read_bytes()[:-4])
    with pytest.warns(RuntimeWarning, match="is damaged.*going on from frames-000000000128"):
        train(what, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", folder)


@pytest.mark.parametrize("whole", ["dqn"], indirect=True)
def test_without_any_whole_replay_the_run_is_refused(whole, tmp_path):
    what, *_ = whole
    with pytest.raises(ZeroDivisionError):
        train(what, tmp_path / "run", progress=stop_after(3, crash))
    for file in (tmp_path / "run" / "replay").iterdir():
        file.unlink()
    with pytest.raises(CheckpointError, match=r"no whole checkpoint.*is missing"):
        train(what, tmp_path / "run", resume=True)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_nan_stops_the_run_and_the_last_good_checkpoint_stays(algorithm, tmp_path, monkeypatch):
    assert_a_nan_stops(config(algorithm), tmp_path / "run", monkeypatch)
    assert train(config(algorithm), tmp_path / "run", resume=True).status == "finished"


def test_an_agent_is_loaded_and_plays_as_in_the_last_evaluation(whole):
    what, folder, result = whole
    agent = load(folder)
    assert agent.frames == result.frames == 256 and agent.config == what
    assert evaluate(agent, episodes=4).returns.tolist() == result.evaluation.returns.tolist()
    state = agent.initial_state(4)
    from arcade_torch.agents.evaluation import make_eval_env

    obs = make_eval_env(what, 4).reset()
    action, extras, _ = agent.act(obs, state)
    best = extras["logits" if what.algorithm == "ppo" else "q_value"].argmax(-1)
    assert torch.equal(action, best) and torch.equal(
        agent.act(obs, state)[0], action
    )  # greedy: no draw


def test_metrics_have_the_columns_of_their_algorithm(whole):
    what, folder, _ = whole
    rows = read_csv(folder / "metrics.csv")
    filled = {name for name, value in rows[-1].items() if value}
    of_ppo, of_q = (
        {"policy_loss", "value_loss", "entropy", "kl", "clip_fraction"},
        {"epsilon", "replay_frames"},
    )
    assert (of_ppo <= filled, bool(of_q & filled)) == (
        what.algorithm == "ppo",
        what.algorithm != "ppo",
    )
    assert {"loss", "q_mean", "td_error", "grad_norm", "lr", "episodes"} <= filled
    if what.algorithm == "dqn":
        assert not rows[0]["loss"] and rows[0]["replay_frames"]


def test_config_json_repeats_the_run(whole):
    what, folder, _ = whole
    saved = TrainConfig.from_dict(json.loads((folder / "config.json").read_text())["config"])
    assert saved == what
    changed = dataclasses.replace(what, pqn=dataclasses.replace(what.pqn, gamma=0.5))
    assert (
        train(changed, folder, resume=True).status == "finished"
    )  # PQN's numbers are not this run's


def test_a_mixed_run_is_evaluated_on_both_twins(tmp_path):
    what = config("ppo", observability="mixed")
    result = train(what, tmp_path / "run")
    full, partial = (
        evaluate(load(tmp_path / "run"), twin, episodes=4).returns.tolist()
        for twin in ("full", "partial")
    )
    assert result.evaluation.returns.tolist() == full[:2] + partial[2:]


class ComplexWeights(nn.Module):
    """h_t = lambda h_{t-1} + B x_t with lambda and B as they stand in a paper."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.input_size = input_size
        self.hidden_size = hidden_size
        self.decay = nn.Parameter(torch.polar(torch.rand(hidden_size), 3 * torch.rand(hidden_size)))
        self.input = nn.Parameter(0.1 * torch.randn(hidden_size, input_size, dtype=torch.complex64))
        self.output = nn.Linear(2 * hidden_size, hidden_size)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        written = F.linear(x.to(self.input.dtype), self.input)
        start = torch.view_as_complex(state["h"].contiguous())
        h = torch.view_as_real(linear_scan(self.decay, written, is_init, start))
        last = TensorDict({"h": h[:, -1].clone()}, batch_size=[len(x)])
        return self.output(h.flatten(-2)), last

    def initial_state(self, batch_size: int) -> TensorDict:
        zeros = self.output.weight.new_zeros(batch_size, self.hidden_size, 2)
        return TensorDict({"h": zeros}, batch_size=[batch_size])


@pytest.mark.parametrize(
    ("algorithm", "numbers"), [("pqn", {}), ("ppo", {"average_share": 0.3}), ("dqn", TARGET["dqn"])]
)
def test_a_memory_with_complex_weights_is_trained_and_goes_on_to_the_bit(
    algorithm: str, numbers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    register_memory("complex_weights", ComplexWeights)
    check_memory(ComplexWeights(3, 4))
    what = preset(
        "smoke",
        algorithm=algorithm,
        **CHANGES | {"memory": "complex_weights"},
        **{algorithm: numbers},
    )
    train(what, tmp_path / "whole")
    with pytest.raises(ZeroDivisionError):
        train(what, tmp_path / "parts", progress=stop_after(3, crash))
    train(what, tmp_path / "parts", resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")
    begun = build_network(what).state_dict()
    learned = load(tmp_path / "whole").network.state_dict()
    for name, weight in begun.items():
        if weight.is_complex():
            assert (learned[name] - weight).abs().min() > 0, name
