"""The interquartile mean, against scipy on the same scores, and its stratified bootstrap."""

import numpy as np
import pytest

from arcade_torch.tools import gap_and_bias
from arcade_torch.tools.measures.bootstrap import iqm, resampled
from arcade_torch.tools.runs import Score


def test_the_middle_half_counts() -> None:
    assert iqm([np.array([0.0, 1.0]), np.array([2.0, 100.0])]) == 1.5
    assert iqm([np.array([7.0])]) == 7.0
    draws = np.arange(24.0).reshape(2, 3, 4)
    assert iqm([draws[:, 0], draws[:, 1], draws[:, 2]]).tolist() == [5.5, 17.5]


def test_the_table_has_the_interquartile_mean_with_an_interval() -> None:
    rng = np.random.default_rng(0)
    scores = [
        Score(agent, game, twin, seed, float(rng.random()))
        for agent in ("mlp", "lru")
        for game in ("CartPoleEasy", "SkittlesEasy")
        for twin in ("full", "partial")
        for seed in range(5)
    ]
    row = gap_and_bias(scores, draws=500).row("lru")
    values = np.sort([s.value for s in scores if (s.agent, s.observability) == ("lru", "full")])
    assert row.mdp_iqm.value == pytest.approx(values[2:-2].mean())
    assert row.mdp_iqm.low < row.mdp_iqm.value < row.mdp_iqm.high


@pytest.mark.parametrize("shape", [(7, 6), (5, 1), (1, 3), (2, 2)])
def test_the_value_is_the_trimmed_mean_of_scipy(shape: tuple[int, int]) -> None:
    """The definition of Agarwal et al.: `scipy.stats.trim_mean` of all runs, a quarter off at both
    ends.
    """
    scores = np.random.default_rng(1).normal(size=(50, *shape))  # draws, runs, tasks
    right = pytest.importorskip("scipy.stats").trim_mean(scores.reshape(50, -1), 0.25, axis=1)
    assert iqm([scores[..., task] for task in range(shape[1])]) == pytest.approx(right, abs=1e-12)


def test_tasks_are_resampled_apart_and_keep_their_seeds() -> None:
    cells = [np.array([1.0, 2.0]), np.array([5.0, 6.0, 7.0])]
    drawn = resampled(cells, 1000, np.random.default_rng(0))
    assert [part.shape for part in drawn] == [(1000, 2), (1000, 3)]
    assert all(set(part.ravel()) == set(cell) for part, cell in zip(drawn, cells, strict=True))
