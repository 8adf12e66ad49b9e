"""Command line, studies, memory analyses, figures, reports and benchmarks.

Every analysis is a function: runs or an agent in, arrays out; figures are made by functions beside
it. Public names are resolved on first use, so that ``arcade-torch --help`` loads neither torch nor
JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "Policy": "measures.policy",
    "as_policy": "measures.policy",
    "Study": "studies.grid",
    "beliefs": "measures.beliefs.measure",
    "beliefs_figure": "measures.beliefs.figure",
    "contamination": "measures.contamination.measure",
    "contamination_example": "measures.contamination.measure",
    "contamination_example_figure": "measures.contamination.example",
    "contamination_figure": "measures.contamination.figure",
    "counterfactual": "measures.counterfactual.measure",
    "counterfactual_figure": "measures.counterfactual.figure",
    "gap_and_bias": "measures.gap_bias.measure",
    "greedy_window": "measures.windows",
    "patching": "measures.beliefs.patching",
    "recall_density": "measures.recall_density.measure",
    "recall_density_figure": "measures.recall_density.figure",
    "report": "reports",
    "saliency": "measures.saliency.measure",
    "saliency_figure": "measures.saliency.figure",
    "steering": "measures.beliefs.steering",
    "study": "studies.runner",
}

if TYPE_CHECKING:
    from arcade_torch.tools.measures.beliefs.figure import beliefs_figure
    from arcade_torch.tools.measures.beliefs.measure import beliefs
    from arcade_torch.tools.measures.beliefs.patching import patching
    from arcade_torch.tools.measures.beliefs.steering import steering
    from arcade_torch.tools.measures.contamination.example import contamination_example_figure
    from arcade_torch.tools.measures.contamination.figure import (
        contamination_figure,
    )
    from arcade_torch.tools.measures.contamination.measure import (
        contamination,
        contamination_example,
    )
    from arcade_torch.tools.measures.counterfactual.figure import counterfactual_figure
    from arcade_torch.tools.measures.counterfactual.measure import counterfactual
    from arcade_torch.tools.measures.gap_bias.measure import gap_and_bias
    from arcade_torch.tools.measures.policy import Policy, as_policy
    from arcade_torch.tools.measures.recall_density.figure import recall_density_figure
    from arcade_torch.tools.measures.recall_density.measure import recall_density
    from arcade_torch.tools.measures.saliency.figure import saliency_figure
    from arcade_torch.tools.measures.saliency.measure import saliency
    from arcade_torch.tools.measures.windows import greedy_window
    from arcade_torch.tools.reports import report
    from arcade_torch.tools.studies.grid import Study
    from arcade_torch.tools.studies.runner import study

__all__ = [
    "Policy", "Study", "as_policy", "beliefs", "beliefs_figure", "contamination",
    "contamination_example", "contamination_example_figure", "contamination_figure",
    "counterfactual", "counterfactual_figure", "gap_and_bias", "greedy_window", "patching",
    "recall_density", "recall_density_figure", "report", "saliency", "saliency_figure", "steering",
    "study",
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
