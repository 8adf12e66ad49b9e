"""A run gives the same numbers in anybody's process: whatever torch is set to, whoever draws."""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import pytest
import torch

from arcade_torch.agents import Agent, Trainer, build_network, evaluate, preset
from arcade_torch.agents.torch_settings import plain_torch

CONFIG = preset("smoke", env="CartPoleEasy-v0", total_frames=640, memory="gru")
CONFIG = dataclasses.replace(CONFIG, pqn=dataclasses.replace(CONFIG.pqn, warmup_steps=8))


@contextmanager
def double() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


SETTINGS: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "float64": double,
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "inference": torch.inference_mode,
    "no_grad": torch.no_grad,
}


@contextmanager
def all_at_once() -> Iterator[None]:
    with SETTINGS["float64"](), SETTINGS["autocast"](), SETTINGS["inference"]():
        yield


def run(setting: Callable[[], AbstractContextManager[None]] = nullcontext) -> list[torch.Tensor]:
    """The weights, and the returns of an evaluation, of a run in that setting."""
    torch.manual_seed(5)
    with setting():
        trainer = Trainer(CONFIG)
        trainer.warm_up()
        trainer.update()
        result = evaluate(Agent(CONFIG, trainer.acting), episodes=2)
        trainer.close()
    with torch.inference_mode(False):
        weights = [weight.clone() for weight in trainer.acting.state_dict().values()]
        return [*weights, torch.tensor(result.returns)]


@pytest.fixture(scope="module")
def wanted() -> list[torch.Tensor]:
    return run()


@pytest.mark.parametrize(
    "setting",
    [all_at_once, *[pytest.param(one, marks=pytest.mark.slow) for one in SETTINGS.values()]],
    ids=["all", *SETTINGS],
)
def test_a_run_is_the_same_under_other_settings_of_torch(
    setting: Callable[[], AbstractContextManager[None]], wanted: list[torch.Tensor]
) -> None:
    dtype = torch.get_default_dtype()
    found = run(setting)
    for one, other in zip(found, wanted, strict=True):
        assert one.dtype == other.dtype and torch.equal(one, other)
    assert torch.get_default_dtype() == dtype


def test_runs_side_by_side_and_draws_between_their_updates_change_nothing(
    wanted: list[torch.Tensor],
) -> None:
    pair = [Trainer(CONFIG), Trainer(dataclasses.replace(CONFIG, seed=1))]
    torch.manual_seed(3)
    for step in (Trainer.warm_up, Trainer.update):
        before = torch.get_rng_state()
        for trainer in pair:
            step(trainer)
        assert torch.equal(torch.get_rng_state(), before)
        torch.rand(7)
    for one, other in zip(pair[0].acting.state_dict().values(), wanted, strict=False):
        assert torch.equal(one, other)
    for trainer in pair:
        trainer.close()


def test_autocast_around_a_network_of_ours_is_that_around_its_parts() -> None:
    network = build_network(CONFIG)
    state = network.initial_state(2)
    pixels = torch.randint(256, (2, 3, 128, 128, 3), dtype=torch.uint8)
    actions = torch.zeros(2, 3, dtype=torch.int64)
    flags = torch.zeros(2, 3, dtype=torch.bool)
    plain, _ = network.remember(network.encode(pixels), actions, flags, state)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out, after = network.remember(network.encode(pixels), actions, flags, state)
    assert all(tensor.dtype == torch.float32 for tensor in after.values(True, True))
    torch.testing.assert_close(out.float(), plain, atol=0.02, rtol=0.05)


def test_settings_come_back_after_an_error() -> None:
    with double(), torch.no_grad():
        with pytest.raises(RuntimeError, match="told to"), plain_torch():
            assert torch.zeros(1).dtype == torch.float32 and torch.is_grad_enabled()
            raise RuntimeError("told to")
        assert torch.get_default_dtype() == torch.float64 and not torch.is_grad_enabled()
