"""``arcade-torch analyze recall-density``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass
class RecallDensityCommand:
    """How the gradient of decisions is spread over the past of their episodes; figures, and their numbers.

    Plays whole greedy episodes on held-out seeds. The numbers of a run are kept in its folder and used again.

    Example: arcade-torch analyze recall-density runs/one runs/two --bins 3 16 --out figures
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders or checkpoints; seeds of one agent are pooled."""
    out: Path | None = None
    """Folder for figures and numbers; the first run's analysis folder by default."""
    bins: tuple[int, ...] = (3, 16)
    """Numbers of bins, a figure each; up to 6 as stacked bars."""
    episodes: int = 100
    """Greedy trajectories of each checkpoint."""
    end: Literal["last", "random"] = "last"
    """The decision: the one that ended the episode, or a random one."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agents were trained on."""
    max_frames: int = 512
    """Longest trajectory; a longer episode gives a window with a random end."""
    norm: Literal["l1", "l2sq", "l2"] = "l1"
    """Norm of a gradient over a frame."""
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """What is differentiated; Q-values, or a policy's probabilities, by default."""
    seed: int = 0
    """Of the episodes."""
    style: Literal["light", "print"] = "light"
    """Look of the figures."""

    def run(self) -> int:
        """Measure, draw, save."""
        from arcade_torch.tools.analysis.kept import analysis_folder
        from arcade_torch.tools.count_bar import CountBar
        from arcade_torch.tools.figures.recall_density import draw, measure
        from arcade_torch.tools.figures.registry import Request
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.optional import need

        keep_freed_memory()
        if not self.runs:
            raise ValueError("name at least one run folder")
        if not self.bins or min(self.bins) < 1:
            raise ValueError(f"--bins must be whole numbers of at least 1, got {list(self.bins)}")
        need("matplotlib")
        out = self.out or analysis_folder(self.runs[0])
        with CountBar() as bar:
            request = Request(
                out=out, style=self.style, episodes=self.episodes, bins=self.bins, end=self.end, progress=bar.update
            )
            densities, notes = measure(
                self.runs,
                request,
                self.observability,
                cap=self.max_frames,
                norm=self.norm,
                reduce=self.reduce,
                target=self.target,
                seed=self.seed,
            )
        made = draw(densities, request)
        for label, density in densities:
            print(
                f"{label.agent} on {label.game} ({label.observability}), seed {label.seed}: {len(density.shares)} "
                f"trajectories, mean length {density.lengths.mean():.0f} frames, "
                f"{100 * density.last_share():.1f} % of the gradient on the last frame, "
                f"thirds {' / '.join(f'{100 * mass:.1f}' for mass in density.mass(3))} %"
            )
        for line in [*notes, *made.notes, *map(str, made.files)]:
            print(line)
        return 0


COMMAND = RecallDensityCommand
