"""``arcade-torch figure``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass
class Figure:
    """Draw one of the paper's figures from run folders, as PDF and PNG with its numbers beside it.

    Figures: returns, gap-bias, curves, saliency, recall-density, contamination, size-sweep, throughput, human,
    hyperparameters.

    Example: arcade-torch figure returns --runs runs/study --out figures --style print
    """

    name: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Which figure."""
    runs: tuple[Path, ...] = ()
    """Folders with runs: studies, run folders, or folders that hold such; for throughput the file of `bench envs`."""
    paper: bool = False
    """Draw the paper's published numbers; returns, gap-bias, human and hyperparameters have them."""
    out: Path = Path("figures")
    """Folder for the files; older ones of the same name are replaced."""
    style: Literal["light", "print"] = "light"
    """For a screen, or for a page."""
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run: final greedy evaluation, or the paper's best smoothed training return."""
    baseline: str = "mlp"
    """The memory-free agent."""
    confidence: float = 0.95
    """Of intervals."""
    episodes: int = 100
    """Trajectories of each checkpoint, for recall-density and contamination."""
    bins: tuple[int, ...] = (3, 16)
    """Numbers of bins, for recall-density."""
    end: Literal["last", "random"] = "last"
    """Decision of trajectories, for recall-density."""

    def run(self) -> int:
        """Draw and save."""
        from arcade_torch.tools.count_bar import CountBar
        from arcade_torch.tools.figures.registry import Request, make_figure
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.optional import need

        keep_freed_memory()
        need("matplotlib")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie between 0 and 1, got {self.confidence}")
        if self.episodes < 1 or not self.bins or min(self.bins) < 1:
            raise ValueError(f"--episodes and --bins must be at least 1, got {self.episodes} and {list(self.bins)}")
        with CountBar() as bar:
            made = make_figure(
                self.name,
                Request(
                    runs=self.runs,
                    out=self.out,
                    style=self.style,
                    paper=self.paper or self.name == "human",
                    metric=self.metric,
                    baseline=self.baseline,
                    confidence=self.confidence,
                    episodes=self.episodes,
                    bins=self.bins,
                    end=self.end,
                    progress=bar.update,
                ),
            )
        for line in [*filter(None, [made.text]), *made.notes, *map(str, made.files)]:
            print(line)
        return 0


COMMAND = Figure
