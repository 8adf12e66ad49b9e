"""Settings as a table, generated from the configs themselves so that it cannot go stale."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args, get_type_hints

from arcade_torch.agents.config import TrainConfig
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress
from arcade_torch.tools.figures.style import drawing, inches, save
from arcade_torch.tools.files import write_text
from arcade_torch.tools.runs import find_runs, flatten

CELL = ("env", "observability", "memory", "seed")
"""Fields that tell runs apart; all others are settings."""

NOT_SETTINGS = ("device", "threads", "checkpoint_every")


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    paper: bool = False
    """The settings of the preset ``paper`` in the place of runs."""


def make(options: Options, progress: Progress | None) -> Made:
    """``hyperparameters``: CSV and Markdown, and the table as a picture; one column an algorithm."""
    notes: list[str] = []
    if options.paper:
        from arcade_torch.agents import preset

        algorithms = get_args(get_type_hints(TrainConfig)["algorithm"])
        columns = {name: _settings(preset("paper", algorithm=name).to_dict()) for name in algorithms}
        notes.append(f"total_frames is that of {TrainConfig().env}; the paper's budget depends on the game")
    else:
        found = find_runs(options.runs)
        notes, columns = found.notes, {}
        for run in found.runs:
            columns.setdefault(str(run.config.get("algorithm", "pqn")), {})
        for algorithm in columns:
            runs = [run for run in found.runs if str(run.config.get("algorithm", "pqn")) == algorithm]
            columns[algorithm] = _common([_settings(run.config) for run in runs])
    names = list(dict.fromkeys(name for settings in columns.values() for name in settings))
    rows = [{"setting": name} | {key: settings.get(name, "") for key, settings in columns.items()} for name in names]
    head = ["setting", *columns]
    table = [[str(row[name]) for name in head] for row in rows]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *(f"| {' | '.join(line)} |" for line in table)]
    with drawing(options.style) as plt:
        size = inches(options.style, 2.8 + 2.6 * len(columns), 0.26 * (len(rows) + 2))
        figure, axis = plt.subplots(figsize=size, layout="constrained")
        axis.set_axis_off()
        drawn = axis.table(table, colLabels=head, bbox=(0, 0, 1, 1), cellLoc="left", edges="horizontal")
        drawn.auto_set_font_size(False)
        for (line, _), cell in drawn.get_celld().items():
            cell.set_edgecolor("#d0d0d0")
            if line == 0:
                cell.set_text_props(weight="bold")
        files = save(options, "hyperparameters", figure, rows)
        base, _ = options.path("hyperparameters")
        files.append(write_text(base.with_suffix(".md"), "\n".join(lines) + "\n"))
    return Made(files, notes, rows=rows)


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flat settings of one run, without those of other algorithms."""
    algorithm = str(config.get("algorithm", "pqn"))
    others = set(get_args(get_type_hints(TrainConfig)["algorithm"])) - {algorithm}
    chosen = {key: value for key, value in config.items() if key not in (*CELL, *NOT_SETTINGS, *others)}
    flat = {name.removeprefix(f"{algorithm}."): value for name, value in flatten(chosen).items()}
    return {name: value for name, value in flat.items() if value != {} and name != "algorithm"}


def _common(settings: list[dict[str, Any]]) -> dict[str, Any]:
    """Each setting's value, or all its values where runs differ."""
    found = {}
    for name in dict.fromkeys(key for each in settings for key in each):
        values = list(dict.fromkeys(str(each.get(name, "-")) for each in settings))
        found[name] = values[0] if len(values) == 1 else " / ".join(sorted(values))
    return found
