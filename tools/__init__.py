"""Command line, studies, memory analyses, figures, reports and benchmarks.

Every analysis is a function: runs or an agent in, arrays out; figures are made by functions beside it.
Public names are resolved on first use, so that ``arcade-torch --help`` loads neither torch nor JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "gap_and_bias": "arcade_torch.tools.analysis.gap_bias",
    "saliency": "arcade_torch.tools.analysis.pixel_saliency",
    "recall_density": "arcade_torch.tools.analysis.recall_density",
    "contamination": "arcade_torch.tools.analysis.contamination",
    "shuffled_beginning": "arcade_torch.tools.analysis.contamination",
    "Policy": "arcade_torch.tools.analysis.policy",
    "saliency_figure": "arcade_torch.tools.figures.saliency",
    "greedy_window": "arcade_torch.tools.analysis.windows",
    "study": "arcade_torch.tools.studies.runner",
    "Study": "arcade_torch.tools.studies.grid",
    "report": "arcade_torch.tools.reports",
}

if TYPE_CHECKING:
    from arcade_torch.tools.analysis.contamination import contamination, shuffled_beginning
    from arcade_torch.tools.analysis.gap_bias import gap_and_bias
    from arcade_torch.tools.analysis.pixel_saliency import saliency
    from arcade_torch.tools.analysis.policy import Policy
    from arcade_torch.tools.analysis.recall_density import recall_density
    from arcade_torch.tools.analysis.windows import greedy_window
    from arcade_torch.tools.figures.saliency import saliency_figure
    from arcade_torch.tools.reports import report
    from arcade_torch.tools.studies.grid import Study
    from arcade_torch.tools.studies.runner import study

__all__ = [
    "Policy",
    "Study",
    "contamination",
    "gap_and_bias",
    "greedy_window",
    "recall_density",
    "report",
    "saliency",
    "saliency_figure",
    "shuffled_beginning",
    "study",
]


if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name not in _PUBLIC:
            raise AttributeError(f"module 'arcade_torch.tools' has no attribute {name!r}; names: {', '.join(__all__)}")
        value = getattr(import_module(_PUBLIC[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Public names, for completion."""
    return sorted(__all__)
