"""Command line, studies, memory analyses, figures, reports and benchmarks.

Every analysis is a function: runs or an agent in, arrays out; figures are made by functions beside
it. Public names are resolved on first use, so that ``arcade-torch --help`` loads neither torch nor
JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "Policy": "analysis.policy",
    "Study": "studies.grid",
    "contamination": "analysis.contamination",
    "gap_and_bias": "analysis.gap_bias",
    "greedy_window": "analysis.windows",
    "recall_density": "analysis.recall_density",
    "report": "reports",
    "saliency": "analysis.pixel_saliency",
    "saliency_figure": "figures.saliency",
    "study": "studies.runner",
}

if TYPE_CHECKING:
    from arcade_torch.tools.analysis.contamination import contamination
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
    "Policy", "Study", "contamination", "gap_and_bias", "greedy_window", "recall_density", "report",
    "saliency", "saliency_figure", "study",
]  # fmt: skip


if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name not in _PUBLIC:
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}; names: {', '.join(__all__)}"
            )
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    """Public names, for completion."""
    return sorted(__all__)
