"""``arcade-torch analyze contamination``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from arcade_torch.tools.tables import show_table


@dataclass
class ContaminationCommand:
    """What one noisy past frame does to later decisions, by strength and delay; figures, an example, and the numbers.

    The recorded actions are replayed, so that only the frame differs. The numbers of a run are kept in its folder.

    Example: arcade-torch analyze contamination runs/one --sigmas 0.1 1.0 --delays 0 1 5 20 --starts 100
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders or checkpoints; seeds of one agent are pooled. Add a memory-free run as control."""
    out: Path | None = None
    """Folder for figures and numbers; the first run's analysis folder by default."""
    sigmas: tuple[float, ...] = (0.1, 0.3, 1.0)
    """Standard deviations of the noise; 1 is the range of a pixel."""
    delays: tuple[int, ...] = (0, 1, 2, 5, 10, 20, 50, 100)
    """Steps from the noisy frame to the decision; 0 is the ceiling."""
    starts: int = 200
    """Start points of each checkpoint, at most four an episode."""
    horizon: int = 10
    """Step of the decision in the example."""
    shuffle: bool = False
    """Permute frames 2 to 10 in place of adding noise."""
    clip: bool = False
    """Keep noisy pixels in their range."""
    feedback: bool = False
    """Let the replay choose the previous actions itself, as the published code does."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agents were trained on."""
    target: Literal["auto", "q", "logits", "probs"] = "auto"
    """What is compared; Q-values, or a policy's probabilities, by default."""
    seed: int = 0
    """Of episodes, start points and noise."""
    style: Literal["light", "print"] = "light"
    """Look of the figures."""

    def run(self) -> int:
        """Measure, draw, save."""
        from arcade_torch.tools.analysis.kept import analysis_folder
        from arcade_torch.tools.count_bar import CountBar
        from arcade_torch.tools.figures.contamination import draw, measure
        from arcade_torch.tools.figures.registry import Request
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.optional import need

        keep_freed_memory()
        if not self.runs:
            raise ValueError("name at least one run folder")
        if self.horizon < 2:
            raise ValueError(f"--horizon must be at least 2, got {self.horizon}")
        need("matplotlib")
        options: dict[str, Any] = {"delays": self.delays, "starts": self.starts, "feedback": self.feedback}
        options |= {"target": self.target, "seed": self.seed}
        if not self.shuffle:
            options |= {"sigmas": self.sigmas, "clip": self.clip}
        with CountBar() as bar:
            request = Request(out=self.out or analysis_folder(self.runs[0]), style=self.style, progress=bar.update)
            measured = measure(self.runs, request, options, self.shuffle, self.observability)
        made = draw(measured, request, self.horizon)
        for label, found in measured:
            rows = [
                ["shuffled" if self.shuffle else f"{sigma:g}", *(f"{100 * x:.1f}" for x in line)]
                for sigma, line in zip(found.sigmas, found.mean("flip"), strict=True)
            ]
            show_table(
                f"{label.agent} on {label.game} ({label.observability}), seed {label.seed}: changed decisions in %",
                ("sigma", *(f"+{delay}" for delay in found.delays)),
                rows,
                f"{len(found.points)} start points ({', '.join(map(str, found.counts()[0]))} by delay); "
                f"a frame replaced by itself moves outputs by {found.clean_error:.1e}",
            )
        for line in [*made.notes, *map(str, made.files)]:
            print(line)
        return 0


COMMAND = ContaminationCommand
