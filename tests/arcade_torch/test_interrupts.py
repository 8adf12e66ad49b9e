"""Whatever ends a window early, what is held stays as it was and the next window is whole."""

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.modules import recurrent_mode, set_recurrent_mode

from arcade_torch import ArcadeCollector, ArcadeEnv
from arcade_torch.compiled import CompiledGame
from tests.arcade_torch.interrupts import follows_on
from tests.arcade_torch.stub import StubGame
from tests.few import few

N = 4
STEPS = 3
GAME = CompiledGame(StubGame(risk=0.3, max_steps=5))
BRIDGE = Path(__file__).resolve().parents[2] / "arcade_torch"


def collector(game: Any = GAME, **options: Any) -> ArcadeCollector:
    return ArcadeCollector(ArcadeEnv(game, N, seed=3), None, N * STEPS, seed=1, **options)


@pytest.fixture(autouse=True)
def _recurrent_mode_as_before() -> Iterator[None]:
    """An interrupt between the instructions of TorchRL's own switch leaves it on for later tests."""
    with set_recurrent_mode(recurrent_mode()):
        yield


# -- at random moments, in a process of its own ----------------------------------------------------


def interrupted(game: str, same: bool, interrupts: int) -> str:
    words = [sys.executable, "-X", "faulthandler", "-m", "tests.arcade_torch.interrupts"]
    words += [game, "--interrupts", str(interrupts), *["--same"] * same]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        words, capture_output=True, text=True, cwd=root, env=environment, timeout=600
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.parametrize("same", few([False, True], often=[False]))
def test_ctrl_c_at_random_moments_harms_nothing(same: bool) -> None:
    """Before: 56 to 59 of 200 interrupts lost memory that tensors lay over; with one storage, a
    segmentation fault.
    """
    assert f"same={same}: 40 interrupts" in interrupted("CartPoleEasy", same, 40)


@pytest.mark.slow
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("game", ["CartPoleEasy", "MineSweeperEasy", "SkittlesEasy"])
def test_a_thousand_interrupts_harm_nothing(game: str, same: bool) -> None:
    assert "170 interrupts" in interrupted(game, same, 170)


# -- at every instruction --------------------------------------------------------------------------


@contextmanager
def raising_at(number: int) -> Iterator[list[int]]:
    """Raise KeyboardInterrupt before the instruction of that number that the bridge executes;
    counts them.
    """
    count = [0]

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        if Path(frame.f_code.co_filename).resolve().parent != BRIDGE:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            count[0] += 1
            if count[0] == number:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield count
    finally:
        sys.settrace(before)


def instructions(same: bool) -> int:
    one = collector(return_same_td=same)
    one.collect()
    with raising_at(-1) as count:
        one.collect()
    return count[0]


def interrupt_everywhere(same: bool, every: int) -> None:
    total = instructions(same)
    assert total > 1000
    one = collector(return_same_td=same)
    held = one.collect()
    copy = held.clone()
    for number in range(1, total, every):
        frames = one.frames
        try:
            with raising_at(number):
                one.collect()
        except KeyboardInterrupt:
            assert one.frames in (frames, frames + N * STEPS)
        if not same:
            assert all(torch.equal(held[key], value) for key, value in copy.items(True, True)), (
                number
            )
        held = one.collect()
        follows_on(held)
        copy = held.clone()


@pytest.mark.parametrize("same", [False, True])
def test_an_interrupt_at_any_instruction_loses_that_window_alone(same: bool) -> None:
    interrupt_everywhere(same, every=151)


@pytest.mark.slow
@pytest.mark.parametrize("same", [False, True])
def test_an_interrupt_at_every_instruction_loses_that_window_alone(same: bool) -> None:
    interrupt_everywhere(same, every=1)


# -- steps that fail while they run ----------------------------------------------------------------


class FailingGame(StubGame):
    """Calls back into Python in every step, which raises when it is told to."""

    def __init__(self, where: str, **numbers: Any) -> None:
        super().__init__(**numbers)
        self.where = where
        self.fails = False

    def _call_back(self, value: jax.Array) -> jax.Array:
        def answer(seen: Any) -> np.ndarray:
            if self.fails:
                raise RuntimeError("told to fail")
            return np.asarray(seen)

        return jax.pure_callback(
            answer, jax.ShapeDtypeStruct(value.shape, value.dtype), value, vmap_method="expand_dims"
        )

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        state, reward, *ends = super().step(key, state, action)
        return (state, self._call_back(reward) if self.where == "step" else reward, *ends)

    def render(self, state: Any, partial: Any) -> jax.Array:
        frame = super().render(state, partial)
        corner = self._call_back(frame[0, 0, 0]) if self.where == "render" else frame[0, 0, 0]
        return frame.at[0, 0, 0].set(corner)


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("where", ["step", "render"])
def test_a_step_that_fails_while_it_runs_loses_its_window_alone(where: str, same: bool) -> None:
    """Before: ``Buffer has been deleted or donated``, and every second ``collect`` failed for
    ever.
    """
    game = FailingGame(where, risk=0.3, max_steps=5)
    one = collector(CompiledGame(game), return_same_td=same)
    held = one.collect()
    copy = held.clone()
    for number in range(20):
        calls = [0]

        def policy(
            td: TensorDictBase, number: int = number, calls: list[int] = calls
        ) -> TensorDictBase:
            game.fails = calls[0] == number % STEPS
            calls[0] += 1
            return td.set("action", torch.zeros(N, dtype=torch.int64))

        one._runner._policy = policy
        one.policy = policy
        with pytest.raises(Exception, match="told to fail"):
            one.collect()
        game.fails = False
        if not same:
            assert all(torch.equal(held[key], value) for key, value in copy.items(True, True))
        one._runner._policy = one.policy = None
        held = one.collect()
        follows_on(held)
        copy = held.clone()
        gc.collect()


@pytest.mark.parametrize("where", ["step", "render"])
def test_an_env_whose_step_failed_stays_where_it_was(where: str) -> None:
    game = FailingGame(where, risk=0.0, max_steps=50)
    env = ArcadeEnv(CompiledGame(game), N, seed=3)
    action = torch.zeros(N, dtype=torch.int64)
    root = env.reset()
    pixels = root["pixels"].clone()
    before = env.get_state()
    for step in (
        lambda: env.step(root.clone().set("action", action)),
        lambda: env.step_raw(action),
    ):
        game.fails = True
        with pytest.raises(Exception, match="told to fail"):
            step()
        game.fails = False
        assert (env.get_state() == before).all()
        assert torch.equal(root["pixels"], pixels)
    assert torch.equal(env.observe()["pixels"], pixels)


def test_steps_of_a_game_that_calls_back_do_not_draw_where_tensors_lie() -> None:
    assert ArcadeEnv(GAME, N).draws_safely()
    for where in ("step", "render"):
        assert not ArcadeEnv(
            CompiledGame(FailingGame(where, risk=0.3, max_steps=5)), N
        ).draws_safely()


# -- others that fail ------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["policy", "compress"])
def test_a_policy_or_a_compression_that_raises_loses_its_window_alone(where: str) -> None:
    fails = [False]

    def act(td: TensorDictBase) -> TensorDictBase:
        if fails[0] and where == "policy":
            raise RuntimeError("told to fail")
        return td.set("action", torch.zeros(N, dtype=torch.int64))

    def compress(pixels: torch.Tensor) -> torch.Tensor:
        if fails[0]:
            raise RuntimeError("told to fail")
        return pixels.clone()

    options = {"compress": compress} if where == "compress" else {}
    one = ArcadeCollector(ArcadeEnv(GAME, N, seed=3), act, N * STEPS, **options)
    for _ in range(5):
        held = one.collect()
        copy = held.clone()
        fails[0] = True
        with pytest.raises(RuntimeError, match="told to fail"):
            one.collect()
        fails[0] = False
        assert all(torch.equal(held[key], value) for key, value in copy.items(True, True))
        follows_on(held)


@pytest.mark.parametrize("windows", [0, 1])
def test_a_collector_saved_after_a_lost_window_is_resumed_as_it_goes_on(windows: int) -> None:
    """Before: the episodes that were saved were thrown away, and all envs began anew."""
    acts = [0]

    def act(td: TensorDictBase) -> TensorDictBase:
        acts[0] += 1
        if acts[0] == (windows + 1) * STEPS:
            raise KeyboardInterrupt
        return td.set("action", torch.zeros(N, dtype=torch.int64))

    one = ArcadeCollector(ArcadeEnv(GAME, N, seed=3), act, N * STEPS)
    other = ArcadeCollector(ArcadeEnv(GAME, N, seed=9), act, N * STEPS)
    for _ in range(windows):
        one.collect()
    with pytest.raises(KeyboardInterrupt):
        one.collect()
    other.load_state_dict(one.state_dict())
    expected = next(one.iterator())
    assert expected["step_count"][:, 0].any(), "an episode must go on"
    batch = next(other.iterator())
    for key in expected.keys(True, True):
        assert torch.equal(batch[key], expected[key]), key


def test_compiled_functions_that_were_cleared_are_compiled_again() -> None:
    one, twin = collector(), collector(compress=torch.clone)
    for _ in range(3):
        assert torch.equal(one.collect()["pixels"], twin.collect()["pixels"])
        jax.clear_caches()
