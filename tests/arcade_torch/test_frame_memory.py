"""Frames are written where earlier ones were, and never where somebody can still see one."""

import re
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import StepCounter

from arcade_torch import make
from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.frame_memory import FrameMemory, Reused, draws_in_place
from arcade_torch.gym.batch import NumpyBatch
from tests.arcade_torch.stub import GAME, LOCKSTEP, MIXED, State, StubGame

N = 6


def scripted(td: TensorDictBase) -> TensorDictBase:
    """Actions that differ from step to step and from env to env."""
    return td.set("action", (td["step_count"].squeeze(-1) + torch.arange(len(td))) % 5)


class Fused:
    """Steps an env by ``step_and_maybe_reset``; the frames of a step are those of its root."""

    def __init__(self, game: CompiledGame = GAME, seed: int = 0) -> None:
        self.env = ArcadeEnv(game, N, seed=seed)
        self.td = self.env.reset()

    def __call__(self) -> torch.Tensor:
        _, self.td = self.env.step_and_maybe_reset(scripted(self.td))
        return self.td.pop("pixels")


class Stock(Fused):
    """Steps by ``step``, ``step_mdp`` and ``maybe_reset``, as transformed envs do."""

    def __call__(self) -> torch.Tensor:
        taken = self.env.step(scripted(self.td))
        frames = taken.get(("next", "pixels"))
        self.td = self.env.maybe_reset(self.env.step_mdp(taken))
        self.td.pop("pixels")
        return frames


class Raw(Fused):
    """Steps by ``step_raw``."""

    def __call__(self) -> torch.Tensor:
        return self.env.step_raw(torch.arange(N) % 5).pixels


# -- what is reused --------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [Fused, Stock, Raw])
@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_frames_that_nobody_holds_are_written_over(path: type[Fused], game: CompiledGame) -> None:
    step = path(game)
    assert len({step().data_ptr() for _ in range(40)}) <= 3


def test_of_many_blocks_that_were_held_the_newest_few_are_kept() -> None:
    reused = Reused(most=3)
    blocks = [np.empty(1) for _ in range(6)]
    held = [reused.hand_out(block, block[:]) for block in blocks]
    kept = [weakref.ref(block) for block in blocks]
    del blocks, held
    assert [block() is not None for block in kept] == [False] * 3 + [True] * 3


def places_of(monkeypatch: pytest.MonkeyPatch, memory: FrameMemory) -> list[int]:
    """Where the frames of the coming steps are written."""
    places: list[int] = []
    show = memory.show

    def noted(frames: jax.Array) -> Any:
        places.append(frames.unsafe_buffer_pointer())
        return show(frames)

    monkeypatch.setattr(memory, "show", noted)
    return places


def test_the_collector_goes_round_in_few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ArcadeEnv(GAME, N)
    places = places_of(monkeypatch, env._memory)
    collector = ArcadeCollector(
        env, scripted, N * 8, compress=torch.clone
    )  # else it draws into the window
    for _ in range(5):
        collector.collect()
    assert len(places) == 40 and len(set(places)) <= 3


@pytest.mark.parametrize("copy", [True, False])
def test_gymnasiums_batch_reuses_frames_too(monkeypatch: pytest.MonkeyPatch, copy: bool) -> None:
    batch, action, held = NumpyBatch(GAME, np.zeros(N, np.bool_)), np.zeros(N, np.int32), []
    batch.reset(np.ones(N, np.bool_))
    places = places_of(monkeypatch, batch._memory)
    for _ in range(20):
        frames = batch.step_and_reset(action, copy)[1]
        held.append((frames[1:], frames[1:].copy()))
    assert (len(set(places)) <= 3) == copy, (
        "frames that were handed out without a copy are still held"
    )
    assert all((seen == copied).all() for seen, copied in held)
    held.clear()
    del frames
    places.clear()
    for _ in range(10):
        batch.step_and_reset(action, copy)
    assert len(set(places)) <= 3


@pytest.mark.parametrize("game", [GAME, MIXED])
@pytest.mark.parametrize("function", ["step", "step_only"])
def test_xla_writes_the_frames_into_the_memory_that_it_is_given(
    game: CompiledGame, function: str
) -> None:
    """The program says so; a copy would need memory of its own."""
    live = ArcadeEnv(game, N)._live
    started = [live.batch, live.ended] if function == "step_only" else [live.batch]
    arguments = [*started, jnp.zeros(N, jnp.int32)]
    spare = jax.ShapeDtypeStruct((N, 8, 8, 3), jnp.uint8)
    lowered = getattr(game, function).lower(*arguments, spare)
    header = lowered.compile().as_text().splitlines()[0]
    number = len(jax.tree.leaves(arguments))
    assert re.search(
        rf"input_output_alias={{ {{\d+}}: \({number}, {{}}, m\w+-alias\) }}", header
    ), header


# -- what is never touched -------------------------------------------------------------------------

HOLDERS: dict[str, Callable[[torch.Tensor], Any]] = {
    "tensor": lambda frames: frames,
    "slice": lambda frames: frames[2:4, 1],
    "permuted": lambda frames: frames.permute(0, 3, 1, 2),
    "other type": lambda frames: frames.reshape(N, -1).view(torch.int32),
    "detached": lambda frames: frames.detach(),
    "parameter": lambda frames: torch.nn.Parameter(frames, requires_grad=False),
    "unbound": lambda frames: frames.unbind(0)[3],
    "storage": lambda frames: torch.tensor([], dtype=torch.uint8).set_(frames.untyped_storage()),
    "numpy": lambda frames: frames.numpy(),
    "numpy slice": lambda frames: frames.numpy()[1:][::2],
    "memoryview": lambda frames: np.asarray(memoryview(frames.numpy())),
    "jax": lambda frames: jax.dlpack.from_dlpack(frames),
    "capsule": lambda frames: torch.utils.dlpack.from_dlpack(torch.utils.dlpack.to_dlpack(frames)),
    "shared memory": lambda frames: frames.share_memory_(),
    "tensordict": lambda frames: TensorDict({"deep": {"pixels": frames}}, [N])["deep"],
    "indexed tensordict": lambda frames: TensorDict({"pixels": frames}, [N])[2:],
    "lazy stack": lambda frames: TensorDict.lazy_stack([TensorDict({"pixels": frames}, [N])] * 2),
    "closure": lambda frames: lambda: frames,
    "cycle": lambda frames: (lambda self: (self.append(self), self.append(frames[1:3]), self)[-1])(
        []
    ),
}


def content(held: Any) -> Any:
    """What is seen now, as a numpy array of its own."""
    if callable(held) and not hasattr(held, "shape"):
        held = held()
    if isinstance(held, list):
        held = held[1]
    if isinstance(held, TensorDictBase):
        held = held["pixels"]
    return (held.numpy() if isinstance(held, torch.Tensor) else np.asarray(held)).copy()


@pytest.mark.parametrize("path", [Fused, Stock, Raw])
@pytest.mark.parametrize("holder", HOLDERS)
def test_frames_that_somebody_holds_never_change(path: type[Fused], holder: str) -> None:
    """Held in turns for up to seven steps, so that memory is free in between; what is held is not
    offered to JAX.
    """
    step, held = path(), []
    for number in range(40):
        frames = step()
        place = frames.data_ptr()
        frames = HOLDERS[holder](frames)
        if number % 3:
            held.append((frames, content(frames), place))
        del frames
        blocks = step.env._memory._reused._blocks
        free = [frames.unsafe_buffer_pointer() for frames, seen in blocks if seen() is None]
        for seen, copied, place in held:
            np.testing.assert_array_equal(content(seen), copied)
            assert (
                place not in free or holder == "shared memory"
            )  # which moved the frames elsewhere
        if number % 7 == 6:
            del held[::2]


@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_a_rollout_and_all_that_came_out_of_the_steps_before_keep_their_frames(
    game: CompiledGame,
) -> None:
    env = ArcadeEnv(game, N, seed=4)
    td, held = env.reset(), []
    for number in range(60):
        taken, td = env.step_and_maybe_reset(scripted(td))
        if number % 4:
            held += [(one.copy(), one.clone()) for one in (taken, td)]
    lazily = env.rollout(30, scripted, break_when_any_done=False, return_contiguous=False)
    dense = env.rollout(30, scripted, break_when_any_done=False)
    held += [(lazily, lazily.clone()), (dense, dense.clone()), (env.get_state(), env.get_state())]
    env.rollout(30, scripted, break_when_any_done=False)
    for seen, copied in held:
        for key in copied.keys(True, True):
            assert torch.equal(seen[key], copied[key]), key


def test_a_transformed_env_and_a_branch_from_a_snapshot_keep_their_frames() -> None:
    env = TransformedEnv(ArcadeEnv(GAME, N, seed=1), StepCounter(step_count_key="steps"))
    data = env.rollout(20, scripted, break_when_any_done=False, return_contiguous=False)
    copied = data.clone()
    base = env.base_env
    state = base.get_state()
    one = base.step(scripted(base.set_state(state)))
    again = one.clone()
    for _ in range(10):
        base.step(scripted(base.set_state(state)))
    assert torch.equal(one["next", "pixels"], again["next", "pixels"]) and torch.equal(
        one["pixels"], again["pixels"]
    )
    assert torch.equal(data["next", "pixels"], copied["next", "pixels"])


@settings(deadline=None)
@given(
    orders=st.lists(
        st.sampled_from(["step", "hold", "hold", "drop first", "drop last", "reset"]), max_size=60
    ),
    path=st.sampled_from([Fused, Stock, Raw]),
    holders=st.lists(st.sampled_from(sorted(HOLDERS)), min_size=1, max_size=4),
)
def test_whatever_is_held_and_dropped_frames_are_those_of_an_env_that_copies(
    orders: list[str], path: type[Fused], holders: list[str]
) -> None:
    step, twin, held = path(seed=7), path(seed=7), []
    for number, order in enumerate(orders):
        if order.startswith("drop") and held:
            held.pop(0 if order == "drop first" else -1)
        elif order == "reset":
            step.td, twin.td = step.env.reset(), twin.env.reset()
        elif order in ("step", "hold"):
            frames, expected = step(), twin().clone()
            assert torch.equal(frames, expected)
            if order == "hold":
                hold = HOLDERS[holders[number % len(holders)]]
                held.append((hold(frames), content(hold(expected))))
            del frames
        for seen, copied in held:
            np.testing.assert_array_equal(content(seen), copied)


def test_a_thread_that_reads_slowly_sees_the_frame_that_it_was_given() -> None:
    env = make("MineSweeperEasy", num_envs=4)
    td = env.reset()

    def slow(frames: torch.Tensor, expected: torch.Tensor) -> bool:
        return all(torch.equal(frames, expected) for _ in range(50))

    with ThreadPoolExecutor(2) as pool:
        answers = []
        for _ in range(60):
            _, td = env.step_and_maybe_reset(scripted(td))
            frames = td["pixels"]
            answers.append(pool.submit(slow, frames[1:], frames[1:].clone()))
            del frames
        assert all(answer.result() for answer in answers)


def test_jax_itself_does_not_write_to_memory_that_is_seen_from_outside() -> None:
    """The second guard: the memory is given to a step although a tensor lies over it."""
    env = ArcadeEnv(GAME, N)
    frames = env.step_raw(torch.arange(N) % 5).pixels
    before, numbers = frames.clone(), set()
    for _ in range(5):
        reused = env._memory._reused
        reused._blocks = [(kept, lambda: None) for kept, _ in reused._blocks]
        following = env.step_raw(torch.arange(N) % 5).pixels
        numbers.add(int(following[0, 0, 0, 0]))
        assert torch.equal(frames, before) and frames.data_ptr() != following.data_ptr()
    assert len(numbers) > 1


class CanvasGame(StubGame):
    """A game whose state is its picture, and whose step may leave it as it is."""

    def reset(self, key: jax.Array) -> Any:
        return super().reset(key), jnp.broadcast_to(
            jax.random.bits(key, dtype=jnp.uint8), (8, 8, 3)
        )

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
        inner, *rest = super().step(key, state[0], action)
        return (inner, state[1]), *rest

    def render(self, state: tuple[State, jax.Array], partial: Any) -> jax.Array:
        return state[1]


@pytest.mark.parametrize("path", [Fused, Stock, Raw])
def test_a_game_whose_state_is_its_picture_keeps_both(path: type[Fused]) -> None:
    step = path(CompiledGame(CanvasGame(risk=0.0, max_steps=50)))
    held = [step() for _ in range(10)]
    for _ in range(10):
        assert torch.equal(step(), held[0])
    assert all(torch.equal(frames, held[0]) for frames in held)
    assert torch.equal(step.env.observe()["pixels"], held[0])


# -- windows that are drawn into -------------------------------------------------------------------


def collector(game: CompiledGame = GAME, copies: bool = False, **options: Any) -> ArcadeCollector:
    """A collector whose steps draw into the window, or one that copies frames there."""
    compress = torch.clone if copies else None
    return ArcadeCollector(
        ArcadeEnv(game, N, seed=3), scripted, N * 6, compress=compress, **options
    )


@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_steps_draw_straight_into_the_window(
    monkeypatch: pytest.MonkeyPatch, game: CompiledGame
) -> None:
    """All frames of a window but the first, which stood there when the window before it ended."""
    one, twin = collector(game), collector(game, copies=True)
    copied: list[int] = []
    copy = torch.Tensor.copy_
    for number in range(5):
        expected = twin.collect()
        with monkeypatch.context() as patch:
            patch.setattr(
                torch.Tensor,
                "copy_",
                lambda to, source: (copied.append(to.data_ptr()), copy(to, source))[1],
            )
            pixels = one.collect()["pixels"]
        places = [pixels[:, step].data_ptr() for step in range(6)]
        assert [copied.count(place) for place in places] == [1, 0, 0, 0, 0, 0], number
        copied.clear()
        assert torch.equal(pixels, expected["pixels"])
        canvas = one._buffer._new_observation["pixels"].canvas
        assert pixels.is_contiguous() and canvas.memory.unsafe_buffer_pointer() == pixels.data_ptr()


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_xla_writes_one_frame_of_a_window_and_copies_none(game: CompiledGame) -> None:
    batch = ArcadeEnv(game, N)._live.batch
    window = jax.ShapeDtypeStruct((N, 5, 8, 8, 3), jnp.uint8)
    text = game._step_into.lower(window, 2, batch, jnp.zeros(N, jnp.int32)).compile().as_text()
    assert re.search(
        r"input_output_alias=\{ \{0\}: \(0, \{\}, m\w+-alias\) \}", text.splitlines()[0]
    )
    assert not re.search(rf"= u8\[{N},5,8,8,3\]\S* copy\(", text)


@settings(deadline=None, max_examples=40)
@given(
    orders=st.lists(
        st.sampled_from(
            ["collect", "iterate", "hold", "drop first", "drop last", "reset", "other"]
        ),
        max_size=12,
    ),
    holder=st.sampled_from(
        ["tensor", "slice", "unbound", "detached", "numpy slice", "capsule", "tensordict", "cycle"]
    ),
    overlap=st.sampled_from([0, 2, 8]),
    final=st.sampled_from(["all", "truncated", "none"]),
)
def test_whatever_is_held_and_dropped_windows_are_those_of_a_collector_that_copies(
    orders: list[str], holder: str, overlap: int, final: Any
) -> None:
    one, twin = (
        collector(copies=copies, overlap=overlap, final_frames=final) for copies in (False, True)
    )
    held: list[tuple[Any, Any]] = []
    for order in orders:
        if order.startswith("drop") and held:
            held.pop(0 if order == "drop first" else -1)
        elif order in ("reset", "other"):
            for each in (one, twin):
                each.reset() if order == "reset" else each.env.step_raw(torch.arange(N) % 5)
        elif order in ("collect", "iterate", "hold"):
            ours, theirs = (
                next(each.iterator()) if order == "iterate" else each.collect()
                for each in (one, twin)
            )
            assert (ours == theirs).all()
            if order == "hold":
                held.append(
                    (
                        HOLDERS[holder](ours["pixels"]),
                        content(HOLDERS[holder](theirs["pixels"].clone())),
                    )
                )
            del ours, theirs
        for seen, copied in held:
            np.testing.assert_array_equal(content(seen), copied)


@pytest.mark.parametrize("same", [False, True])
def test_a_policy_may_hold_the_frames_that_it_saw(same: bool) -> None:
    """Within the window, whatever is drawn beside them; and beyond it, unless one storage was asked
    for.
    """
    held: list[tuple[torch.Tensor, torch.Tensor]] = []

    def policy(td: TensorDictBase) -> TensorDictBase:
        if len(windows) < 4:
            held.append((td["pixels"][1:], td["pixels"][1:].clone()))
        return scripted(td)

    one = ArcadeCollector(ArcadeEnv(GAME, N), policy, N * 6, return_same_td=same)
    windows: list[int] = []
    for _ in range(4):
        windows.append(one.collect()["pixels"].data_ptr())
        assert all(torch.equal(seen, copied) for seen, copied in held)
        if same:
            held.clear()
    assert len(set(windows)) == (1 if same else 4)
    held.clear()
    assert len({one.collect()["pixels"].data_ptr() for _ in range(8)}) <= 2, (
        "memory that nobody sees is used again"
    )


@pytest.mark.parametrize("setting", ["jax_disable_jit", "jax_debug_nans", "jax_debug_infs"])
def test_where_jax_donates_nothing_windows_are_the_same(setting: str) -> None:
    """The setting is the process's, for steps compile in a thread of their own, and stands before
    the game is compiled.
    """
    twin = ArcadeCollector(ArcadeEnv(GAME, N), scripted, N * 2)
    game = CompiledGame(StubGame())
    jax.config.update(setting, True)
    try:
        one = ArcadeCollector(ArcadeEnv(game, N), scripted, N * 2)
        slow = [one.collect() for _ in range(2)]
    finally:
        jax.config.update(setting, False)
    assert all((batch == twin.collect()).all() for batch in slow)


def test_a_jax_that_draws_elsewhere_has_its_frames_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    twin = collector()
    monkeypatch.setattr("arcade_torch.rollout_buffer.draws_in_place", lambda: False)
    one, places = collector(), []
    step = one.env.step_raw
    monkeypatch.setattr(
        one.env,
        "step_raw",
        lambda action, **how: (places.append(how["into"]), step(action, **how))[1],
    )
    assert all((one.collect() == twin.collect()).all() for _ in range(3))
    assert places == [None] * 18


def test_this_jax_draws_in_donated_memory() -> None:
    assert draws_in_place()


def test_a_window_whose_storage_was_moved_is_written_where_it_is_now() -> None:
    one, twin = collector(return_same_td=True), collector()
    for _ in range(3):
        ours = one.collect()
        assert (ours == twin.collect()).all()
        ours["pixels"].share_memory_()
