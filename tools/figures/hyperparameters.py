"""Settings as a table, generated from the configs themselves so that it cannot go stale."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_type_hints

from arcade_torch.agents import preset
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.figures.registry import Made, PaperOptions, Picture, Progress
from arcade_torch.tools.figures.style import panels
from arcade_torch.tools.files import markdown_table
from arcade_torch.tools.runs import find_runs, flatten

NOT_SETTINGS = ("env", "observability", "memory", "seed", "algorithm", "device", "threads", "checkpoint_every")
"""Fields that tell runs apart, or decide nothing."""

ALGORITHMS = get_args(get_type_hints(TrainConfig)["algorithm"])


def settings(options: PaperOptions, progress: Progress | None) -> Made:
    """``hyperparameters``: CSV and Markdown, and the table as a picture; one column an algorithm."""
    configs: dict[str, list[Mapping[str, Any]]] = {}
    if options.paper:
        notes = [f"total_frames is that of {TrainConfig().env}; the paper's budget depends on the game"]
        configs = {name: [preset("paper", algorithm=name).to_dict()] for name in ALGORITHMS}
    else:
        found = find_runs(options.runs)
        notes = list(found.notes)
        for run in found.runs:
            configs.setdefault(str(run.config.get("algorithm", "pqn")), []).append(run.config)
    columns = {name: _common([_settings(config, name) for config in here]) for name, here in configs.items()}
    names = dict.fromkeys(name for column in columns.values() for name in column)
    rows = [{"setting": name} | {key: column.get(name, "") for key, column in columns.items()} for name in names]
    head, table = ["setting", *columns], [[str(value) for value in row.values()] for row in rows]
    figure, axes = panels(1, 1, (2.8 + 2.6 * len(columns), 0.26 * (len(rows) + 2)))
    axes[0, 0].set_axis_off()
    drawn = axes[0, 0].table(table, colLabels=head, bbox=(0, 0, 1, 1), cellLoc="left", edges="horizontal")
    drawn.auto_set_font_size(False)
    for (line, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("#d0d0d0")
        cell.set_text_props(weight="normal" if line else "bold")
    base, _ = options.path("hyperparameters")
    page = write_atomic(base.with_suffix(".md"), markdown_table(head, table) + "\n")
    return Made([Picture("hyperparameters", figure, rows=rows)], notes, files=[page])


def _settings(config: Mapping[str, Any], algorithm: str) -> dict[str, Any]:
    """Flat settings of one run, without those of other algorithms."""
    own = {key: value for key, value in config.items() if key not in {*NOT_SETTINGS, *ALGORITHMS} - {algorithm}}
    flat = {name.removeprefix(f"{algorithm}."): value for name, value in flatten(own).items()}
    return {name: value for name, value in flat.items() if value != {}}


def _common(settings: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Each setting's value, or all its values where runs differ."""
    names = dict.fromkeys(name for each in settings for name in each)
    values = {name: dict.fromkeys(str(each.get(name, "-")) for each in settings) for name in names}
    return {name: " / ".join(sorted(found)) for name, found in values.items()}
