"""What holds across devices, processes and threads, shown without a GPU as far as that goes."""

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torchrl.envs.utils import ExplorationType, set_exploration_type

import arcade_torch
from arcade_torch import collector as collector_module
from arcade_torch import compiled, devices, dlpack, rollout_buffer
from arcade_torch import env as env_module
from arcade_torch.agents import Trainer, preset
from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import compiled_game
from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax import registry
from arcade_torch.frame_memory import FrameMemory
from tests.arcade_torch.stub import GAME, MIXED, StubGame
from tests.arcade_torch.test_collector import Recurrent, assert_same, scripted
from tests.own_registry import forget_games

ROOT = Path(__file__).resolve().parents[2]
N = 6


class CudaStandIn(torch.Tensor):
    """A tensor that says it is on a GPU, and can only be copied from there."""

    @property
    def device(self) -> torch.device:
        return torch.device("cuda", 0)

    def to(self, *args: Any, **options: Any) -> torch.Tensor:
        moved = self.as_subclass(torch.Tensor).to(*args, **options)
        return moved if "cpu" in args else moved.as_subclass(CudaStandIn)

    def numpy(self, *, force: bool = False) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def __dlpack_device__(self) -> tuple[int, int]:
        return 2, 0


def test_actions_on_a_gpu_reach_jax_on_the_cpu() -> None:
    """JAX without its CUDA plugin: the first step failed with "Unknown backend cuda"."""
    action = torch.arange(5).as_subclass(CudaStandIn)
    argument = dlpack.int32_argument(action, jax.devices("cpu")[0])
    assert isinstance(argument, np.ndarray) and argument.dtype == np.int32
    assert argument.tolist() == [0, 1, 2, 3, 4]


def test_a_tensor_on_a_gpu_that_begins_where_jax_cannot_compute_is_refused() -> None:
    """XLA's programs refuse it when they run; only the CPU's alignment was checked."""
    with pytest.raises(ValueError, match="multiple of 16 bytes, JAX cannot compute with it"):
        dlpack.to_jax(torch.zeros(64).as_subclass(CudaStandIn)[1:])


@pytest.mark.parametrize(
    "cuda, said",
    [
        (None, r"torch \S+ is without CUDA, install one with it"),
        ("13.0", "its CUDA is 13.0, but .*nvidia-smi"),
    ],
)
def test_without_a_gpu_torch_built_for_cuda_is_not_told_to_be_installed(
    monkeypatch: pytest.MonkeyPatch, cuda: str | None, said: str
) -> None:
    """Without a driver, torch built for CUDA was to be installed with CUDA."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", cuda)
    with pytest.raises(ValueError, match=f"torch sees no GPU: {said}.*, or use 'cpu'$"):
        devices.pick_devices("cuda")


@pytest.mark.parametrize(
    "change", ["reset", "observe", "set_seed", "set_observability", "set_state"]
)
def test_what_brings_no_actions_waits_until_torch_has_read_its_frames(
    monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """A step waits for its actions. The others gave JAX memory of frames that torch had yet to
    read.
    """
    env = ArcadeEnv(GAME, N)
    env.reset()
    argument = {
        "set_seed": [1],
        "set_observability": ["partial"],
        "set_state": [env.get_state()],
    }.get(change, [])
    events: list[str] = []
    stream = type("Stream", (), {"synchronize": lambda self: events.append("torch")})()
    monkeypatch.setattr(devices, "is_host", lambda value: False)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    monkeypatch.setattr(
        env_module, "to_torch", lambda array, device: torch.from_numpy(np.array(array))
    )
    for name in ("render", "reset_render"):
        original = getattr(env._batched, name)
        call = lambda *args, original=original: (events.append("jax"), original(*args))[1]  # noqa: E731
        monkeypatch.setattr(env._batched, name, call)
    put = jax.device_put
    monkeypatch.setattr(jax, "device_put", lambda *args: (events.append("jax"), put(*args))[1])
    getattr(env, change)(*argument)
    assert events[0] == "torch" and "jax" in events


@pytest.mark.parametrize("path", ["collector", "env"])
def test_a_step_exports_frames_and_one_array_of_numbers(
    monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """Each export is a transfer where JAX is on the CPU and torch on a GPU; there were nine."""
    env = ArcadeEnv(GAME, N)
    root = env.reset()
    exported = []

    def to_torch(array: jax.Array, device: torch.device | None = None) -> torch.Tensor:
        exported.append(array.shape)
        return dlpack.to_torch(array, device)

    monkeypatch.setattr(env_module, "to_torch", to_torch)
    if path == "env":
        env.step(scripted(root))
    else:
        ArcadeCollector(env, scripted, N, final_frames="none").collect()
        exported = exported[4:]  # the reset's: frames, counts, last action
    assert exported == [(N, 8, 8, 3), (N, 5)]


def test_final_observations_are_drawn_on_the_device_of_the_env() -> None:
    """Two host devices: they were drawn on JAX's default device."""
    code = """
import jax, torch
from arcade_torch.frame_memory import FrameMemory
from arcade_torch.env import ArcadeEnv
from tests.arcade_torch.stub import LOCKSTEP
used, show = set(), FrameMemory.show
def shown(memory, frames):
    used.update((id(memory), device) for device in frames.devices())
    return show(memory, frames)
FrameMemory.show = shown
with jax.default_device(jax.devices()[1]):
    env = ArcadeEnv(LOCKSTEP, 6)
    env.rollout(12, break_when_any_done=False)
print(used == {(id(memory), jax.devices()[0]) for memory in (env._memory, env._final_memory)})
"""
    options = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "PYTHONPATH": str(ROOT)}
    assert output_of(code, options) == "True"


def test_an_env_on_the_second_device_leaves_nothing_on_the_first() -> None:
    """Random keys were drawn, and the mask of a partial step was put, on JAX's default device.

    Nor is the user told that memory of JAX is read only, which torch does once in a process.
    """
    code = "from tests.arcade_torch.second_device import main; main()"
    options = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "PYTHONPATH": str(ROOT)}
    options["PYTHONWARNINGS"] = "error:The given NumPy array is not writable"
    report = json.loads(output_of(code, options))
    assert report["on the second"] > 0
    assert report["left"] == {} and report["programs"] == []


def output_of(code: str, environment: dict[str, str] | None = None) -> str:
    import os

    variables = {**os.environ, **(environment or {})}
    command = [sys.executable, "-c", code]
    result = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env=variables, timeout=300, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


# -- waits of the host -----------------------------------------------------------------------------


class Waits(TorchDispatchMode):
    """Counts what makes the host wait for a GPU: values that Python reads, and shapes that depend
    on values.

    Also Python numbers that become a tensor (``lift_fresh``), as a list of indices does: the copy
    is waited for.
    """

    READS = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "unique", "lift_fresh")

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in self.READS or (
            name == "index" and any(i is not None and i.dtype is torch.bool for i in args[1])
        ):
            self.counts[name] += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def as_on_cuda(monkeypatch: pytest.MonkeyPatch, env: ArcadeEnv) -> Iterator[Counter[str]]:
    """Take the paths that a GPU takes, and count waits: reads by torch, copies to the host, reads
    of JAX arrays.
    """
    waits, array = Waits(), type(jnp.zeros(1))

    def counted(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(self: Any, *args: Any, **options: Any) -> Any:
            waits.counts[name] += 1
            return original(self, *args, **options)

        return call

    def read_by_numpy(original: Callable[..., Any]) -> Callable[..., Any]:
        return lambda x, *rest, **options: (
            counted("numpy", original)
            if isinstance(x, array)
            else original  # numpy does not ask for __array__
        )(x, *rest, **options)

    monkeypatch.setattr(FrameMemory, "show", lambda self, frames: frames)
    for module in (devices, dlpack, env_module, collector_module, rollout_buffer):
        monkeypatch.setattr(module, "is_host", lambda value: False)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: self)
    monkeypatch.setattr(
        torch, "from_numpy", _disable_current_modes()(torch.from_numpy)
    )  # from pinned memory: no wait
    monkeypatch.setattr(env, "_check_actions", False)
    monkeypatch.setattr(torch.Tensor, "cpu", counted("cpu", torch.Tensor.cpu))
    for name in ("array", "asarray"):
        monkeypatch.setattr(np, name, read_by_numpy(getattr(np, name)))
    for name in ("block_until_ready", "__bool__", "__int__", "__float__", "item", "tolist"):
        monkeypatch.setattr(array, name, counted(name, getattr(array, name)))
    with waits:
        yield waits.counts


@pytest.mark.parametrize("mode", ["truncated", "all"])
@pytest.mark.parametrize("game", [GAME, MIXED])
def test_the_host_waits_once_a_window(
    monkeypatch: pytest.MonkeyPatch, game: Any, mode: Any
) -> None:
    """128 steps, a recurrent policy whose states are stored, ends of both kinds."""
    env = ArcadeEnv(game, N)
    collector = ArcadeCollector(env, Recurrent(), N * 128, final_frames=mode)
    expected = ArcadeCollector(ArcadeEnv(game, N), Recurrent(), N * 128, final_frames=mode)
    for _ in range(2):  # the first call traces, and reads
        collector.collect(), expected.collect()
    with as_on_cuda(monkeypatch, env) as counts:
        batch = collector.collect()
    monkeypatch.undo()
    assert counts == {"cpu": 1}
    assert batch["next", "truncated"].any() and batch["next", "terminated"].any()
    again = expected.collect()
    if mode == "truncated":
        assert torch.equal(
            batch["final_pixels"][batch["final_mask"]], again["final_pixels"][again["final_mask"]]
        )
    assert_same(batch.exclude("final_pixels"), again.exclude("final_pixels"))


@pytest.mark.parametrize("memory", ["lru", "gru"])
@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_the_host_waits_once_a_window_of_a_training_too(
    monkeypatch: pytest.MonkeyPatch, algorithm: str, memory: str
) -> None:
    """With our networks, exploration and final frames of truncated episodes."""
    learner = {algorithm: {"time_limit": "bootstrap"}}
    trainer = Trainer(
        preset("smoke", env="SignpostEasy", algorithm=algorithm, memory=memory, **learner)
    )
    for _ in range(2):
        trainer.collector.collect()
    with as_on_cuda(monkeypatch, trainer.env) as counts:
        trainer.collector.collect()
    monkeypatch.undo()
    trainer.close()
    assert counts == {"cpu": 1}


def test_the_counter_of_waits_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ArcadeEnv(GAME, N)
    root, ones = env.reset(), jnp.ones(2)
    with as_on_cuda(monkeypatch, env) as counts:
        bool(root["is_init"].any())
        root["is_init"].cpu()
        np.asarray(ones)
        root["step_count"][root["is_init"]]
        root["step_count"][[0, 1]]
    assert counts == {"_local_scalar_dense": 1, "cpu": 1, "numpy": 1, "index": 1, "lift_fresh": 1}


# -- one process, many -----------------------------------------------------------------------------


@pytest.fixture
def games_of_this_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget afterwards what a test registers."""
    forget_games(monkeypatch)


class Large(StubGame):
    """The stub with pictures of a size that can be made by id."""

    obs_size = 128

    def render(self, state: Any, partial: Any) -> jax.Array:
        return jnp.tile(super().render(state, partial), (16, 16, 1))


def register_large(id: str) -> None:
    registry.register(id, lambda id, obs_size, rules: Large(id=id))


@pytest.mark.usefixtures("games_of_this_test")
def test_a_bare_name_means_the_newest_version_also_after_it_was_made() -> None:
    register_large("CachedEasy-v0")
    assert compiled_game("CachedEasy", 128, "default", {}).batched.game.id == "CachedEasy-v0"
    register_large("CachedEasy-v1")
    assert compiled_game("CachedEasy", 128, "default", {}).batched.game.id == "CachedEasy-v1"
    assert compiled_game("CachedEasy-v0", 128, "default", {}).batched.game.id == "CachedEasy-v0"


def test_an_option_is_refused_whatever_was_made_before() -> None:
    arcade_torch.make("BreakoutEasy", 2, random_start=True)
    with pytest.raises((TypeError, ValueError), match="random_start is 1"):
        arcade_torch.make("BreakoutEasy", 2, random_start=1)


FORKED_BY_HAND = """
import arcade_torch, gymnasium, jax, os, signal, warnings
warnings.simplefilter("ignore")
jax.devices()
if os.fork():
    os.wait()
    os._exit(0)
signal.alarm(50)
for make in (lambda: arcade_torch.make("SignpostEasy"), lambda: gymnasium.make("arcade_torch/CartPoleEasy-v0")):
    try:
        make()
    except RuntimeError as error:
        print(error, flush=True)
os._exit(0)
"""


def test_a_forked_process_is_refused_in_one_line() -> None:
    """No env had been made before the fork, only JAX had started: the first one hung for ever."""
    command = [sys.executable, "-c", FORKED_BY_HAND]
    result = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False
    )
    lines = result.stdout.splitlines()
    assert [
        line.count("forked after JAX had started, where JAX hangs: start workers") for line in lines
    ] == [1, 1]


INHERITED = """
import arcade_torch, gymnasium, jax, jax.numpy as jnp, os, signal, torch, warnings
from torchrl.data import Categorical
warnings.simplefilter("ignore")

class Counter:
    def reset(self, key):
        return jnp.zeros(1), jnp.int32(0)

    def step(self, key, state, action):
        return jnp.ones(1), state + action, jnp.float32(0), state > 3, {}

env = arcade_torch.make("SignpostEasy", num_envs=2)
other = arcade_torch.from_jax(Counter(), num_envs=2, action_spec=Categorical(2, shape=(2,)))
alone = gymnasium.make("arcade_torch/CartPoleEasy-v0").unwrapped
several = gymnasium.make_vec("arcade_torch/CartPoleEasy-v0", num_envs=2, render_mode="rgb_array")
actions = torch.zeros(2, dtype=torch.int64)
alone._running = several._started = True  # as if reset in the parent
if os.fork():
    os.wait()
    os._exit(0)
signal.alarm(50)
for call in (
    env.reset, lambda: env.step_raw(actions), other.reset, lambda: other.step_raw(actions),
    alone.reset, lambda: alone.step(0), several.reset, lambda: several.step([0, 0]), several.render,
):
    try:
        call()
        print("nothing was raised", flush=True)
    except RuntimeError as error:
        print(error, flush=True)
os._exit(0)
"""


def test_an_env_that_a_forked_process_inherits_is_refused_in_one_line() -> None:
    """Only making one was refused: the first reset or step hung for ever."""
    result = subprocess.run(
        [sys.executable, "-c", INHERITED],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=110,
        check=False,
    )
    lines = result.stdout.splitlines()
    assert [line.count("where JAX hangs: start workers") for line in lines] == [1] * 9, lines


FORKED = """
import arcade_torch, gymnasium, jax
if __name__ == "__main__":
    try:
        envs = gymnasium.make_vec("arcade_torch/CartPoleEasy-v0", 2, vectorization_mode="async", vector_kwargs=KW)
        print(envs.reset(seed=0)[0].shape)
        envs.close()
    except Exception as error:
        print(type(error).__name__)
"""


def test_gymnasiums_async_vector_env_ends_at_once_and_names_spawn(tmp_path: Path) -> None:
    """It hung for ever: Gymnasium makes one env in the parent, forks, and makes the others in the
    workers.
    """
    for options, clear in (("{'context': 'fork'}", True), ("{'context': 'spawn'}", False)):
        script = tmp_path / "script.py"
        script.write_text(FORKED.replace("KW", options))
        command = [sys.executable, str(script)]
        result = subprocess.run(
            command, capture_output=True, text=True, cwd=ROOT, timeout=120, check=False
        )
        assert ("start workers with 'spawn'" in result.stderr) == clear, result.stderr
        assert ("(2, 128, 128, 3)" in result.stdout) != clear, result.stdout


def test_each_thread_may_have_envs_and_collectors_of_its_own() -> None:
    """What is promised: envs share compiled functions, not state; one env belongs to one thread at
    a time.
    """

    def path(seed: int) -> TensorDictBase:
        env = arcade_torch.make("CartPoleEasy", num_envs=2, seed=seed)
        collector = ArcadeCollector(
            env, lambda td: td.set("action", td["step_count"].squeeze(-1) % 5), 2 * 8
        )
        return torch.stack([collector.collect() for _ in range(4)])

    alone = [path(seed) for seed in range(4)]
    compiled._compile.cache_clear()  # so that threads also compile at the same time
    with set_exploration_type(ExplorationType.RANDOM), ThreadPoolExecutor(4) as pool:
        for one, two in zip(alone, pool.map(path, range(4)), strict=True):
            assert_same(one, two)


def test_a_collector_leaves_the_exploration_type_alone_where_it_is_as_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It belongs to the process: threads that set it and put it back in turns leave the wrong one
    behind.
    """
    env = arcade_torch.make("CartPoleEasy", num_envs=2, seed=0)
    collector = ArcadeCollector(
        env, lambda td: td.set("action", td["step_count"].squeeze(-1) % 5), 2 * 8
    )
    with set_exploration_type(ExplorationType.RANDOM):
        monkeypatch.setattr("arcade_torch.collector.set_exploration_type", None)
        assert collector.collect()["action"].shape == (2, 8)
