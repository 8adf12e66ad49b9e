"""Beliefs: scores of the probes of each fact, over all steps and step by step, with intervals over
seeds, or over episodes where there is one seed.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Made, Picture, Progress, style
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.arguments import check_by_name
from arcade_torch.tools.measures.beliefs import BeliefsOptions, measure
from arcade_torch.tools.measures.beliefs.patching import OUTCOMES, Patches, patching
from arcade_torch.tools.measures.beliefs.recording import MIN_EPISODES, NO_FACTS
from arcade_torch.tools.measures.beliefs.steering import ARMS, Steering, steering
from arcade_torch.tools.measures.bootstrap import Array, Interval, pooled
from arcade_torch.tools.measures.checkpoints import Label, by_task, checkpoints_of, measure_runs
from arcade_torch.tools.measures.section import Cells, section
from arcade_torch.tools.options import at_least

SOURCES: Mapping[measure.Source, str] = {"state": "recurrent state", "frame": "frame alone"}
KINDS = {True: "share of the way from chance to 1", False: "R2"}
ALL = "all"  # of the steps
LOWEST = -0.15  # of the axis: what is below is worse than a guess, however much


PROBES: Mapping[str, Any] = {"episodes": 64, "max_steps": 96}
"""Options of `beliefs` for a report."""
OF_RUN = (measure.beliefs, PROBES)  # what a report measures of a run, and how


class Scores(NamedTuple):
    """Scores of one fact read off one source, with the ends of their intervals."""

    overall: Interval
    by_step: Array  # [T]
    low: Array  # [T]
    high: Array  # [T]


MOST_LEVEL = 10
"""Letters of the longest of several facts whose names stand level below their bars."""
OfAgent = Mapping[tuple[str, measure.Source], Scores]
"""By fact and source; an agent without memory has no state."""


def by_fact(options: BeliefsOptions, progress: Progress | None) -> Made:
    """Figures ``beliefs-GAME-TWIN``, one a task."""
    at_least(options, episodes=MIN_EPISODES, max_steps=1, seed=0)
    paths, notes = checkpoints_of(options.runs)
    measured = measure_runs(paths, measure.beliefs, vars(options), progress)
    patched = measure_runs(paths, patching, vars(options), progress)
    steered = measure_runs(paths, steering, vars(options), progress)
    tables = [
        _table(measured, options.confidence),
        _patched_table(patched, options.confidence),
        _steered_table(steered, options.confidence),
    ]
    result = Made([], notes, tables)
    result.notes += _notes(measured)
    for (game, twin), agents in style.agents_by_task(by_task(measured)).items():
        result.pictures.append(_picture(game, twin, agents, options))
    return result


def _notes(measured: Sequence[tuple[Label, measure.Beliefs]]) -> list[str]:
    """Which agents have no state, and which facts are left out."""
    notes = list[str]()
    for label, probes in measured:
        if not probes.state_width:
            notes.append(f"{label} has no recurrent state: it knows what its frame shows")
        if probes.constant.size:
            left_out = ", ".join(probes.constant.tolist())
            notes.append(f"{label}: {left_out} did not vary, and can be read off nothing")
    return notes


def _table(measured: Sequence[tuple[Label, measure.Beliefs]], confidence: float) -> Table:
    """The scores of each run, one row a fact."""
    rows = list[tuple[Any, ...]]()
    for label, probes in measured:
        for place, fact in enumerate(probes.names.tolist()):
            cells = [probes.score(fact, source, confidence).text() for source in measure.SOURCES]
            is_class = bool(probes.is_class[place])
            rows.append((label, fact, probes.cells[place], KINDS[is_class], *cells))
    head = ("run", "fact", "cells", "score", *SOURCES.values())
    caption = (
        "what a linear probe reads off the recurrent state, and off the features of the frame of "
        "the same step: 1 is perfect, 0 a constant guess; over episodes that the probe never saw, "
        f"with {100 * confidence:g} % intervals over them"
    )
    return Table("hidden facts that can be read", head, rows, caption, left=2)


def _patched_table(patched: Sequence[tuple[Label, Patches]], confidence: float) -> Table:
    """Whose decision follows an exchanged state, one row a run."""
    rows = list[tuple[Any, ...]]()
    for label, patches in patched:
        cells = [patches.share(outcome, confidence).text() for outcome in OUTCOMES]
        rows.append((label, int(patches.differs.sum()), *cells))
    caption = (
        "decisions on the own frame with the recurrent state of another episode at the same step, "
        "where that episode decides otherwise: shares that follow it, stay as they were, or are a "
        f"third, with {100 * confidence:g} % intervals over episodes"
    )
    head = ("run", "exchanges", *OUTCOMES)
    return Table("whose decision an exchanged state brings", head, rows, caption)


def _steered_table(steered: Sequence[tuple[Label, Steering]], confidence: float) -> Table:
    """Whose decision follows a state that was moved for one fact, one row a run and fact."""
    rows = list[tuple[Any, ...]]()
    for label, moves in steered:
        for fact in moves.names.tolist():
            patches = moves.patches(fact)
            cells = [moves.patches(fact, arm).share("follows", confidence).text() for arm in ARMS]
            rows.append((label, fact, int(patches.differs.sum()), *cells))
    caption = (
        "the recurrent state is another episode's (whole state), or moved by what states with the "
        "two values of the fact differ on average (the fact), or equally far at random; shares of "
        "decisions that become those of the other episode, where it has another value of the fact "
        f"and decides otherwise, with {100 * confidence:g} % intervals over episodes"
    )
    head = ("run", "fact", "moves", "whole state", "the fact", "at random")
    return Table("decisions that follow one fact", head, rows, caption, left=2)


def scores_of(seeds: Sequence[measure.Beliefs], confidence: float = 0.95) -> OfAgent:
    """The scores of one task, pooled over its seeds, or over the episodes of a single one."""
    steps = max(seed.guess_loss.shape[-1] for seed in seeds)
    scores = dict[tuple[str, measure.Source], Scores]()
    names = dict[str, None]()
    for seed in seeds:
        names |= dict.fromkeys(seed.names.tolist())
    for fact in names:
        having = [seed for seed in seeds if fact in seed.names.tolist()]
        for source in measure.SOURCES:
            if source == "state" and not all(seed.state_width for seed in having):
                continue
            if len(having) == 1:
                (only,) = having
                overall = only.score(fact, source, confidence)
                scores[fact, source] = Scores(overall, *only.by_step(fact, source, confidence))
                continue
            values = np.full((len(having), steps + 1), np.nan)
            for place, seed in enumerate(having):
                by_step = seed.by_step(fact, source, confidence)[0]
                values[place, : len(by_step)] = by_step
                values[place, -1] = seed.score(fact, source, confidence).value
            of_seeds = pooled(values.tolist(), confidence)
            ends = (of_seeds.mean[-1], of_seeds.low[-1], of_seeds.high[-1])
            scores[fact, source] = Scores(
                Interval(*(float(end) for end in ends)),
                of_seeds.mean[:-1],
                of_seeds.low[:-1],
                of_seeds.high[:-1],
            )
    return scores


def _picture(
    game: str,
    twin: str,
    agents: Mapping[str, Sequence[measure.Beliefs]],
    options: BeliefsOptions,
) -> Picture:
    """The figure of one task: bars of all facts, and a panel a fact over the steps."""
    scores = {agent: scores_of(seeds, options.confidence) for agent, seeds in agents.items()}
    facts = facts_of(scores)
    size, widths = _size_of(facts)
    figure, axes = style.panels(1, 1 + len(facts), size, sharey=True, width_ratios=widths)
    colours = style.agent_colours(list(agents))
    _plot(scores, list(axes[0]), colours)
    title = f"{game}, {style.TWIN_NAMES[twin]}"
    style.legend_above(figure, _legend(scores, colours), 6, "outside upper right", title)
    rows = list[dict[str, Any]]()
    for agent, of_agent in scores.items():
        rows += _rows(agent, game, twin, len(agents[agent]), of_agent)
    return Picture(f"beliefs-{game}-{twin}", figure, _note(agents, options), rows)


def beliefs_figure(
    probes: Mapping[str, measure.Beliefs | Sequence[measure.Beliefs]],
    *,
    confidence: float = 0.95,
    figure: Any = None,
) -> Any:
    """Draw what can be read off states and off frames: bars of all facts over all steps, and a
    panel a fact step by step.

    Args:
        probes: by name what `beliefs` gave, or that of several seeds; intervals are over seeds, or
            over the scored episodes of a single one.
        confidence: of the intervals, in (0, 1).
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default.

    Returns:
        A matplotlib figure.
    """
    check_by_name("probes", probes)
    scores = dict[str, OfAgent]()
    for name, given in probes.items():
        seeds = [given] if isinstance(given, measure.Beliefs) else given
        scores[name] = scores_of(seeds, confidence)
    facts = facts_of(scores)
    size, widths = _size_of(facts)
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    figure.set_size_inches(*size)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(1, 1 + len(facts), sharey=True, width_ratios=widths)
    colours = style.agent_colours(list(scores))
    _plot(scores, list(np.ravel(axes)), colours)
    style.legend_above(figure, _legend(scores, colours), 6)
    return figure


def _size_of(facts: Sequence[str]) -> tuple[tuple[float, float], list[float]]:
    """Inches of the figure of so many facts, and the widths of its panels."""
    wide = max(9.5, 4.2 + 2.9 * len(facts))  # room for title and legend
    return (wide, 3.6), [1.4, *[1.0] * len(facts)]


def _plot(scores: Mapping[str, OfAgent], axes: Sequence[Any], colours: Mapping[str, str]) -> None:
    """Bars of all facts in the first of the axes, and a fact in each of the others."""
    plot_bars(scores, axes[0], colours)
    axes[0].set_ylabel("score: 0 a guess, 1 perfect")
    for fact, axis in zip(facts_of(scores), axes[1:], strict=True):
        plot_steps(scores, fact, axis, colours)


def facts_of(scores: Mapping[str, OfAgent]) -> list[str]:
    """The facts of all agents, in the order in which they come."""
    names = dict[str, None]()
    for of_agent in scores.values():
        for fact, _ in of_agent:
            names[fact] = None
    return list(names)


def _bars(
    scores: Mapping[str, OfAgent],
) -> Iterator[tuple[float, float, str, measure.Source, Interval]]:
    """Place, width, agent, source and score of every bar: facts side by side, in each the agents,
    of each its state and its frame.
    """
    present = list[tuple[str, measure.Source]]()
    for agent, of_agent in scores.items():
        sources = {source for _, source in of_agent}
        present += [(agent, source) for source in measure.SOURCES if source in sources]
    width = 0.8 / len(present)
    for fact_place, fact in enumerate(facts_of(scores)):
        for place, (agent, source) in enumerate(present):
            if (fact, source) in scores[agent]:
                x = fact_place + width * (place - (len(present) - 1) / 2)
                yield x, width, agent, source, scores[agent][fact, source].overall


def plot_bars(scores: Mapping[str, OfAgent], axis: Any, colours: Mapping[str, str]) -> None:
    """Draw the scores over all steps: full bars of states, empty bars of frames."""
    for x, width, agent, source, score in _bars(scores):
        height = max(score.value, LOWEST)
        axis.bar(x, height, 0.88 * width, lw=1, **_look(source, colours[agent]))
        ends = style.whiskers(
            np.array([score.value]), np.array([score.low]), np.array([score.high])
        )
        axis.errorbar(x, score.value, ends, fmt="none", ecolor=style.NEUTRAL, capsize=2, lw=1)
    facts = facts_of(scores)
    is_crowded = len(facts) > 1 and max(map(len, facts)) > MOST_LEVEL
    turned = {"rotation": 25, "ha": "right", "rotation_mode": "anchor"} if is_crowded else {}
    axis.set_xticks(range(len(facts)), facts, **turned)
    axis.axhline(0, color=style.NEUTRAL, lw=0.8)
    axis.set_ylim(LOWEST, 1.05)
    axis.set_title("all steps")


def _look(source: measure.Source, colour: str) -> dict[str, Any]:
    """How the bar of a source looks."""
    return {"facecolor": colour if source == "state" else "none", "edgecolor": colour}


def plot_steps(
    scores: Mapping[str, OfAgent], fact: str, axis: Any, colours: Mapping[str, str]
) -> None:
    """Draw the score of one fact over the steps: full lines of states, broken ones of frames."""
    markers = style.agent_markers(scores, colours)
    for place, (agent, of_agent) in enumerate(scores.items()):
        for source in measure.SOURCES:
            if (fact, source) not in of_agent:
                continue
            of_fact = of_agent[fact, source]
            # beside one another, so that equal lines are all seen
            steps = np.arange(len(of_fact.by_step)) + 0.1 * (place - (len(scores) - 1) / 2)
            dashes = "-" if source == "state" else "--"
            look = {"color": colours[agent], "marker": markers[agent], "ms": 4, "lw": 1.2}
            axis.plot(steps, of_fact.by_step, ls=dashes, **look)
            if source == "state":
                ends = (of_fact.low, of_fact.high)
                axis.fill_between(steps, *ends, color=colours[agent], alpha=0.15, lw=0)
    axis.axhline(0, color=style.NEUTRAL, lw=0.8)
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set_xlabel("step of the episode")
    axis.set_title(fact)


def _legend(scores: Mapping[str, OfAgent], colours: Mapping[str, str]) -> list[Any]:
    """Handles with labels: a colour an agent, and what full and empty bars, and lines, are."""
    from matplotlib.patches import Patch

    handles = list[Any]()
    for agent in scores:
        handles.append(Patch(facecolor=colours[agent], label=style.legend_name(agent)))
    for source, name in SOURCES.items():
        lines = "full" if source == "state" else "broken"
        handles.append(Patch(**_look(source, style.NEUTRAL), label=f"{name} ({lines} lines)"))
    return handles


def _note(agents: Mapping[str, Sequence[measure.Beliefs]], options: BeliefsOptions) -> str:
    """What was played, what the intervals are over, and who has no state."""
    counts = [len(seeds) for seeds in agents.values()]
    if max(counts) > 1:
        sample = style.seeds_note(counts, options.confidence, "bars and bands")
    else:
        share = f"{100 * options.confidence:g} %"
        sample = f"n = 1 seed; bars and bands: {share} bootstrap interval over scored episodes"
    note = (
        f"{sample};\n{options.episodes} episodes: half fit the linear probe, a quarter choose its "
        "penalty, a quarter are scored;\nclasses: share of the way from the most frequent "
        "class to 1, numbers: R2"
    )
    empty = list[str]()
    for agent, seeds in agents.items():
        if not max(seed.state_width for seed in seeds):
            empty.append(agent)
    return f"{note}; without memory: {', '.join(empty)}" if empty else note


def _rows(
    agent: str, game: str, twin: str, seeds: int, scores: OfAgent
) -> Iterator[dict[str, Any]]:
    """The numbers of a figure, one row a step of each fact and source."""
    for (fact, source), of_fact in scores.items():
        overall = of_fact.overall
        yield from style.rows_of(
            agent=agent,
            game=game,
            observability=twin,
            seeds=seeds,
            fact=fact,
            source=source,
            step=[ALL, *map(str, range(len(of_fact.by_step)))],
            score=np.append(overall.value, of_fact.by_step),
            low=np.append(overall.low, of_fact.low),
            high=np.append(overall.high, of_fact.high),
        )


def beliefs_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Probes of the first seed of every cell that is a POMDP whose game names facts, a picture a
    task; numbers are kept in the run folders. Each further seed would take as long again.
    """
    colours = style.agent_colours(agents)
    hiding = {cell: paths[:1] for cell, paths in cells.items() if cell[2] == "partial"}

    def summary(
        measured: Sequence[tuple[Label, measure.Beliefs]],
    ) -> tuple[OfAgent, dict[str, Any]]:
        scores = scores_of([probes for _, probes in measured])
        return scores, {"facts": _section_rows(scores)}

    def draw(by_agent: Mapping[str, OfAgent], axis: Any) -> None:
        plot_bars(by_agent, axis, colours)
        if len(facts_of(by_agent)) > 2:
            for label in axis.get_xticklabels():
                label.set(rotation=20, ha="right", rotation_mode="anchor")

    parts = section("beliefs", hiding, OF_RUN, summary, draw, "score", progress)
    parts["notes"] = [note for note in parts["notes"] if NO_FACTS not in note]
    parts["sentences"] = _sentences(parts["rows"])
    return parts


def _section_rows(scores: OfAgent) -> list[dict[str, Any]]:
    """What is read of every fact, one row a fact."""
    rows = list[dict[str, Any]]()
    for fact in facts_of({"": scores}):
        state = scores.get((fact, "state"))
        row: dict[str, Any] = {"fact": fact, "frame": scores[fact, "frame"].overall}
        row["state"] = state.overall if state is not None else None
        rows.append(row)
    return rows


def _sentences(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Whose state holds more than its frame shows, as far as the two intervals lie apart; those
    that hold most first.
    """
    sentences = list[tuple[float, str]]()
    for row in rows:
        for of_fact in row["facts"]:
            state = of_fact["state"]
            frame = of_fact["frame"]
            if state is not None and state.low > max(frame.high, 0.0):
                text = (
                    f"{row['game']} {row['twin']}: a linear probe reads {of_fact['fact']} off "
                    f"{row['agent']}'s state with a score of {state.value:.2f}, off the frame "
                    f"alone with {frame.value:.2f}."
                )
                sentences.append((frame.value - state.value, text))
    return [text for _, text in sorted(sentences)]
