"""``arcade-torch demo``."""

import shlex
from dataclasses import dataclass
from pathlib import Path


@dataclass
class Demo:
    """Small study of what memory does: MineSweeper as MDP and POMDP, with a memory and without, two seeds each.

    Ends in one HTML page with learning curves, observability gap, memory bias and saliency. About 8 minutes on two
    cores; type the same again to go on after an interruption.

    Example: arcade-torch demo --frames 60000 --seeds 1 --out runs/taste
    """

    frames: int = 400_000
    """Environment steps of each run; below about 200000 the agents learn little."""
    seeds: int = 2
    """Runs of each agent and twin."""
    out: Path = Path("runs/demo")
    """Folder of the study."""
    workers: int = 0
    """Runs at once; 0 for one a core."""

    def run(self) -> int:
        """Run the study and write its report."""
        from arcade_torch.tools.demo import demo

        return demo(self.out, self.frames, self.seeds, self.workers, self.command())

    def command(self) -> str:
        """The line that starts this demo."""
        return shlex.join(
            ["arcade-torch", "demo", "--frames", str(self.frames), "--seeds", str(self.seeds), "--out", str(self.out)]
        )

    def how_to_go_on(self) -> str:
        """What to type after an interruption."""
        return f"finished runs are kept, the others go on from their checkpoints with: {self.command()}"


COMMAND = Demo
