"""The paper's picture of state contamination: an episode as it was and disturbed, and what became
of one decision.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from arcade_torch.agents.checked import require
from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import style
from arcade_torch.tools.measures.contamination import measure

# bars of an example, as in the paper
CLEAN_BEST = "#354e6a"
OTHER_BEST = "#a33a2f"
REST = "#b3b3b3"
MOST_LETTERS = 34
"""Of actions beside one another below their bars; more stand upright, below the last row alone."""
LETTER = 0.075
"""Inches of a letter that stands upright."""


def contamination_example_figure(
    example: measure.Example,
    *,
    title: str = "",
    actions: Sequence[str] | None = None,
    figure: Any = None,
) -> Any:
    """Draw what `contamination_example` gave: rows are an episode as it was, and disturbed; columns
    some of its frames, and bars of the outputs on its last, blue the best action when clean, red
    the best if it is another.

    Args:
        example: of `contamination_example`.
        title: stands above it.
        actions: names of the actions; by default those of our games, or numbers.
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default.

    Returns:
        A matplotlib figure.
    """
    if not isinstance(example, measure.Example):
        raise TypeError(f"example must be what contamination_example gave; got {kind_of(example)}")
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    n = example.frames.shape[1] - 1
    shuffle = example.hits[1] < 0
    names = row_names(example)
    names_of_actions = action_names(example) if actions is None else list(actions)
    count = example.values.shape[1]
    require(len(names_of_actions) == count, "actions", names_of_actions, f"{count} names")
    columns = 6 if shuffle else 3
    labels = [style.folded(name) for name in names_of_actions]
    is_crowded = sum(len(name) + 2 for name in names_of_actions) > MOST_LETTERS
    turned = max(map(len, "\n".join(labels).split("\n"))) * LETTER if is_crowded else 0.0
    figure.set_size_inches(1.6 * (columns + 1.7), 1.7 * len(names) + 0.8 + turned)
    figure.set_layout_engine("constrained")
    widths = [1.0] * columns + [1.7]
    axes = figure.subplots(
        len(names), columns + 1, squeeze=False, sharey="col", width_ratios=widths
    )
    for row, (*pictures, bars) in enumerate(axes):
        if shuffle:
            early = range(measure.FIRST + 1, measure.FIRST + 4)
            late = range(n - 2, n + 1)
            steps = [*early, *late]
        else:
            steps = [0, max(example.hits[row], example.hits[1]), n]
        for axis, t in zip(pictures, steps, strict=True):
            axis.imshow(example.frames[row, t], interpolation="nearest")
            axis.set(xticks=[], yticks=[], frame_on=False)
            axis.set_title(f"$o_{{{example.order[row, t]}}}$", parse_math=True)
        pictures[0].set_ylabel(names[row], fontsize="small")
        _plot_outputs(example, row, bars)
        is_last = row == len(names) - 1
        bars.set_xticks(range(count), labels, rotation=90 if is_crowded else 0, parse_math=False)
        bars.tick_params(labelsize="small", labelbottom=is_last or not is_crowded)
    outputs = "probabilities" if example.target == "probs" else f"centred {example.target}"
    axes[0, -1].set_title(f"{outputs} on $o_{{{n}}}$", parse_math=True)
    figure.suptitle(title, x=0.01, ha="left", parse_math=False)
    return figure


def row_names(example: measure.Example) -> list[str]:
    """How the rows of an example are called."""
    shuffle = example.hits[1] < 0
    noisy = ["shuffled" if shuffle else f"noise on frame {hit}" for hit in example.hits[1:]]
    return ["clean", *noisy]


def action_names(example: measure.Example) -> list[str]:
    """The names of our games' actions where there are as many, or else numbers."""
    count = example.values.shape[1]
    names = list(ACTION_NAMES)
    return names if count == len(names) else [str(action) for action in range(count)]


def _plot_outputs(example: measure.Example, row: int, axis: Any) -> None:
    """Draw the outputs of a row as bars, that of the best action in colour."""
    best = np.nanargmax(example.values, axis=1)
    axis.bar(range(example.values.shape[1]), example.values[row], color=REST)
    axis.patches[best[row]].set_facecolor(OTHER_BEST)
    axis.patches[best[0]].set_facecolor(CLEAN_BEST)
    axis.axhline(0.0, color=style.NEUTRAL, lw=0.8)
