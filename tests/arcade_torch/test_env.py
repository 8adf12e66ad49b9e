"""Laws of the env: specs, zero copy, seeds, resets, snapshots, observability."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.batch import env_keys
from arcade_torch.factory import make
from tests.arcade_torch.same import assert_same
from tests.arcade_torch.stub import GAME, LOCKSTEP, MIXED

N = 6


def stub_env(game: CompiledGame = GAME, num_envs: int = N, **options: Any) -> ArcadeEnv:
    return ArcadeEnv(game, num_envs, **options)


def scripted(td: TensorDictBase) -> TensorDictBase:
    """A deterministic policy that reads the frame, the counts and the last action."""
    pixels = td["pixels"][:, :, 0, 0].long()
    td["action"] = (pixels.sum(-1) + 3 * td["step_count"].squeeze(-1) + td["last_action"]) % 5
    return td


def stock_rollout(env: ArcadeEnv, steps: int) -> TensorDict:
    """TorchRL's own way: step, move to the root, reset by mask."""
    td, taken = env.reset(), []
    for _ in range(steps):
        td = env.step(scripted(td))
        taken.append(td)
        td = env.maybe_reset(env.step_mdp(td))
    return torch.stack(taken, 1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"categorical_actions": False},
        {"state_in_td": True},
        {"task_in_td": True},
        {"game": MIXED},
        {"game": MIXED, "state_in_td": True},
        {"game": MIXED, "task_in_td": False},
    ],
)
def test_specs_describe_the_data(options: dict[str, Any]) -> None:
    check_env_specs(stub_env(**options), break_when_any_done="both", seed=0)


@pytest.mark.parametrize("game", [GAME, LOCKSTEP, MIXED])
def test_the_fused_path_and_torchrls_stock_path_give_the_same_bits(game: CompiledGame) -> None:
    fused = stub_env(game, seed=3).rollout(80, scripted, break_when_any_done=False)
    stock = stock_rollout(stub_env(game, seed=3), 80)
    assert fused["next", "done"].sum() > 40
    assert_same(fused.contiguous(), stock.contiguous())


def test_next_pixels_at_an_end_is_the_true_final_frame_and_the_root_is_fresh() -> None:
    env = stub_env(LOCKSTEP, seed=1)
    data = env.rollout(12, scripted, break_when_any_done=False)
    ended = data["next", "done"].squeeze(-1)
    assert torch.equal(ended.sum(0), torch.tensor([0, 0, 0, 0, N] * 2 + [0, 0]))
    count = data["next", "pixels"][..., 0, 0, 0]  # the stub draws its step count
    assert (count[ended] == 5).all()
    assert (data["pixels"][:, 5, 0, 0, 0] == 0).all()
    assert torch.equal(
        data["next", "pixels"][:, :-1][~ended[:, :-1]], data["pixels"][:, 1:][~ended[:, :-1]]
    )


def test_done_is_terminated_or_truncated_and_a_time_limit_only_truncates() -> None:
    following = stub_env(LOCKSTEP).rollout(10, break_when_any_done=False)["next"]
    assert torch.equal(following["done"], following["terminated"] | following["truncated"])
    assert following["truncated"].any() and not following["terminated"].any()


def test_native_counts_are_those_of_torchrls_transforms() -> None:
    transforms = Compose(
        InitTracker("start"), StepCounter(step_count_key="steps"), RewardSum(["reward"], ["total"])
    )
    env = TransformedEnv(stub_env(seed=5), transforms)
    data = env.rollout(100, scripted, break_when_any_done=False)
    for native, theirs in (
        ("is_init", "start"),
        ("step_count", "steps"),
        ("episode_reward", "total"),
    ):
        assert torch.equal(data[native], data[theirs])
        assert torch.equal(data["next", native], data["next", theirs])
    plain = stub_env(seed=5).rollout(100, scripted, break_when_any_done=False)
    assert_same(plain, data.select(*plain.keys(True, True)))


def test_last_action_is_the_action_that_led_here_also_over_an_end() -> None:
    data = stub_env().rollout(50, break_when_any_done=False)
    assert torch.equal(data["last_action"][:, 1:], data["action"][:, :-1])
    assert torch.equal(data["next", "last_action"], data["action"])
    assert (data["last_action"][:, 0] == 0).all()
    env, action = stub_env(), torch.full((N,), 3)
    taken, root = env.step_and_maybe_reset(env.reset().set("action", action))
    action.zero_()  # a policy may write its next actions there
    assert (taken["next", "last_action"] == 3).all() and (root["last_action"] == 3).all()


@pytest.mark.parametrize("game", [LOCKSTEP, MIXED])
def test_frames_are_the_memory_that_jax_wrote(
    monkeypatch: pytest.MonkeyPatch, game: CompiledGame
) -> None:
    env = stub_env(game)
    written = []
    compiled = env._compiled.step
    monkeypatch.setattr(
        env._compiled, "step", lambda *args: written.append(compiled(*args)) or written[-1]
    )
    td, following = env.step_and_maybe_reset(scripted(env.reset()))
    pixels = written[0].pixels
    assert (
        td["next", "pixels"].data_ptr()
        == following["pixels"].data_ptr()
        == pixels.unsafe_buffer_pointer()
    )


@pytest.mark.parametrize("game", [LOCKSTEP, MIXED])
def test_a_second_env_compiles_nothing_also_at_ends(game: CompiledGame) -> None:
    def compiled() -> list[int]:
        return [function._cache_size() for function in (game.step, game.draw)]

    stub_env(game).rollout(20, scripted, break_when_any_done=False)
    before = compiled()
    stub_env(game).rollout(20, scripted, break_when_any_done=False)
    assert compiled() == before and min(before) > 0


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_an_env_begins_where_init_begins_and_compiles_its_reset_once(game: CompiledGame) -> None:
    env = stub_env(game, seed=0)
    begun = game.batched.init(env_keys(0, N), np.zeros(N, np.bool_))
    key = torch.from_numpy(np.array(env_keys(0, N)).view(np.int32))  # a seed sets it again
    exported = env._snapshots.export(begun).set("key", key)
    assert_same(env.get_state(), exported)
    compiled = game.batched.reset_render._cache_size()
    env.rollout(3, scripted)
    env.reset()
    assert game.batched.reset_render._cache_size() == compiled > 0


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_writing_to_what_the_env_gave_does_not_change_its_future(game: CompiledGame) -> None:
    wanton, careful = stub_env(game, seed=2), stub_env(game, seed=2)
    ours, theirs = wanton.reset(), careful.reset()
    for _ in range(10):
        taken, following = wanton.step_and_maybe_reset(scripted(ours))
        ours = following.clone()
        taken.zero_()
        following.zero_()
        _, theirs = careful.step_and_maybe_reset(scripted(theirs))
        assert_same(ours, theirs)


@given(mask=st.lists(st.booleans(), min_size=N, max_size=N), seed=st.integers(0, 9))
def test_a_partial_reset_leaves_the_other_envs_bit_identical(mask: list[bool], seed: int) -> None:
    env = stub_env(seed=seed)
    td = env.step_mdp(env.step(scripted(env.reset())))
    before = env.get_state()
    chosen = torch.tensor(mask)
    out = env.reset(td.clone().set("_reset", chosen.unsqueeze(-1)))
    assert_same(env.get_state()[~chosen], before[~chosen])
    keys = ("pixels", "last_action", "step_count", "episode_reward", "is_init")
    assert_same(out[~chosen].select(*keys), td[~chosen].select(*keys))
    assert (out[chosen]["step_count"] == 0).all() and out[chosen]["is_init"].all()
    fresh = (
        env.get_state()["state", "clock", "serial"][chosen]
        != before["state", "clock", "serial"][chosen]
    )
    assert fresh.all()


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_resetting_all_by_mask_is_resetting_all(game: CompiledGame) -> None:
    one, two = stub_env(game, seed=4), stub_env(game, seed=4)
    td = one.step_mdp(one.step(scripted(one.reset())))
    two.step(scripted(two.reset()))
    by_mask = one.reset(td.set("_reset", torch.ones(N, 1, dtype=torch.bool)))
    assert torch.equal(by_mask["pixels"], two.reset()["pixels"])


@settings(max_examples=4)
@given(first=st.sampled_from([1, 4]), seed=st.integers(0, 2**32 - 1))
def test_an_env_walks_the_same_path_whatever_the_batch_size(first: int, seed: int) -> None:
    small, large = stub_env(num_envs=first), stub_env()
    small.set_seed(seed)
    large.set_seed(seed)
    one = small.rollout(8, scripted, break_when_any_done=False)
    many = large.rollout(8, scripted, break_when_any_done=False)
    assert_same(one, many[:first])


def test_the_seed_of_the_constructor_is_the_seed_of_set_seed() -> None:
    env = stub_env(seed=0)
    env.rollout(5)
    env.set_seed(11)
    assert_same(env.rollout(20, scripted), stub_env(seed=11).rollout(20, scripted))


def test_the_first_reset_after_seeding_is_the_games_own_first_state() -> None:
    env = stub_env(seed=8)
    batch = GAME.batched.init(env_keys(8, N), np.zeros(N, bool))
    assert np.array_equal(env.reset()["pixels"].numpy(), np.asarray(GAME.batched.render(batch)))


def test_without_a_seed_torch_draws_one() -> None:
    torch.manual_seed(0)
    one, two = (stub_env(seed=None).reset()["pixels"] for _ in range(2))
    assert not torch.equal(one, two)
    torch.manual_seed(0)
    assert torch.equal(stub_env(seed=None).reset()["pixels"], one)


def test_set_seed_returns_another_seed_unless_static() -> None:
    env = stub_env()
    assert env.set_seed(3) != 3
    assert env.set_seed(3, static_seed=True) == 3


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_a_snapshot_gives_the_same_future_on_another_env(game: CompiledGame) -> None:
    env, other = stub_env(game, seed=1), stub_env(game, seed=99)
    td = env.rollout(10, scripted, break_when_any_done=False)[:, -1]
    snapshot = env.get_state()
    expected = env.rollout(
        60, scripted, break_when_any_done=False, auto_reset=False, tensordict=env.observe()
    )
    other.rollout(3)
    root = other.set_state(snapshot)
    assert torch.equal(root["step_count"], td["next", "step_count"])
    future = other.rollout(
        60, scripted, break_when_any_done=False, auto_reset=False, tensordict=root
    )
    assert_same(expected, future)


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_a_snapshot_can_be_loaded_by_reset_and_saved_without_pickle(
    tmp_path: Any, game: CompiledGame
) -> None:
    env = stub_env(game, seed=1)
    env.rollout(4)
    torch.save(env.get_state().to_dict(), tmp_path / "state.pt")
    state = TensorDict(torch.load(tmp_path / "state.pt", weights_only=True), [N])
    root = stub_env(game, seed=2).reset(TensorDict({"state": state}, [N]), set_state=True)
    assert_same(root.select("pixels", "step_count"), env.observe().select("pixels", "step_count"))


def test_what_is_observed_after_an_end_says_so_until_it_is_reset_or_loaded() -> None:
    env = stub_env(LOCKSTEP, seed=1)
    odd, last = torch.arange(N) % 2 == 1, env.rollout(100)["next"][:, -1]
    keys = ("done", "terminated", "truncated", "is_init")
    assert last["truncated"].all() and not last["terminated"].any()
    assert_same(env.observe().select(*keys), last.select(*keys))
    env.set_seed(3)  # episodes go on
    env.observe()["truncated"].zero_()
    root = env.reset(env.observe().set("_reset", odd))
    assert (
        root["done"].squeeze(-1).tolist()
        == env.observe()["done"].squeeze(-1).tolist()
        == (~odd).tolist()
    )
    for _ in range(5):  # the others stay where they are until the odd ones have ended too
        assert env.observe()["done"].squeeze(-1).tolist() == (~odd).tolist()
        env.step(scripted(env.observe()).set("_step", odd))
    assert env.observe()["done"].all()
    env.reset()
    for step in range(5):  # at the last all would end, and the odd ones do
        env.step(scripted(env.observe()).set("_step", odd | (step < 4)))
    assert env.observe()["done"].squeeze(-1).tolist() == odd.tolist()
    other = stub_env(LOCKSTEP)
    other.load_state_dict(env.state_dict())
    assert_same(other.observe(), env.observe())
    assert not env.set_state(env.get_state())[
        "done"
    ].any()  # a snapshot does not say what has ended


def test_a_snapshot_is_a_private_copy() -> None:
    env = stub_env(seed=1)
    env.reset()
    before = env.observe()["pixels"].clone()
    snapshot = env.get_state()
    env.get_state().zero_()
    assert torch.equal(env.observe()["pixels"], before)
    env.set_state(snapshot)
    snapshot.zero_()
    assert torch.equal(env.observe()["pixels"], before)


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_state_dict_of_the_env_restores_it(game: CompiledGame) -> None:
    env, other = stub_env(game, seed=1), stub_env(game, seed=2)
    env.rollout(4)
    other.load_state_dict(env.state_dict())
    assert_same(other.get_state(), env.get_state())


@pytest.mark.parametrize("game", [GAME, MIXED])
def test_flipping_observability_in_mid_episode_changes_only_the_frames_and_compiles_nothing(
    game: CompiledGame,
) -> None:
    env, twin = stub_env(game, seed=6), stub_env(game, seed=6)
    actions = torch.randint(0, 5, (30, N))
    ours, theirs = env.reset(), twin.reset()
    compiled = game.step._cache_size()
    flags = torch.arange(N) % 2 == 0
    for time, action in enumerate(actions):
        if time == 10:
            given = flags.clone()
            env.set_observability(given)
            given.logical_not_()  # the caller's own, as is what the property gives
            env.observability.logical_not_()
            assert torch.equal(env.observability, flags)
        taken, ours = env.step_and_maybe_reset(ours.set("action", action))
        other, theirs = twin.step_and_maybe_reset(theirs.set("action", action))
        assert_same(taken["next"].exclude("pixels"), other["next"].exclude("pixels"))
        same = (ours["pixels"] == theirs["pixels"]).flatten(1).all(1)
        assert torch.equal(same, ~flags if time >= 10 else torch.ones(N, dtype=torch.bool))
    assert game.step._cache_size() == compiled or compiled == 0


def test_the_state_in_the_tensordict_is_the_state_that_is_stepped() -> None:
    env = stub_env(seed=3, state_in_td=True)
    root = env.reset()
    first = env.step(root.clone().set("action", torch.full((N,), 4)))
    env.step(root.clone().set("action", torch.zeros(N, dtype=torch.int64)))
    again = env.step(root.clone().set("action", torch.full((N,), 4)))
    assert_same(first, again)
    assert torch.equal(first["next", "state", "step_count"], root["state", "step_count"] + 1)


def test_a_step_from_the_state_in_the_tensordict_shows_the_twin_that_was_set_last() -> None:
    env = stub_env(observability="partial", state_in_td=True)
    root = env.reset()
    env.set_observability("full")
    following = env.step(scripted(root))["next"]
    assert not env.observability.any() and not following["state", "partial"].any()
    assert (
        following["pixels"][:, 1:4] != 0
    ).any()  # the stub's partial frames hide the serial number


def test_one_hot_actions_mean_the_same_as_integers() -> None:
    integer, one_hot = stub_env(seed=3), stub_env(seed=3, categorical_actions=False)
    action = torch.arange(N) % 5
    hot = torch.nn.functional.one_hot(action, 5)
    for written in (hot.bool(), 0.9 * hot):  # a softmax may miss the 1
        ours = integer.step_and_maybe_reset(integer.reset().set("action", action))[0]
        theirs = one_hot.step_and_maybe_reset(one_hot.reset().set("action", written))[0]
        assert_same(ours.exclude("action"), theirs.exclude("action"))
        assert_same(
            integer.step(integer.reset().set("action", action))["next"],
            one_hot.step(one_hot.reset().set("action", written))["next"],
        )


@given(
    action=st.lists(st.integers(0, 4), min_size=N, max_size=N),
    dtype=st.sampled_from([torch.int64, torch.int32, torch.uint8]),
)
def test_any_integer_type_is_taken_and_may_be_overwritten_at_once(
    action: list[int], dtype: torch.dtype
) -> None:
    env, twin = stub_env(seed=3), stub_env(seed=3)
    tensor = torch.tensor(action, dtype=dtype)
    env.reset(), twin.reset()
    env.step_raw(tensor)
    tensor.fill_(0)
    twin.step_raw(torch.tensor(action))
    assert_same(env.get_state(), twin.get_state())
    assert env.get_state()["last_action"].tolist() == action


def test_what_the_policy_wrote_beside_the_action_is_kept_as_on_the_stock_path() -> None:
    def run(env: ArcadeEnv, stock: bool) -> tuple[TensorDictBase, TensorDictBase]:
        stale = torch.full((N, 1), 9.0)  # of the step before, in a tensordict that is used again
        root = scripted(env.reset()).set(
            "next", TensorDict({"memory": torch.arange(N), "reward": stale}, [N])
        )
        root["value"] = torch.ones(N)
        if stock:
            taken = env.step(root)
            return taken, env.maybe_reset(env.step_mdp(taken))
        return env.step_and_maybe_reset(root)

    ours, theirs = run(stub_env(LOCKSTEP), stock=False), run(stub_env(LOCKSTEP), stock=True)
    assert "value" in ours[1] and ("next", "memory") in ours[0].keys(True)
    assert_same(ours[0], theirs[0])
    assert_same(ours[1], theirs[1])


@pytest.mark.parametrize("id", ["CartPoleEasy", "MineSweeperEasy"])
def test_real_games_pass_through(id: str) -> None:
    env = make(id, num_envs=3, partial_obs=True)
    check_env_specs(env, seed=0)
    assert env.observability.all()
    assert make(id, num_envs=3)._compiled is env._compiled


def test_make_hands_on_what_the_env_is_told() -> None:
    env = make(
        "MineSweeperEasy", num_envs=3, categorical_actions=False, state_in_td=True, task_in_td=True
    )
    assert env.one_hot and {"state", "task"} <= set(env.observation_spec.keys())


@pytest.mark.parametrize(
    "options", [{}, {"state_in_td": True}, {"game": MIXED}], ids=["plain", "state", "mixed"]
)
def test_a_step_moves_the_marked_envs_alone(options: dict[str, Any]) -> None:
    """TorchRL hands ``_step`` to envs of a fixed batch size and trusts that they heed it."""
    env, twin = stub_env(seed=3, **options), stub_env(seed=3, **options)
    td, other = env.reset(), twin.reset()
    marked = torch.arange(N) % 3 != 0
    for _ in range(3):  # the envs left alone keep their state, their frames and their dice
        whole = twin.step(scripted(other.clone()))["next"]
        before = td.clone().set("reward", torch.ones(N, 1))  # of an earlier step
        stepped = env.step(scripted(before).set("_step", marked))["next"]
        assert_same(stepped[marked], whole[marked])
        assert (stepped["reward"][~marked] == 0).all()
        assert_same(
            stepped.exclude("reward")[~marked],
            td.select(*stepped.exclude("reward").keys(True, True))[~marked],
        )
        td, other = (env.step_mdp(TensorDict({"next": part}, [N])) for part in (stepped, whole))
    fresh = stub_env(seed=3, **options)
    first = fresh.step(scripted(fresh.reset()))["next"]
    assert_same(env.step(scripted(td))["next"][~marked], first[~marked])
