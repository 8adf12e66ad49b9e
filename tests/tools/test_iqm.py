"""The interquartile mean and its stratified bootstrap, against rliable on the same scores and the same draws."""

import numpy as np
import pytest

from arcade_torch.tools import gap_and_bias
from arcade_torch.tools.analysis.bootstrap import iqm, mean_over_tasks, percentile_interval, resampled
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


@pytest.mark.parametrize("name", ["iqm", "mean"])
def test_value_and_interval_are_those_of_rliable(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    theirs, ours = {"iqm": (metrics.aggregate_iqm, iqm), "mean": (metrics.aggregate_mean, mean_over_tasks)}[name]
    runs, tasks, draws = 7, 6, 400
    scores = np.random.default_rng(1).normal(size=(runs, tasks))
    places = [np.random.default_rng(2 + task).integers(runs, size=(draws, runs)) for task in range(tasks)]

    given = iter(np.stack(places, axis=-1))  # rliable draws from numpy's global state: hand it the very same draws
    monkeypatch.setattr(np.random, "choice", lambda *words, **options: next(given))
    values, intervals = library.get_interval_estimates({"x": scores}, lambda x: np.array([theirs(x)]), reps=draws)
    cells = [scores[:, task] for task in range(tasks)]
    assert float(ours(cells)) == pytest.approx(float(values["x"][0]), abs=1e-9)
    drawn = [cell[place] for cell, place in zip(cells, places, strict=True)]
    interval = percentile_interval(float(ours(cells)), ours(drawn), 0.95)
    assert (interval.low, interval.high) == pytest.approx(tuple(intervals["x"][:, 0]), abs=1e-9)


def test_tasks_are_resampled_apart_and_keep_their_seeds() -> None:
    cells = [np.array([1.0, 2.0]), np.array([5.0, 6.0, 7.0])]
    drawn = resampled(cells, 1000, np.random.default_rng(0))
    assert [part.shape for part in drawn] == [(1000, 2), (1000, 3)]
    assert all(set(part.ravel()) == set(cell) for part, cell in zip(drawn, cells, strict=True))
