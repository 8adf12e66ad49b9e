"""``amp``: the convolutions in bfloat16, everything else as it was."""

import dataclasses
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import load, preset
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.config import TrainConfig
from arcade_torch.models import Encoder, PaperEncoder, SmallEncoder
from tests.agents.test_training import assert_goes_on_to_the_bit

CONFIG = preset("smoke", env="SignpostEasy-v0", total_frames=192, checkpoint_every=64, amp=True)


@pytest.mark.parametrize("kind", [PaperEncoder, SmallEncoder])
def test_features_and_gradients_are_float32_and_close_to_exact_ones(kind: type[Encoder]) -> None:
    encoder = kind(128)  # type: ignore[call-arg]
    frames = torch.randint(256, (6, 128, 128, 3), dtype=torch.uint8)
    exact = encoder(frames)
    encoder.amp = True
    found = encoder(frames)
    assert found.dtype is torch.float32 and not torch.equal(found, exact)
    assert (found - exact).abs().max() < 0.02 * exact.abs().max()  # bfloat16 has 8 bits
    found.sum().backward()
    assert all(
        p.dtype is torch.float32 and p.grad is not None and p.grad.isfinite().all() for p in encoder.parameters()
    )


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_every_encoder_of_a_network_follows_the_config(algorithm: str) -> None:
    for amp in (False, True):
        network = build_network(preset("smoke", algorithm=algorithm, amp=amp))
        encoders = [module for module in network.modules() if isinstance(module, Encoder)]
        assert encoders and all(encoder.amp is amp for encoder in encoders)


def test_a_run_goes_on_to_the_bit_and_its_agent_acts_as_it_was_trained(tmp_path: Path) -> None:
    assert load(assert_goes_on_to_the_bit(CONFIG, tmp_path)).network.encoder.amp


def test_it_belongs_to_the_identity_of_a_run_and_is_true_or_false() -> None:
    plain = CONFIG.to_dict()
    assert TrainConfig.from_dict(plain) == CONFIG != dataclasses.replace(CONFIG, amp=False)
    with pytest.raises(ValueError, match="amp must be true or false; got 1"):
        TrainConfig.from_dict(plain | {"amp": 1})
