"""Runs in threads of one process, which share torch's global generator."""

import dataclasses
import threading
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import TrainConfig, preset, train
from arcade_torch.agents.policy import build_network
from arcade_torch.agents.training import own_settings
from tests.agents.test_training import assert_same_run

CONFIG = preset("smoke", env="SignpostEasy", total_frames=512)


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_runs_in_threads_are_those_that_they_are_alone(algorithm: str, tmp_path: Path) -> None:
    """They drew from the generator by turns; another network that was built set it back."""
    configs = [dataclasses.replace(CONFIG, algorithm=algorithm, seed=seed) for seed in range(2)]
    for config in configs:
        train(config, tmp_path / f"alone{config.seed}")
    torch.manual_seed(5)
    together = threading.Barrier(2, timeout=120)
    over = threading.Event()

    def run(config: TrainConfig) -> None:
        train(config, tmp_path / f"thread{config.seed}", progress=lambda row: together.wait())

    def build() -> None:
        while not over.is_set():
            build_network(configs[0])

    threads = [threading.Thread(target=run, args=(config,)) for config in configs]
    builder = threading.Thread(target=build)
    for thread in (*threads, builder):
        thread.start()
    for thread in threads:
        thread.join()
    over.set()
    builder.join()
    for config in configs:
        assert_same_run(tmp_path / f"thread{config.seed}", tmp_path / f"alone{config.seed}")


@pytest.mark.parametrize("first_out", [0, 1])
def test_runs_that_overlap_leave_the_process_as_it_was(first_out: int) -> None:
    """Before: the one that ended last brought back what the other had seeded and set."""
    threads = torch.get_num_threads()
    torch.manual_seed(5)
    before = torch.get_rng_state()
    runs = [own_settings(dataclasses.replace(CONFIG, seed=1, threads=threads + 1))]
    runs += [own_settings(dataclasses.replace(CONFIG, seed=2, threads=threads + 2))]
    try:
        for run in runs:
            run.__enter__()
        runs.pop(first_out).__exit__(None, None, None)
        left = 2 - first_out  # the seed of the other, which goes on
        assert torch.initial_seed() == left
        assert torch.get_num_threads() == threads + left
        runs.pop().__exit__(None, None, None)
        assert torch.equal(torch.get_rng_state(), before)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(threads)
