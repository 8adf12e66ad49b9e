"""Which folders count as runs: through links, below any name, each real folder once, and in the
order of a study.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, gap_and_bias
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.run_folders import MOST_DEPTH
from arcade_torch.tools.scores import read_scores
from tests.tools.fabricated import small_study, write_run, write_study
from tests.tools.test_runs import write


def seeds_of(*folders: Path) -> list[int]:
    """The seeds of all runs below."""
    return sorted(run.seed for run in find_runs(folders).runs)


def test_runs_behind_links_are_found(tmp_path: Path) -> None:
    for seed in range(3):
        write(tmp_path / "disk" / str(seed), "lru", "full", seed, 0.5)
    here = tmp_path / "results"
    here.mkdir()
    (here / "0").symlink_to(tmp_path / "disk" / "0")
    (here / "1").symlink_to(Path("..") / "disk" / "1")
    write(here / "own", "lru", "full", 7, 0.5)
    assert seeds_of(here) == [0, 1, 7]
    whole = tmp_path / "whole"
    whole.symlink_to(tmp_path / "disk")
    assert seeds_of(whole) == [0, 1, 2]
    (here / "all").symlink_to(
        whole
    )  # a link to a link to a folder of runs, two of which were met already
    assert seeds_of(here) == [0, 1, 2, 7]


def test_each_real_folder_is_one_run_however_many_links_lead_to_it(tmp_path: Path) -> None:
    run = write(tmp_path / "s" / "z-run", "lru", "full", 0, 0.5)
    (tmp_path / "s" / "a-link").symlink_to(run)
    (tmp_path / "s" / "b-link").symlink_to(run)
    (found,) = find_runs([tmp_path / "s"]).runs
    assert found.path == run
    assert seeds_of(
        tmp_path / "s", run, tmp_path / "s" / "a-link", tmp_path / "s" / ".." / "s"
    ) == [0]


def test_links_to_parents_end_and_lead_nowhere_else(tmp_path: Path) -> None:
    write(tmp_path / "other", "lru", "full", 1, 0.5)
    run = write(tmp_path / "s" / "deep" / "run", "lru", "full", 0, 0.5)
    (run / "up").symlink_to("..")
    (run / "root").symlink_to(tmp_path / "s")
    (run / "self").symlink_to(".")
    (run / "ring").symlink_to("ring")
    (tmp_path / "s" / "above").symlink_to(tmp_path)
    (tmp_path / "s" / "top").symlink_to("/")
    assert seeds_of(tmp_path / "s") == [0]


def test_folders_are_looked_into_to_a_bounded_depth(tmp_path: Path) -> None:
    deep = tmp_path.joinpath(*["d"] * (MOST_DEPTH + 1))
    write(tmp_path / "d" / "run", "lru", "full", 0, 0.5)
    write(deep, "lru", "full", 1, 0.5)
    assert seeds_of(tmp_path) == [0]


def test_a_link_that_leads_nowhere_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "s" / "0", "lru", "full", 0, 0.5)
    (tmp_path / "s" / "1").symlink_to(tmp_path / "unplugged" / "1")
    notes = find_runs([tmp_path / "s"]).notes
    assert notes == [f"left out, a link that leads nowhere: {tmp_path / 's' / '1'}"]
    assert cli.main(["figure", "curves", str(tmp_path / "s"), "--out", str(tmp_path / "f")]) == 0
    assert notes[0] in capsys.readouterr().out


def test_a_folder_that_may_not_be_read_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "0", "lru", "full", 0, 0.5)
    closed = write(tmp_path / "closed" / "1", "lru", "full", 1, 0.5).parent
    scandir = os.scandir

    def guarded(path: Any) -> Any:
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", guarded)  # root may read everything
    assert find_runs([tmp_path]).notes == [f"left out, Permission denied: {closed}"]


@pytest.mark.parametrize(
    "name", ["checkpoints", "checkpoints/checkpoints", "replay", "my/checkpoints/of/2026"]
)
def test_runs_below_a_folder_of_any_name_are_found(name: str, tmp_path: Path) -> None:
    root = tmp_path / name
    run = write(root / "one", "lru", "full", 0, 0.5)
    write(run / "checkpoints" / "frames-1", "lru", "full", 5, 0.5)  # the run's own are none
    for folder in (tmp_path, root, run):
        assert seeds_of(folder) == [0]
    assert gap_and_bias([write(root / "two", "mlp", "full", 0, 0.5), *twins(root)], draws=5).rows
    words = ["figure", "curves", "--runs", str(tmp_path), "--out", str(tmp_path / "figures")]
    assert cli.main(words) == 0


def twins(root: Path) -> list[Path]:
    """What a table of Gap and Bias needs beside one run of an agent without memory."""
    return [write(root / "three", "mlp", "partial", 0, 0.5)]


def test_a_study_whose_runs_are_links_is_no_study_that_lost_its_runs(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study())
    (tmp_path / "disk").mkdir()
    (folder.root / "runs").rename(tmp_path / "disk" / "runs")
    (folder.root / "runs").symlink_to(tmp_path / "disk" / "runs")
    changed = folder.run(small_study().runs()[0])
    write_run(changed.path, small_study().runs()[0], 0.75, settings=changed.config)
    assert 0.75 in [score.value for score in read_scores(folder.root)]


def test_the_interval_is_the_same_by_whatever_name_the_runs_are_given(tmp_path: Path) -> None:
    study = small_study(
        name="order",
        games=["TetrisEasy", "CartPoleEasy"],
        memories=["mlp", "mingru"],
        seeds=[2, 10, 1, 0],
    )
    folder = write_study(tmp_path / "s", study, spread=0.05)
    runs = sorted((folder.root / "runs").iterdir())
    (tmp_path / "links").mkdir()
    for run in runs:
        (tmp_path / "links" / run.name).symlink_to(run)
    by_study = gap_and_bias(folder.root, draws=200)
    for given in (
        folder.root / "runs",
        runs,
        runs[::-1],
        tmp_path / "links",
        folder.root / "results.csv",
    ):
        table = gap_and_bias(given, draws=200)
        for row in by_study.rows:
            assert table.row(row.agent).gap == row.gap and table.row(row.agent).bias == row.bias
            assert (
                table.row(row.agent).mdp_iqm == row.mdp_iqm
                and table.row(row.agent).coverage == row.coverage
            )
        assert table.difference("gap", "mingru", "mlp") == by_study.difference(
            "gap", "mingru", "mlp"
        )
        assert set(table.without) == set(by_study.without)
    by_folder = gap_and_bias(folder.root / "runs", draws=200)
    assert [row.agent for row in by_folder.rows] == [row.agent for row in by_study.rows]


def test_the_numbers_of_figures_are_the_same_by_study_and_by_its_runs(tmp_path: Path) -> None:
    study = small_study(memories=["mlp", "mingru"], seeds=[2, 10, 1, 0])
    folder = write_study(tmp_path / "s", study, spread=0.05)
    for name in ("curves", "gap-bias"):
        tables = []
        for given in (folder.root, folder.root / "runs"):
            out = tmp_path / f"{name}-{given.name}.csv"
            assert cli.main(["figure", name, "--runs", str(given), "--out", str(out)]) == 0
            tables.append(read_csv(out))
        assert tables[0] == tables[1]


def test_an_interval_does_not_depend_on_who_else_is_in_the_table(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study(seeds=4), spread=0.05)
    alone = [run for run in (folder.root / "runs").iterdir() if "mlp" in run.name]
    whole, part = gap_and_bias(folder.root, draws=100), gap_and_bias(alone, draws=100)
    assert part.row("mlp").gap == whole.row("mlp").gap
    assert np.isfinite(part.row("mlp").gap.low)
