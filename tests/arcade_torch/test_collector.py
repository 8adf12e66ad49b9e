"""Laws of the collector: the same data as TorchRL's, every frame once, sequences that replay, resuming to the bit."""

import copy
import re
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type

from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.frames import FramePool, next_pixels, shift_next
from tests.arcade_torch.stub import GAME, LOCKSTEP, MIXED

N, T = 6, 8


def stub_env(game: CompiledGame = GAME, seed: int = 3, **options: Any) -> ArcadeEnv:
    return ArcadeEnv(game, N, seed=seed, **options)


def stub_collector(policy: Any, game: CompiledGame = GAME, seed: int = 3, **options: Any) -> ArcadeCollector:
    return ArcadeCollector(stub_env(game, seed), policy, options.pop("frames_per_batch", N * T), **options)


def scripted(td: TensorDictBase) -> TensorDictBase:
    """A deterministic policy that reads the frame, the counts and the last action."""
    pixels = td["pixels"][:, :, 0, 0].long()
    td["action"] = (pixels.sum(-1) + 3 * td["step_count"].squeeze(-1) + td["last_action"]) % 5
    td["value"] = td["episode_reward"] + 1
    return td


class Recurrent:
    """A deterministic actor with a memory: a leaky sum of what it saw, forgotten at the start of an episode."""

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"sum": torch.full((batch_size, 1), 0.5)}, [batch_size])

    def act(self, obs: TensorDict, state: TensorDict) -> tuple[torch.Tensor, dict[str, torch.Tensor], TensorDict]:
        seen = obs["pixels"].flatten(1).float().sum(-1, keepdim=True) / 1000 + obs["last_action"].unsqueeze(-1)
        total = torch.where(obs["is_init"], 0.0, state["sum"]) / 2 + seen
        action = (total.squeeze(-1) * 7).long() % 5
        return action, {"total": total}, TensorDict({"sum": total}, state.batch_size)


def assert_same(one: TensorDictBase, two: TensorDictBase) -> None:
    """Same keys, same bits."""
    keys = set(one.keys(True, True))
    assert keys == set(two.keys(True, True))
    different = [key for key in keys if not torch.equal(one[key], two[key])]
    assert not different, different


def tensors(batch: TensorDictBase) -> TensorDictBase:
    """A copy of a batch of sequences, with the true next frames in place of the pool."""
    out = batch.exclude("next_pool", ("next", "frame_slot")).clone()
    out["next", "pixels"] = next_pixels(batch)
    return out


# -- the same data as TorchRL's ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("game", "steps"), [(GAME, 200), (LOCKSTEP, 24), (MIXED, 24)])  # 1000 and 120 steps an env
def test_iteration_gives_the_data_of_torchrls_collector_and_of_rollout(game: CompiledGame, steps: int) -> None:
    windows = 5
    options = {"frames_per_batch": N * steps, "total_frames": N * steps * windows}
    stock = torch.cat(list(Collector(stub_env(game), scripted, **options)), 1)
    ours = torch.cat(list(stub_collector(scripted, game, return_same_td=False, **options)), 1)
    rollout = stub_env(game).rollout(steps * windows, scripted, break_when_any_done=False)
    assert ours["next", "done"].sum() > N * steps // 2
    assert ours.names == stock.names == [None, "time"]
    assert_same(ours, stock)
    assert_same(ours.exclude("collector"), rollout)


def test_compact_batches_lack_only_the_next_frames_and_can_have_them_back() -> None:
    full = list(stub_collector(scripted, total_frames=3 * N * T, return_same_td=False))
    compact = list(stub_collector(scripted, total_frames=3 * N * T, return_same_td=False, compact_obs=True))
    for one, two in zip(full, compact, strict=True):
        assert ("next", "pixels") not in two.keys(True)
        assert torch.equal(next_pixels(two), one["next", "pixels"])
        assert_same(one.exclude(("next", "pixels")), two.exclude("next_pool", ("next", "frame_slot")))


@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_sequences_hold_the_data_of_a_rollout(game: CompiledGame) -> None:
    rollout = stub_env(game).rollout(10 * T, scripted, break_when_any_done=False)
    collector = stub_collector(scripted, game)
    windows = torch.cat([tensors(collector.collect()).auto_batch_size_(2) for _ in range(10)], 1)
    keys = [key for key in windows.keys(True, True) if key[0] != "initial_state"]
    assert len(keys) > 12
    assert_same(windows.select(*keys), rollout.select(*keys))


# -- the next frames --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["all", "truncated", "none"])
def test_final_frames_are_kept_as_asked(mode: str) -> None:
    collector, reference = stub_collector(scripted, final_frames=mode), stub_collector(scripted)
    slots_seen = 0
    for _ in range(20):
        batch, full = tensors_and_slots(collector), tensors(reference.collect())
        terminated, truncated = (full["next", key].squeeze(-1) for key in ("terminated", "truncated"))
        wanted = {"all": terminated | truncated, "truncated": truncated & ~terminated}.get(mode, truncated & False)
        slots = batch["slot"].squeeze(-1)
        assert torch.equal(slots[:, :-1] >= 0, wanted[:, :-1])
        assert (slots[:, -1] >= 0).all()
        true = wanted | ~(terminated | truncated)
        assert torch.equal(batch["next", "pixels"][true], full["next", "pixels"][true])
        replaced = ~true
        replaced[:, -1] = False
        follower = batch["pixels"].roll(-1, 1)
        assert torch.equal(batch["next", "pixels"][replaced], follower[replaced])
        slots_seen += int((slots[:, :-1] >= 0).sum())
    assert (slots_seen > 0) == (mode != "none")


def tensors_and_slots(collector: ArcadeCollector) -> TensorDictBase:
    batch = collector.collect()
    return tensors(batch).set("slot", batch["next", "frame_slot"].clone())


def test_selected_rows_keep_their_next_frames() -> None:
    batch = stub_collector(scripted, LOCKSTEP).collect()
    rows = torch.tensor([4, 0, 2])
    assert torch.equal(next_pixels(batch[rows]), next_pixels(batch)[rows])
    assert torch.equal(next_pixels(batch[1:3]), next_pixels(batch)[1:3])


def test_a_batch_without_successors_is_refused() -> None:
    with pytest.raises(ValueError, match="the last step of the batch has no successor"):
        shift_next(torch.zeros(1, 2), torch.zeros(1), torch.tensor([[[0], [-1]]]))
    with pytest.raises(KeyError, match="the batch has no 'next_pool'"):
        next_pixels(TensorDict({"pixels": torch.zeros(1, 2)}, [1]))


def test_gradients_reach_both_the_window_and_the_pool() -> None:
    current, pool = torch.randn(2, 3, 4, requires_grad=True), torch.randn(3, 4, requires_grad=True)
    slot = torch.tensor([[-1, 2, 0], [-1, -1, 1]]).unsqueeze(-1)
    shift_next(current, pool, slot).sum().backward()
    assert current.grad is not None and pool.grad is not None
    assert current.grad[..., 0].tolist() == [[0, 1, 0], [0, 1, 1]]
    assert pool.grad[:, 0].tolist() == [1, 1, 1]


def test_a_pool_grows_and_keeps_what_it_holds() -> None:
    pool = FramePool(torch.Size([2]), 1)
    first = pool.append(torch.tensor([[1, 2]], dtype=torch.uint8))
    second = pool.append(torch.tensor([[3, 4], [5, 6]], dtype=torch.uint8))
    assert first.tolist() == [0] and second.tolist() == [1, 2]
    assert pool.pixels.tolist() == [[1, 2], [3, 4], [5, 6]]
    copied = copy.deepcopy(pool)
    pool.resize(1)
    assert len(pool) == 1 and len(copied) == 3


# -- recurrent state and context --------------------------------------------------------------------------------------


def replay(batch: TensorDictBase) -> torch.Tensor:
    """Act again over a batch of sequences, from its initial state; returns the extras."""
    actor, state = Recurrent(), batch["initial_state"]
    totals = []
    for time in range(batch["action"].shape[1]):
        obs = TensorDict({key: batch[key][:, time] for key in ("pixels", "last_action", "is_init")}, batch.batch_size)
        action, extras, state = actor.act(obs, state)
        assert torch.equal(action, batch["action"][:, time])
        totals.append(extras["total"])
    return torch.stack(totals, 1)


@pytest.mark.parametrize("context", [0, 3, T, T + 3, 3 * T])
@pytest.mark.parametrize("game", [GAME, LOCKSTEP])
def test_sequences_replay_from_their_initial_state_and_begin_with_the_context(game: CompiledGame, context: int) -> None:
    collector = stub_collector(Recurrent(), game, context=context)
    before = None
    for _ in range(6):
        batch = collector.collect()
        assert batch["pixels"].shape[:2] == (N, context + T)
        assert torch.equal(replay(batch), batch["total"])
        now = tensors(batch).exclude("initial_state").auto_batch_size_(2)
        if before is not None and context:
            assert_same(now[:, :context], before[:, -context:])
        before = now


def test_the_context_holds_the_same_path_as_windows_without_context() -> None:
    plain = stub_collector(Recurrent())
    path = torch.cat([tensors(plain.collect()).exclude("initial_state").auto_batch_size_(2) for _ in range(6)], 1)
    collector = stub_collector(Recurrent(), context=3)
    for window in range(4):
        now = tensors(collector.collect()).exclude("initial_state").auto_batch_size_(2)
        assert_same(now, path[:, window * T : window * T + T + 3])
    assert collector.frames == 4 * N * T


def test_iteration_with_a_context_gives_only_the_new_steps() -> None:
    plain = torch.cat(list(stub_collector(scripted, total_frames=5 * N * T, return_same_td=False)), 1)
    batches = stub_collector(scripted, context=3, total_frames=4 * N * T, return_same_td=False)
    ours = torch.cat(list(batches), 1).exclude("collector")
    assert_same(ours, plain[:, 3 : 3 + 4 * T].exclude("collector"))


# -- storage ----------------------------------------------------------------------------------------------------------


def test_storage_is_reused_unless_copies_are_asked_for() -> None:
    collector = stub_collector(scripted)
    first, second = collector.collect(), collector.collect()
    assert first["pixels"].data_ptr() == second["pixels"].data_ptr()
    collector = stub_collector(scripted, return_same_td=False)
    first = collector.collect()
    kept = tensors(first)
    collector.collect()
    assert_same(tensors(first), kept)


def test_a_frame_is_stored_once_and_the_pool_stays_small() -> None:
    collector = stub_collector(scripted, LOCKSTEP)
    for _ in range(20):
        batch = collector.collect()
    ends_a_window = N * 2
    assert batch["pixels"].untyped_storage().nbytes() == N * T * 8 * 8 * 3
    assert batch["next_pool"]._buffer.shape[0] <= 2 * (N + ends_a_window)


def test_what_is_stored_of_a_frame_is_what_the_policy_saw() -> None:
    seen = []

    def policy(td: TensorDictBase) -> TensorDictBase:
        seen.append(td["pixels"].clone())
        return td.set("action", torch.arange(N) % 5)

    def compress(pixels: torch.Tensor) -> torch.Tensor:
        return pixels[..., ::2, ::4, :] + 1

    batch = tensors(stub_collector(policy, compress=compress).collect())
    full = tensors(stub_collector(policy).collect())
    assert batch["pixels"].shape == (N, T, 4, 2, 3)
    assert torch.equal(batch["pixels"], torch.stack(seen[:T], 1))
    for key in ("pixels", ("next", "pixels")):
        assert torch.equal(batch[key], compress(full[key]))


# -- control ----------------------------------------------------------------------------------------------------------


def resumed(collector: ArcadeCollector, other: ArcadeCollector, path: Any) -> None:
    torch.save(collector.state_dict(), path)
    other.load_state_dict(torch.load(path, weights_only=True))


@pytest.mark.parametrize(("game", "context"), [(GAME, 0), (GAME, 3), (GAME, T + 3), (MIXED, 3)])
@pytest.mark.parametrize("policy", [Recurrent, lambda: None, lambda: scripted])
def test_a_resumed_collector_goes_on_to_the_bit(policy: Any, game: CompiledGame, context: int, tmp_path: Any) -> None:
    collector = stub_collector(policy(), game, context=context, init_random_frames=N * T)
    for _ in range(3):
        collector.collect()
    other = stub_collector(policy(), game, seed=77, context=context, init_random_frames=N * T)
    other.collect()
    resumed(collector, other, tmp_path / "collector.pt")
    assert other.frames == collector.frames
    for _ in range(3):
        assert_same(tensors(other.collect()), tensors(collector.collect()))


def test_a_collector_that_has_not_begun_can_be_resumed(tmp_path: Any) -> None:
    collector, other = stub_collector(None, seed=1), stub_collector(None, seed=2)
    resumed(collector, other, tmp_path / "collector.pt")
    assert_same(tensors(other.collect()), tensors(collector.collect()))


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
    first = tensors(collector.collect())
    collector.collect()
    collector.set_seed(5)
    assert_same(tensors(collector.collect()), first)
    other = ArcadeCollector(stub_env(seed=8), None, N * T, seed=5)
    assert_same(tensors(other.collect()), first)


def test_iteration_ends_after_total_frames() -> None:
    collector = stub_collector(scripted, total_frames=2 * N * T + 1)
    assert len(list(collector)) == 3
    assert collector.frames == 3 * N * T
    assert list(collector) == []


def test_random_frames_come_first_and_the_env_took_them() -> None:
    collector = stub_collector(lambda td: td.set("action", torch.full((N,), 4)), init_random_frames=N * T + 1)
    first, second, third = (collector.collect()["action"].clone() for _ in range(3))
    assert first.unique().numel() == second.unique().numel() == 5
    assert (third == 4).all()


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
    assert (batch["pixels"][:, :, 1:4] == 0).all()  # the stub's partial frames hide the serial number


def test_an_env_that_was_stepped_in_between_is_looked_at_again() -> None:
    collector = stub_collector(scripted)
    collector.collect()
    collector.env.rollout(3)
    expected = collector.env.observe()
    batch = collector.collect()
    assert torch.equal(batch["pixels"][:, 0], expected["pixels"])
    assert torch.equal(batch["step_count"][:, 0], expected["step_count"])


def test_hooks_are_called_and_statistics_counted() -> None:
    seen: list[int] = []
    collector = stub_collector(
        scripted, total_frames=2 * N * T, post_collect_hook=lambda batch: seen.append(batch.numel())
    )
    list(collector)
    assert seen == [N * T, N * T]
    assert collector.stats()["frames"] == 2 * N * T


def test_a_collector_that_was_shut_down_says_so() -> None:
    collector = stub_collector(scripted)
    collector.collect()
    collector.shutdown()
    collector.shutdown()
    with pytest.raises(RuntimeError, match="the collector has been shut down"):
        collector.collect()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"frames_per_batch": 7}, ValueError, "frames_per_batch is 7, expected a multiple of num_envs (6)"),
        ({"frames_per_batch": 0}, ValueError, "frames_per_batch is 0, expected a multiple"),
        ({"context": -1}, ValueError, "context is -1, expected 0 or more"),
        ({"final_frames": "some"}, ValueError, "final_frames is 'some', allowed: 'all', 'truncated', 'none'"),
        ({"policy": 3}, TypeError, "policy is a int, expected a TensorDictModule"),
    ],
)
def test_wrong_arguments_are_explained(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=re.escape(message)):
        stub_collector(options.pop("policy", scripted), **options)


def test_wrong_envs_are_explained() -> None:
    with pytest.raises(TypeError, match=r"env is a TransformedEnv, expected an ArcadeEnv; others go with torchrl"):
        ArcadeCollector(TransformedEnv(stub_env()), scripted, N * T)
    with pytest.raises(ValueError, match="make the env with categorical_actions=True"):
        ArcadeCollector(stub_env(categorical_actions=False), scripted, N * T)


def test_a_state_of_other_sizes_is_refused() -> None:
    state = stub_collector(scripted).state_dict()
    with pytest.raises(ValueError, match=re.escape("(envs, steps, context) [6, 8, 0], this one has [6, 8, 2]")):
        stub_collector(scripted, context=2).load_state_dict(state)
