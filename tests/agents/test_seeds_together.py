"""Several seeds in one process: each as if alone, in folders that everything else reads, resumable."""

import dataclasses
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from arcade_torch.agents import CheckpointError, NonFiniteError, TrainConfig, load, preset, train, train_seeds
from arcade_torch.agents.checkpoint import list_checkpoints, load_latest
from arcade_torch.agents.files import read_csv, read_json
from arcade_torch.agents.optim import clip_gradients
from arcade_torch.agents.run_folder import RunFolderError
from arcade_torch.agents.seed_learner import SeedLearner, clip_each
from arcade_torch.agents.seed_trainer import SeedTrainer
from arcade_torch.agents.trainer import Trainer
from arcade_torch.models import make_network, memory_names
from arcade_torch.models.stacked import StackedNetworks

SEEDS = (3, 7)
TOLERANCE = 1e-5  # of the norm of a weight; measured after 6 updates: 2e-7
CONTEXT = {"context": 3, "time_limit": "bootstrap"}


def _config(**changes: Any) -> TrainConfig:
    return preset("smoke", env="CartPoleEasy", **changes)


def _distance(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> float:
    """Largest relative difference of a tensor."""
    assert one.keys() == other.keys()
    pairs = [(one[name].detach().double(), other[name].detach().double()) for name in one]
    return max((float((a - b).norm() / b.norm().clamp_min(1e-12)) for a, b in pairs), default=0.0)


def _flat(nested: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in nested.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + str(name): value}
    return flat


@pytest.mark.parametrize("pqn", [{}, CONTEXT, {**CONTEXT, "bootstrap": "last"}], ids=["small", "context", "last"])
def test_each_seed_is_trained_as_it_would_be_alone(pqn: dict[str, Any]) -> None:
    config = _config(memory="gru", observability="mixed", pqn=pqn)
    group = SeedTrainer(config, SEEDS)
    alone = [Trainer(dataclasses.replace(config, seed=seed)) for seed in SEEDS]
    group.warm_up()
    for trainer in alone:
        trainer.warm_up()
    for _ in range(4):
        group.update()
        for lane, trainer in zip(group.lanes, alone, strict=True):
            row = trainer.update()
            assert lane.row.keys() == row.keys()
            exact = ("frames", "updates", "grad_steps", "epsilon", "lr", "train_return", "train_return_last")
            assert [lane.row[name] for name in exact] == [row[name] for name in exact]
            close = ("loss", "grad_norm", "q_mean", "td_error")
            assert [lane.row[name] for name in close] == pytest.approx([row[name] for name in close], rel=1e-4)
            assert _distance(lane.network.state_dict(), trainer.network.state_dict()) < TOLERANCE
            mine, its = _flat(lane.state_dict()), _flat(trainer.state_dict())
            walked = [name for name in its if name.startswith(("collector.env_state_dict", "explore", "shuffle"))]
            assert len(walked) > 5 and all(torch.equal(mine[name], its[name]) for name in walked)


@pytest.mark.parametrize("memory", [*memory_names(), "feedforward"])
def test_stacked_networks_and_their_gradients_are_those_of_the_networks(memory: str) -> None:
    alone = [make_network("small", memory) for _ in SEEDS]
    twins = [make_network("small", memory) for _ in SEEDS]
    for one, twin in zip(alone, twins, strict=True):
        twin.load_state_dict(one.state_dict())
    stack = StackedNetworks(twins)
    pixels = torch.randint(0, 256, (6, 5, 32, 32, 3), dtype=torch.uint8)
    last_action, is_init = torch.randint(0, 5, (6, 5)), torch.rand(6, 5) < 0.3
    out, state = stack(pixels, last_action, is_init, stack.initial_state(6))
    out.square().sum().backward()
    for index, network in enumerate(alone):
        rows = slice(3 * index, 3 * index + 3)
        own, after = network(pixels[rows], last_action[rows], is_init[rows], network.initial_state(3))
        own.square().sum().backward()
        assert torch.allclose(out[rows], own, atol=1e-5)
        assert _distance(_flat(state[rows].to_dict()), _flat(after.to_dict())) < TOLERANCE
        for name, parameter in network.named_parameters():
            stacked = stack.get_parameter(name.replace(".", "/")).grad
            assert (parameter.grad is None) == (stacked is None)
            if stacked is not None and parameter.grad is not None:
                assert torch.allclose(stacked[index], parameter.grad, rtol=1e-3, atol=1e-5)


def test_both_ways_to_run_the_encoders_give_the_same() -> None:
    stack = StackedNetworks([make_network("small", "mlp") for _ in SEEDS])
    pixels = torch.randint(0, 256, (6, 2, 32, 32, 3), dtype=torch.uint8)
    assert torch.allclose(stack.encode_in_turn(pixels), stack.encode_fused(pixels), atol=1e-5)


def test_what_happens_to_a_network_shows_in_the_stack_and_back() -> None:
    networks = [make_network("small", "gru") for _ in SEEDS]
    stack, other = StackedNetworks(networks), make_network("small", "gru")
    networks[1].load_state_dict(other.state_dict())
    name = "block.linear.weight"
    stacked = stack.get_parameter(name.replace(".", "/"))
    assert torch.equal(stacked[1], other.get_parameter(name))
    with torch.no_grad():
        stacked.zero_()
    assert not networks[0].get_parameter(name).any() and not networks[1].get_parameter(name).any()


@pytest.mark.parametrize("limit", [1e-3, 2.0, 1e3])
def test_every_network_is_clipped_by_its_own_norm(limit: float) -> None:
    shapes = [(), (3,), (4, 5)]
    stacked = [torch.nn.Parameter(torch.zeros(2, *shape)) for shape in shapes]
    for parameter in stacked:
        parameter.grad = torch.randn_like(parameter) * torch.tensor([0.1, 10.0]).view(2, *[1] * (parameter.ndim - 1))
    alone = [[torch.nn.Parameter(torch.zeros(shape)) for shape in shapes] for _ in range(2)]
    for group, parameters in enumerate(alone):
        for parameter, stack in zip(parameters, stacked, strict=True):
            assert stack.grad is not None
            parameter.grad = stack.grad[group].clone()
    norms = clip_each(stacked, limit)
    assert torch.allclose(norms, torch.stack([clip_gradients(parameters, limit) for parameters in alone]))
    for group, parameters in enumerate(alone):
        for parameter, stack in zip(parameters, stacked, strict=True):
            assert stack.grad is not None and parameter.grad is not None
            assert torch.allclose(stack.grad[group], parameter.grad)


def test_every_folder_is_that_of_a_run(tmp_path: Path) -> None:
    config = _config(total_frames=256)
    seen: list[Mapping[str, Any]] = []
    results = train_seeds(config, SEEDS, tmp_path, progress=seen.append)
    assert [result.status for result in results] == ["finished", "finished"]
    assert [row["frames"] for row in seen] == [128, 256, 384, 512] and seen[-1]["total_frames"] == 512
    for seed, result in zip(SEEDS, results, strict=True):
        folder = tmp_path / f"seed{seed}"
        assert result.run_dir == folder and read_json(folder / "config.json")["config"]["seed"] == seed
        assert [int(row["frames"]) for row in read_csv(folder / "metrics.csv")] == [64, 128, 192, 256]
        agent = load(folder)
        assert agent.config.seed == seed and agent.frames == 256
        alone = train(dataclasses.replace(config, seed=seed), tmp_path / "alone" / str(seed))
        assert _distance(agent.network.state_dict(), load(alone.run_dir).network.state_dict()) < TOLERANCE
        names = [sorted(p.name for p in each.iterdir()) for each in (folder, alone.run_dir)]
        assert names[0] == names[1]
    again = train_seeds(config, SEEDS, tmp_path, resume=True)
    assert [result.frames for result in again] == [256, 256]


def _states(folder: Path) -> dict[str, Any]:
    """Weights and state of the newest checkpoint, without times."""
    found = load_latest(folder / "checkpoints")
    flat = _flat({"weights": found.weights, "trainer": found.trainer})
    return {name: value for name, value in flat.items() if not name.endswith("seconds") and "generator" not in name}


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        torch.equal(one[name], other[name]) if isinstance(one[name], Tensor) else str(one[name]) == str(other[name])
        for name in one
    )


def test_an_interrupted_group_goes_on_to_the_bit(tmp_path: Path) -> None:
    config = _config(memory="lru", pqn=CONTEXT, total_frames=384, checkpoint_every=0)
    train_seeds(config, SEEDS, tmp_path / "whole")

    def stop(row: Mapping[str, Any]) -> None:
        if row["updates"] == 3:
            signal.raise_signal(signal.SIGTERM)

    cut = train_seeds(config, SEEDS, tmp_path / "cut", progress=stop)
    assert [(result.status, result.frames) for result in cut] == [("interrupted", 192)] * 2
    train_seeds(config, SEEDS, tmp_path / "cut", resume=True)
    for seed in SEEDS:
        whole, parts = tmp_path / "whole" / f"seed{seed}", tmp_path / "cut" / f"seed{seed}"
        assert _same(_states(whole), _states(parts))
        assert read_json(whole / "eval.json")["returns"] == read_json(parts / "eval.json")["returns"]


class _KilledError(Exception):
    """Stands for a process that ends between two writes."""


def test_a_group_killed_between_two_saves_goes_on_from_what_all_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config(pqn=CONTEXT, total_frames=384, checkpoint_every=128)
    train_seeds(config, SEEDS, tmp_path / "whole")
    for kill_at in (128, 256):
        with monkeypatch.context() as patch:
            _die_while_saving(patch, seed=SEEDS[1], frames=kill_at)
            with pytest.raises(_KilledError):
                train_seeds(config, SEEDS, tmp_path / "cut", resume=True)
        ahead, behind = (tmp_path / "cut" / f"seed{seed}" / "checkpoints" for seed in SEEDS)
        assert len(list_checkpoints(ahead)) == len(list_checkpoints(behind)) + 1
    train_seeds(config, SEEDS, tmp_path / "cut", resume=True)
    for seed in SEEDS:
        whole, parts = tmp_path / "whole" / f"seed{seed}", tmp_path / "cut" / f"seed{seed}"
        assert _same(_states(whole), _states(parts))
        assert [row["loss"] for row in read_csv(whole / "metrics.csv")] == [
            row["loss"] for row in read_csv(parts / "metrics.csv")
        ]


_KILLED = """
import json, sys
from arcade_torch.agents import TrainConfig, train_seeds
train_seeds(TrainConfig.from_dict(json.loads(sys.argv[1])), json.loads(sys.argv[2]), sys.argv[3], resume=True)
"""


@pytest.mark.slow
def test_a_group_killed_at_many_moments_goes_on_to_the_bit(tmp_path: Path) -> None:
    config = _config(pqn=CONTEXT, memory="lru", total_frames=1280, checkpoint_every=128)
    train_seeds(config, SEEDS, tmp_path / "whole")
    rng, log = random.Random(0), tmp_path / "cut" / f"seed{SEEDS[0]}" / "metrics.csv"
    for rows in (1, 3, 4, 8, 13, 17):
        words = [json.dumps(config.to_dict()), json.dumps(SEEDS), str(tmp_path / "cut")]
        process = subprocess.Popen([sys.executable, "-c", _KILLED, *words])
        try:
            deadline = time.monotonic() + 120
            while not (log.is_file() and log.read_text().count("\n") > rows):
                assert process.poll() is None and time.monotonic() < deadline, "the group does not get on"
                time.sleep(0.002)
            time.sleep(rng.random() * 0.2)
        finally:
            process.kill()
            process.wait()
    train_seeds(config, SEEDS, tmp_path / "cut", resume=True)
    for seed in SEEDS:
        assert _same(*(_states(tmp_path / name / f"seed{seed}") for name in ("whole", "cut")))


def _die_while_saving(patch: pytest.MonkeyPatch, seed: int, frames: int) -> None:
    from arcade_torch.agents import loop

    save = loop.save_checkpoint

    def dying(folder: Path, config: TrainConfig, at: int, *rest: Any) -> Path:
        if (config.seed, at) == (seed, frames):
            raise _KilledError
        return save(folder, config, at, *rest)

    patch.setattr(loop, "save_checkpoint", dying)


def test_seeds_move_between_a_group_and_runs_alone(tmp_path: Path) -> None:
    config = _config(pqn=CONTEXT, total_frames=384, memory="gru")

    def stop(row: Mapping[str, Any]) -> None:
        if row["updates"] in (2, 4):
            signal.raise_signal(signal.SIGTERM)

    train_seeds(config, SEEDS, tmp_path, progress=stop)
    ones = [dataclasses.replace(config, seed=seed) for seed in SEEDS]
    for one in ones:
        assert train(one, tmp_path / f"seed{one.seed}", resume=True, progress=stop).frames == 256
    results = train_seeds(config, SEEDS, tmp_path, resume=True)
    for one, result in zip(ones, results, strict=True):
        alone = train(one, tmp_path / f"alone{one.seed}")
        assert (result.status, result.frames) == ("finished", 384)
        weights = load(result.run_dir).network.state_dict()
        assert _distance(weights, load(alone.run_dir).network.state_dict()) < TOLERANCE


def test_a_finished_seed_is_left_alone(tmp_path: Path) -> None:
    config = _config(total_frames=128)
    train(dataclasses.replace(config, seed=SEEDS[0]), tmp_path / f"seed{SEEDS[0]}")
    before = (tmp_path / f"seed{SEEDS[0]}" / "metrics.csv").read_bytes()
    results = train_seeds(config, SEEDS, tmp_path, resume=True)
    assert [result.status for result in results] == ["finished", "finished"]
    assert (tmp_path / f"seed{SEEDS[0]}" / "metrics.csv").read_bytes() == before


def test_seeds_without_a_common_checkpoint_are_refused(tmp_path: Path) -> None:
    config = _config(total_frames=384, checkpoint_every=128)

    def stop(row: Mapping[str, Any]) -> None:
        if row["updates"] == 4:
            signal.raise_signal(signal.SIGTERM)

    train(dataclasses.replace(config, seed=SEEDS[0]), tmp_path / f"seed{SEEDS[0]}", progress=stop)
    with pytest.raises(CheckpointError, match=r"no frame has a whole .*seed 3 at \[128, 256\], seed 7 at none"):
        train_seeds(config, SEEDS, tmp_path, resume=True)
    assert len(list_checkpoints(tmp_path / f"seed{SEEDS[0]}" / "checkpoints")) == 2


def test_a_lone_checkpoint_of_one_seed_is_not_thrown_away_for_a_seed_that_has_not_begun(tmp_path: Path) -> None:
    config = _config(total_frames=384, checkpoint_every=0)

    def stop(row: Mapping[str, Any]) -> None:
        if row["updates"] == 4:
            signal.raise_signal(signal.SIGTERM)

    train(dataclasses.replace(config, seed=SEEDS[0]), tmp_path / f"seed{SEEDS[0]}", progress=stop)
    with pytest.raises(CheckpointError, match=r"seed 3 at \[256\], seed 7 at none"):
        train_seeds(config, SEEDS, tmp_path, resume=True)
    assert load(tmp_path / f"seed{SEEDS[0]}").frames == 256


def test_a_seed_that_explodes_is_named_and_all_keep_their_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn = SeedLearner.learn

    def explode(self: SeedLearner, batch: Any, frames: int) -> Any:
        if frames == 192:
            batch.get(("next", "reward"))[-1] = torch.nan
        return learn(self, batch, frames)

    monkeypatch.setattr(SeedLearner, "learn", explode)
    with pytest.raises(NonFiniteError, match=r"update 4 .*: seed 7: a reward is not finite; .*frames-0+128"):
        train_seeds(_config(), SEEDS, tmp_path)
    for seed in SEEDS:
        assert read_json(tmp_path / f"seed{seed}" / "progress.json")["status"] == "failed"
        assert load(tmp_path / f"seed{seed}").frames == 128


@pytest.mark.parametrize(
    ("changes", "seeds", "message"),
    [
        ({}, (1, 2, 1), r"seeds must be all different; got \[1, 2, 1\]"),
        ({}, (), "seeds must be at least one seed"),
        ({}, (0, 1.5), r"seeds must be whole numbers; got \[0, 1.5\]"),
        ({}, (0, -1), "seed must be in"),
        ({"algorithm": "ppo"}, (0, 1), "algorithm must be 'pqn' for several seeds in one process; got 'ppo'"),
        ({"logger": "wandb"}, (0, 1), "logger must be 'none' or 'tensorboard'"),
        ({"memory": "nothing"}, (0, 1), "unknown memory"),
    ],
)
def test_what_cannot_be_trained_together_is_refused_in_one_line(
    tmp_path: Path, changes: dict[str, Any], seeds: tuple[Any, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        train_seeds(_config(**changes), seeds, tmp_path)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_a_folder_in_use_stops_the_group_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "seed7").mkdir()
    (tmp_path / "seed7" / "something").touch()
    with pytest.raises(RunFolderError, match="seed7 is not empty"):
        train_seeds(_config(), SEEDS, tmp_path)
    assert not (tmp_path / "seed3").exists()


def test_a_memory_that_cannot_be_stacked_is_refused() -> None:
    from arcade_torch.models.gru import GRU

    class Asking(GRU):
        """Looks at a number, which vmap does not allow."""

        def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
            return super().run(x * float(x.isfinite().all().item()), h0, is_init)

    with pytest.raises(ValueError, match=r"does not run under torch.vmap, so train its seeds one by one"):
        StackedNetworks([make_network("small", Asking) for _ in SEEDS])
