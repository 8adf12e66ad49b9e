"""The end-to-end proof: agents with a memory solve a game that cannot be played without one, and the others do not.

Signpost pays 1 to whoever remembers the sign of the first frame, and on average 0.25 at most to everybody else.
"""

import math

import pytest

from arcade_torch.agents import evaluate, load, preset, train

FRAMES = 100_000
EPISODES = 256
CHANCE = 0.25
DEVIATION = math.sqrt(CHANCE * (1 - CHANCE) / EPISODES)  # of the mean return of somebody who guesses


def learned(folder, algorithm, memory, observability):
    """Greedy return after training."""
    what = preset(
        "small",
        env="SignpostEasy",
        algorithm=algorithm,
        memory=memory,
        observability=observability,
        total_frames=FRAMES,
        eval_every=0,
    )
    assert train(what, folder).status == "finished"
    return evaluate(load(folder), episodes=EPISODES).returns.mean()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_with_a_memory_the_pomdp_is_solved(tmp_path, algorithm):
    assert learned(tmp_path / "run", algorithm, "lru", "partial") > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_without_a_memory_the_pomdp_stays_at_chance(tmp_path, algorithm):
    assert learned(tmp_path / "run", algorithm, "mlp", "partial") < CHANCE + 4 * DEVIATION


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_without_a_memory_the_mdp_is_solved(tmp_path, algorithm):
    assert learned(tmp_path / "run", algorithm, "mlp", "full") > 0.9
