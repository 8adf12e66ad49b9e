"""Laws of the collector: the same data as TorchRL's, every frame once, sequences that replay,
resuming to the bit.
"""

import itertools
import re
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import TensorDictPrimer, TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type

from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.final_observations import _OneGame
from tests.arcade_torch.same import assert_same
from tests.arcade_torch.stub import GAME, LOCKSTEP, MIXED, StubGame
from tests.few import a_third

N, T = 6, 8
HASTY = CompiledGame(StubGame(risk=0.15, max_steps=3))  # both kinds of end, several in a row


def stub_env(game: CompiledGame = GAME, seed: int = 3, **options: Any) -> ArcadeEnv:
    return ArcadeEnv(game, N, seed=seed, **options)


def stub_collector(
    policy: Any, game: CompiledGame = GAME, seed: int = 3, **options: Any
) -> ArcadeCollector:
    return ArcadeCollector(
        stub_env(game, seed), policy, options.pop("frames_per_batch", N * T), **options
    )


def scripted(td: TensorDictBase) -> TensorDictBase:
    """A deterministic policy that reads the frame, the counts and the last action."""
    pixels = td["pixels"][:, :, 0, 0].long()
    td["action"] = (pixels.sum(-1) + 3 * td["step_count"].squeeze(-1) + td["last_action"]) % 5
    td["value"] = td["episode_reward"] + 1
    return td


class Recurrent(nn.Module):
    """A deterministic policy with a memory: a leaky sum of what it saw, forgotten at the start of
    an episode.
    """

    in_keys = ("pixels", "last_action", "is_init", ("memory", "sum"))
    out_keys = ("action", "total", ("next", "memory", "sum"))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        spec = Composite({"memory": Composite({"sum": Unbounded((1,))})})
        return TensorDictPrimer(spec, default_value={"memory": {"sum": 0.5}})

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        seen = td["pixels"].flatten(1).float().sum(-1, keepdim=True) / 1000 + td[
            "last_action"
        ].unsqueeze(-1)
        total = torch.where(td["is_init"], 0.5, td["memory", "sum"]) / 2 + seen
        td["action"] = (total.squeeze(-1) * 7).long() % 5
        td["total"] = td["next", "memory", "sum"] = total
        return td


def steps(batch: TensorDictBase) -> TensorDictBase:
    """The entries of sequences that have an axis of time, as a batch [N, L]."""
    keys = [
        key
        for key in batch.keys(True, True)
        if key[0] != "initial_state" and not str(key).startswith("final_")
    ]
    return batch.select(*keys).clone().auto_batch_size_(2)


# -- the same data as TorchRL's --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("game", "steps"),
    [(GAME, 200), (LOCKSTEP, 24), pytest.param(MIXED, 24, marks=pytest.mark.slow)],
)  # 1000 and 120 steps an env
def test_iteration_gives_the_data_of_torchrls_collector_and_of_rollout(
    game: CompiledGame, steps: int
) -> None:
    windows = 5
    options = {"frames_per_batch": N * steps, "total_frames": N * steps * windows}
    stock = torch.cat(list(Collector(stub_env(game), scripted, **options)), 1)
    ours = torch.cat(list(stub_collector(scripted, game, return_same_td=False, **options)), 1)
    rollout = stub_env(game).rollout(steps * windows, scripted, break_when_any_done=False)
    assert ours["next", "done"].sum() > N * steps // 2
    assert ours.names == stock.names == [None, "time"]
    assert_same(ours, stock)
    assert_same(ours.exclude("collector"), rollout)


def test_batches_of_an_env_with_its_state_in_the_tensordict_lack_only_the_state() -> None:
    rollout = stub_env(state_in_td=True).rollout(T, scripted, break_when_any_done=False)
    ours = next(ArcadeCollector(stub_env(state_in_td=True), scripted, N * T).iterator())
    assert_same(ours.exclude("collector"), rollout.exclude("state", ("next", "state")))


@pytest.mark.parametrize("overlap", [0, 2])
def test_compact_batches_lack_only_the_next_frames(overlap: int) -> None:
    options = {"total_frames": 3 * N * T, "overlap": overlap}
    full = list(stub_collector(scripted, **options))
    compact = list(stub_collector(scripted, compact_obs=True, **options))
    for one, two in zip(full, compact, strict=True):
        assert_same(one.exclude(("next", "pixels")), two)


@pytest.mark.parametrize("overlap", [0, 4])
@pytest.mark.parametrize("mode", ["all", "truncated", "none"])
def test_iteration_gives_all_next_frames_or_none(mode: Any, overlap: int) -> None:
    """Where final frames were not drawn, the first frames of the next episodes stood in their
    place.
    """
    rollout = stub_env().rollout(3 * T + overlap, scripted, break_when_any_done=False)[:, overlap:]
    batches = stub_collector(scripted, total_frames=3 * N * T, final_frames=mode, overlap=overlap)
    ours = torch.cat(list(batches), 1).exclude("collector")
    assert rollout["next", "terminated"].any() and rollout["next", "truncated"].any()
    assert_same(ours, rollout if mode == "all" else rollout.exclude(("next", "pixels")))


@pytest.mark.parametrize("overlap", [0, 4])
@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_sequences_hold_the_data_of_a_rollout(game: CompiledGame, overlap: int) -> None:
    rollout = stub_env(game).rollout(10 * T + overlap, scripted, break_when_any_done=False)
    collector = stub_collector(scripted, game, overlap=overlap)
    for window in range(10):
        found = steps(collector.collect())
        assert len(list(found.keys(True, True))) == (14 if game is not MIXED else 15)
        assert_same(
            found,
            rollout[:, window * T : (window + 1) * T + overlap].select(*found.keys(True, True)),
        )


# -- the observations that follow a step -----------------------------------------------------------


def dense_next_pixels(batch: TensorDictBase) -> torch.Tensor:
    """Dense next observations from a batch of sequences with final_pixels, as its description has
    it.
    """
    dense = torch.cat([batch["pixels"][:, 1:], batch["pixels"][:, :1] * 0], 1)
    for row, place in batch["final_mask"].nonzero().tolist():
        dense[row, batch["final_index"][row, place]] = batch["final_pixels"][row, place]
    return dense


def small(pixels: torch.Tensor) -> torch.Tensor:
    return pixels[..., ::2, ::4, :] + 1


WINDOWS = a_third(
    [GAME, LOCKSTEP, HASTY, MIXED], [0, 4, T + 3], ["truncated", "none"], [None, small]
)


def test_every_pair_of_a_game_and_an_option_of_its_windows_is_looked_at_on_every_change() -> None:
    values = [tuple(map(str, case.values)) for case in WINDOWS]
    often = [tuple(map(str, case.values)) for case in WINDOWS if not case.marks]
    assert 3 * len(often) == len(values)
    for one, other in itertools.combinations(range(4), 2):
        assert {(case[one], case[other]) for case in often} == {
            (case[one], case[other]) for case in values
        }


@pytest.mark.parametrize(("game", "overlap", "mode", "compress"), WINDOWS)
def test_next_observations_of_sequences_are_those_of_a_rollout(
    game: CompiledGame, overlap: int, mode: Any, compress: Any
) -> None:
    """Terminations, truncations, several truncations a row (LOCKSTEP: every 5 steps, HASTY: every
    3).
    """
    rollout = stub_env(game).rollout(8 * T + overlap, scripted_small, break_when_any_done=False)
    collector = stub_collector(
        scripted_small, game, overlap=overlap, final_frames=mode, compress=compress
    )
    limit, length = min(game.game.max_steps for game in game.batched.groups), T + overlap
    places = 1 + -(-(length - 1) // limit) if mode == "truncated" else 1
    used = 0
    for window in range(8):
        batch = collector.collect()
        path = rollout[:, window * T : window * T + length]
        terminated, truncated, done = (
            path["next", key].squeeze(-1) for key in ("terminated", "truncated", "done")
        )
        index, mask = batch["final_index"], batch["final_mask"]
        assert batch["final_pixels"].shape[:2] == index.shape == mask.shape == (N, places)
        assert index.dtype is torch.int64 and mask.dtype is torch.bool
        assert (index[~mask] == length - 1).all()
        wanted = truncated & ~terminated if mode == "truncated" else torch.zeros_like(done)
        wanted[:, -1] = ~terminated[:, -1] if mode == "truncated" else ~done[:, -1]
        for row in range(N):
            assert index[row][mask[row]].tolist() == wanted[row].nonzero().flatten().tolist()
        expected = path["next", "pixels"] if compress is None else compress(path["next", "pixels"])
        known = wanted | ~done
        assert torch.equal(dense_next_pixels(batch)[known], expected[known])
        used = max(used, int(mask.sum(1).max()))
    assert used == places or game in (GAME, MIXED)


def scripted_small(td: TensorDictBase) -> TensorDictBase:
    """A deterministic policy that reads nothing that compression changes."""
    return td.set("action", (3 * td["step_count"].squeeze(-1) + td["last_action"]) % 5)


def test_a_window_may_begin_and_end_with_a_truncation() -> None:
    """Every place is used: more would be a game that truncates before its time limit."""
    steps = LOCKSTEP.batched.game.max_steps + 1
    rollout = stub_env(LOCKSTEP).rollout(6 * steps, scripted, break_when_any_done=False)
    collector = stub_collector(
        scripted, LOCKSTEP, frames_per_batch=N * steps, final_frames="truncated"
    )
    fully = []
    for window in range(6):
        batch = collector.collect()
        assert batch["final_index"].shape == (N, 2)
        path = rollout[:, window * steps : (window + 1) * steps]
        assert torch.equal(dense_next_pixels(batch), path["next", "pixels"])
        fully.append(bool(path["next", "truncated"][:, [0, -1]].all()))
    assert any(fully)


@pytest.mark.parametrize("ends", [0.005, 0.012, 0.05, 1.0])
@pytest.mark.parametrize("num_envs", [2, 96])
def test_final_frames_are_drawn_in_portions_of_one_shape(num_envs: int, ends: float) -> None:
    """Whatever ends when: all once and in order, of few steps at once."""
    game = _OneGame(None, slice(0, num_envs), 8, 8, jax.devices("cpu")[0])
    most = 12 if num_envs == 96 else 2  # an eighth
    for seed in range(20):
        wanted = np.random.default_rng(seed).random((num_envs, 40)) < ends
        steps, rows = np.nonzero(wanted.T)
        portions = list(game.portions(rows, steps))
        assert all(len(some) <= most for some, _ in portions)
        assert all(len(set(some.tolist())) <= 8 for _, some in portions)
        for whole, parts in zip((rows, steps), zip(*portions, strict=True), strict=False):
            assert np.array_equal(np.concatenate(parts), whole)
        assert len(rows) == sum(len(some) for some, _ in portions)


@pytest.mark.parametrize("max_steps", [20, 4])
def test_a_game_that_truncates_before_its_time_limit_is_named(max_steps: int) -> None:
    """Also one truncation more than there are places for."""

    class Impatient(StubGame):
        def step(self, key: Any, state: Any, action: Any) -> Any:
            following, reward, terminated, _ = super().step(key, state, action)
            return following, reward, terminated, following.clock.count >= 2

    compiled = CompiledGame(Impatient(risk=0.0, max_steps=max_steps))
    with pytest.raises(RuntimeError, match="truncated an episode before its max_steps"):
        stub_collector(scripted, compiled, final_frames="truncated").collect()
    assert stub_collector(scripted, compiled).collect()["next", "truncated"].any()


@pytest.mark.parametrize("mode", ["all", "truncated"])
def test_a_replay_buffer_of_torchrl_stores_sequences_and_gives_them_back(mode: Any) -> None:
    collector = stub_collector(Recurrent(), LOCKSTEP, final_frames=mode, overlap=2)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2 * N), batch_size=N)
    batches = [collector.collect() for _ in range(2)]
    for batch in batches:
        buffer.extend(batch)
    assert len(buffer) == 2 * N
    for number, batch in enumerate(batches):
        found = buffer[number * N : (number + 1) * N]
        assert ("initial_state", "memory", "sum") in found.keys(True)
        assert_same(found.exclude("index"), batch)
    assert buffer.sample()["pixels"].shape[:2] == (N, T + 2)


# -- recurrent state and overlap -------------------------------------------------------------------


def replay(batch: TensorDictBase) -> torch.Tensor:
    """Act again over a batch of sequences, from its initial state; returns the extras."""
    policy, state = Recurrent(), batch["initial_state"]
    totals = []
    for time in range(batch["action"].shape[1]):
        root = {key: batch[key][:, time] for key in ("pixels", "last_action", "is_init")}
        td = policy(TensorDict({**root, **dict(state.items())}, batch.batch_size))
        assert torch.equal(td["action"], batch["action"][:, time])
        totals.append(td["total"])
        state = td["next"]
    return torch.stack(totals, 1)


@pytest.mark.parametrize("overlap", [0, 3, T, T + 3, 3 * T])
@pytest.mark.parametrize("game", [GAME, LOCKSTEP])
def test_sequences_replay_from_their_initial_state_and_begin_with_the_overlap(
    game: CompiledGame, overlap: int
) -> None:
    collector = stub_collector(Recurrent(), game, overlap=overlap)
    before = None
    for _ in range(6):
        batch = collector.collect()
        assert batch["pixels"].shape[:2] == (N, overlap + T)
        assert torch.equal(replay(batch), batch["total"])
        now = steps(batch)
        if before is not None and overlap:
            assert_same(now[:, :overlap], before[:, -overlap:])
        before = now


def test_an_overlap_longer_than_a_window_is_moved_in_parts_that_share_no_memory() -> None:
    """A GPU copies all parts at once; on a CPU torch refuses that of a single env."""
    collector = ArcadeCollector(
        ArcadeEnv(GAME, 1, seed=3), scripted, T, overlap=T + 3, return_same_td=True
    )
    before = steps(collector.collect())
    assert_same(steps(collector.collect())[:, : T + 3], before[:, -T - 3 :])


def test_the_overlap_holds_the_same_path_as_windows_without_overlap() -> None:
    plain = stub_collector(Recurrent())
    path = torch.cat([steps(plain.collect()) for _ in range(6)], 1)
    collector = stub_collector(Recurrent(), overlap=3)
    for window in range(4):
        now = steps(collector.collect())
        assert_same(now, path[:, window * T : window * T + T + 3])
    assert collector.frames == 4 * N * T


def test_iteration_with_a_overlap_gives_only_the_new_steps() -> None:
    plain = torch.cat(
        list(stub_collector(scripted, total_frames=5 * N * T, return_same_td=False)), 1
    )
    batches = stub_collector(scripted, overlap=3, total_frames=4 * N * T, return_same_td=False)
    ours = torch.cat(list(batches), 1).exclude("collector")
    assert_same(ours, plain[:, 3 : 3 + 4 * T].exclude("collector"))


# -- storage ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("overlap", [0, 3])
def test_batches_are_the_callers_own_unless_storage_is_to_be_reused(overlap: int) -> None:
    """TorchRL's default: ``list(collector)`` holds different batches."""
    options: dict[str, Any] = {"overlap": overlap, "final_frames": "truncated"}
    collector = stub_collector(Recurrent(), LOCKSTEP, **options)
    batches = [collector.collect() for _ in range(3)]
    reusing = stub_collector(Recurrent(), LOCKSTEP, return_same_td=True, **options)
    pointers = set()
    for batch in batches:
        again = reusing.collect()
        assert_same(batch.exclude("final_pixels"), again.exclude("final_pixels"))
        assert torch.equal(
            batch["final_pixels"][batch["final_mask"]], again["final_pixels"][again["final_mask"]]
        )
        pointers.add(again["pixels"].data_ptr())
    assert len(pointers) == 1
    frames = [batch["pixels"].sum() for batch in stub_collector(scripted, total_frames=3 * N * T)]
    assert [
        batch["pixels"].sum() for batch in list(stub_collector(scripted, total_frames=3 * N * T))
    ] == frames


def test_memory_that_nobody_holds_any_more_is_used_again() -> None:
    collector = stub_collector(scripted)
    pointers = [batch["pixels"].data_ptr() for batch in (collector.collect() for _ in range(6))]
    assert len(set(pointers)) == 2  # the loop holds a batch while the next one is collected
    held = [
        collector.collect()["pixels"][0, 0].numpy() for _ in range(4)
    ]  # any view keeps the memory
    frames = [frame.copy() for frame in held]
    collector.collect()
    assert all((one == two).all() for one, two in zip(held, frames, strict=True))


def test_a_frame_is_stored_once() -> None:
    batch = stub_collector(scripted, LOCKSTEP, final_frames="truncated").collect()
    assert batch["pixels"].untyped_storage().nbytes() == N * T * 8 * 8 * 3
    assert batch["final_pixels"].untyped_storage().nbytes() == N * 3 * 8 * 8 * 3
    assert ("next", "pixels") not in batch.keys(True)


def test_only_what_is_asked_for_is_stored() -> None:
    standard = set(stub_collector(None).collect().keys(True, True))

    def stored(**options: Any) -> set[Any]:
        batch = stub_collector(Recurrent(), **options).collect()
        return set(batch.keys(True, True)) - standard - {("initial_state", "memory", "sum")}

    state = {("memory", "sum"), ("next", "memory", "sum")}
    assert stored() == {"total"} | state
    assert stored(store_states=False) == {"total"}
    assert stored(store=[]) == set()
    assert stored(store=["total"]) == {"total"}
    assert stored(store=["memory", ("next", "memory")]) == state


def test_the_stored_state_at_a_start_is_the_primers() -> None:
    batch = stub_collector(Recurrent(), LOCKSTEP).collect()
    starts = batch["is_init"].squeeze(-1)
    assert (batch["memory", "sum"][starts] == 0.5).all() and not (
        batch["memory", "sum"][~starts] == 0.5
    ).any()
    assert (batch["initial_state", "memory", "sum"] == 0.5).all()


class Unaware(Recurrent):
    """Does not read where an episode begins: the collector puts the primer's values back."""

    in_keys = ("pixels", "last_action", ("memory", "sum"))

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        return super().forward(td.set("is_init", torch.zeros(N, 1, dtype=torch.bool)))


def test_a_policy_that_does_not_read_is_init_begins_anew_whether_its_states_are_stored_or_not() -> (
    None
):
    aware = stub_collector(Recurrent(), LOCKSTEP).collect()["total"]
    for stored in (True, False):
        assert torch.equal(
            stub_collector(Unaware(), LOCKSTEP, store_states=stored).collect()["total"], aware
        )


def test_a_policy_may_write_all_its_actions_into_one_tensor() -> None:
    own = torch.zeros(N, dtype=torch.int64)

    def policy(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", own.copy_(scripted_small(td)["action"]))

    one, two = stub_collector(policy), stub_collector(scripted_small)
    for _ in range(3):
        assert_same(one.collect(), two.collect())


def test_what_is_stored_of_a_frame_is_what_the_policy_saw() -> None:
    seen = []

    def policy(td: TensorDictBase) -> TensorDictBase:
        seen.append(td["pixels"].clone())
        return td.set("action", torch.arange(N) % 5)

    batch = stub_collector(policy, compress=small).collect()
    full = stub_collector(policy).collect()
    assert batch["pixels"].shape == (N, T, 4, 2, 3)
    assert torch.equal(batch["pixels"], torch.stack(seen[:T], 1))
    for key in ("pixels", ("next", "pixels")):
        assert torch.equal(batch[key], small(full[key]))


# -- control ---------------------------------------------------------------------------------------


def resumed(collector: ArcadeCollector, other: ArcadeCollector, path: Any) -> None:
    torch.save(collector.state_dict(), path)
    other.load_state_dict(torch.load(path, weights_only=True))


@pytest.mark.parametrize(("game", "overlap"), [(GAME, 0), (GAME, 3), (GAME, T + 3), (MIXED, 3)])
@pytest.mark.parametrize("policy", [Recurrent, lambda: None, lambda: scripted])
def test_a_resumed_collector_goes_on_to_the_bit(
    policy: Any, game: CompiledGame, overlap: int, tmp_path: Any
) -> None:
    collector = stub_collector(policy(), game, overlap=overlap, init_random_frames=N * T)
    for _ in range(3):
        collector.collect()
    other = stub_collector(policy(), game, seed=77, overlap=overlap, init_random_frames=N * T)
    other.collect()
    resumed(collector, other, tmp_path / "collector.pt")
    assert other.frames == collector.frames
    for _ in range(3):
        assert_same(other.collect(), collector.collect())


def test_a_resumed_collector_has_the_final_frames_of_its_overlap_and_leaves_earlier_batches_alone(
    tmp_path: Any,
) -> None:
    options: dict[str, Any] = {"overlap": T + 3, "final_frames": "truncated"}
    collector, other = (
        stub_collector(scripted_small, LOCKSTEP, seed, **options) for seed in (3, 77)
    )
    collector.collect()
    held = other.collect()
    before = held.clone()
    resumed(collector, other, tmp_path / "collector.pt")
    assert_same(held, before)
    for _ in range(2):
        ours, theirs = other.collect(), collector.collect()
        assert_same(ours.exclude("final_pixels"), theirs.exclude("final_pixels"))
        assert torch.equal(dense_next_pixels(ours), dense_next_pixels(theirs))


def test_a_collector_that_has_not_begun_can_be_resumed(tmp_path: Any) -> None:
    collector, other = stub_collector(None, seed=1), stub_collector(None, seed=2)
    resumed(collector, other, tmp_path / "collector.pt")
    assert_same(other.collect(), collector.collect())


def test_resumed_iteration_counts_trajectories_and_frames_on(tmp_path: Any) -> None:
    collector = stub_collector(scripted, total_frames=4 * N * T)
    batches = iter(collector)
    next(batches), next(batches)
    other = stub_collector(scripted, seed=9, total_frames=4 * N * T)
    resumed(collector, other, tmp_path / "collector.pt")
    rest = list(other)
    assert len(rest) == 2
    next(batches)
    assert_same(next(batches), rest[1])


def test_seeding_starts_over_and_repeats() -> None:
    collector = stub_collector(None)
    collector.set_seed(5)
    first = collector.collect()
    collector.collect()
    collector.set_seed(5)
    assert_same(collector.collect(), first)
    for seed in (5, 0):
        other = ArcadeCollector(stub_env(seed=8), None, N * T, seed=seed)
        collector.set_seed(seed)
        assert_same(other.collect(), collector.collect())
    assert collector.set_seed(5) == stub_env().set_seed(5)
    assert collector.set_seed(5, static_seed=True) == 5


def test_random_actions_differ_from_collector_to_collector() -> None:
    one, two = (stub_collector(None).collect()["action"] for _ in range(2))
    assert not torch.equal(one, two)


def test_iteration_ends_after_total_frames() -> None:
    collector = stub_collector(scripted, total_frames=2 * N * T + 1)
    assert len(list(collector)) == 3
    assert collector.frames == 3 * N * T
    assert list(collector) == []


def test_random_frames_come_first_and_the_env_took_them() -> None:
    for frames, windows in ((N * T, 1), (N * T + 1, 2)):
        collector = stub_collector(
            lambda td: td.set("action", torch.full((N,), 4)), init_random_frames=frames
        )
        actions = [collector.collect()["action"] for _ in range(windows + 1)]
        assert [action.unique().numel() for action in actions] == [5] * windows + [1]
        assert (actions[-1] == 4).all()


def test_a_random_window_is_random_and_the_policy_runs_for_its_state() -> None:
    collector, again = stub_collector(Recurrent(), seed=3), stub_collector(Recurrent(), seed=3)
    warm_up = collector.collect(random=True)
    assert warm_up["action"].unique().numel() == 5
    seen = warm_up["pixels"][:, 0].flatten(1).float().sum(-1, keepdim=True) / 1000
    assert torch.equal(warm_up["total"][:, 0], 0.25 + seen)  # the first last_action is 0
    acted = collector.collect()
    assert torch.equal(replay(acted), acted["total"])
    again._generator.set_state(torch.Generator().manual_seed(1).get_state())
    assert not torch.equal(again.collect(random=True)["action"], warm_up["action"])


def test_the_policy_explores_while_collecting() -> None:
    seen = []

    def policy(td: TensorDictBase) -> TensorDictBase:
        seen.append(exploration_type())
        return td.set("action", torch.zeros(N, dtype=torch.int64))

    stub_collector(policy).collect()
    stub_collector(policy, exploration_type=ExplorationType.MODE).collect()
    assert set(seen[:T]) == {ExplorationType.RANDOM} and set(seen[T:]) == {ExplorationType.MODE}


def test_a_change_of_observability_between_windows_is_seen_at_once() -> None:
    collector = stub_collector(scripted)
    collector.collect()
    collector.env.set_observability("partial")
    batch = collector.collect()
    assert (
        batch["pixels"][:, :, 1:4] == 0
    ).all()  # the stub's partial frames hide the serial number


def test_final_frames_show_the_twin_that_each_step_showed() -> None:
    """Before: all of a window showed the twin of its last end, so partial ones the whole state."""

    def turning(env: ArcadeEnv) -> Callable[[TensorDictBase], TensorDictBase]:
        twins = itertools.cycle(["full"] * 4 + ["partial"] * 4)

        def policy(td: TensorDictBase) -> TensorDictBase:
            env.set_observability(next(twins))
            return scripted(td)

        return policy

    env, twin = stub_env(HASTY), stub_env(HASTY)
    rollout = twin.rollout(3 * T, turning(twin), break_when_any_done=False)
    batches = ArcadeCollector(env, turning(env), N * T, 3 * N * T)
    assert_same(torch.cat(list(batches), 1).exclude("collector"), rollout)


def rollout_of(env: ArcadeEnv) -> None:
    assert env.rollout(100)["next", "done"][
        :, -1
    ].any()  # it stops at the first end, before the reset


def reset_some(env: ArcadeEnv) -> None:
    env.reset(TensorDict({"_reset": torch.arange(N) % 2 == 0}, [N]))


def step_raw(env: ArcadeEnv) -> None:
    env.step_raw(torch.zeros(N, dtype=torch.int64))


def load(env: ArcadeEnv) -> None:
    env.set_state(stub_env(seed=12).get_state())


def another_collector(env: ArcadeEnv) -> None:
    ArcadeCollector(env, scripted, N * 2, seed=None).collect()


@pytest.mark.parametrize("overlap", [0, 3])
@pytest.mark.parametrize("interfere", [rollout_of, reset_some, step_raw, load, another_collector])
def test_what_others_did_to_the_env_leaks_into_no_window(
    interfere: Callable[[ArcadeEnv], None], overlap: int
) -> None:
    """The overlap is dropped, the policy's state begins anew, episode numbers go on; none goes on
    after its end.
    """
    collector = stub_collector(Recurrent(), overlap=overlap)
    before = collector.collect()
    interfere(collector.env)
    state, ended = collector.env.get_state(), collector.env.observe()["done"]
    assert ended.any() == (interfere is rollout_of)
    batch = collector.collect()
    assert batch["is_init"][:, 0][ended].all()
    expected = stub_collector(Recurrent(), overlap=overlap)
    expected.collect()
    expected.env.set_state(state)
    expected.env.reset(TensorDict({"_reset": ended}, [N]))
    assert_same(batch, expected.collect())
    assert torch.equal(replay(batch), batch["total"]) and not torch.equal(
        before["pixels"], batch["pixels"]
    )
    inside, done = batch["is_init"][:, 1:], batch["next", "done"][:, :-1]
    assert torch.equal(inside, done)


@pytest.mark.parametrize("interfere", [rollout_of, reset_some, step_raw, load])
def test_a_collector_saved_after_others_moved_the_env_is_resumed_as_it_goes_on(
    interfere: Any, tmp_path: Any
) -> None:
    """And it goes on as one that was never saved."""
    collector, unsaved, other = (
        stub_collector(Recurrent(), seed=seed, overlap=3) for seed in (3, 3, 77)
    )
    for one in (collector, unsaved):
        one.collect()
        torch.manual_seed(0)  # of the actions that others take
        interfere(one.env)
    resumed(collector, other, tmp_path / "collector.pt")
    assert_same(collector.env.observe(), unsaved.env.observe())
    for window in (ArcadeCollector.collect, lambda one: next(one.iterator())):
        expected = window(unsaved)
        assert_same(window(collector), expected)
        assert_same(window(other), expected)


def test_an_episode_number_is_given_once_also_when_others_moved_the_env() -> None:
    collector, numbers = stub_collector(scripted, HASTY), set()
    for batch in itertools.islice(collector.iterator(), 3):
        ids = batch["collector", "traj_ids"]
        own = [set(row) for row in ids.tolist()]
        assert len(set().union(*own)) == sum(map(len, own)), "two envs have the same number"
        assert not numbers & set().union(*own)
        numbers |= set().union(*own)
        step_raw(collector.env)


def test_two_collectors_that_take_turns_on_one_env_both_go_on_from_where_it_is() -> None:
    env = stub_env()
    collectors = [ArcadeCollector(env, scripted, N * T) for _ in range(2)]
    path = [collectors[window % 2].collect() for window in range(6)]
    for one, two in itertools.pairwise(path[1:]):  # the second collector began with a reset
        going_on = ~one["next", "done"][:, -1, 0]
        assert torch.equal(two["pixels"][:, 0][going_on], one["next", "pixels"][:, -1][going_on])
        assert torch.equal(
            two["step_count"][:, 0][going_on], one["next", "step_count"][:, -1][going_on]
        )


def test_hooks_are_called_and_statistics_counted() -> None:
    seen: list[int] = []
    collector = stub_collector(
        scripted, total_frames=2 * N * T, post_collect_hook=lambda batch: seen.append(batch.numel())
    )
    collector.pre_collect_hook = lambda: seen.append(0)
    list(collector)
    assert seen == [0, N * T, 0, N * T]
    assert collector.stats()["frames"] == 2 * N * T


def test_a_collector_that_was_shut_down_says_so() -> None:
    collector = stub_collector(scripted)
    collector.collect()
    collector.shutdown()
    collector.shutdown()
    with pytest.raises(RuntimeError, match="the collector has been shut down"):
        collector.collect()
    collector.env.rollout(3)  # the env can still be used


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"frames_per_batch": 7},
            ValueError,
            "frames_per_batch is 7, expected an int multiple of num_envs (6)",
        ),
        ({"frames_per_batch": 0}, ValueError, "frames_per_batch is 0, expected an int multiple"),
        ({"frames_per_batch": 48.0}, TypeError, "frames_per_batch is 48.0, expected an int"),
        ({"overlap": -1}, ValueError, "overlap is -1, expected an int of 0 or more"),
        ({"overlap": 2.0}, TypeError, "overlap is 2.0, expected an int"),
        (
            {"final_frames": "some"},
            ValueError,
            "final_frames is 'some', allowed: 'all', 'truncated', 'none'",
        ),
        ({"policy": 3}, TypeError, "policy is an int, expected a TensorDictModule"),
        (
            {"policy": lambda pixels: pixels},
            TypeError,
            "policy takes the tensor pixels, expected one that takes a TensorDict: pass "
            "TensorDictModule(policy, ['pixels'], ['action'])",
        ),
    ],
)
def test_wrong_arguments_are_explained(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        stub_collector(options.pop("policy", scripted), **options)


@pytest.mark.parametrize(
    ("policy", "gives"),
    [
        (lambda td: td["last_action"], "a Tensor"),
        (lambda td: None, "a NoneType"),
        (lambda td: td.select("pixels"), "pixels, but no 'action'"),
    ],
)
def test_what_a_policy_has_to_give_is_explained(policy: Any, gives: str) -> None:
    with pytest.raises(TypeError, match=f"^the policy gives {gives}, expected the TensorDict"):
        stub_collector(policy).collect()


@pytest.mark.parametrize("keys", [("done", "terminated", "truncated"), ("truncated",)])
def test_a_policy_may_read_whether_an_episode_has_ended(keys: tuple[str, ...]) -> None:
    """As in TorchRL's ``Collector``; where policies act, none has."""
    policy = TensorDictModule(
        lambda frames, *ends: frames[:, 0, 0, 0].long() % 5 * ~torch.cat(ends, 1).any(1),
        ["pixels", *keys],
        ["action"],
    )
    for module in (policy, lambda td: policy(td)):  # functions name no keys
        ours = next(stub_collector(module).iterator())
        stock = Collector(stub_env(GAME, 3), module, frames_per_batch=N * T, total_frames=N * T)
        theirs = next(iter(stock))
        assert ours["action"].any() and torch.equal(ours["action"], theirs["action"])
        assert set(ours.keys(True, True)) == set(theirs.keys(True, True))


def test_a_compiled_policy_takes_the_weights_of_one_that_is_not() -> None:
    def module() -> TensorDictModule:
        head = nn.Sequential(nn.Linear(1, 5), nn.Flatten(0, -2))
        act = TensorDictModule(lambda q: q.argmax(-1), ["q"], ["action"])
        read = TensorDictModule(lambda frames: frames[:, 0, 0, :1].float(), ["pixels"], ["x"])
        return TensorDictSequential(read, TensorDictModule(head, ["x"], ["q"]), act)

    compiled = torch.compile(module(), backend="eager")
    for one, other in ((compiled, module()), (module(), compiled)):
        stub_collector(one).update_policy_weights_(other)
        for a, b in zip(one.parameters(), other.parameters(), strict=True):
            assert torch.equal(a, b)


def test_wrong_envs_are_explained() -> None:
    with pytest.raises(TypeError, match=r"env is a function, .* is called first"):
        ArcadeCollector(stub_env, scripted, N * T)  # type: ignore[arg-type]
    with pytest.raises(
        TypeError, match=r"TransformedEnv, expected an ArcadeEnv or what from_jax gives; others go"
    ):
        ArcadeCollector(TransformedEnv(stub_env()), scripted, N * T)
    with pytest.raises(ValueError, match="make the env with categorical_actions=True"):
        ArcadeCollector(stub_env(categorical_actions=False), scripted, N * T)


@pytest.mark.parametrize("mode", ["truncated", "none"])
def test_an_overlap_without_the_next_frames_that_batches_show_is_refused(mode: Any) -> None:
    collector = stub_collector(scripted, overlap=2, final_frames=mode)
    collector.collect()
    with pytest.raises(ValueError, match="saved overlap 'dense/pixels' is None"):
        stub_collector(scripted, overlap=2).load_state_dict(collector.state_dict())


def test_after_a_state_that_was_refused_windows_are_whole() -> None:
    """Before: the overlap was half that of the refused state, which no memory had acted."""
    saved = stub_collector(Recurrent(), overlap=3, final_frames="truncated")
    saved.collect()
    collector = stub_collector(Recurrent(), seed=77, overlap=3)
    collector.collect()
    with pytest.raises(ValueError, match="saved overlap"):
        collector.load_state_dict(saved.state_dict())
    for _ in range(2):
        batch = collector.collect()
        assert torch.equal(replay(batch), batch["total"])
        assert torch.equal(batch["is_init"][:, 1:], batch["next", "done"][:, :-1])


def test_weights_that_a_state_lacks_are_refused_unless_they_may() -> None:
    head = nn.Sequential(nn.Linear(3, 5), nn.Flatten(0, -2))
    policy = TensorDictSequential(
        TensorDictModule(lambda frames: frames[:, 0, 0].float(), ["pixels"], ["x"]),
        TensorDictModule(head, ["x"], ["q"]),
        TensorDictModule(lambda q: q.argmax(-1), ["q"], ["action"]),
    )
    collector = stub_collector(policy)
    state = collector.state_dict()
    weights = dict(state["policy_state_dict"])
    name = next(iter(weights))
    state["policy_state_dict"] = {key: value for key, value in weights.items() if key != name}
    with pytest.raises(RuntimeError, match=re.escape(name)):
        collector.load_state_dict(state)
    collector.load_state_dict(state, strict=False)
    del state["policy_state_dict"]
    collector.load_state_dict(state, strict=False)
    collector.collect()


def test_a_recurrent_state_of_another_policy_is_refused() -> None:
    collector = stub_collector(Recurrent())
    collector.collect()
    with pytest.raises(ValueError, match="the saved recurrent state is not one of this policy"):
        stub_collector(None).load_state_dict(collector.state_dict())


def test_a_state_of_other_sizes_is_refused() -> None:
    state = stub_collector(scripted).state_dict()
    with pytest.raises(
        ValueError, match=re.escape("(envs, steps, overlap) [6, 8, 0], this one has [6, 8, 2]")
    ):
        stub_collector(scripted, overlap=2).load_state_dict(state)


def test_what_a_policy_writes_in_the_place_of_the_envs_outcomes_is_overwritten() -> None:
    """Before: the reward of a batch was what a policy had written under "next"."""

    def writes(pixels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        nines = torch.full((len(pixels), 1), 9)
        return pixels + 1, nines.float(), nines > 0, nines, nines

    names = ("pixels", "reward", "terminated", "step_count")
    keys = [*(("next", name) for name in names), ("collector", "guess")]
    policy = TensorDictSequential(
        TensorDictModule(writes, ["pixels"], keys),
        TensorDictModule(lambda frames: frames[:, 0, 0, 0].long() % 5, ["pixels"], ["action"]),
    )
    batch = next(stub_collector(policy).iterator())
    expected = next(stub_collector(policy[1]).iterator())
    assert set(batch.keys(True, True)) - set(expected.keys(True, True)) == {("collector", "guess")}
    for key in expected.keys(True, True):
        assert torch.equal(batch[key], expected[key]), key
