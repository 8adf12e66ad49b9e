"""``arcade-torch analyze saliency``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


@dataclass
class SaliencyCommand:
    """Which pixels of the past the last decision of a greedy episode depends on; a figure, and its numbers as npz.

    Example: arcade-torch analyze saliency runs/one --show 10 --out runs/one/saliency.png
    """

    run_folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders or checkpoints, one row each."""
    out: Path | None = None
    """Figure (.png, .svg or .pdf); saliency.png in the first run folder by default."""
    seed: int = 0
    """Of the episode."""
    show: int = 8
    """How many of the last frames are drawn."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agent was trained on."""
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l2sq", "l2", "l1"] = "l2sq"
    """Norm over colour channels."""
    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """What is differentiated; Q-values, or a policy's probabilities, by default."""

    def run(self) -> int:
        """Compute, draw, save."""
        from arcade_torch.agents import load
        from arcade_torch.tools.analysis.episode_saliency import episode_window, explain
        from arcade_torch.tools.analysis.saliency_figure import save_saliency
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.optional import need

        keep_freed_memory()
        if not self.run_folders:
            raise ValueError("name at least one run folder")
        if self.show < 1:
            raise ValueError(f"--show must be at least 1, got {self.show}")
        need("matplotlib")
        rows = []
        extra: dict[str, Any] = {}
        for index, folder in enumerate(self.run_folders):
            agent = load(folder)
            window = episode_window(agent, seed=self.seed, observability=self.observability)
            found = explain(agent, window, reduce=self.reduce, norm=self.norm, target=self.target)
            twin = self.observability or agent.config.observability
            title = f"{agent.config.env} ({twin}), {agent.config.memory}"
            rows.append((title, window.frames.cpu().numpy(), found.maps))
            extra |= {f"per_frame_{index}": found.per_frame, f"action_{index}": window.action.cpu().numpy()}
            print(f"{title}: {window.n + 1} frames, {100 * found.shares()[-1]:.1f} % of the gradient on the last frame")
        for path in save_saliency(self.out or self.run_folders[0] / "saliency.png", rows, extra, self.show):
            print(path)
        return 0


COMMAND = SaliencyCommand
