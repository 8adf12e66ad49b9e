"""Who is before whom: normalised scores, interquartile means with intervals, ranks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np

from arcade_torch.tools.board.check import CheckRecord
from arcade_torch.tools.board.entry import Entry
from arcade_torch.tools.board.protocol import TWINS, Suite, frames_class
from arcade_torch.tools.measures.bootstrap import (
    Array,
    Interval,
    iqm,
    percentile_interval,
    resampled,
)
from arcade_torch.tools.measures.gap_bias.measure import generator_of, normalise

DRAWS = 2000
CONFIDENCE = 0.95
Cells = Mapping[tuple[str, str], Sequence[float]]
"""Game and twin -> the returns of the seeds."""


@dataclass(frozen=True)
class Listed:
    """An entry of the page, with the file that it came from and its last check."""

    file: str
    entry: Entry
    record: CheckRecord | None

    @property
    def cells(self) -> dict[tuple[str, str], list[float]]:
        """The raw returns."""
        cells = dict[tuple[str, str], list[float]]()
        for run in sorted(self.entry.runs, key=lambda run: run.cell):
            cells.setdefault((run.game, run.twin), []).append(run.score)
        return cells

    @property
    def seeds(self) -> int:
        """Seeds of each cell."""
        return len({run.seed for run in self.entry.runs})

    @property
    def seconds(self) -> float:
        """Mean seconds of a training."""
        return mean(run.seconds for run in self.entry.runs)


@dataclass(frozen=True)
class Ranked:
    """A line of a table; without a rank and an interval where cells are missing."""

    listed: Listed
    rank: int  # 0 for none
    games: int  # of the suite that it has
    means: Mapping[str, Interval]  # by twin; empty where cells are missing


def suite_iqm(cells: Cells, suite: Suite, twin: str, name: str = "") -> Interval:
    """Interquartile mean of the normalised returns of all runs of a suite on one twin, with its
    stratified percentile bootstrap: seeds are resampled within each game.

    Args:
        cells: raw returns; every game of the suite has some.
        suite: the games.
        twin: ``full`` or ``partial``.
        name: of the agent; with the game and the twin it decides the draws.

    Returns:
        The mean, in [0, 1]; no interval where a game has a single seed.

    Source: Agarwal et al. (2021), arXiv 2108.13264; `normalise` as for gap and bias.
    """
    scores = list[Array]()
    drawn = list[Array]()
    for game in suite.games:
        returns = np.array(cells[game, twin], dtype=np.float64)
        scores.append(np.asarray(normalise(game, returns)))
        drawn += resampled(scores[-1:], DRAWS, generator_of(0, name, game, twin))
    several = min(len(values) for values in scores) > 1
    return percentile_interval(float(iqm(scores)), iqm(drawn), CONFIDENCE, several)


def has_suite(cells: Cells, suite: Suite) -> bool:
    """Whether there are returns of every game of a suite on both twins."""
    return all((game, twin) in cells for game in suite.games for twin in TWINS)


def games_of(cells: Cells, suite: Suite) -> list[str]:
    """The games of a suite that there are returns of."""
    return [game for game in suite.games if (game, TWINS[0]) in cells]


def ranking(entries: Sequence[Listed], suite: Suite, frames: str) -> list[Ranked]:
    """The entries of a class that have a game of a suite, best POMDP first.

    An entry that has all games on both twins is ranked by its interquartile mean on the POMDPs. One
    that lacks some has no rank and no mean: means over other games say something else.
    """
    complete = list[Ranked]()
    rest = list[Ranked]()
    for listed in entries:
        cells = listed.cells
        games = games_of(cells, suite)
        if frames_class(listed.entry.frames) != frames or not games:
            continue
        if not has_suite(cells, suite):
            rest.append(Ranked(listed, 0, len(games), {}))
            continue
        means = {}
        for twin in TWINS:
            means[twin] = suite_iqm(cells, suite, twin, listed.entry.name)
        complete.append(Ranked(listed, 0, len(games), means))
    complete.sort(key=lambda row: (-row.means["partial"].value, row.listed.entry.name))
    rest.sort(key=lambda row: (-row.games, row.listed.entry.name))
    ranked = []
    for place, row in enumerate(complete, 1):
        ranked.append(Ranked(row.listed, place, row.games, row.means))
    return [*ranked, *rest]
