"""Frames between JAX and torch on one GPU: memory that is shared, who waits for whom, and what may
be drawn over.
"""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import arcade_torch
from arcade_torch.agents import Trainer, preset
from arcade_torch.collector import ArcadeCollector
from arcade_torch.dlpack import to_jax, to_torch
from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax import registered_ids
from arcade_torch.models import memory_names
from tests.arcade_torch.stub import GAME, MIXED
from tests.arcade_torch.test_collector import Recurrent, assert_same, scripted

pytestmark = pytest.mark.gpu
ROOT = Path(__file__).resolve().parents[2]
EASY = [id for id in registered_ids() if "Easy" in id]
REHEARSED = ("MineSweeperEasy-v0", "CartPoleEasy-v0")
"""A game of whole numbers and one of fractions."""
N = 6


@pytest.fixture
def jax_device(device: str) -> jax.Device:
    return jax.devices("gpu" if device == "cuda" else "cpu")[0]


def keep_torch_busy(device: str) -> None:
    """A quarter of a second of work on torch's stream; the host goes on. On the CPU torch has no
    queue.
    """
    if device == "cuda":
        torch.cuda._sleep(400_000_000)


@jax.jit
def slowly(x: jax.Array) -> jax.Array:
    """Many products of matrices that change nothing: whole numbers below 2 ** 24."""
    return jax.lax.fori_loop(0, 50, lambda _, y: jnp.round(y @ jnp.eye(len(y))), x)


def numbers(device: jax.Device) -> jax.Array:
    size = 128 if device.platform == "cpu" else 4096
    return jax.device_put(
        np.random.default_rng(0).integers(0, 99, (size, size)).astype(np.float32), device
    )


# -- the same memory -------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [jnp.bool_, jnp.uint8, jnp.int32, jnp.float32])
def test_an_array_becomes_a_tensor_over_the_same_memory(
    dtype: Any, device: str, jax_device: jax.Device
) -> None:
    array = jax.device_put(np.ones((4, 3), dtype), jax_device)
    tensor = to_torch(array)
    assert tensor.device.type == device and tensor.data_ptr() == array.unsafe_buffer_pointer()
    assert tensor.tolist() == np.asarray(array).tolist()


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.float32])
def test_a_tensor_becomes_an_array_over_the_same_memory(
    dtype: Any, device: str, jax_device: jax.Device
) -> None:
    tensor = torch.arange(64, device=device).to(dtype)
    array = to_jax(tensor)
    assert array.devices() == {jax_device} and array.unsafe_buffer_pointer() == tensor.data_ptr()
    assert array.tolist() == tensor.tolist()


def test_a_permuted_tensor_is_shared_with_its_elements_in_their_places(device: str) -> None:
    tensor = torch.arange(24, dtype=torch.int32, device=device).reshape(2, 3, 4).permute(2, 0, 1)
    array = to_jax(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr() and array.tolist() == tensor.tolist()


def test_a_tensor_that_begins_where_jax_cannot_compute_is_refused(device: str) -> None:
    with pytest.raises(ValueError, match=r"does not begin at a multiple of \d+ bytes"):
        to_jax(torch.zeros(64, device=device)[1:])
    aligned = torch.arange(64, dtype=torch.float32, device=device)[16:]
    assert (to_jax(aligned) + 1).tolist() == (aligned + 1).tolist()


def test_the_frames_of_a_step_are_the_memory_that_jax_wrote(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = arcade_torch.make("MineSweeperEasy", num_envs=N, device=device)
    written = []
    step = env._compiled.step
    monkeypatch.setattr(
        env._compiled, "step", lambda *args: written.append(step(*args)) or written[-1]
    )
    raw = env.step_raw(torch.zeros(N, dtype=torch.int64, device=device))
    assert len(written) == 1 and raw.pixels.device == raw.numbers.device == env.device
    assert raw.pixels.data_ptr() == written[0].pixels.unsafe_buffer_pointer()
    assert raw.numbers.data_ptr() == written[0].numbers.unsafe_buffer_pointer()


# -- the order of the streams ----------------------------------------------------------------------


@pytest.mark.parametrize("move", ["step_raw", "reset", "observe"])
def test_a_slow_reader_sees_the_frame_it_was_given(move: str, device: str) -> None:
    """The reader lets go of its frame while it waits in the queue, so JAX may draw the next ones
    over it.
    """
    env = arcade_torch.make("MineSweeperEasy", num_envs=256, device=device)
    action = torch.ones(256, dtype=torch.int64, device=device)
    moves = {"step_raw": lambda: env.step_raw(action), "reset": env.reset, "observe": env.observe}
    for _ in range(3):
        moves[move](), env.step_raw(action)  # compiled, and memory that is used again
    for turn in range(4):
        frames = env.step_raw(action).pixels
        expected = frames.cpu().clone()
        env.set_observability("full" if turn % 2 else "partial")  # other frames than those before
        keep_torch_busy(device)
        seen = frames.clone()
        del frames
        for _ in range(6):
            moves[move]()
        assert torch.equal(seen.cpu(), expected)


def test_torch_waits_for_what_jax_still_computes(device: str, jax_device: jax.Device) -> None:
    x = numbers(jax_device)
    slowly(x).block_until_ready()
    assert torch.equal(to_torch(slowly(x)).cpu(), torch.from_numpy(np.array(x)))
    if device == "cuda":  # also a stream other than the default one
        with torch.cuda.stream(torch.cuda.Stream()):
            assert torch.equal(to_torch(slowly(x)).cpu(), torch.from_numpy(np.array(x)))


def test_jax_waits_for_what_torch_still_computes(device: str, jax_device: jax.Device) -> None:
    keep_torch_busy(device)
    array = to_jax(torch.full((1000,), 3.0, device=device) + 4)
    assert (np.asarray(array + 1) == 8).all()


def test_memory_that_torch_let_go_of_is_not_written_before_jax_has_read_it(
    device: str, jax_device: jax.Device
) -> None:
    x = numbers(jax_device)
    slowly(x).block_until_ready()
    given = to_torch(x).clone()
    result = slowly(to_jax(given))
    expected = np.array(x)
    del given
    for value in range(8):
        torch.full(x.shape, float(value), device=device)
    assert np.array_equal(np.asarray(result), expected)


def test_frames_that_are_held_stay_as_they_were(device: str) -> None:
    env = arcade_torch.make("TetrisEasy", num_envs=N, device=device)
    held = [env.step_raw(torch.full((N,), i % 5, device=device)).pixels for i in range(30)]
    copies = [frames.cpu().clone() for frames in held]
    for i in range(30):
        env.step_raw(torch.full((N,), i % 5, device=device))
    assert len({frames.data_ptr() for frames in held}) == 30
    assert all(torch.equal(frames.cpu(), copy) for frames, copy in zip(held, copies, strict=True))


# -- the same numbers as on the CPU ----------------------------------------------------------------


@pytest.mark.parametrize("mode", ["all", "truncated", "none"])
@pytest.mark.parametrize("game", [GAME, MIXED], ids=["one game", "several"])
def test_a_collector_on_a_card_gives_the_windows_of_one_on_the_cpu(
    game: Any, mode: Any, device: str
) -> None:
    pairs = [
        ArcadeCollector(ArcadeEnv(game, N, device=d), scripted, N * 24, final_frames=mode)
        for d in (device, "cpu")
    ]
    for _ in range(4):
        one, two = (collector.collect().cpu() for collector in pairs)
        if mode == "truncated":
            shown = [batch["final_pixels"][batch["final_mask"]] for batch in (one, two)]
            assert torch.equal(*shown)
        assert_same(*(batch.exclude("final_pixels") for batch in (one, two)))


@pytest.mark.parametrize("path", ["rollout", "stock"])
def test_the_paths_of_torchrl_give_the_frames_of_the_cpu(path: str, device: str) -> None:
    def rollout(device: str) -> Any:
        env = ArcadeEnv(GAME, N, device=device, state_in_td=path == "stock")
        return (
            env.rollout(40, scripted, break_when_any_done=False)
            .exclude("state", ("next", "state"))
            .cpu()
        )

    assert_same(rollout(device), rollout("cpu"))


@pytest.mark.parametrize("game", EASY)
def test_a_card_draws_the_frames_of_the_cpu(game: str, device: str) -> None:
    """From equal states. Where states are fractions of a pixel, a card may round another way."""
    if device == "cpu" and game not in REHEARSED:
        pytest.skip("a rehearsal draws two games: the others say something on a CUDA device alone")
    here, there = (
        arcade_torch.make(game, num_envs=8, observability="partial", device=d)
        for d in ("cpu", device)
    )
    here.reset()
    actions = torch.randint(5, (48, 8), generator=torch.Generator().manual_seed(0))
    for step, action in enumerate(actions):
        frames = here.step_raw(action).pixels
        if step % 6 == 5:
            state = here.get_state()
            seen = there.set_state(state.to(device))["pixels"].cpu()
            fractions = any(
                value.is_floating_point() for value in state["state"].values(True, True)
            )
            assert (seen != frames).float().mean() <= (0.005 if fractions else 0)


FALLBACK = """
import sys, torch, arcade_torch
env = arcade_torch.make("SignpostEasy", num_envs=4, device=sys.argv[1])
policy = lambda td: td.set("action", (td["step_count"].squeeze(-1) + td["last_action"]) % 5)
collector = arcade_torch.ArcadeCollector(env, policy, 4 * 64, final_frames="all")
batch = [collector.collect() for _ in range(2)][-1]
assert batch["pixels"].device.type == sys.argv[1].split(":")[0]
weight = torch.arange(1, 65, device=env.device).reshape(1, 64, 1, 1, 1)
print(int((batch["pixels"] * weight).sum()), int((batch["next", "pixels"] * weight).sum()), int(batch["action"].sum()))
"""


@pytest.mark.slow
def test_where_jax_has_the_cpu_alone_frames_are_copied_and_somebody_says_so(device: str) -> None:
    def run(device: str) -> tuple[str, str]:
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", FALLBACK, device]
        result = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=300, check=False
        )
        assert result.returncode == 0, result.stderr
        return result.stdout, result.stderr

    found, said = run(device)
    assert found == run("cpu")[0]
    assert ("every frame is copied to the GPU" in said) == (device == "cuda")


# -- waits of the host -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["truncated", "all"])
def test_the_host_waits_once_a_window(mode: Any, cuda: str) -> None:
    """By torch's own count; ``tests/arcade_torch/test_devices.py`` counts without a GPU."""
    count_waits(
        ArcadeCollector(ArcadeEnv(GAME, N, device=cuda), Recurrent(), N * 128, final_frames=mode)
    )


@pytest.mark.parametrize("memory", memory_names())
@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_the_host_waits_once_a_window_of_a_training_too(
    algorithm: str, memory: str, cuda: str
) -> None:
    learner = {algorithm: {"time_limit": "bootstrap"}}
    config = preset(
        "smoke", env="SignpostEasy", algorithm=algorithm, memory=memory, device=cuda, **learner
    )
    trainer = Trainer(config)
    count_waits(trainer.collector)
    trainer.close()


def count_waits(collector: ArcadeCollector) -> None:
    for _ in range(2):  # the first call compiles
        collector.collect()
    with (
        warnings.catch_warnings(record=True) as caught,
        jax.transfer_guard_device_to_host("disallow"),
    ):
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            collector.collect()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    waits = [
        str(warning.message)
        for warning in caught
        if "called a synchronizing" in str(warning.message)
    ]
    assert len(waits) == 1, waits
