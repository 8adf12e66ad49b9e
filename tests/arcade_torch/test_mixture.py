"""Several games, and both twins, in one env: one policy's view of all of them."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.factory import make
from tests.arcade_torch.stub import GAME, MIXED, CoinGame

IDS = ["BattleShipEasy", "TetrisEasy"]
N = 4


def random_policy(td: TensorDictBase) -> TensorDictBase:
    """Actions that depend on the count of steps and the row alone, so that every env can be played
    apart.
    """
    rows = torch.arange(td.shape[0])
    td["action"] = (
        td["step_count"].squeeze(-1) * 7 + rows * 3 + td["step_count"].squeeze(-1) // 5
    ) % 5
    return td


@pytest.fixture(scope="module")
def env() -> ArcadeEnv:
    return make(IDS, num_envs=N, seed=3)


def test_real_games_share_an_env_and_pass_torchrls_checker(env: ArcadeEnv) -> None:
    check_env_specs(env, seed=0)
    assert env.task.tolist() == [0, 0, 1, 1]
    assert [game.id for game in env.games] == ["BattleShipEasy-v0", "TetrisEasy-v0"]
    assert env.game.id == "BattleShipEasy-v0+TetrisEasy-v0"
    data = env.rollout(3)
    assert (data["task"] == env.task.unsqueeze(-1)).all() and (
        data["next", "task"] == data["task"]
    ).all()
    assert make(IDS, num_envs=N)._compiled is env._compiled, "a second env compiles nothing"


def test_every_env_shows_what_it_shows_in_its_game_alone() -> None:
    together = ArcadeEnv(MIXED, 6, seed=5).rollout(40, random_policy, break_when_any_done=False)
    for task, game in enumerate((GAME, CompiledGame(CoinGame()))):
        alone = ArcadeEnv(game, 6, seed=5).rollout(40, random_policy, break_when_any_done=False)
        mine = together["task"][:, 0] == task
        assert alone["next", "done"].any()
        for key in alone.keys(True, True):
            assert torch.equal(together[mine][key], alone[mine][key]), key


def test_an_id_that_stands_twice_gets_two_shares() -> None:
    assert (
        make(["CartPoleEasy", "TetrisEasy", "CartPoleEasy-v0"], num_envs=6).task.tolist()
        == [0] * 4 + [1] * 2
    )
    assert make(["TetrisEasy", "CartPoleEasy"], num_envs=5).task.tolist() == [0] * 3 + [1] * 2


def test_an_id_with_plus_is_the_list_of_its_games() -> None:
    listed = make(["TetrisEasy", "BattleShipEasy", "BattleShipEasy"], num_envs=6)
    named = make("TetrisEasy+2*BattleShipEasy", num_envs=6)
    assert named.game.id == listed.game.id == "TetrisEasy-v0+2*BattleShipEasy-v0"
    assert named._compiled is listed._compiled
    assert named.task.tolist() == [0, 0, 1, 1, 1, 1]
    again = make(named.game.id, num_envs=6)
    assert again._compiled is named._compiled, "the id of a mixture makes the mixture"


def test_a_single_game_has_a_task_if_asked() -> None:
    assert "task" not in ArcadeEnv(GAME, N).reset()
    root = ArcadeEnv(GAME, N, task_in_td=True).reset()
    assert root["task"].tolist() == [0] * N and root["task"].dtype is torch.int64
    assert "task" not in ArcadeEnv(MIXED, N, task_in_td=False).reset()


def test_a_policy_may_read_the_task_in_either_collector() -> None:
    class ByTask:
        in_keys = ("task",)
        out_keys = ("action",)

        def __call__(self, td: TensorDictBase) -> TensorDictBase:
            td["action"] = td["task"] + 2
            return td

    batch = ArcadeCollector(ArcadeEnv(MIXED, 6), ByTask(), frames_per_batch=48).collect()
    assert torch.equal(batch["action"], batch["task"] + 2) and batch["task"].unique().tolist() == [
        0,
        1,
    ]


def test_the_state_of_a_mixture_names_the_game_of_every_env() -> None:
    state = ArcadeEnv(MIXED, 6).get_state()
    assert set(state["state"].keys()) == {"StubEasy-v0", "CoinEasy-v0"}
    assert state["game"].unique().numel() == 2
    with pytest.raises(
        ValueError, match="the state of env 4 is one of another game, this env plays 2"
    ):
        ArcadeEnv(MIXED, 6).set_state(
            state.clone().set("game", state["game"][:1].expand(6).clone())
        )


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"id": []}, ValueError, "the list of env ids is empty: name at least one game"),
        ({"id": ()}, ValueError, "the list of env ids is empty"),
        (
            {"id": ["CartPoleEasy", "TetrsEasy"]},
            ValueError,
            "unknown env id 'TetrsEasy': did you mean 'TetrisEasy'?",
        ),
        ({"id": ["CartPoleEasy", 3]}, TypeError, "the env id is 3, expected a string"),
        (
            {"id": 3},
            TypeError,
            "the env id is 3, expected a string such as 'CartPoleEasy', or a list of them",
        ),
        ({"num_envs": 1}, ValueError, "num_envs is 1, too few for CartPoleEasy-v0+TetrisEasy-v0"),
        ({"arrow": "log"}, TypeError, "TetrisEasy-v0 has no option 'arrow'"),
        ({"obs_size": [128, 256]}, ValueError, "obs_size is [128, 256], allowed: 128, 256"),
    ],
)
def test_make_explains_a_wrong_mixture(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        make(**{"id": ["CartPoleEasy", "TetrisEasy"], "num_envs": 3, **options})


# -- both twins at once ----------------------------------------------------------------------------


def test_each_env_of_a_mixed_batch_shows_the_twin_it_was_told_also_from_mid_episode_on() -> None:
    flags, later = (
        torch.tensor([True, False, True, False]),
        torch.tensor([True, True, False, False]),
    )
    mixed = make("MineSweeperEasy", N, observability=flags, seed=2)
    twins = [make("MineSweeperEasy", N, observability=word, seed=2) for word in ("full", "partial")]
    roots = [env.reset() for env in (mixed, *twins)]
    rng = np.random.default_rng(0)
    hidden = 0
    for time in range(60):
        if time == 20:
            assert (roots[0]["step_count"] > 0).any(), "in the middle of an episode"
            mixed.set_observability(later)
            roots[0] = mixed.observe()
        ours, full, partial = (root["pixels"] for root in roots)
        shown = flags if time < 20 else later
        assert torch.equal(ours, torch.where(shown[:, None, None, None], partial, full))
        hidden += int((full != partial).flatten(1).any(1).sum())
        action = torch.from_numpy(rng.integers(0, 5, N))
        stepped = [
            env.step_and_maybe_reset(root.set("action", action))
            for env, root in zip((mixed, *twins), roots, strict=True)
        ]
        for key in ("reward", "done", "terminated", "truncated", "step_count", "episode_reward"):
            assert torch.equal(stepped[0][0]["next", key], stepped[1][0]["next", key])
            assert torch.equal(stepped[0][0]["next", key], stepped[2][0]["next", key])
        roots = [root for _, root in stepped]
    assert hidden > 60, "the twins ought to look different"


def test_the_collector_follows_when_twins_are_switched_between_two_windows() -> None:
    """In the frames that are acted on and in those at ends; the games begin with different
    twins.
    """
    flags = torch.tensor([True, False, True, False, False, True])

    def frames(batch: TensorDictBase) -> torch.Tensor:
        return torch.cat([batch["pixels"], batch["next", "pixels"]], 1)

    def windows(start: Any) -> tuple[torch.Tensor, torch.Tensor]:
        env = ArcadeEnv(MIXED, 6, start, seed=4)
        collector = ArcadeCollector(env, random_policy, frames_per_batch=48, return_same_td=False)
        first = frames(collector.collect())
        env.set_observability(~flags if isinstance(start, torch.Tensor) else start)
        return first, frames(collector.collect())

    ours, full, partial = windows(flags), windows("full"), windows("partial")
    for window, shown in enumerate((flags, ~flags)):
        expected = torch.where(shown.reshape(6, 1, 1, 1, 1), partial[window], full[window])
        assert torch.equal(ours[window], expected)
    assert (full[1] != partial[1]).any()
