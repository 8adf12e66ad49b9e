"""Finished runs that may be compared: where they lie, and which are seeds of one agent.

Whatever pools seeds (report, figures, gap and bias, curves, measures of checkpoints) asks here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_values
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools.names import AgentKey, agent_names, bare_name, game_names, plain_number
from arcade_torch.tools.run_folders import RunFolders
from arcade_torch.tools.runs import FREE, Run, Score, open_run
from arcade_torch.tools.text import printable

_CELL = {
    "env",
    "observability",
    "memory",
    "seed",
    "algorithm",
    "network",
    "network_options",
    "rules",
    "obs_size",
}
"""Settings that say which cell of a grid a run is, or that are compared by themselves."""


@dataclass(frozen=True)
class Runs:
    """Finished runs that may be compared, and what to say about those that were left out."""

    runs: tuple[Run, ...]
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = game_names(run.game for run in self.runs)
        named = []
        for run in self.runs:
            name = names[run.game]
            named.append(run if name == run.game else replace(run, game_name=name))
        object.__setattr__(self, "runs", tuple(named))

    @cached_property
    def names(self) -> dict[AgentKey, str]:
        """Name of every agent."""
        return agent_names(run.key for run in self.runs)

    def groups(self) -> dict[tuple[str, str, str], list[Run]]:
        """(agent, game, twin) -> runs by seed."""
        groups: dict[tuple[str, str, str], list[Run]] = {}
        for run in sorted(self.runs, key=lambda run: run.seed):
            cell = (self.names[run.key], run.game, run.twin)
            groups.setdefault(cell, []).append(run)
        return groups

    def scores(self, metric: str) -> list[Score]:
        """One score a run."""
        scores = []
        for run in self.runs:
            agent = self.names[run.key]
            scores.append(Score(agent, run.game, run.twin, run.seed, run.value(metric)))
        return scores

    def single_seeds(self) -> list[str]:
        """A note on cells with a single seed; empty if there are none."""
        alone = []
        for (agent, game, twin), runs in self.groups().items():
            if len(runs) < 2:
                alone.append(f"{agent} on {game} ({twin})")
        return [f"no interval, a single seed: {listed(alone)}"] if alone else []


def listed(names: Sequence[str], most: int = 3) -> str:
    """Some names, and how many more: ``a, b, c and 2 more``."""
    text = ", ".join(names[:most])
    if len(names) > most:
        text += f" and {len(names) - most} more"
    return text


def find_runs(paths: Sequence[Path]) -> Runs:
    """All finished runs below some folders, which have to be comparable."""
    if not paths:
        raise ValueError("name the folder with the runs: --runs DIR")
    search = RunFolders()
    finished: list[Run] = []
    unfinished: list[str] = []
    for path in paths:
        for folder in _folders(path, search):
            run = open_run(folder)
            if run is None:
                unfinished.append(folder.name)
            else:
                finished.append(run)
    if not finished:
        below = listed([str(path) for path in paths])
        raise ValueError(f"none of the {len(unfinished)} runs below {below} has finished")
    check_comparable(Runs(tuple(finished)))
    notes = []
    if unfinished:
        notes.append(f"left out, not finished: {listed(unfinished)}")
    notes += search.notes
    versions = _versions(finished)
    if len(versions) > 1:
        notes.append(
            f"the runs were made with several versions of arcade_torch: {', '.join(versions)}"
        )
    notes += import_notes(finished) + frame_notes(finished)
    return Runs(tuple(finished), notes)


def frame_notes(runs: Sequence[Run]) -> list[str]:
    """A note on games that agents were trained on for different numbers of frames."""
    frames: dict[str, set[int]] = {}
    for run in runs:
        count = run.config.get("total_frames")
        if isinstance(count, int | float):
            frames.setdefault(run.game, set()).add(int(count))
    games = [game for game, counts in frames.items() if len(counts) > 1]
    if not games:
        return []
    counts = ", ".join(f"{count:,}" for count in sorted(frames[games[0]]))
    return [f"agents were trained for different numbers of frames: {counts} on {listed(games)}"]


def import_notes(runs: Sequence[Run]) -> list[str]:
    """A note on every imported file that changed between the trainings of some runs."""
    texts: dict[str, set[str]] = {}
    for run in runs:
        for name, sha256 in run.imports.items():
            texts.setdefault(name, set()).add(sha256)
    notes = []
    for name, hashes in texts.items():
        if len(hashes) > 1:
            notes.append(f"{name} has changed between the runs: {len(hashes)} versions of it")
    return notes


def _folders(path: Path, search: RunFolders) -> list[Path]:
    """Run folders below a path: those of a study in the order of its grid."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if not path.is_dir():
        raise ValueError(f"{path} is a file: give a folder with runs")
    if (path / "meta.json").is_file():
        raise ValueError(
            f"{path} is a single checkpoint: give its run folder, {path.parent.parent}"
        )
    again = search.has_seen(path)
    folders = list(search.below(path))
    if not folders and not again:
        notes = "".join(f"; {note}" for note in search.notes)
        raise ValueError(f"{path} holds no run: a run folder has a config.json{notes}")
    orders: dict[Path, dict[str, int]] = {}

    def place(folder: Path) -> tuple[Path, int, Path]:
        study = folder.absolute().parent.parent
        if study not in orders:
            orders[study] = _order_in(study)
        order = orders[study]
        return study, order.get(folder.name, len(order)), folder

    return sorted(folders, key=place)


def _order_in(study: Path) -> dict[str, int]:
    """Name of a run -> its line in the table of a study; empty if there is no table."""
    table = study / "results.csv"
    rows = read_csv(table) if table.is_file() else []
    return {row.get("run", ""): line for line, row in enumerate(rows)}


def _versions(runs: Sequence[Run]) -> list[str]:
    """The versions of this package that made some runs."""
    versions = set()
    for run in runs:
        packages = run.record.get("versions")
        if isinstance(packages, dict) and packages.get("arcade_torch"):
            versions.add(str(packages["arcade_torch"]))
    return sorted(versions)


def check_comparable(runs: Runs) -> None:
    """Refuse runs that may not stand in one table.

    Raises:
        ValueError: several versions, rules, sizes or options of a game; a run that stands there
            twice; seeds, or twins, of one agent with other settings.
    """
    _check_versions(runs)
    _check_rules(runs)
    _check_options(runs)
    _check_seeds(runs)
    _check_twins(runs)


def _check_versions(runs: Runs) -> None:
    games = sorted({run.game for run in runs.runs})
    for old, new in pairwise(games):
        if bare_name(old) == bare_name(new):
            raise ValueError(
                f"runs of {old} and {new} cannot be compared: give one version of a game"
            )


def _check_rules(runs: Runs) -> None:
    for name, default in (("rules", TrainConfig.rules), ("obs_size", TrainConfig.obs_size)):
        values = sorted({str(plain_number(run.config.get(name, default))) for run in runs.runs})
        if len(values) > 1:
            raise ValueError(
                f"runs with {name} {' and '.join(values)} cannot be compared: give runs with one "
                "of them"
            )


def _check_options(runs: Runs) -> None:
    first: dict[str, Run] = {}
    for run in runs.runs:
        before = first.setdefault(run.game, run).config.get("env_options") or {}
        options = run.config.get("env_options") or {}
        if options != before:
            raise ValueError(
                f"{run.game} was played with env_options {before} and {options}: give runs with "
                "one of them"
            )


def _check_seeds(runs: Runs) -> None:
    for (agent, game, twin), seeds in runs.groups().items():
        for one, other in pairwise(seeds):
            if one.seed == other.seed:
                raise ValueError(f"{one.path} and {other.path} are the same cell: give one of them")
            _check_settings(f"seeds of {agent} on {game} ({twin})", one, other)


def _check_twins(runs: Runs) -> None:
    """The twins of an agent are told apart by what is hidden, and by nothing else."""
    first: dict[tuple[str, str], Run] = {}
    for (agent, game, _), seeds in runs.groups().items():
        one = first.setdefault((agent, game), seeds[0])
        _check_settings(f"the twins of {agent} on {game}", one, seeds[0])


def _check_settings(pair: str, one: Run, other: Run) -> None:
    differences = []
    for name, values in differing_values(one.config, other.config, _CELL | FREE).items():
        differences.append(printable(f"{name}: {values[0]} and {values[1]}"))
    if differences:
        raise ValueError(f"{pair} differ in {', '.join(differences)}; give runs with one of them")
