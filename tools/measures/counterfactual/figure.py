"""Counterfactual recall: effects of exchanged frames by lag, and of an exchanged state, with
intervals over seeds and their episodes.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.agents.checked import require
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Made, Picture, Progress, style
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.arguments import check_by_name
from arcade_torch.tools.measures.bootstrap import Array, Interval, Pooled, pooled_episodes
from arcade_torch.tools.measures.checkpoints import (
    Label,
    by_task,
    checkpoints_of,
    measure_run,
    measure_runs,
)
from arcade_torch.tools.measures.counterfactual import CounterfactualOptions, measure
from arcade_torch.tools.measures.recall_density.figure import DENSITY
from arcade_torch.tools.measures.recall_density.measure import RecallDensity, recall_density
from arcade_torch.tools.measures.saliency.figure import SATURATED
from arcade_torch.tools.measures.section import Cells, section
from arcade_torch.tools.options import at_least

EFFECTS: Mapping[measure.Effect, str] = {
    "flip": "share of changed decisions",
    "distance": "total variation",
    "change": "change of value / action gap",
}
SHARES = ("flip", "distance")  # effects that lie in [0, 1]
DONORS = {False: "all donors", True: "donors that differ"}
STATE = "state"  # the place on the axis of lags where everything before the last frame is exchanged

EXCHANGES: Mapping[str, Any] = {**DENSITY, "donors": 4, "most_lags": 24}
"""Options of `counterfactual` for a report: the decisions are those of its recall density."""
OF_RUN = (measure.counterfactual, EXCHANGES)  # what a report measures of a run, and how


# of one agent on one task: each effect at every lag, and at last of the state, [L + 1]
Profiles = Mapping[measure.Effect, Pooled]


def by_lag(options: CounterfactualOptions, progress: Progress | None) -> Made:
    """Figures ``counterfactual-GAME-TWIN``, one a task."""
    at_least(options, episodes=2, donors=1, block=1, lags=1, seed=0)
    paths, notes = checkpoints_of(options.runs)
    settings = vars(options) | {"cap": options.max_frames, "most_lags": options.lags}
    measured = measure_runs(paths, measure.counterfactual, settings, progress)
    result = Made([], notes, [_table(measured, options.confidence)])
    for (game, twin), agents in style.agents_by_task(by_task(measured)).items():
        result.pictures.append(_picture(game, twin, agents, options))
    alone = sum(exchanges.alone for _, exchanges in measured)
    if alone:
        result.notes.append(
            f"{alone} decisions come at a step that no other episode has: no state, and no frame "
            "so late, could be exchanged"
        )
    if options.donors >= options.episodes:
        result.notes.append(
            f"fewer than {options.donors} donors: a decision has the {options.episodes - 1} other "
            "episodes at most, give more --episodes"
        )
    return result


def _table(measured: Sequence[tuple[Label, measure.Counterfactual]], confidence: float) -> Table:
    """What the decisions of each run rest on, one row a run."""
    rows = list[tuple[Any, ...]]()
    for label, exchanges in measured:
        cells = list[str]()
        for differing in (False, True):
            memory = exchanges.memory_reliance("flip", differing, confidence)
            observation = exchanges.observation_reliance("flip", differing, confidence)
            cells += [memory.text(), observation.text()]
        certainty = f"{exchanges.certainty.mean():.4f}"
        rows.append((label, len(exchanges.lengths), *cells, certainty))
    head = (
        "run", "decisions", "memory", "observation", "memory, differing", "observation, differing",
        "probability",
    )  # fmt: skip
    caption = (
        "share of decisions that change if the recurrent state (memory) or the last frame "
        "(observation) is another episode's, over all donors and over those that truly differ, "
        f"with {100 * confidence:g} % intervals over episodes; probability: of the action taken"
    )
    return Table("reliance on memory and observation", head, rows, caption)


def profiles_of(
    seeds: Sequence[measure.Counterfactual], differing: bool, confidence: float = 0.95
) -> Profiles:
    """The effects of one task, pooled over its seeds and their decisions."""
    lags = max(seed.flip.shape[1] for seed in seeds)
    profiles = dict[measure.Effect, Pooled]()
    for effect in EFFECTS:
        decisions = [_of_seed(seed, effect, differing, lags) for seed in seeds]
        profiles[effect] = pooled_episodes(decisions, confidence)
    return profiles


def _of_seed(
    seed: measure.Counterfactual, effect: measure.Effect, differing: bool, lags: int
) -> Array:
    """The decisions of one seed, [D, lags + 1]: at every lag, NaN beyond its longest episode, and
    then the effect of the state.
    """
    by_lag = seed.by_lag(effect, differing)
    values = np.full((len(by_lag), lags + 1), np.nan)
    values[:, : by_lag.shape[1]] = by_lag
    values[:, -1] = seed.by_state(effect, differing)
    return values


def _picture(
    game: str,
    twin: str,
    agents: Mapping[str, Sequence[measure.Counterfactual]],
    options: CounterfactualOptions,
) -> Picture:
    """The figure of one task: a row an effect, a column all donors and those that differ."""
    figure, axes = style.panels(len(EFFECTS), len(DONORS), (9.5, 7.6), sharey="row")
    colours = style.agent_colours(list(agents))
    rows = list[dict[str, Any]]()
    for column, (differing, title) in enumerate(DONORS.items()):
        profiles = dict[str, Profiles]()
        for agent, seeds in agents.items():
            profiles[agent] = profiles_of(seeds, differing, options.confidence)
        for row, (effect, name) in enumerate(EFFECTS.items()):
            plot(profiles, axes[row, column], effect, colours)
            axes[row, 0].set_ylabel(name)
        axes[0, column].set_title(title)
        axes[-1, column].set_xlabel("steps back from the decision")
        for agent, of_agent in profiles.items():
            rows += _rows(agent, game, twin, len(agents[agent]), title, of_agent)
    handles, _ = axes[0, 0].get_legend_handles_labels()
    title = f"{game}, {style.TWIN_NAMES[twin]}"
    style.legend_above(figure, handles, 6, "outside upper right", title)
    return Picture(f"counterfactual-{game}-{twin}", figure, _note(agents, options), rows)


def _note(
    agents: Mapping[str, Sequence[measure.Counterfactual]], options: CounterfactualOptions
) -> str:
    """What was exchanged, and what the intervals are over."""
    counts = [len(seeds) for seeds in agents.values()]
    count = f"n = {min(counts)}" if min(counts) == max(counts) else f"n = up to {max(counts)}"
    over = "its episodes" if max(counts) == 1 else "seeds and their episodes"
    share = f"{100 * options.confidence:g} %"
    plural = "s" if max(counts) > 1 else ""
    sample = f"{count} seed{plural}; bars: {share} bootstrap interval over {over}"
    frames = "one frame" if options.block == 1 else f"{options.block} consecutive frames"
    return (
        f"{sample}; {options.episodes} decisions each, {frames} exchanged for those of up to "
        f"{options.donors} other episodes at the same step; {STATE}: everything before the last "
        "frame is the other episode's"
    )


def _rows(
    agent: str, game: str, twin: str, seeds: int, donors: str, profiles: Profiles
) -> list[dict[str, Any]]:
    """The numbers of a figure, one row a lag."""
    lags = len(profiles["flip"].mean) - 1
    columns: dict[str, Any] = {"agent": agent, "game": game, "observability": twin}
    columns["seeds"] = seeds
    columns["donors"] = donors
    columns["lag"] = [*map(str, range(lags)), STATE]
    for effect in EFFECTS:
        values = profiles[effect]
        columns[effect] = values.mean
        columns[f"{effect}_low"] = values.low
        columns[f"{effect}_high"] = values.high
    return style.rows_of(**columns)


def plot(
    agents: Mapping[str, Profiles],
    axis: Any,
    effect: measure.Effect,
    colours: Mapping[str, str],
) -> None:
    """Draw one effect by lag, a line an agent, and at the right the effect of the state."""
    lags = max(len(profiles[effect].mean) for profiles in agents.values()) - 1
    state = lags + 0.5
    markers = style.agent_markers(agents, colours)
    for place, (agent, profiles) in enumerate(agents.items()):
        values = profiles[effect]
        steps = np.arange(len(values.mean) - 1)
        x = np.append(steps, state) + 0.08 * (place - (len(agents) - 1) / 2)
        look = {"color": colours[agent], "marker": markers[agent], "ms": 4}
        axis.plot(x[:-1], values.mean[:-1], label=style.legend_name(agent), **look)
        axis.plot(x[-1:], values.mean[-1:], ls="", **look)
        bars = style.whiskers(values.mean, values.low, values.high)
        axis.errorbar(x, values.mean, bars, fmt="none", ecolor=colours[agent], capsize=2, lw=1)
    axis.axvline(lags - 0.1, color=style.NEUTRAL, lw=0.8, ls=":")
    spacing = max(1, -(-lags // 8))
    ticks = list(range(0, lags, spacing))
    axis.set_xticks([*ticks, state], [*map(str, ticks), STATE])
    axis.set_xlim(-0.5, state + 0.5)
    if effect in SHARES:
        axis.set_ylim(-0.03, 1.05)
    else:
        axis.set_ylim(bottom=0, auto=True)  # panels that share it still widen it


def counterfactual_figure(
    effects: Mapping[str, measure.Counterfactual | Sequence[measure.Counterfactual]],
    *,
    effect: measure.Effect = "flip",
    figure: Any = None,
) -> Any:
    """Draw one effect by lag and of the state, a line a name, over all donors and over those that
    differ.

    Args:
        effects: by name what `counterfactual` gave, or that of several seeds; bars are over seeds
            and their episodes.
        effect: ``flip``, ``distance`` or ``change``.
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default.

    Returns:
        A matplotlib figure.
    """
    check_by_name("effects", effects)
    require(effect in EFFECTS, "effect", effect, f"one of {', '.join(EFFECTS)}")
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    figure.set_size_inches(8.0, 3.2)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(1, len(DONORS), sharey=True)
    colours = style.agent_colours(list(effects))
    for axis, (differing, title) in zip(axes, DONORS.items(), strict=True):
        profiles = dict[str, Profiles]()
        for name, given in effects.items():
            seeds = [given] if isinstance(given, measure.Counterfactual) else given
            profiles[name] = profiles_of(seeds, differing)
        plot(profiles, axis, effect, colours)
        axis.set_title(title)
        axis.set_xlabel("steps back from the decision")
    axes[0].set_ylabel(EFFECTS[effect])
    style.legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure


class OfCell(NamedTuple):
    """What the report shows of one agent on one task."""

    profiles: Profiles
    gradients: Array  # [L], mean share of the gradient by lag; empty where it was not asked for


def counterfactual_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None, gradients: bool
) -> dict[str, Any]:
    """Exchanges of every cell, a picture a task; numbers are kept in the run folders.

    ``gradients`` draws the recall density of the same decisions beside them.
    """
    colours = style.agent_colours(agents)

    def summary(
        measured: Sequence[tuple[Label, measure.Counterfactual]],
    ) -> tuple[OfCell, dict[str, Any]]:
        shares = np.zeros(0)
        if gradients:
            densities = [
                measure_run(label.path, recall_density, DENSITY)[1] for label, _ in measured
            ]
            shares = share_by_lag(densities, EXCHANGES["most_lags"])
        seeds = [exchanges for _, exchanges in measured]
        return OfCell(profiles_of(seeds, False), shares), _section_row(seeds)

    def draw(by_agent: Mapping[str, OfCell], axis: Any) -> None:
        profiles = {agent: of_cell.profiles for agent, of_cell in by_agent.items()}
        plot(profiles, axis, "flip", colours)
        for agent, of_cell in by_agent.items():
            lags = len(profiles[agent]["flip"].mean) - 1
            share = of_cell.gradients[:lags]
            axis.plot(np.arange(len(share)), share, color=colours[agent], ls="--", lw=1)
        axis.set_xlabel("steps back from the decision")

    share = "decisions changed"
    parts = section("counterfactual recall", cells, OF_RUN, summary, draw, share, progress)
    parts["sentences"] = _sentences(parts["rows"])
    return parts


def _sentences(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Who relies on memory, as far as an interval excludes zero; the strongest first."""
    sentences = list[str]()
    for row in sorted(rows, key=lambda row: -row["memory"].value):
        memory = row["memory"]
        if not memory.low > 0:
            continue
        fact = (
            f"{row['game']} {row['twin']}: another episode's memory changes "
            f"{100 * memory.value:.0f} % of {row['agent']}'s decisions"
        )
        differing = row["memory_differing"]
        if differing.value > memory.value:
            fact += f", {100 * differing.value:.0f} % where it differs"
        if row["at_peak"].low > 0:
            steps = "step" if row["peak"] == 1 else "steps"
            fact += (
                f"; of single frames the one {row['peak']} {steps} back changes most, "
                f"{100 * row['at_peak'].value:.0f} %"
            )
        if row["twin"] == style.TWIN_NAMES["full"]:
            fact += "; the MDP shows all there is to know on the last frame"
        sentences.append(f"{fact}.")
    return sentences


def share_by_lag(densities: Sequence[RecallDensity], lags: int) -> Array:
    """Mean share of the gradient so many steps back, float64 [lags]; NaN if there is no gradient.

    Like an exchange it is averaged over the episodes that have such a step.
    """
    rows = list[Array]()
    for density in densities:
        for share in density.shares:
            row = np.full(lags, np.nan)
            latest = share[::-1][:lags]
            row[: len(latest)] = latest
            rows.append(row)
    if not rows:
        return np.full(lags, np.nan)
    return np.asarray(np.ma.masked_invalid(rows).mean(axis=0).filled(np.nan))


def _section_row(seeds: Sequence[measure.Counterfactual]) -> dict[str, Any]:
    """The row of one cell in the table of a report."""
    everybody = profiles_of(seeds, False)["flip"]
    differing = profiles_of(seeds, True)["flip"]
    profile = everybody.mean[:-1]
    earlier = np.where(np.isfinite(profile[1:]), profile[1:], -1)
    peak = 1 + int(earlier.argmax()) if earlier.size else 0
    return {
        "seeds": len(seeds),
        "decisions": sum(len(seed.lengths) for seed in seeds),
        "memory": _cell(everybody, -1),
        "observation": _cell(everybody, 0),
        "memory_differing": _cell(differing, -1),
        "observation_differing": _cell(differing, 0),
        "peak": peak,
        "at_peak": _cell(everybody, peak),
        "at_peak_differing": _cell(differing, peak),
        "saturated": all(_is_saturated(seed) for seed in seeds),
    }


def _is_saturated(seed: measure.Counterfactual) -> bool:
    """Whether the softmax of a policy is flat where its decisions are taken."""
    return seed.target == "probs" and float(seed.certainty.mean()) >= SATURATED


def _cell(values: Pooled, place: int) -> Interval:
    """One number of a profile with its interval."""
    return Interval(float(values.mean[place]), float(values.low[place]), float(values.high[place]))
