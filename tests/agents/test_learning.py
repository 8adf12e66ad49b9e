"""The end-to-end proof: agents with a memory solve a game that cannot be played without one, and
the others do not.

Signpost pays 1 to whoever remembers the sign of the first frame, and on average 0.25 at most to
everybody else.
"""

import math

import pytest

from arcade_torch.agents import evaluate, load, preset, train

FRAMES = 100_000
EPISODES = 256
CHANCE = 0.25
DEVIATION = math.sqrt(
    CHANCE * (1 - CHANCE) / EPISODES
)  # of the mean return of somebody who guesses


def learned(folder, algorithm, memory, observability, env="SignpostEasy", frames=FRAMES):
    """Greedy return after training."""
    what = preset(
        "small",
        env=env,
        algorithm=algorithm,
        memory=memory,
        observability=observability,
        total_frames=frames,
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


@pytest.mark.slow
def test_the_small_preset_counts_cards_better_than_the_papers_memory_free_agent(tmp_path):
    """The paper's earns .40 after 20 million frames, random play .11."""
    assert learned(tmp_path / "run", "ppo", "mlp", "full", "CountRecallEasy", 800_000) > 0.40


@pytest.mark.slow
def test_in_minesweepers_pomdp_memory_pays(tmp_path):
    """Sweeping blindly without repeats earns 1/3, the paper's agents .65 with memory and .45
    without.
    """
    with_memory = learned(tmp_path / "lru", "ppo", "lru", "partial", "MineSweeperEasy", 900_000)
    without = learned(tmp_path / "mlp", "ppo", "mlp", "partial", "MineSweeperEasy", 900_000)
    assert with_memory > 0.45 and with_memory > without + 0.05
