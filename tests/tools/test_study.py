"""Studies: the grid, the engines, and going on after failures and interruptions; runs are
fabricated.
"""

import io
import json
import os
import textwrap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from arcade_torch.agents import preset
from arcade_torch.agents.presets import preset_names
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.studies.engines import Inline, Job, JobResult, RayOptions
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import STUDY_PRESETS, Study, study_preset
from arcade_torch.tools.studies.processes import Processes
from arcade_torch.tools.studies.runner import (
    DiskFullError,
    make_engine,
    planned,
    progress_bars,
    show_progress,
    study,
)
from tests.tools.fabricated import jobs, small_study, write_run, write_study


class Fabricator:
    """An engine that fabricates runs; may fail some, and may be interrupted after some."""

    def __init__(self, what: Study, fail: str = "", stop_after: int = 99) -> None:
        self.runs, self.fail, self.stop_after = (
            {run.name: run for run in what.runs()},
            fail,
            stop_after,
        )
        self.done: list[str] = []

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        for job in jobs:
            if len(self.done) == self.stop_after:
                raise KeyboardInterrupt
            settings = json.loads(job.config.read_text())
            assert settings["env"] == self.runs[job.name].game
            self.done.append(job.name)
            if self.fail and self.fail in job.name:
                yield JobResult(job.name, "no luck")
            else:
                write_run(job.folder, self.runs[job.name], 0.5, settings=settings)
                yield JobResult(job.name)


def carry_out(what: Study, root: Path, engine: Fabricator) -> "list[dict[str, str]]":
    study(what, root, engine, stream=io.StringIO())
    return read_csv(root / "results.csv")


def test_the_grid_holds_every_cell_once_under_a_name_of_its_own() -> None:
    runs = small_study().runs()
    assert len(runs) == len({run.name for run in runs}) == 8
    assert runs[0].name == "MineSweeperEasy__full__mingru__pqn__seed0"


def test_growing_the_grid_keeps_the_names() -> None:
    names = {run.name for run in small_study().runs()}
    assert names < {
        run.name for run in small_study(seeds=3, memories=["mingru", "mlp", "gru"]).runs()
    }


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_is_one_algorithm_in_train_in_studies_and_in_python(name: str) -> None:
    """With ``small``, ``train`` was PPO and ``study`` PQN: a return of .750 against .287."""
    study_of_preset = Study("one", ("SkittlesEasy-v0",), ("lru",), (0,), preset=name)
    (run, _) = study_of_preset.runs()
    config = preset(name, env="SkittlesEasy-v0", memory="lru", observability="full")
    words = ["--preset", name, "--env", "SkittlesEasy-v0", "--memory", "lru"]
    train = cli.command_class("train").parse([*words, "--observability", "full"], "train")
    assert run.algorithm == config.algorithm == train.settings.algorithm
    assert study_of_preset.overridden_preset() == ""
    of_study = study_of_preset.config(run)
    assert replace(of_study, threads=config.threads) == config == train.settings


def test_a_study_says_that_it_overrides_the_algorithm_of_its_preset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "one.toml"
    lines = 'games = "SkittlesEasy"\nmemories = "lru"\nseeds = 1\npreset = "small"\n'
    for algorithms, said in (('["pqn", "dqn"]', True), ('["ppo", "dqn"]', False)):
        file.write_text(f"{lines}algorithms = {algorithms}\n")
        assert cli.main(["study", str(file), "--dry-run"]) == 0
        told = "warning: the preset 'small' trains ppo, but this study pqn and dqn, "
        assert (told in capsys.readouterr().err) == said
    file.write_text(lines)
    assert cli.main(["study", str(file), "--dry-run"]) == 0
    captured = capsys.readouterr()
    assert "SkittlesEasy__full__lru__ppo__seed0" in captured.out and "warning" not in captured.err


def test_a_study_survives_being_written_and_read() -> None:
    what = small_study(settings={"pqn": {"gamma": 0.9}}, question="why?")
    assert Study.from_dict(json.loads(json.dumps(what.to_dict()))) == what


def test_a_study_is_read_from_toml_and_its_settings_become_fields_of_the_config(
    tmp_path: Path,
) -> None:
    file = tmp_path / "one.toml"
    file.write_text(
        textwrap.dedent("""
        games = "CartPoleEasy"
        memories = ["mlp", "lru"]
        seeds = 2
        total_frames = 4096
        [settings]
        eval_every = 512
        [settings.pqn]
        learning_rate = 1e-3
        [settings.env_options]
        wind = true
        """)
    )
    what = Study.load(file)
    assert what.name == "one" and what.seeds == (0, 1)
    config = what.config(what.runs()[0])
    assert (config.env, config.observability, config.memory, config.seed) == (
        "CartPoleEasy",
        "full",
        "mlp",
        0,
    )
    assert (config.total_frames, config.eval_every, config.threads) == (4096, 512, 1)
    assert config.pqn.learning_rate == 1e-3 and config.env_options == {"wind": True}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"games": []}, "games is empty"),
        ({"seeds": 0}, "1 to 10000"),
        ({"seeds": [1, 1]}, "names something twice"),
        ({"seeds": [-1]}, "0 or more"),
        ({"observability": ["some"]}, "full or partial, or a list of the two"),
        ({"total_frames": 0}, "total_frames"),
        ({"name": "a/b"}, "letters, digits"),
        ({"colour": 1}, "unknown key 'colour'"),
        ({"settings": {"env": "X"}}, "the key games decides it"),
    ],
)
def test_bad_studies_are_refused_with_a_reason(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_study(**changes)


def test_unknown_games_and_memories_are_named_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="MineSweeperEasy"):
        planned(small_study(games=["MineSweperEasy"]))
    with pytest.raises(ValueError, match="did you mean 'mingru'"):
        study(small_study(memories=["minrgu"]), tmp_path / "s", Fabricator(small_study()))
    assert not (tmp_path / "s").exists()


def test_a_study_writes_one_row_a_run_in_the_order_of_the_grid(tmp_path: Path) -> None:
    what = small_study()
    rows = carry_out(what, tmp_path / "s", Fabricator(what))
    assert [row["run"] for row in rows] == [run.name for run in what.runs()]
    assert {row["status"] for row in rows} == {"finished"}
    assert float(rows[0]["eval_mean"]) == 0.5


def test_finished_runs_are_skipped_and_interrupted_studies_go_on(tmp_path: Path) -> None:
    what, root = small_study(), tmp_path / "s"
    first, second = Fabricator(what, stop_after=3), Fabricator(what)
    with pytest.raises(KeyboardInterrupt):
        carry_out(what, root, first)
    rows = carry_out(what, root, second)
    assert first.done + second.done == [run.name for run in what.runs()]
    assert all(row["status"] == "finished" for row in rows)


def test_a_failing_run_does_not_lose_the_others_and_is_tried_again(tmp_path: Path) -> None:
    what, root = small_study(), tmp_path / "s"
    rows = carry_out(what, root, Fabricator(what, fail="partial__mlp"))
    failed = [row for row in rows if row["status"] == "failed"]
    assert len(failed) == 2 and failed[0]["error"] == "no luck"
    timed = {row["run"] for row in read_csv(root / "timings.csv")}
    assert timed == {row["run"] for row in rows if row["status"] == "finished"}
    again = Fabricator(what)
    assert all(row["status"] == "finished" for row in carry_out(what, root, again))
    assert again.done == [row["run"] for row in failed]
    assert not list(root.glob("failures/*"))


def test_a_run_is_finished_if_its_final_evaluation_is_there_whatever_its_engine_says(
    tmp_path: Path,
) -> None:
    class Liar(Fabricator):
        """Says of a run that is finished that it failed, and of one that is not the contrary."""

        def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
            killed, idle, *others = list(jobs)
            write_run(killed.folder, self.runs[killed.name], 0.5)
            yield JobResult(killed.name, "ended by signal 9")
            yield JobResult(idle.name)
            yield from super().run(others)

    what = small_study()
    result = study(what, tmp_path / "s", Liar(what), stream=io.StringIO())
    assert list(result.errors) == [what.runs()[1].name]
    states = [(row["status"], row["error"]) for row in result.rows[:2]]
    assert states == [("finished", ""), ("failed", "ended without a final evaluation")]


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("precious")
    with pytest.raises(FileExistsError, match="holds no study"):
        carry_out(small_study(), tmp_path / "other", Fabricator(small_study()))
    assert os.listdir(tmp_path / "other") == ["thesis.tex"]
    (tmp_path / "other" / "thesis.tex").rename(tmp_path / "thesis.tex")
    (tmp_path / "other" / "study.json.lock").symlink_to(tmp_path / "thesis.tex")
    with pytest.raises(FileExistsError, match="holds no study"):
        carry_out(small_study(), tmp_path / "other", Fabricator(small_study()))
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_a_study_with_other_settings_is_refused_but_a_larger_grid_is_welcome(
    tmp_path: Path,
) -> None:
    what, root = small_study(), tmp_path / "s"
    write_study(root, what)
    with pytest.raises(FileExistsError, match="total_frames = 2048, not 4096"):
        carry_out(small_study(total_frames=4096), root, Fabricator(what))
    lacks = r"which this study lacks \(memories = \['mlp'\], without \w+\): add it, or choose"
    with pytest.raises(FileExistsError, match=lacks):
        carry_out(small_study(memories=["mlp"]), root, Fabricator(what))
    larger = small_study(seeds=3)
    engine = Fabricator(larger)
    carry_out(larger, root, engine)
    assert len(engine.done) == 4 and all("seed2" in name for name in engine.done)


def test_what_changes_no_result_may_change_in_the_file_of_a_study(tmp_path: Path) -> None:
    """Before: a study that was to go on with two threads was refused, though docs/cluster.md says
    that threads may differ.
    """
    what = small_study(settings={"threads": 1, "pqn": {"lam": 0.65}})
    folder = write_study(tmp_path / "s", what)
    free = {"threads": 2, "eval_every": 512, "checkpoint_every": 0}
    other = small_study(settings=free | {"pqn": {"lam": 0.65}}, seeds=3)
    engine = Fabricator(other)
    carry_out(other, folder.root, engine)
    assert len(engine.done) == 4 and all("seed2" in name for name in engine.done)
    with pytest.raises(FileExistsError, match=r"settings = \{'pqn.lam': 0.65\}, not \{"):
        carry_out(small_study(settings=free), folder.root, engine)


def change_config(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the settings that a run says it was made with."""
    record = json.loads((run / "config.json").read_text())
    change(record["config"])
    (run / "config.json").write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: config["pqn"].update(lam=0.123), r"pqn.lam \(0.123 != 0.65\)"),
        (lambda config: config.update(amp=True), "amp"),
        (lambda config: config.update(env_options={"mine_reward": -1}), "env_options.mine_reward"),
        (
            lambda config: config["pqn"].pop("lam"),
            r"pqn.lam \(0.95 != 0.65\)",
        ),  # from before there was that field
        (
            lambda config: config.update(no_longer=1),
            r"no_longer \(1 != None\)",
        ),  # a field that is gone
    ],
)
def test_a_finished_run_that_was_made_with_other_settings_is_refused(
    change: Callable[[dict[str, Any]], object], message: str, tmp_path: Path
) -> None:
    what = small_study(settings={"pqn": {"lam": 0.65}})
    folder = write_study(tmp_path / "s", what)
    change_config(folder.run(what.runs()[2]).path, change)
    before = (folder.root / "study.json").read_bytes()
    with pytest.raises(
        FileExistsError, match=f"{what.runs()[2].name} has other settings, .*{message}"
    ):
        carry_out(
            small_study(settings={"pqn": {"lam": 0.65}}, seeds=3), folder.root, Fabricator(what)
        )
    assert (folder.root / "study.json").read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [
        lambda config: config.update(
            device="cuda:1", threads=4, compile=True, cuda_graphs=True, logger="wandb"
        ),
        lambda config: config.update(eval_every=512, eval_episodes=7, checkpoint_every=0),
        lambda config: config.update(env="MineSweeperEasy-v0"),  # as `train` pins it
        lambda config: config["ppo"].update(clip=0.7),  # another algorithm's
        lambda config: (
            config["pqn"].pop("bootstrap"),
            config.pop("amp"),
        ),  # from before there were these fields
    ],
)
def test_what_does_not_change_a_result_lets_a_study_go_on(
    change: Callable[[dict[str, Any]], object], tmp_path: Path
) -> None:
    what = small_study()
    folder = write_study(tmp_path / "s", what)
    change_config(folder.run(what.runs()[2]).path, change)
    engine = Fabricator(what)
    carry_out(what, folder.root, engine)
    assert engine.done == []


@pytest.mark.parametrize("theirs", [small_study(), small_study(total_frames=4096)])
def test_two_may_begin_at_once_if_they_are_shards_of_one_study(
    theirs: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, exists, other = tmp_path / "s", Path.exists, [True]

    def late(path: Path, **how: Any) -> bool:
        found = exists(path, **how)
        if path.name == "study.json" and other and other.pop():
            StudyFolder(root).claim(theirs, "the other")  # between this look and the next
        return found

    monkeypatch.setattr(Path, "exists", late)
    if theirs == small_study():
        StudyFolder(root).claim(small_study(), "this shard")
    else:
        with pytest.raises(FileExistsError, match="total_frames = 4096, not 2048"):
            StudyFolder(root).claim(small_study(), "this")
    assert StudyFolder(root).load() == theirs and not other


def test_versions_of_the_first_runs_stay_on_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = StudyFolder(tmp_path / "s")
    folder.claim(small_study(), "first")
    before = folder.record()["versions"]
    for release in ("98", "99", "99"):
        current = {"torch": release}
        monkeypatch.setattr("arcade_torch.tools.studies.folder.versions", lambda now=current: now)
        folder.claim(small_study(seeds=3), "second")
    record = folder.record()
    assert record["versions"] == before
    assert record["also"] == [{"torch": "98"}, {"torch": "99"}]
    assert record["command"] == "second" and len(record["runs"]) == 12


def test_the_table_of_results_holds_no_clock_and_the_timings_stand_beside(tmp_path: Path) -> None:
    what = small_study()
    rows = carry_out(what, tmp_path / "s", Fabricator(what))
    assert "seconds" not in rows[0]
    assert float(rows[0]["eval_std"]) == pytest.approx(0.02**0.5)  # of two returns .2 apart
    assert {row["run"]: row["seconds"] for row in read_csv(tmp_path / "s" / "timings.csv")} == {
        run.name: "95.0" for run in what.runs()
    }


def test_one_episode_has_no_deviation(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study())
    file = folder.run(small_study().runs()[0]).path / "eval.json"
    file.write_text(
        json.dumps(json.loads(file.read_text()) | {"returns": [0.5], "lengths": [3], "mean": 0.5})
    )
    folder.write_results(small_study())
    row = read_csv(folder.root / "results.csv")[0]
    assert (row["eval_mean"], row["eval_std"], row["eval_n"]) == ("0.5", "", "1")


def test_sizes_are_an_axis_of_their_own_that_the_memory_free_agent_does_not_have() -> None:
    what = small_study(sizes=["1x64", "2x128"], seeds=1)
    assert [run.agent for run in what.runs() if run.observability == "full"] == [
        "mingru 1x64",
        "mingru 2x128",
        "mlp",
    ]
    run = what.runs()[2]
    assert run.name == "MineSweeperEasy__full__mingru-2x128__pqn__seed0"
    assert what.config(run).network_options == {"layers": 2, "hidden_size": 128}
    with pytest.raises(ValueError, match="layers x width"):
        small_study(sizes=["128"])


def test_a_damaged_final_evaluation_is_made_again(tmp_path: Path) -> None:
    what, root = small_study(), tmp_path / "s"
    carry_out(what, root, Fabricator(what))
    broken = StudyFolder(root).run(what.runs()[3]).path
    (broken / "eval.json").write_text('{"status": "fini')
    again = Fabricator(what)
    assert all(row["status"] == "finished" for row in carry_out(what, root, again))
    assert again.done == [broken.name]


def test_a_damaged_record_of_the_study_is_written_anew(tmp_path: Path) -> None:
    what, root = small_study(), tmp_path / "s"
    carry_out(what, root, Fabricator(what))
    (root / "study.json").write_text("")
    again = Fabricator(what)
    carry_out(what, root, again)
    assert again.done == [] and StudyFolder(root).load() == what


def test_a_study_killed_while_it_wrote_its_first_file_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The half file was called otherwise than the folder expected, and the folder was refused as
    somebody else's.
    """
    what, root = small_study(), tmp_path / "s"

    def interrupted(*paths: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as killed:
        killed.setattr(os, "replace", interrupted)
        killed.setattr(Path, "unlink", lambda *args, **how: None)
        with pytest.raises(KeyboardInterrupt):
            StudyFolder(root).claim(what)
    names = {path.name for path in root.iterdir()} - {"study.json.lock"}
    assert [name[:12] for name in names] == [".study.json."]
    StudyFolder(root).claim(what)
    assert StudyFolder(root).load() == what


def test_inline_runs_one_after_the_other_and_survives_exceptions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(job: Job) -> None:
        if job.name == "job1":
            raise RuntimeError("broken\nbadly")
        if job.name == "job2":  # somebody's memory model called sys.exit
            raise SystemExit(0)
        if job.name == "job3":
            raise AssertionError

    monkeypatch.setattr(Job, "train", train)
    parts = jobs(tmp_path, "", "", "", "", "")
    assert [result.error for result in Inline().run(parts)] == [
        "",
        "RuntimeError: broken badly",
        "SystemExit: 0",
        "AssertionError",
        "",
    ]
    assert "in train\n" in parts[1].log.read_text() and not parts[0].log.exists()


def test_engines_are_made_by_name() -> None:
    assert isinstance(make_engine("inline"), Inline)
    assert isinstance(make_engine("processes", 3), Processes)
    with pytest.raises(ValueError, match="auto, inline, processes, ray"):
        make_engine("cluster")
    with pytest.raises(ValueError, match="workers"):
        make_engine("processes", -1)
    with pytest.raises(ValueError, match="--address is for --engine ray"):
        make_engine("processes", ray=RayOptions(address="auto"))


@pytest.mark.parametrize(
    ("has_ended", "said"),
    [
        (1, "toy: 3,072 of 8,192 frames (38 %), 1/4 runs\n"),
        # all but the first have failed: a study was at 100 % when all had
        (4, "toy: 3,072 of 8,192 frames (38 %), 4/4 runs\n"),
    ],
)
def test_the_display_adds_up_the_frames_that_runs_have_trained(
    has_ended: int, said: str, tmp_path: Path
) -> None:
    what = small_study(seeds=1)
    folder = StudyFolder(tmp_path / "s")
    runs = what.runs()
    write_run(folder.run(runs[0]).path, runs[0], 0.5, frames=2048)
    write_run(folder.run(runs[1]).path, runs[1], 0.5, frames=2048, status="running")
    stream = io.StringIO()
    with Bars(stream, "frames") as bars:
        of_run = {run.name: folder.run(run) for run in runs}
        show_progress(bars, "toy", of_run, {run.name for run in runs[:has_ended]})
    assert stream.getvalue() == said


def test_the_display_prints_lines_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    with progress_bars("toy", {}, set(), stream) as note:
        note("hello")
    assert stream.getvalue() == "toy: hello\ntoy: 0 frames, 0/0 runs\n"


def test_the_display_draws_bars_on_a_terminal(tmp_path: Path) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    run = small_study(seeds=1).runs()[0]
    folder = write_study(tmp_path / "s", small_study(seeds=1)).run(run)
    write_run(folder.path, run, 0.5, frames=2048, status="running")
    stream = Terminal()
    with progress_bars("toy", {run.name: folder}, set(), stream):
        pass
    assert "toy" in stream.getvalue() and "50%" in stream.getvalue()


def test_numbers_of_a_learner_are_given_to_its_own_runs_only() -> None:
    what = small_study(
        algorithms=("pqn", "ppo"), settings={"pqn": {"gamma": 0.9}, "ppo": {"clip": 0.1}}
    )
    for run in what.runs():
        config, usual = what.config(run), small_study().config(run)
        assert (config.pqn.gamma == 0.9, config.ppo.clip == 0.1) == (
            run.algorithm == "pqn",
            run.algorithm == "ppo",
        )
        assert config.learner != usual.learner


def test_options_of_a_preset_stay_where_a_study_gives_others() -> None:
    what = small_study(
        preset="reference",
        sizes=["1x64"],
        total_frames=10**6,
        settings={"env_options": {"noise": 1}},
    )
    config = what.config(what.runs()[0])
    assert config.network_options == {"skip": "none", "layers": 1, "hidden_size": 64}
    assert config.env_options == {"noise": 1}
    other = small_study(preset="reference", settings={"network_options": {"skip": "residual"}})
    assert other.config(other.runs()[0]).network_options["skip"] == "residual"


def test_a_setting_that_does_not_exist_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    for settings, message in (
        ({"gama": 1}, "unknown field 'gama'"),
        ({"pqn": {"lam": 7}}, "pqn.lam"),
    ):
        with pytest.raises(ValueError, match=message):
            study(small_study(settings=settings), tmp_path / "s", "inline")
    assert not (tmp_path / "s").exists()


def test_shards_share_the_runs_out_and_each_knows_the_results_of_all(tmp_path: Path) -> None:
    what, root = small_study(), tmp_path / "s"
    parts = [Fabricator(what) for _ in range(3)]
    results = [
        study(what, root, e, stream=io.StringIO(), shard=f"{i + 1}/3") for i, e in enumerate(parts)
    ]
    assert [result.finished for result in results] == [3, 6, 8]
    assert sorted(name for part in parts for name in part.done) == sorted(
        run.name for run in what.runs()
    )
    for wrong in ("0/3", "4/3", "3", "a/b", "1/0"):
        with pytest.raises(ValueError, match="a shard is written 3/10, the third of ten"):
            planned(what, wrong)


def test_a_study_on_a_full_disk_stops_at_the_first_run_that_fails_for_it(tmp_path: Path) -> None:
    class Full(Fabricator):
        def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
            for job in jobs:
                self.done.append(job.name)
                yield JobResult(job.name, "OSError: [Errno 28] No space left on device")

    engine = Full(small_study())
    with pytest.raises(DiskFullError, match="make room and start it again"):
        carry_out(small_study(), tmp_path / "s", engine)
    assert len(engine.done) == 1


def test_without_room_a_run_that_fails_ends_a_study_and_one_that_succeeds_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "arcade_torch.tools.studies.runner.shutil.disk_usage", lambda _: SimpleNamespace(free=0)
    )
    what = small_study()
    assert len(carry_out(what, tmp_path / "fine", Fabricator(what))) == 8
    with pytest.raises(DiskFullError, match="no luck"):
        carry_out(what, tmp_path / "full", Fabricator(what, fail="mlp"))


def test_a_run_that_another_process_finished_meanwhile_has_not_failed(tmp_path: Path) -> None:
    class Second(Fabricator):
        """Finds a run in training, which is finished before the last of its own is."""

        def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
            taken, lost, *others = list(jobs)
            yield JobResult(taken.name, "another process trains in it")
            yield JobResult(lost.name, "no luck")
            write_run(taken.folder, self.runs[taken.name], 0.5)
            yield from super().run(others)

    what = small_study()
    result = study(what, tmp_path / "s", Second(what), stream=io.StringIO())
    assert list(result.errors) == [what.runs()[1].name]
    assert result.finished == len(what.runs()) - 1
    assert [row["error"] for row in result.rows if row["error"]] == ["no luck"]
    assert len(list((tmp_path / "s" / "failures").iterdir())) == 1


def test_the_presets_are_studies() -> None:
    sizes = {name: len(study_preset(name).runs()) for name in STUDY_PRESETS}
    assert sizes == {"demo": 24, "paper-easy": 800, "paper": 2400, "size-sweep": 192}
    with pytest.raises(ValueError, match=r"preset of a study must be one of .*; got 'papers'"):
        study_preset("papers")


def test_options_of_one_memory_stand_under_its_name(tmp_path: Path) -> None:
    """Those of ``[settings]`` go to every memory, and ``mlp`` beside yours refused them."""
    file = tmp_path / "s.toml"
    text = (
        'games = "SignpostEasy"\nmemories = ["frame_stack", "mlp"]\nseeds = 1\npreset = "small"\n'
    )
    file.write_text(f"{text}[memory_options.frame_stack]\nframes = 7\n")
    what = Study.load(file)
    for run, config in planned(what).items():
        options = config.network_options.get("memory_options", {})
        assert options == ({"frames": 7} if run.memory == "frame_stack" else {})
    assert Study.from_dict(json.loads(json.dumps(what.to_dict()))) == what
    other = replace(what, memory_options={"frame_stack": {"frames": 8}})
    StudyFolder(tmp_path / "begun").claim(what)
    with pytest.raises(FileExistsError, match=r"memory_options = .*7.*, not .*8"):
        StudyFolder(tmp_path / "begun").claim(other)
    study(what, tmp_path / "s", Fabricator(what), stream=io.StringIO())
    with pytest.raises(FileExistsError, match="memory_options"):
        study(other, tmp_path / "s", Fabricator(what), stream=io.StringIO())
    for options, said in (
        ("[memory_options.gru]\nx = 1", "memory_options names 'gru'"),
        ("[memory_options]\nframe_stack = 7", "memory_options.frame_stack"),
        ("[memory_options.frame_stack]\nnope = 7", "nope"),
    ):
        file.write_text(f"{text}{options}\n")
        with pytest.raises((ValueError, TypeError), match=said):
            planned(Study.load(file))


def test_options_of_one_memory_go_before_those_of_all_and_to_no_other() -> None:
    common = {"heads": 2, "window": 5}
    what = small_study(
        memories=["attention", "mlp"],
        settings={"network_options": {"memory_options": common}},
        memory_options={"attention": {"window": 7}},
    )
    for _ in range(2):
        for run in what.runs():
            window = 7 if run.memory == "attention" else 5
            expected = {"heads": 2, "window": window}
            assert what.config(run).network_options["memory_options"] == expected
