"""The demo: a small study that ends in a report."""

import sys
import time
from dataclasses import replace
from pathlib import Path

from arcade_torch.tools.progress import Bars, clock
from arcade_torch.tools.studies.grid import Study, study_preset

GAME = "SignpostEasy"
FRAMES = 100_000


def demo_study(frames: int = FRAMES, seeds: int = 4, game: str = GAME) -> Study:
    """The demo's study: one game, both twins, one memory model and the memory-free control."""
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    what = replace(study_preset("demo"), games=(game,), seeds=tuple(range(seeds)), total_frames=frames)
    return what if game == GAME else replace(what, question=_QUESTION.format(game=game))


_QUESTION = "What does a memory do for an agent that plays {game} as an MDP (full) and as a POMDP (partial)?"


def demo(out: Path, study_of: Study, workers: int, command: str) -> int:
    """Run the demo, or go on with it, and write its report."""
    from arcade_torch.tools.reports.build import report
    from arcade_torch.tools.studies.runner import study

    started = time.monotonic()
    print(f"{len(study_of.runs())} runs in {out}; Ctrl-C stops, the same command goes on", file=sys.stderr)
    result = study(study_of, out, workers=workers, command=command)
    for name, error in result.errors.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    if not result.finished:
        return 1
    print("looking into the agents, playing the oracles, writing the report ...", file=sys.stderr, flush=True)
    with Bars() as bars:
        page = report(out, progress=bars.update)
    print(f"report after {clock(time.monotonic() - started)}: {page.resolve()}")
    return 1 if result.errors else 0
