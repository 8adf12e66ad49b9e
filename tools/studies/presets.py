"""Ready-made studies, by name."""

from importlib.resources import files
from pathlib import Path

from arcade_torch.tools.studies.grid import Study

STUDY_PRESETS = ("demo", "paper-easy", "paper", "size-sweep")


def study_preset(name: str) -> Study:
    """A ready-made study.

    * ``demo``: what ``arcade-torch demo`` runs.
    * ``paper-easy``: the paper's agents on the easy game of each family, both twins, five seeds.
    * ``paper``: all of the paper's main experiment: 30 games, both twins, seven memories and none, five seeds.
    * ``size-sweep``: depth and width of the memory on two games, for the figure of that name.

    Args:
        name: of the preset.

    Raises:
        ValueError: there is no such preset.

    Example:
        >>> len(study_preset("paper").runs())
        2400
    """
    if name == "demo":
        from arcade_torch.tools.demo import demo_study

        return demo_study()
    if name not in STUDY_PRESETS:
        raise ValueError(f"unknown study preset {name!r}; presets: {', '.join(STUDY_PRESETS)}")
    return Study.parse((files("arcade_torch.tools") / "data" / f"study-{name}.toml").read_text("utf-8"), name)


def total_frames(study: Study) -> int:
    """Training frames of all runs together.

    Args:
        study: the grid.
    """
    from arcade_torch.tools.commands.train import parse

    budget: dict[tuple[str, str], int] = {}
    for run in study.runs():
        key = (run.game, run.algorithm)
        if key not in budget:
            config = parse(study.arguments(run, Path("nowhere"))[1:], "arcade-torch train").config
            budget[key] = config.num_updates * config.learner.frames_per_update
    return sum(budget[run.game, run.algorithm] for run in study.runs())
