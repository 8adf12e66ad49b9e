"""Studies of many runs: what is done again and again does not grow with what is finished."""

import io
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.studies import folder as study_folder
from arcade_torch.tools.studies import runner
from arcade_torch.tools.studies.engines import Job, JobResult
from arcade_torch.tools.studies.runner import SHARE, Pace, show_progress, study
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_study import Fabricator


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each file of a run was read."""
    counts = Counter[str]()
    read_json = study_folder.read_json

    def counted(path: Path) -> Any:
        counts[path.name] += 1
        return read_json(path)

    monkeypatch.setattr("arcade_torch.tools.runs.read_json", counted)
    return counts


def test_the_display_reads_a_run_that_has_ended_once(tmp_path: Path, reads: Counter[str]) -> None:
    what = small_study(seeds=3)
    folder = write_study(tmp_path / "s", what)
    runs = {run.name: folder.run(run) for run in what.runs()}
    ended, kept = set(list(runs)[:10]), dict[str, tuple[int, int, str]]()
    reads.clear()
    stream = io.StringIO()
    with Bars(stream, "frames") as bars:
        for _ in range(5):
            show_progress(bars, "toy", runs, ended, kept)
    assert reads["progress.json"] == 10 + 5 * 2
    assert stream.getvalue() == "toy: 4,200,000 of 4,200,000 frames (100 %), 10/12 runs\n"


def test_a_run_that_ends_between_two_looks_is_read_after_its_end(tmp_path: Path) -> None:
    what = small_study(seeds=1)
    folder = write_study(tmp_path / "s", what)
    runs = {run.name: folder.run(run) for run in what.runs()}
    kept = dict[str, tuple[int, int, str]]()
    with Bars(io.StringIO(), "frames") as bars:
        show_progress(bars, "toy", runs, set(), kept)
        assert kept == {}
        show_progress(bars, "toy", runs, set(runs), kept)
    assert set(kept) == set(runs) and all(status == "finished" for _, _, status in kept.values())


@pytest.mark.parametrize("seeds", [5, 40])
def test_a_study_reads_each_run_a_few_times_however_many_there_are(
    seeds: int, tmp_path: Path, reads: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # on a loaded machine a study takes long: what is done by the clock is done once here
    monkeypatch.setattr(runner, "SHARE", 1e-9)
    monkeypatch.setattr(runner, "LOOK_EVERY_S", 1e9)
    what = small_study(seeds=seeds)
    study(what, tmp_path / "s", Fabricator(what, stop_after=10**6), stream=io.StringIO())
    assert reads["eval.json"] <= 6 * len(what.runs())
    assert [row["status"] for row in read_csv(tmp_path / "s" / "results.csv")] == [
        "finished"
    ] * len(what.runs())


def test_the_table_is_whole_when_a_study_is_interrupted(tmp_path: Path) -> None:
    what = small_study(seeds=5)
    with pytest.raises(KeyboardInterrupt):
        study(what, tmp_path / "s", Fabricator(what, stop_after=7), stream=io.StringIO())
    states = [row["status"] for row in read_csv(tmp_path / "s" / "results.csv")]
    assert states == ["finished"] * 7 + ["waiting"] * 13


def test_the_table_is_written_while_a_study_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "SHARE", 1e9)  # it rests no longer than a write takes
    what = small_study(seeds=1)

    class Slow(Fabricator):
        def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
            rows = read_csv(tmp_path / "s" / "results.csv")
            assert [row["status"] for row in rows] == ["waiting"] * 4
            for place, result in enumerate(super().run(jobs)):
                yield result
                rows = read_csv(tmp_path / "s" / "results.csv")
                assert sum(row["status"] == "finished" for row in rows) == place + 1
                time.sleep(0.01)

    study(what, tmp_path / "s", Slow(what), stream=io.StringIO())


def test_work_takes_its_share_of_the_time_however_long_it_is() -> None:
    now = [0.0]

    def work(seconds: float) -> None:
        now[0] += seconds

    pace = Pace(0.5, clock=lambda: now[0])
    assert pace.rest_s == 0
    pace.work(lambda: work(0.001))
    assert pace.rest_s == 0.5
    now[0] += 0.5
    assert pace.rest_s == 0
    pace.work(lambda: work(1.0))
    assert pace.rest_s == pytest.approx(1.0 / SHARE)


def test_configs_of_many_seeds_are_those_of_each_alone() -> None:
    what = small_study(
        algorithms=["pqn", "ppo"], sizes=["1x64"], seeds=3, settings={"pqn": {"gamma": 0.9}}
    )
    configs = what.configs(what.runs())
    assert configs == {run: what.config(run) for run in what.runs()}
    with pytest.raises(ValueError, match="seed must be in"):
        small_study(seeds=[0, 2**31]).configs(small_study(seeds=[0, 2**31]).runs())


def test_a_dry_run_of_ten_thousand_seeds_ends_soon(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "many.toml"
    file.write_text(
        'games = "CartPoleEasy"\nmemories = ["mingru", "mlp"]\nseeds = 10000\npreset = "smoke"\n'
    )
    start_s = time.perf_counter()
    assert cli.main(["study", str(file), "--dry-run"]) == 0
    assert (
        time.perf_counter() - start_s < 20
    )  # 4 s on a core of 2026; one config at a time takes 20 and more
    said = capsys.readouterr()
    assert said.out.count("\n") == 40_000 and "40,000 runs" in said.err


def test_finished_runs_keep_their_rows(tmp_path: Path, reads: Counter[str]) -> None:
    what = small_study()
    folder = write_study(tmp_path / "s", what)
    results = runner.Results(folder, what)
    rows = results.write()
    reads.clear()
    assert results.write() == rows and reads["eval.json"] == 0
    assert folder.write_results(what) == rows and reads["eval.json"] == 8
