"""Gymnasium: registered without cost, the same bits as ArcadeEnv, and Gymnasium's own rules at the
ends.
"""

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import arcade_torch
from arcade_torch.envs_jax import probe_ids
from arcade_torch.gym.batch import seed_keys
from arcade_torch.gym.env import ArcadeGymEnv
from arcade_torch.gym.vector import ArcadeVectorEnv
from arcade_torch.gym.window import Window

ROOT = Path(__file__).resolve().parents[2]
GAME = "arcade_torch/MineSweeperEasy-v0"  # both ways to end: a mine, and 32 steps
MODES = tuple(AutoresetMode)


def output_of(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def equal(left: object, right: object) -> bool:
    """Equality of nested observations and infos, types included."""
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(equal(left[key], right[key]) for key in left)
    if isinstance(left, tuple) and isinstance(right, tuple):
        return len(left) == len(right) and all(
            equal(a, b) for a, b in zip(left, right, strict=True)
        )
    if isinstance(left, np.ndarray) and isinstance(right, np.ndarray):
        if left.dtype != right.dtype or left.shape != right.shape:
            return False
        if left.dtype == object:
            return all(equal(a, b) for a, b in zip(left, right, strict=True))
        return bool((left == right).all())
    return type(left) is type(right) and left == right


def random_actions(steps: int, envs: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 5, (steps, envs))


@pytest.mark.parametrize(
    "imports",
    [
        "import arcade_torch, gymnasium",
        "import gymnasium, arcade_torch",
        "import arcade_torch, importlib.util; importlib.util.find_spec('gymnasium'); import "
        "gymnasium",
        "import arcade_torch, importlib; importlib.reload(arcade_torch); import gymnasium",
        "import arcade_torch; from gymnasium.envs.registration import registry; import gymnasium",
    ],
)
def test_the_games_are_registered_whoever_is_imported_first(imports: str) -> None:
    code = (
        f"{imports}\nimport sys\nn = sum(id.startswith('arcade_torch/') for id in "
        "gymnasium.registry)"
    )
    assert output_of(f"{code}\nprint(n, sorted({{'jax', 'torch'}} & set(sys.modules)))") == "30 []"


def test_the_registered_ids_are_those_of_the_games() -> None:
    theirs = {
        id.removeprefix("arcade_torch/")
        for id in gymnasium.registry
        if id.startswith("arcade_torch/")
    }
    assert theirs - set(probe_ids()) == set(arcade_torch.registered_ids())


def test_an_environment_loads_no_torch() -> None:
    """And Gymnasium imports the package itself when the id names it."""
    code = (
        f"import gymnasium, sys; env = gymnasium.make('arcade_torch:{GAME}'); env.reset(); "
        "env.step(4)"
    )
    assert output_of(f"{code}; print('torch' in sys.modules)") == "False"


@pytest.mark.parametrize("observability", ["full", "partial"])
def test_env_and_vector_env_have_the_bits_of_arcade_env(observability: str) -> None:
    """Frames, rewards, ends and counts over many episodes: env 0 alone, all envs as a vector."""
    num_envs, steps = 3, 100
    theirs = arcade_torch.make(
        "MineSweeperEasy", num_envs=num_envs, observability=observability, seed=5
    )
    alone = gymnasium.make(GAME, observability=observability)
    many = gymnasium.make_vec(
        GAME, num_envs=num_envs, observability=observability, autoreset_mode="SameStep"
    )
    root = theirs.reset()
    assert equal(alone.reset(seed=5)[0], root["pixels"][0].numpy())
    assert equal(many.reset(seed=5)[0], root["pixels"].numpy())
    ends = 0
    for action in random_actions(steps, num_envs):
        step, root = theirs.step_and_maybe_reset(root.set("action", torch.from_numpy(action)))
        after = {
            key: value.squeeze(-1).numpy() for key, value in step["next"].items() if key != "pixels"
        }
        frame, reward, terminated, truncated, info = alone.step(action[0])
        assert equal(frame, step["next", "pixels"][0].numpy())
        assert type(reward) is float and reward == after["reward"][0]
        assert (terminated, truncated) == (after["terminated"][0], after["truncated"][0])
        assert info == {
            "episode_reward": after["episode_reward"][0],
            "step_count": after["step_count"][0],
        }
        frames, rewards, terminations, truncations, infos = many.step(action)
        assert equal(frames, root["pixels"].numpy())
        assert (rewards == after["reward"]).all()
        assert equal(terminations, after["terminated"]) and equal(truncations, after["truncated"])
        for i in np.flatnonzero(after["done"]):
            assert equal(infos["final_obs"][i], step["next", "pixels"][i].numpy())
            assert infos["final_info"]["episode_reward"][i] == after["episode_reward"][i]
            assert infos["final_info"]["step_count"][i] == after["step_count"][i]
        if terminated or truncated:
            ends += 1
            assert equal(alone.reset()[0], root["pixels"][0].numpy())
    assert ends >= 3


@pytest.mark.parametrize("mode", MODES, ids=[mode.value for mode in MODES])
def test_the_vector_env_is_gymnasium_s_own_to_the_bit(mode: AutoresetMode) -> None:
    """One seed an env: everything SyncVectorEnv gives, infos included, over ends of both kinds."""
    num_envs, seeds = 3, [3, 11, 4]
    sync = SyncVectorEnv([lambda: ArcadeGymEnv("MineSweeperEasy")] * num_envs, autoreset_mode=mode)
    ours = gymnasium.make_vec(GAME, num_envs=num_envs, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert (
        ours.observation_space == sync.observation_space and ours.action_space == sync.action_space
    )
    assert equal(ours.reset(seed=seeds), sync.reset(seed=seeds))
    kinds, resets = np.zeros(2, bool), set()
    for action in random_actions(80, num_envs):
        action = np.where(np.arange(num_envs) == 0, 0, action)  # the first runs into the time limit
        mine, theirs = ours.step(action), sync.step(action)
        assert equal(mine, theirs)
        terminated, truncated = mine[2:4]
        kinds |= [terminated.any(), truncated.any()]
        if mode is AutoresetMode.DISABLED and (terminated | truncated).any():
            mask = {"reset_mask": terminated | truncated}
            seed = seeds if terminated[1] else None  # seeds count in the envs that are reset
            assert equal(
                ours.reset(seed=seed, options=dict(mask)), sync.reset(seed=seed, options=dict(mask))
            )
            resets.add("without a seed" if seed is None else "seeded")
    assert kinds.all() and len(resets) == (2 if mode is AutoresetMode.DISABLED else 0)


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_an_end_stands_until_its_own_env_begins_anew(mode: str) -> None:
    envs = ArcadeVectorEnv("MineSweeperEasy", 3, autoreset_mode=mode)
    envs.reset(seed=0)
    ended = np.zeros(3, bool)
    for action in random_actions(30, 3):  # before the time limit: a mine
        ended = envs.step(action)[2]
        if ended.any():
            break
    assert ended.any() and not ended.all()
    envs.reset(options={"reset_mask": ~ended})
    if mode == "Disabled":
        with pytest.raises(ResetNeeded, match=rf"^envs \[{np.flatnonzero(ended)[0]}\] have ended"):
            envs.step(np.zeros(3, int))
    else:
        _, rewards, _, _, infos = envs.step(np.zeros(3, int))
        assert infos["step_count"].tolist() == np.where(ended, 0, 1).tolist()
        assert (rewards[ended] == 0).all()


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_time_limit_of_the_spec_is_the_step_that_truncates(rules: str) -> None:
    # by the reference rules it comes a step late here, as in the longest episode of some others
    env = gymnasium.make("arcade_torch/AutoEncodeEasy-v0", rules=rules)
    env.reset(seed=0)
    steps, truncated = 0, False
    while not truncated:
        _, _, _, truncated, _ = env.step(0)
        steps += 1
    assert env.spec is not None and env.spec.max_episode_steps == steps
    assert env.unwrapped.time_limit == steps  # type: ignore[attr-defined]


@pytest.mark.parametrize("mode", MODES, ids=[mode.value for mode in MODES])
def test_what_was_handed_out_never_changes(mode: AutoresetMode) -> None:
    envs = ArcadeVectorEnv("MineSweeperEasy", 3, autoreset_mode=mode)
    frames, _ = envs.reset(seed=0)
    before = frames.copy()
    action = np.full(3, 4)
    later, *_ = envs.step(action)
    action[:] = 0  # the caller's array is the caller's own again
    assert equal(frames, before)
    assert later.flags.writeable and not np.shares_memory(frames, later)


def test_frames_without_a_copy_are_equal_and_read_only() -> None:
    plain = ArcadeVectorEnv("MineSweeperEasy", 3, autoreset_mode="SameStep")
    shared = ArcadeVectorEnv("MineSweeperEasy", 3, autoreset_mode="SameStep", copy=False)
    kept = [(plain.reset(seed=1)[0], shared.reset(seed=1)[0])]
    for action in random_actions(20, 3):
        kept.append((plain.step(action)[0], shared.step(action)[0]))
    assert all(equal(a, b) for a, b in kept)
    assert not any(b.flags.writeable for _, b in kept)


def test_a_batch_may_mix_twins_and_an_episode_may_change_twins() -> None:
    def walk(envs: ArcadeVectorEnv) -> np.ndarray:
        envs.reset(seed=2)
        return np.stack([envs.step(np.full(3, action))[0] for action in (4, 3, 4, 1)])

    full, partial, mixed = (
        walk(ArcadeVectorEnv("MineSweeperEasy", 3, observability=which))
        for which in ("full", "partial", [False, True, False])
    )
    assert not equal(full[:, 1], partial[:, 1])
    assert equal(mixed[:, [0, 2]], full[:, [0, 2]]) and equal(mixed[:, 1], partial[:, 1])


def test_the_twin_of_a_running_episode_can_be_changed() -> None:
    one = ArcadeGymEnv("MineSweeperEasy", partial_obs=True)
    frames = {}
    for which in ("full", "partial"):
        one.reset(seed=3, options={"observability": which})
        frames[which] = [one.step(action)[0] for action in (4, 3)]
    assert not equal(frames["full"][1], frames["partial"][1])
    one.reset(seed=3)
    assert equal(one.step(4)[0], frames["partial"][0])
    one.set_observability("full")
    assert equal(one.step(3)[0], frames["full"][1])
    many = ArcadeVectorEnv("MineSweeperEasy", 1, partial_obs=True)
    many.reset(seed=3)
    assert equal(many.step(np.array([4]))[0][0], frames["partial"][0])
    many.set_observability("full")
    assert equal(many.step(np.array([3]))[0][0], frames["full"][1])


def test_none_is_no_twin_to_change_to() -> None:
    """Before: it was the MDP, though nobody had asked for that."""
    one = ArcadeGymEnv("MineSweeperEasy", partial_obs=True)
    many = ArcadeVectorEnv("MineSweeperEasy", 1, partial_obs=True)
    for change in (
        lambda: one.set_observability(None),  # type: ignore[arg-type]
        lambda: one.reset(options={"observability": None}),
        lambda: many.set_observability(None),  # type: ignore[arg-type]
    ):
        with pytest.raises(ValueError, match=r"^observability is None, allowed: 'full', 'partial'"):
            change()


def test_without_a_seed_np_random_decides_and_with_one_nothing_else() -> None:
    one, two = (ArcadeVectorEnv("MineSweeperEasy", 3) for _ in range(2))

    def shots(envs: ArcadeVectorEnv, seed: int | None = None) -> list[np.ndarray]:
        return [
            envs.reset(seed=seed)[0],
            *(envs.step(np.full(3, action))[0] for action in (4, 3, 4)),
        ]

    one.np_random, two.np_random = (np.random.default_rng(7) for _ in range(2))
    drawn = shots(one)
    assert all(equal(a, b) for a, b in zip(drawn, shots(two), strict=True))
    again = shots(one)
    assert not all(equal(a, b) for a, b in zip(drawn, again, strict=True))
    assert all(equal(a, b) for a, b in zip(again, shots(two), strict=True))
    seeded = shots(one, seed=9)
    assert not all(equal(a, b) for a, b in zip(seeded, shots(two, seed=10), strict=True))
    assert all(equal(a, b) for a, b in zip(seeded, shots(two, seed=9), strict=True))
    alone = [ArcadeGymEnv("MineSweeperEasy") for _ in range(3)]
    for env, number in zip(alone, (7, 7, 8), strict=True):
        env.np_random = np.random.default_rng(number)
        env.reset()
    keys = [env._batch._batch.key.tolist() for env in alone]
    assert keys[0] == keys[1] != keys[2]


def test_rules_sizes_and_game_options_reach_the_game() -> None:
    env = gymnasium.make(
        "arcade_torch/BreakoutEasy-v0", obs_size=256, rules="reference", tail="previous"
    )
    game = env.unwrapped._batch.game
    assert (game.obs_size, game.rules, game.tail) == (256, "reference", "previous")
    assert env.observation_space.shape == (256, 256, 3) and env.reset(seed=0)[0].shape == (
        256,
        256,
        3,
    )
    envs = gymnasium.make_vec(
        "arcade_torch/BreakoutEasy-v0", num_envs=2, rules="reference", random_start=True
    )
    assert (envs._batch.game.rules, envs._batch.game.random_start) == ("reference", True)


def test_render_gives_the_frame_that_is_seen() -> None:
    env = gymnasium.make(GAME, render_mode="rgb_array", partial_obs=True)
    frame, _ = env.reset(seed=0)
    assert equal(env.render(), frame)
    frame = env.step(4)[0]
    kept = frame.copy()
    for given in (frame, env.render()):  # the caller's own
        assert equal(given, kept)
        given[:] = 0
    assert equal(env.render(), kept)
    envs = gymnasium.make_vec(GAME, num_envs=3, render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.step(np.array([4, 0, 3]))[0]
    assert equal(np.stack(envs.render()), frames)
    assert all(frame.flags.writeable for frame in envs.render())
    assert gymnasium.make(GAME, render_mode="rgb_array_list").reset()[0].shape == (128, 128, 3)


def test_human_rendering_shows_every_frame_in_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame", reason="needs the play extra: pip install '.[play]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make(GAME, render_mode="human")
    for look in (lambda: env.reset(seed=0), lambda: env.step(4)):
        frame = look()[0]
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        assert shown.shape == (512, 512, 3)
        assert equal(shown[::4, ::4], frame)
    assert env.render() is None
    env.close()
    env.close()
    assert pygame.display.get_surface() is None


def test_a_window_is_as_wide_and_high_as_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame", reason="needs the play extra: pip install '.[play]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window(2)
    window.show(np.zeros((2, 3, 3), np.uint8), "a frame")
    assert pygame.display.get_surface().get_size() == (6, 4)
    window.close()


def test_a_window_without_pygame_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pip install '.\[play\]'"):
        gymnasium.make(GAME, render_mode="human")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"observability": "half"},
            ValueError,
            "observability is 'half', allowed: 'full', 'partial'",
        ),
        (
            {"observability": [True, False]},
            ValueError,
            r"observability is bool \(2,\), expected bool \(1,\)",
        ),
        ({"observability": "full", "partial_obs": True}, ValueError, "partial_obs is its alias"),
        ({"partial_obs": "yes"}, TypeError, "partial_obs is 'yes'"),
        ({"obs_size": 64}, ValueError, "obs_size is 64, allowed: 128, 256"),
        ({"rules": "mine"}, ValueError, "rules is 'mine'"),
        ({"wind": 1}, TypeError, "MineSweeperEasy-v0 has no option 'wind'"),
        ({"render_mode": "ascii"}, ValueError, "render_mode is 'ascii'"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_bad_arguments_are_refused_with_one_clear_line(
    arguments: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        ArcadeGymEnv("MineSweeperEasy", **arguments)
    with pytest.raises(
        error, match=message.replace("render_mode is", "render_mode of a vector environment is")
    ):
        ArcadeVectorEnv("MineSweeperEasy", 1, **arguments)


@pytest.mark.parametrize(
    "seed",
    [1.5, True, "12", [1, 2.0], [True, 2], [None, 2], ["1", 2], {1, 2}, np.ones(2)],
    ids=repr,
)
def test_a_seed_that_is_no_whole_number_is_refused_in_one_line(seed: object) -> None:
    with pytest.raises(
        TypeError, match=r"^seed is .*, expected a whole number from 0 to 4294967295$"
    ):
        seed_keys(seed, 2)  # type: ignore[arg-type]


def test_seeds_of_numpy_mean_what_those_of_python_mean() -> None:
    assert (seed_keys(np.array([3, 4]), 2) == seed_keys([3, 4], 2)).all()
    assert (seed_keys(np.int64(3), 2) == seed_keys(3, 2)).all()  # type: ignore[arg-type]
    envs = ArcadeVectorEnv("MineSweeperEasy", 2)
    envs.reset(seed=3)
    drawn = envs.np_random.random()
    for seed in (np.int64(3), np.array(3)):
        envs.reset(seed=seed)  # type: ignore[arg-type]
        assert envs.np_random.random() == drawn, repr(seed)


def test_a_refused_seed_changes_nothing() -> None:
    one, many = ArcadeGymEnv("MineSweeperEasy"), ArcadeVectorEnv("MineSweeperEasy", 2)

    def found() -> tuple[object, ...]:
        return tuple((env._batch.draw(), env.np_random.bit_generator.state) for env in (one, many))

    one.reset(seed=1), many.reset(seed=1)
    before = found()
    for seed, error in ((2**32, ValueError), (-1, ValueError), (1.5, TypeError)):
        with pytest.raises(error, match=f"seed is {seed}"):
            one.reset(seed=seed, options={"observability": "partial"})
        with pytest.raises(error, match=f"seed is {seed}"):
            many.reset(seed=seed)
    assert equal(found(), before)


def test_the_vector_env_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="allowed: 'NextStep', 'SameStep', 'Disabled'"):
        ArcadeVectorEnv("MineSweeperEasy", 2, autoreset_mode="never")
    with pytest.raises(ValueError, match="num_envs is 0"):
        gymnasium.make_vec(GAME, num_envs=0)
    envs = ArcadeVectorEnv("MineSweeperEasy", 3, autoreset_mode="Disabled")
    with pytest.raises(ResetNeeded, match="call reset"):
        envs.step(np.zeros(3, int))
    with pytest.raises(ResetNeeded, match="the first reset"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ValueError, match="2 seeds for 3 envs"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="seed is 4294967296"):
        envs.reset(seed=2**32)
    with pytest.raises(ValueError, match="no option 'speed', allowed: reset_mask"):
        envs.reset(options={"speed": 1})
    envs.reset(seed=0)
    for mask in (np.zeros(3, bool), np.ones(2, bool), np.ones(3, int)):
        with pytest.raises(ValueError, match=r"expected bool \(3,\) with at least one True"):
            envs.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="actions range from 0 to 5, allowed: 0 to 4"):
        envs.step(np.array([0, 5, 1]))
    with pytest.raises(ValueError, match=r"expected integers \(3,\)"):
        envs.step(np.zeros((3, 1), int))
    with pytest.raises(ValueError, match=r"expected integers \(3,\)"):
        envs.step(np.zeros(3))
    for _ in range(32):
        ended = np.logical_or(*envs.step(np.zeros(3, int))[2:4])
    assert ended.all()
    with pytest.raises(ResetNeeded, match=r"envs \[0, 1, 2\] have ended"):
        envs.step(np.zeros(3, int))


def test_the_env_refuses_what_does_not_fit() -> None:
    env = ArcadeGymEnv("MineSweeperEasy", render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.step(0)
    with pytest.raises(ResetNeeded):
        env.render()
    with pytest.raises(ValueError, match="no option 'speed', allowed: observability"):
        env.reset(options={"speed": 1})
    env.reset(seed=0)
    for action in (5, -1, 1.0, "up"):
        with pytest.raises(ValueError, match="allowed: integers from 0 to 4"):
            env.step(action)
    while not any(env.step(0)[2:4]):
        pass
    with pytest.raises(ResetNeeded, match="after every end"):
        env.step(0)


def test_gymnasium_s_wrappers_take_it() -> None:
    env = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(GAME, max_episode_steps=7))
    env = gymnasium.wrappers.FrameStackObservation(gymnasium.wrappers.GrayscaleObservation(env), 4)
    assert env.reset(seed=0)[0].shape == (4, 128, 128)
    for _ in range(7):
        *_, truncated, info = env.step(0)
    assert truncated and info["episode"]["l"] == info["step_count"] == 7
    assert info["episode"]["r"] == pytest.approx(info["episode_reward"])
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(gymnasium.make_vec(GAME, num_envs=3))
    envs.reset(seed=0)
    for _ in range(32):
        *_, infos = envs.step(np.zeros(3, int))
    assert (infos["episode"]["l"] == 32).all()
    assert infos["episode"]["r"] == pytest.approx(infos["episode_reward"])
