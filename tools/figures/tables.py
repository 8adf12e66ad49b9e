"""Gap and Bias of the runs a figure is made from, or of the paper."""

from arcade_torch.tools.analysis.bootstrap import seed_coverage
from arcade_torch.tools.analysis.gap_bias import GapBias, gap_and_bias
from arcade_torch.tools.analysis.paper import SEEDS, paper_table
from arcade_torch.tools.figures.registry import Request
from arcade_torch.tools.figures.runs import find_runs
from arcade_torch.tools.figures.style import seeds_note


def table_of(request: Request) -> tuple[GapBias, list[str], str, str]:
    """The table a figure draws.

    Args:
        request: of the figure.

    Returns:
        ``(table, notes, what stands under the figure, text to print)``.

    Raises:
        ValueError: the runs do not suffice, see `find_runs` and `gap_and_bias`.
    """
    if request.paper:
        paper = paper_table()
        under = (
            f"published returns, {len(paper.table.tasks)} tasks, n = {SEEDS} seeds; bars: normal 95 % interval, tasks "
            f"independent (a bootstrap over {SEEDS} seeds would cover {100 * seed_coverage(SEEDS):.0f} %)"
        )
        return paper.table, [], under, paper.text()
    found = find_runs(request.runs)
    scores = [run.score(request.metric) for run in found.runs]
    table = gap_and_bias(scores, metric=request.metric, baseline=request.baseline, confidence=request.confidence)
    notes = found.notes + found.single_seeds()
    if table.dropped:
        notes.append(f"left out, some agent lacks one of its twins: {', '.join(table.dropped)}")
    under = f"{len(table.tasks)} task{'s' * (len(table.tasks) > 1)}, {request.metric}, "
    under += seeds_note([row.seeds for row in table.rows], request.confidence)
    return table, notes, under, ""


def is_person(agent: str) -> bool:
    """Whether a row is people: they have no Bias, which compares training runs."""
    return agent.lower() == "human"
