"""The Gymnasium environments inside TorchRL's ``GymEnv`` and ``GymWrapper``: the numbers of
``ArcadeEnv``.
"""

import gymnasium
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

import arcade_torch

GAME = "arcade_torch/MineSweeperEasy-v0"
STEPS, N = 100, 3
ENDS = ("reward", "terminated", "truncated", "done")


class Scripted:
    """The same actions for every env that it plays, whether that is batched or not."""

    def __init__(self) -> None:
        drawn = torch.randint(5, (STEPS, N), generator=torch.Generator().manual_seed(0))
        self.actions = iter(drawn)

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        actions = next(self.actions)
        return td.set("action", actions[: td.shape[0]].clone() if td.ndim else actions[0].clone())


def ours(num_envs: int, seed: int) -> TensorDictBase:
    env = arcade_torch.make(
        "MineSweeperEasy", num_envs=num_envs, observability="partial", seed=seed
    )
    env.reset()  # as TorchRL's wrapper does when it is given a seed
    return env.rollout(STEPS, Scripted(), break_when_any_done=False)


def assert_same_numbers(theirs: TensorDictBase, expected: TensorDictBase) -> None:
    assert expected["next", "done"].sum() >= 2
    frames = "observation" if "observation" in theirs else "pixels"
    assert torch.equal(theirs[frames], expected["pixels"])
    assert torch.equal(theirs["next", frames], expected["next", "pixels"])
    for key in ENDS:
        assert torch.equal(
            theirs["next", key].to(expected["next", key].dtype), expected["next", key]
        ), key


def test_torchrls_gymenv_makes_a_game_by_its_id() -> None:
    env = GymEnv(GAME, observability="partial", categorical_action_encoding=True)
    check_env_specs(env)
    env.set_seed(5)
    data = env.rollout(STEPS, Scripted(), break_when_any_done=False)
    assert_same_numbers(data, ours(1, seed=5)[0])


def test_torchrls_gymenv_still_refuses_options_the_game_does_not_have() -> None:
    with pytest.raises(
        TypeError, match=r"^MineSweeperEasy-v0 has no option 'wind': its options are [^\n]*$"
    ):
        GymEnv(GAME, wind=1)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrls_wrapper_takes_the_vector_env(mode: str) -> None:
    envs = gymnasium.make_vec(
        GAME,
        num_envs=N,
        vectorization_mode="vector_entry_point",
        observability="partial",
        autoreset_mode=mode,
    )
    env = GymWrapper(envs, categorical_action_encoding=True)
    env.set_seed(5)
    data = env.rollout(STEPS, Scripted(), break_when_any_done=False)
    assert_same_numbers(data, ours(N, seed=5))
    check_env_specs(env)


def test_torchrls_wrapper_refuses_the_mode_that_loses_steps() -> None:
    with pytest.raises(RuntimeError, match="auto-reset mode must be one of SAME_STEP or DISABLED"):
        GymWrapper(gymnasium.make_vec(GAME, num_envs=N))


def test_torchrl_reads_the_infos() -> None:
    env = GymWrapper(
        gymnasium.make(GAME, observability="partial"), categorical_action_encoding=True
    )
    env = env.auto_register_info_dict()
    env.set_seed(5)
    data = env.rollout(STEPS, Scripted(), break_when_any_done=False)
    expected = ours(1, seed=5)[0]
    for key in ("step_count", "episode_reward"):
        assert torch.equal(
            data["next", key].reshape(-1, 1), expected["next", key].to(data["next", key].dtype)
        )
