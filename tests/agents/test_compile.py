"""``compile``: encoder and memory through torch.compile; the same agent up to rounding."""

import dataclasses
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import load, preset, train_seeds, trainer
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.config import TrainConfig
from tests.agents.test_training import assert_goes_on_to_the_bit

CONFIG = preset("smoke", env="SignpostEasy-v0", total_frames=192, checkpoint_every=64, compile=True)


@pytest.fixture(autouse=True)
def _without_a_compiler(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "slow" not in request.keywords:
        monkeypatch.setattr(trainer, "COMPILE_BACKEND", "eager")  # captured as for inductor, then run as it stands
    torch.compiler.reset()


def outputs_and_gradients(config: TrainConfig, compiled: bool) -> list[torch.Tensor]:
    network = build_network(config)
    if compiled:
        trainer.compile_parts(network)
        assert list(network.state_dict()) == list(build_network(config).state_dict())
    found = []
    generator = torch.Generator().manual_seed(0)
    for steps in (1, 7, 12):  # acting, and windows of two lengths
        pixels = torch.randint(256, (3, steps, 128, 128, 3), dtype=torch.uint8, generator=generator)
        last_action, is_init = torch.zeros(3, steps, dtype=torch.int64), torch.rand(3, steps, generator=generator) < 0.2
        features = network.encode(network.compress(pixels))
        out, state = network.remember(features, last_action, is_init, network.initial_state(3))
        network.zero_grad()
        out.square().sum().backward()
        found += [out.detach(), *state.detach().values(True, True)]
        found += [p.grad.clone() for p in network.parameters() if p.grad is not None]
    return found


@pytest.mark.parametrize(("algorithm", "memory"), [("pqn", "lru"), ("pqn", "attention"), ("ppo", "gdn")])
def test_outputs_states_and_gradients_are_those_of_the_plain_network(algorithm: str, memory: str) -> None:
    config = preset("smoke", algorithm=algorithm, memory=memory)
    for one, other in zip(outputs_and_gradients(config, True), outputs_and_gradients(config, False), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_generated_code_agrees_too() -> None:
    config = preset("smoke", memory="lru")
    for one, other in zip(outputs_and_gradients(config, True), outputs_and_gradients(config, False), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_a_run_goes_on_to_the_bit_and_its_agent_is_loaded_plain(tmp_path: Path) -> None:
    assert "encode" not in load(assert_goes_on_to_the_bit(CONFIG, tmp_path)).network.__dict__


def test_it_belongs_to_the_identity_of_a_run_and_seeds_together_refuse_it(tmp_path: Path) -> None:
    assert TrainConfig.from_dict(CONFIG.to_dict()) == CONFIG != dataclasses.replace(CONFIG, compile=False)
    with pytest.raises(ValueError, match="compile must be false for several seeds in one process; got True"):
        train_seeds(CONFIG, [0, 1], tmp_path)
    assert not list(tmp_path.iterdir())
