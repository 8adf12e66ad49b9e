"""Every example runs in a short form, and each shows something that is true of all of it."""

import csv
import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest
import torch

from arcade_torch.agents import check_replay
from arcade_torch.models import MemoryModule

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def example(name: str) -> Any:
    """Import a script without running it."""
    module_name = f"example_{name.replace('/', '_')}"
    spec = importlib.util.spec_from_file_location(module_name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore")
def test_torchrls_trainer_begins_with_the_policy_that_acted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    script = example("torchrl_ppo_trainer")
    monkeypatch.setattr(script, "EPOCHS", 1)
    seen: list[int] = []
    largest = script.check_replay
    monkeypatch.setattr(
        script,
        "check_replay",
        lambda policy, b: (seen.append(b.numel()), largest(policy, b))[1],
    )
    result = script.main(frames=2 * script.NUM_ENVS * script.NUM_STEPS, memory="lru")
    assert result.log_ratio < 1e-5 and seen == [script.MINIBATCH]
    assert len(result.returns) == 2 and all(-1 <= value <= 1 for value in result.returns)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["ppo", pytest.param("dqn", marks=pytest.mark.slow)])
def test_torchrls_configured_trainers_learn_from_what_their_policy_did(name: str) -> None:
    hydra = pytest.importorskip("hydra", reason="needs the hydra extra")
    script = example("torchrl_config/train")
    frames = 2560
    sizes = [f"trainer.total_frames={frames}", "width=16", "memory=lru"]
    with hydra.initialize_config_dir(str(EXAMPLES / "torchrl_config"), version_base=None):
        trainer = script.make_trainer(hydra.compose(name, overrides=sizes))
    loss = trainer.loss_module
    network = loss.actor_network if name == "ppo" else loss.value_network
    assert (
        next(m for m in network.modules() if isinstance(m, MemoryModule)).memory.hidden_size == 16
    )
    before = [weight.detach().clone() for weight in loss.parameters()]
    differences: list[float] = []

    def check(batch: Any) -> Any:
        differences.append(check_replay(network, batch))
        return batch

    trainer.register_op("process_optim_batch", check)
    trainer.train()
    assert trainer.collected_frames == frames
    # 64 slices of 5 steps in a minibatch: the first update sees what acting saw
    assert differences[0] < 1e-5
    assert max(differences) > differences[0]
    moved = [not torch.equal(x, y) for x, y in zip(before, loss.parameters(), strict=True)]
    assert sum(moved) > len(moved) / 2


@pytest.mark.filterwarnings("ignore")
def test_the_loop_replays_every_window_as_it_was_acted() -> None:
    script = example("a2c_loop")
    result = script.main(frames=4 * script.NUM_ENVS * script.NUM_STEPS, memory="lru")
    assert 0 <= result.log_ratio < 1e-5  # over all four windows, each before its own update
    assert len(result.returns) == 4 and all(-1 <= value <= 1 for value in result.returns)


class Chain:
    """A sign at the first of five steps, and a reward at the last for having remembered it."""

    action_space = SimpleNamespace(n=2)

    def reset(self, key: jax.Array) -> tuple[jax.Array, Any]:
        sign = jax.random.bernoulli(key).astype(jnp.int32)
        return jnp.stack([2.0 * sign - 1, 0.0]), (sign, jnp.int32(0))

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        sign, time = state
        is_last = time == 4
        reward = jnp.where(is_last, 2.0 * (action == sign) - 1, 0.0)
        return jnp.stack([0.0, (time + 1) / 4]), (sign, time + 1), reward, is_last, {}


@pytest.mark.filterwarnings("ignore")
def test_ppo_with_a_memory_learns_an_env_of_another_suite_and_without_one_does_not() -> None:
    assert len((EXAMPLES / "gymnax_ppo.py").read_text(encoding="utf-8").splitlines()) <= 100
    script = example("gymnax_ppo")
    assert script.main(Chain(), memory="gru", windows=12)[-1] > 0.9
    assert abs(script.main(Chain(), memory="mlp", windows=4)[-1]) < 0.3


@pytest.mark.filterwarnings("ignore")
def test_pqn_learns_on_torchrls_collector() -> None:
    assert len((EXAMPLES / "pqn_torchrl.py").read_text(encoding="utf-8").splitlines()) <= 120
    script = example("pqn_torchrl")
    assert -1 <= script.main(frames=2 * script.NUM_ENVS * script.NUM_STEPS) <= 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_pqn_with_a_memory_reads_the_sign() -> None:
    assert example("pqn_torchrl").main() > 0.8


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("theirs", [False, True], ids=["ours", "theirs"])
def test_one_line_makes_our_environment_instead_of_theirs(
    theirs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if theirs:
        pytest.importorskip("pygame", reason="needs the play extra: pip install '.[play]'")
    script = example("stock_pixels_ppo")
    monkeypatch.setattr(script, "EPOCHS", 1)
    monkeypatch.setattr(script, "WINDOW", 32)
    monkeypatch.setattr(script, "MINIBATCH", 16)
    env = script.make_env(theirs)
    assert (
        env.observation_spec["pixels"].dtype is torch.uint8
        and env.observation_spec["pixels"].shape[-1] == 3
    )
    env.close()
    returns = script.main(frames=64, theirs=theirs)
    assert len(returns) == 2
    for value in returns:
        assert math.isnan(value) or (value >= 8 if theirs else -1 <= value <= 1)


def test_ppo_in_one_file_begins_with_the_policy_that_acted(monkeypatch: pytest.MonkeyPatch) -> None:
    script = example("cleanrl_style_ppo")
    monkeypatch.setattr(script, "NUM_ENVS", 8)
    monkeypatch.setattr(script, "NUM_STEPS", 10)
    monkeypatch.setattr(script, "EPOCHS", 1)
    first: list[float] = []
    minimum = torch.minimum

    def gain(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
        if not first:  # ratio 1 everywhere: nothing is clipped
            first.append(float((one - two).detach().abs().max()))
        return minimum(one, two)

    monkeypatch.setattr(script.torch, "minimum", gain)
    history = script.main(frames=160)
    assert first == [0.0]
    assert len(history) == 2 and all(-1 <= value <= 1 for value in history)


@pytest.mark.slow
def test_stable_baselines3_takes_the_environment() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the sb3 extra: pip install '.[sb3]'")
    assert -1 <= example("cleanrl_style_ppo").stable_baselines3(frames=640) <= 1


def test_a_thousand_steps_in_jax_do_not_leave_the_device() -> None:
    """A transfer inside the compiled call would be refused by the guard of the script."""
    script = example("jax_scan")
    assert script.STEPS == 1000
    result = script.main(num_envs=4)
    assert (result.episodes >= 1000 // 32).all() and (abs(result.reward) <= result.episodes).all()
    full, hidden = result.brightness[0::2].mean(), result.brightness[1::2].mean()
    assert abs(full - hidden) > 0.5  # the twins differ in what they draw, and frames were drawn


def test_a_script_written_for_gymnax_learns() -> None:
    first, last = example("jax_actor_critic").main()
    assert (
        first < 0 and last > 0.15
    )  # random play earns -0.6, the best without reading the sign 0.25


def test_a_probe_reads_where_things_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "probe.csv"
    words = "--games BreakoutEasy --encoders 32 --frames 2048 --passes 3 --out"
    monkeypatch.setattr(sys, "argv", ["probe_encoders.py", *words.split(), str(out)])
    threads = torch.get_num_threads()
    try:
        example("probe_encoders").main()
    finally:
        torch.set_num_threads(threads)
    rows = {row["fact"]: row for row in csv.DictReader(out.open())}
    assert {"action", "ball_x", "bricks"} <= set(rows) and rows["action"]["encoder"] == "32"
    assert float(rows["pos"]["learned"]) > 0.3
