"""How large a study may be that ends after some minutes: games, seeds and frames, by a measured
speed.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from arcade_torch.tools.machine import torch_threads
from arcade_torch.tools.studies.grid import RunSpec, Study

SEEDS = ((5, 250_000), (3, 60_000), (2, 60_000))
"""So many seeds where each run can have so many frames at least; the first that fits is taken.
Signpost is learned with 60,000 frames, with fewer no game is.
"""
FEWEST_FRAMES = 20_000
MOST_FRAMES = 2_500_000
"""Those of the preset ``small``."""
UPDATES = 2
"""Updates of each memory that are timed."""
START_S = 6.0
"""Seconds of a core for a run beside building and training: imports, evaluations, checkpoints."""
REPORT_S = 3.5
"""Seconds of a core for a run in the report, which the same workers measure."""
SHARE = 0.85
"""Workers side by side are so much slower than one alone, which is timed."""


class Speed(NamedTuple):
    """What was measured of one worker."""

    frames_per_s: float  # collecting and learning, the same number of frames of every memory
    start_s: float  # of a run, before and after its frames
    report_s: float  # of a run in the report


class Size(NamedTuple):
    """How large a study is."""

    games: tuple[str, ...]
    seeds: int
    frames: int  # of a run


def measure_speed(study: Study) -> Speed:
    """Time some updates of every memory of a study, on the POMDP of its first game."""
    from arcade_torch.agents.trainer import Trainer

    seconds_a_frame = 0.0
    build_s = list[float]()
    with torch_threads(1):
        cpu_s = -time.process_time()
        clock_s = -time.perf_counter()
        for memory in study.memories:
            run = RunSpec(study.games[0], "partial", memory, study.algorithms[0], 0)
            began = time.perf_counter()
            trainer = Trainer(study.config(run))
            trainer.warm_up()
            trainer.update()
            ready = time.perf_counter()
            for _ in range(UPDATES):
                trainer.update()
            frames = UPDATES * trainer.config.learner.frames_per_update
            seconds_a_frame += (time.perf_counter() - ready) / frames
            build_s.append(ready - began)
            trainer.close()
        cpu_s += time.process_time()
        clock_s += time.perf_counter()
    load = max(1.0, clock_s / cpu_s)  # what else runs on the machine slows imports down, too
    frames_per_s = len(study.memories) / seconds_a_frame
    # workers share what is compiled, so that the last one is what most of them take
    return Speed(frames_per_s, load * START_S + build_s[-1], load * REPORT_S)


@dataclass(frozen=True)
class Budget:
    """What a study of both twins takes."""

    agents: int  # how many are compared
    workers: int  # runs at once
    speed: Speed

    def _rounds(self, games: int, seeds: int) -> int:
        """How many runs a worker carries out, one after the other."""
        return math.ceil(2 * games * self.agents * seeds / self.workers)

    def minutes(self, games: int, seeds: int, frames: int) -> float:
        """How long a study takes."""
        training_s = self.speed.start_s + frames / self.speed.frames_per_s
        run_s = training_s / SHARE + self.speed.report_s
        return self._rounds(games, seeds) * run_s / 60

    def frames(self, games: int, seeds: int, minutes: float) -> int:
        """Frames of each run, in whole thousands, of a study that takes so long; below zero where
        the starts alone take longer.
        """
        run_s = 60 * minutes / self._rounds(games, seeds)
        training_s = SHARE * (run_s - self.speed.report_s)
        frames = int((training_s - self.speed.start_s) * self.speed.frames_per_s) // 1000 * 1000
        return min(frames, MOST_FRAMES)

    def fit(
        self,
        games: Sequence[str],
        minutes: float,
        seeds: int | None = None,
        frames: int | None = None,
        all_games: bool = False,
    ) -> Size:
        """The largest study that takes so long: first as many games, then as many seeds as can be;
        the smallest one if none does.

        Args:
            games: the first ones are kept where there is no time for all.
            minutes: how long it may take.
            seeds: None for as many as fit.
            frames: of each run; None for as many as fit.
            all_games: leave no game out.
        """
        fewest_games = len(games) if all_games else 1
        choices = SEEDS if seeds is None else ((seeds, SEEDS[-1][1]),)
        for count in range(len(games), fewest_games - 1, -1):
            for number, least in choices:
                fitting = self.frames(count, number, minutes)
                if fitting >= (frames or least):
                    return Size(tuple(games[:count]), number, frames or fitting)
        fewest_seeds = choices[-1][0]
        fitting = max(self.frames(fewest_games, fewest_seeds, minutes), FEWEST_FRAMES)
        return Size(tuple(games[:fewest_games]), fewest_seeds, frames or fitting)
