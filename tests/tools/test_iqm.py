"""The interquartile mean, against scipy on the same scores, its stratified bootstrap, and what an
interval says.
"""

import numpy as np
import pytest

from arcade_torch.tools import gap_and_bias
from arcade_torch.tools.measures.bootstrap import (
    Interval,
    iqm,
    measured_coverage,
    percentile_interval,
    pooled,
    pooled_episodes,
    resampled,
)
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


def test_an_interval_holds_its_confidence_and_both_ends_belong_to_it() -> None:
    draws = np.arange(101.0)
    assert percentile_interval(50, draws, 0.9) == pytest.approx((50, 5, 95))
    assert percentile_interval(50, draws, 0.5) == pytest.approx((50, 25, 75))
    for nothing in (np.inf, np.nan):
        assert np.isnan(percentile_interval(nothing, draws, 0.9)[1:]).all()
    for low, high in ((0.0, 0.6), (-0.6, 0.0), (-0.1, 0.1), (np.nan, np.nan)):
        assert not Interval(0.3, low, high).excludes_zero
    assert Interval(0.3, 0.1, 0.6).excludes_zero and Interval(-0.3, -0.6, -0.1).excludes_zero


def test_a_table_shows_an_interval_where_there_is_one() -> None:
    nan = float("nan")
    intervals = [Interval(0.5, 0.25, 0.75), Interval(0.5, nan, nan), Interval(nan, nan, nan)]
    assert [interval.text() for interval in intervals] == ["0.50 [0.25, 0.75]", "0.50", "-"]


def test_a_seed_without_a_value_takes_no_part() -> None:
    nan = np.nan
    seeds, mean, low, _ = pooled([[1.0, nan, nan], [3.0, 5.0, nan]])
    np.testing.assert_array_equal(mean, [2.0, 5.0, nan])
    np.testing.assert_array_equal(np.isnan(low), [False, True, True])
    of_episodes = pooled_episodes([[[1.0, nan], [2.0, nan]], [[6.0, 4.0], [nan, nan]]])
    np.testing.assert_array_equal(of_episodes.seeds, [[1.5, nan], [6.0, 4.0]])
    np.testing.assert_array_equal(of_episodes.mean, [3.75, 4.0])
    assert seeds.shape == (2, 3)


def test_measured_coverage_is_that_of_studies_played_out_one_by_one() -> None:
    """Many seeds on the MDP and two on the POMDP: a mean of each counts once, not each seed."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(1000):
        mdp, pomdp = rng.standard_normal(20), rng.standard_normal(2)
        over_mdp, over_pomdp = (drawn.mean(1) for drawn in resampled([mdp, pomdp], 200, rng))
        interval = percentile_interval(0.0, over_mdp - over_pomdp, 0.95)
        held += not interval.excludes_zero
    measured = measured_coverage((20,), (2,), simulations=1000, draws=200)
    assert measured == pytest.approx(held / 1000, abs=0.05)
