"""Training runs on a GPU: the faster ways to the same agent, and going on after an end that nobody
announced.
"""

import dataclasses
import random
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import load, preset, train, trainer
from tests.agents.test_training import assert_goes_on_to_the_bit, assert_same_run, kill_and_resume
from tests.few import few

pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def _repeatable(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Convolutions that give the same bits twice; on the CPU no C++ compiler is asked for."""
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", True)
    if device == "cpu":
        monkeypatch.setattr(trainer, "COMPILE_BACKEND", "eager")
    torch.compiler.reset()


@pytest.mark.parametrize("form", ["compile", "amp"])
@pytest.mark.parametrize("memory", few(["lru", "gru", "attention"], often=["lru"]))
def test_a_faster_way_gives_the_agent_of_the_plain_one_up_to_rounding(
    memory: str, form: str, device: str, tmp_path: Path
) -> None:
    config = preset("smoke", env="SignpostEasy", memory=memory, device=device, total_frames=64)
    for folder, how in (("plain", config), ("fast", dataclasses.replace(config, **{form: True}))):
        assert train(how, tmp_path / folder).status == "finished"
    plain, fast = (load(tmp_path / folder).network.state_dict() for folder in ("plain", "fast"))
    for name, weight in plain.items():
        assert fast[name].isfinite().all()
        if form == "compile":
            torch.testing.assert_close(fast[name], weight, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_an_interrupted_run_goes_on_to_the_bit(algorithm: str, device: str, tmp_path: Path) -> None:
    config = preset(
        "smoke", algorithm=algorithm, env="SignpostEasy", device=device, total_frames=256
    )
    assert_goes_on_to_the_bit(
        dataclasses.replace(config, env="SignpostEasy-v0", checkpoint_every=64), tmp_path
    )


def test_an_interrupted_run_with_graphs_goes_on_to_the_bit(cuda: str, tmp_path: Path) -> None:
    config = preset(
        "smoke", env="SignpostEasy-v0", device=cuda, total_frames=512, checkpoint_every=64
    )
    assert_goes_on_to_the_bit(dataclasses.replace(config, cuda_graphs=True), tmp_path)


def test_a_killed_run_goes_on_to_the_bit(device: str, tmp_path: Path) -> None:
    config = preset(
        "smoke", env="CartPoleEasy-v0", device=device, total_frames=640, checkpoint_every=128
    )
    train(config, tmp_path / "whole")
    kill_and_resume(tmp_path / "killed", random.Random(0), config)
    assert_same_run(tmp_path / "killed", tmp_path / "whole")
