"""The demo: a small study that ends in a report."""

import sys
import time
from pathlib import Path

from arcade_torch.tools.studies.grid import Study
from arcade_torch.tools.studies.progress import clock

GAME = "MineSweeperEasy"


def demo_study(frames: int = 400_000, seeds: int = 2) -> Study:
    """The demo's study: one game, both twins, one memory model and the memory-free control.

    Args:
        frames: environment steps of each run.
        seeds: runs of each agent and twin.

    Raises:
        ValueError: a number is below 1.
    """
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    return Study(
        name="demo",
        games=(GAME,),
        memories=("lru", "mlp"),
        seeds=tuple(range(seeds)),
        preset="demo",
        total_frames=frames,
        question=(
            "Does a memory let an agent play MineSweeper when only the number under the cursor is shown (POMDP), "
            "and what does memory cost where every uncovered number stays in view (MDP)?"
        ),
    )


def demo(out: Path, frames: int, seeds: int, workers: int, command: str) -> int:
    """Run the demo, or go on with it, and write its report.

    Args:
        out: folder.
        frames: environment steps of each run.
        seeds: runs of each agent and twin.
        workers: runs at once, 0 for one a core.
        command: how the user started it.

    Returns:
        Exit code: 1 if a run failed.
    """
    from arcade_torch.tools.reports.build import report
    from arcade_torch.tools.studies.runner import study

    started = time.monotonic()
    what = demo_study(frames, seeds)
    print(
        f"{len(what.runs())} runs of {frames:,} frames in {out}; Ctrl-C stops, the same command goes on",
        file=sys.stderr,
    )
    result = study(what, out, workers=workers, command=command)
    for name, error in result.errors.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    if not result.finished:
        return 1
    print("drawing saliency, playing the oracles, writing the report ...", file=sys.stderr, flush=True)
    page = report(out)
    print(f"report after {clock(time.monotonic() - started)}: {page.resolve()}")
    return 1 if result.errors else 0
