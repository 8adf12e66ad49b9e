"""``arcade-torch demo``."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from arcade_torch.tools.extensions import command_line


@dataclass
class Demo:
    """Small study of what memory does: one game as MDP and POMDP, with a memory and without, four seeds each.

    Ends in one HTML page with learning curves, observability gap, memory bias and saliency. About four minutes on two
    cores; type the same again to go on after an interruption. The game is a probe, solved with memory and only with it;
    with one of the ten games it takes longer and says less clearly.

    Example: arcade-torch demo --game MineSweeperEasy --frames 400000 --seeds 2 --out runs/mines
    """

    game: str = "SignpostEasy"
    """Game to play; of the ten, MineSweeperEasy learns something in 400000 frames."""
    frames: int = 100_000
    """Environment steps of each run."""
    seeds: int = 4
    """Runs of each agent and twin."""
    out: Path = Path("runs/demo")
    """Folder of the study."""
    workers: int = 0
    """Runs at once; 0 for one a core."""
    argv: tyro.conf.Suppress[tuple[str, ...]] = ()

    def run(self) -> int:
        """Run the study and write its report."""
        from arcade_torch.tools.commands.study import carry_out
        from arcade_torch.tools.studies.grid import demo_study
        from arcade_torch.tools.studies.runner import make_engine

        what = demo_study(self.game, self.frames, self.seeds)
        return carry_out(what, self.out, make_engine("auto", self.workers), self.command(), self.resume_hint())

    def command(self) -> str:
        """The line that starts this demo."""
        return command_line(["demo", *self.argv])

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        return f"finished runs are kept, the others go on from their checkpoints with: {self.command()}"


COMMAND = Demo
