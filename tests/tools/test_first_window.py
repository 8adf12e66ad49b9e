"""Where the paper's returns of Tetris without memory come from: results/differences.md, "The training
score".
"""

import csv
from pathlib import Path

import pytest

import arcade_torch

PAPER = Path(arcade_torch.__path__[0]) / "tools" / "data" / "paper_returns.csv"
WINDOWS, ENVS, STEPS = 10, 16, 128


def published(difficulty: str) -> tuple[float, float]:
    with PAPER.open() as file:
        rows = [
            row for row in csv.DictReader(file) if (row["model"], row["env"]) == ("MLP", "Tetris")
        ]
    row = next(row for row in rows if row["difficulty"] == difficulty)
    assert (row["mdp_mean"], row["mdp_std"]) == (row["pomdp_mean"], row["pomdp_std"])
    return float(row["mdp_mean"]), float(row["mdp_std"])


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
def test_random_play_that_has_not_ended_yet_scores_what_the_paper_has(difficulty: str) -> None:
    """Zeros for the environments whose first episode is not over, as the published code counts
    them.
    """
    id, rules = f"Tetris{difficulty.capitalize()}", "reference"
    env = arcade_torch.make(
        id, num_envs=WINDOWS * ENVS, observability="partial", seed=0, rules=rules
    )
    options = {"seed": 0, "final_frames": "none", "compress": lambda frames: frames[:, :1, :1]}
    steps = arcade_torch.ArcadeCollector(env, None, WINDOWS * ENVS * STEPS, **options).collect()
    done = steps["next", "done"].squeeze(-1)
    ended = done.cumsum(1) > 0  # every return is -1: nobody clears a line by chance
    assert (steps["next", "episode_reward"].squeeze(-1)[done] <= -0.9).float().mean() > 0.95
    scores = -ended.float().mean(1).view(WINDOWS, ENVS).mean(1)
    mean, deviation = published(difficulty)
    assert scores.mean().item() == pytest.approx(mean, abs=0.04)
    assert scores.std().item() == pytest.approx(deviation, abs=0.03)
