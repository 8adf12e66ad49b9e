"""``arcade-torch report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass
class Report:
    """Write the HTML page of a study: one file, nothing loaded from elsewhere. Missing analyses are made first.

    Example: arcade-torch report runs/demo
    """

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """The page; report.html in that folder by default."""
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run that the headline is based on."""
    saliency: bool = True
    """Draw saliency strips."""
    recall: bool = True
    """Measure recall density: how decisions spread over the past."""
    contamination: bool = True
    """Measure state contamination: what one noisy past frame changes."""
    references: bool = True
    """Draw the returns of the random policy and of the oracles."""

    def run(self) -> int:
        """Write the page."""
        from arcade_torch.tools.progress import Bars
        from arcade_torch.tools.reports.build import report

        sections = {name: getattr(self, name) for name in ("saliency", "recall", "contamination", "references")}
        with Bars() as bars:
            page = report(self.study, self.out, metric=self.metric, progress=bars.update, **sections)
        print(f"report: {page}")
        return 0


COMMAND = Report
