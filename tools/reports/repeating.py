"""How to repeat a study: the commands, versions and settings of its runs."""

from collections.abc import Mapping, Sequence
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import flatten
from arcade_torch.tools.options import command_line
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study


def how_to_repeat(
    folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Commands, versions and settings; settings of a run where they differ from those that all runs
    share.
    """
    record = folder.record()
    commands = record["runs"] if isinstance(record.get("runs"), dict) else {}
    settings = _settings_of_runs(folder, study)
    shared = _shared(list(settings.values()))
    runs = []
    for spec, row in zip(study.runs(), rows, strict=True):
        different = {}
        for key, value in settings.get(spec.name, {}).items():
            if key not in shared:
                different[key] = value
        command = commands.get(spec.name, "")
        runs.append({"row": row, "name": spec.name, "command": command, "settings": different})
    return {
        "shared": shared,
        "runs": runs,
        "versions": record.get("versions") or {},
        "also": record.get("also") or [],
        "command": record.get("command", ""),
        "report_command": command_line(["report", str(folder.root)]),
        "seconds": sum(float(row.get("seconds") or 0) for row in rows),
    }


def _settings_of_runs(folder: StudyFolder, study: Study) -> dict[str, dict[str, Any]]:
    """The settings of the runs by name, flat; one that a run does not name has its default."""
    settings = dict[str, dict[str, Any]]()
    names = set[str]()
    for spec in study.runs():
        run = folder.run(spec)
        if (run.path / "config.json").exists():
            settings[spec.name] = flatten(run.config)
            names.update(settings[spec.name])
    defaults = {}
    for name, value in flatten(TrainConfig().to_dict()).items():
        if name in names:
            defaults[name] = value
    return {run: defaults | values for run, values in settings.items()}


def _shared(settings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The settings that have one value in all runs."""
    if not settings:
        return {}
    first, *others = settings
    shared = {}
    for name, value in first.items():
        if all(name in other and other[name] == value for other in others):
            shared[name] = value
    return shared
