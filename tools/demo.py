"""The demo: a small study that ends in a report."""

import sys
import time
from pathlib import Path

from arcade_torch.tools.studies.grid import Study
from arcade_torch.tools.studies.progress import clock

GAME = "SignpostEasy"
FRAMES = 100_000


def demo_study(frames: int = FRAMES, seeds: int = 4, game: str = GAME) -> Study:
    """The demo's study: one game, both twins, one memory model and the memory-free control.

    Args:
        frames: environment steps of each run.
        seeds: runs of each agent and twin.
        game: id of the game.

    Raises:
        ValueError: a number is below 1.
    """
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    return Study(
        name="demo",
        games=(game,),
        memories=("lru", "mlp"),
        seeds=tuple(range(seeds)),
        preset="small",
        total_frames=frames,
        question=_QUESTIONS.get(
            game, f"What does a memory do for an agent that plays {game} as an MDP (full) and as a POMDP (partial)?"
        ),
    )


_QUESTIONS = {
    "SignpostEasy": (
        "A sign says which of four ways to take at the end of a corridor. Does a memory let an agent take it when the "
        "sign is shown in the first frame alone (POMDP), and what does memory cost where the sign stays in view (MDP)? "
        "Whoever forgets the sign can expect a return of 0.25 and no more."
    ),
    "MineSweeperEasy": (
        "Does a memory let an agent play MineSweeper when only the number under the cursor is shown (POMDP), and what "
        "does memory cost where every uncovered number stays in view (MDP)?"
    ),
}


def demo(out: Path, study_of: Study, workers: int, command: str) -> int:
    """Run the demo, or go on with it, and write its report.

    Args:
        out: folder.
        study_of: what to run, see :func:`demo_study`.
        workers: runs at once, 0 for one a core.
        command: how the user started it.

    Returns:
        Exit code: 1 if a run failed.
    """
    from arcade_torch.tools.count_bar import CountBar
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
    with CountBar() as bar:
        page = report(out, progress=bar.update)
    print(f"report after {clock(time.monotonic() - started)}: {page.resolve()}")
    return 1 if result.errors else 0
