"""``make gpu`` rehearsed on the CPU: every stage in a tiny form, what a second call does, and the
page.
"""

import os
import re
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest
import torch

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.bench.registry import TABLES
from arcade_torch.tools.studies.grid import Study
from tests.gpu import needs, stages
from tests.gpu.stages import ROOT, Stage, run

FAILS = "import sys; print('one'); sys.exit('no card at hand')"


def script(name: str, code: str, resumes: bool = False) -> Stage:
    return Stage(name, ("-c", code), resumes)


def in_this_process(stage: Stage, log: Path, seconds: float) -> int | None:
    """Commands as they are, without the seconds that a process needs to begin. Of the tests those
    of one stage run, four of them, and those of the others are said to pass.
    """
    log.write_text("")
    if stage.name == "tests-bridge":
        words = (*stage.argv, "-k", "test_an_array_becomes")
        return subprocess.run([sys.executable, *words], cwd=ROOT, check=False).returncode
    if stage.is_tests:
        report = Path(stage.argv[-1].removeprefix("--junitxml="))
        report.write_text(
            '<testsuite><testcase classname="a.b" name="test_c" time="0.1"/></testsuite>'
        )
        return 0
    if stage.argv[0] == "-c":
        return subprocess.run([sys.executable, *stage.argv], cwd=ROOT, check=False).returncode
    return cli.main(list(stage.argv[2:]))


@pytest.mark.slow
def test_a_rehearsal_runs_every_stage_and_writes_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "launch", in_this_process)
    assert stages.main([str(tmp_path), "--device", "cpu"]) == 0
    names = [stage.name for stage in stages.stages(tmp_path, "cpu")]
    assert {name.split("-")[0] for name in names} == {
        "machine",
        "tests",
        "envs",
        "train",
        "memory",
        "study",
    }
    page = (tmp_path / "gpu.md").read_text()
    for name in ("envs", "train", "models", "scans", "saliency"):
        assert f"## {TABLES[name].title}\n" in page
    rows = read_csv(tmp_path / "study-tiny.csv")
    assert [row["observability"] for row in rows] == ["full", "partial"]
    assert all(
        row["status"] == "finished" and float(row["seconds"]) > 0 and row["run"] in page
        for row in rows
    )
    machine = read_csv(tmp_path / "machine.csv")[0]
    assert (
        machine["torch"] in page
        and machine["jax_device"] in page
        and "| tests-bridge | 4 |" in page
    )
    monkeypatch.setattr(stages, "launch", None)
    assert stages.main([str(tmp_path), "--device", "cpu"]) == 0  # all is done: nothing runs again


SKIPPED = """
import pytest

@pytest.mark.skip(reason="needs a CUDA device")
def test_on_a_card(): pass
"""


def stage_of_tests(folder: Path, code: str) -> Stage:
    """Tests of a file of one's own, run by pytest as any stage runs it."""
    file = folder / "test_on_a_card.py"
    file.write_text(code)
    report = f"--junitxml={folder / 'tests-one.xml'}"
    options = ("-q", "-p", "no:cacheprovider", "-c", os.devnull, f"--rootdir={folder}")
    return Stage("tests-one", ("-m", "pytest", *options, str(file), report))


def test_tests_that_were_all_skipped_have_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """pytest ends with 0: without a card the stage was done, and never ran again."""
    assert run([stage_of_tests(tmp_path, SKIPPED)], tmp_path, 60) == {"tests-one": "failed"}
    assert "tests-one: failed, no test passed" in capsys.readouterr().out
    assert [row["outcome"] for row in read_csv(tmp_path / "tests-one.csv")] == ["skipped"]
    both = stage_of_tests(tmp_path, f"{SKIPPED}\ndef test_on_any_machine(): pass\n")
    assert run([both], tmp_path, 60) == {"tests-one": "done"}
    assert not (tmp_path / "tests-one.failed").exists()


def test_a_mark_of_tests_that_were_all_skipped_is_not_believed(tmp_path: Path) -> None:
    stage = stage_of_tests(tmp_path, "def test_on_any_machine(): pass")
    (tmp_path / "tests-one.done").write_text("exit code 0, 9 s\n")
    (tmp_path / "tests-one.csv").write_text("test,outcome,seconds,message\na::b,skipped,0,\n")
    assert run([stage], tmp_path, 60) == {"tests-one": "done"}
    assert [row["outcome"] for row in read_csv(tmp_path / "tests-one.csv")] == ["passed"]
    (tmp_path / "test_on_a_card.py").unlink()
    assert run([stage], tmp_path, 60) == {"tests-one": "done"}  # this one is believed


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a card")
def test_without_a_card_one_line_says_so_and_no_stage_begins(tmp_path: Path) -> None:
    with pytest.raises(
        SystemExit, match=r"^no stage was begun: torch sees no GPU: .*DEVICE=cpu\)$"
    ):
        stages.main([str(tmp_path / "new")])
    assert not (tmp_path / "new").exists()


def test_marks_of_a_machine_without_a_card_are_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stages, "why_no_card", lambda: "")
    monkeypatch.setattr(stages, "launch", lambda _, log, seconds: log.write_text("no card"))
    for device, believed in (("cpu (cpu)", False), ("gpu (NVIDIA H100)", True)):
        (tmp_path / "machine.csv").write_text(f"jax_device,torch_device\n{device},cuda\n")
        (tmp_path / "machine.done").write_text("exit code 0, 9 s\n")
        assert stages.main([str(tmp_path), "--only", "machine"]) == (0 if believed else 1)
        assert ("JAX on cpu (cpu)): they run again" in capsys.readouterr().out) != believed


def installation(*words: str) -> str:
    """What ``make install`` would do in a folder where nothing is."""
    command = ["make", "--dry-run", "install", "VENV=build/never", *words]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return answer.stdout


def test_make_installs_jax_for_a_card_where_it_is_asked_to() -> None:
    """``make install && make gpu`` on a rented card copied all frames: JAX came for the CPU."""
    assert "gpu" not in installation()
    assert installation("GPU=1").count("-e '.[gpu]'") == 1
    assert installation("GPU=12").count("-e '.[gpu-cuda12]'") == 1
    setup = ConfigParser(interpolation=None)
    setup.read(ROOT / "setup.cfg")
    (jax,) = (line for line in needs.needed() if line.startswith("jax"))
    for extra, cuda in (("gpu", "cuda13"), ("gpu-cuda12", "cuda12")):
        line = setup["options.extras_require"][extra].strip()
        assert line.startswith(jax.replace("jax", f"jax[{cuda}]"))


def test_a_bare_python_is_told_of_all_that_is_missing_in_one_line() -> None:
    bare = [sys.executable, "-S", "-m", "tests.gpu.stages", "build/never"]
    answer = subprocess.run(bare, cwd=ROOT, capture_output=True, text=True, env={}, check=False)
    assert answer.returncode == 1 and answer.stdout == "" and answer.stderr.count("\n") == 1
    for requirement in needs.needed():
        assert requirement.replace("jax>", "jax[cuda13]>") in answer.stderr
    assert "-m pip install 'torch>=" in answer.stderr and needs.missing_packages() == []


def test_every_command_for_a_card_is_one_that_the_parser_takes(tmp_path: Path) -> None:
    found = stages.stages(tmp_path, "cuda")
    assert len({stage.name for stage in found}) == len(found) > 25
    for stage in found:
        if "arcade_torch.tools" in stage.argv:
            command, options = cli.split_command(stage.argv[2:])
            cli.command_class(command).parse(options, f"arcade-torch {command}")
    runs = Study.load(tmp_path / "study-small.toml")
    assert len(runs.runs()) == 20 and {runs.config(run).device for run in runs.runs()} == {"cuda"}
    paper = Study.load(tmp_path / "study-paper.toml")
    assert {paper.config(run).total_frames for run in paper.runs()} == {10_000_000}


def test_tests_marked_gpu_stand_where_a_stage_finds_them() -> None:
    marked = re.compile(r"^(?:@|pytestmark = )pytest\.mark\.gpu$", re.MULTILINE)
    found = [
        path.relative_to(ROOT)
        for path in (ROOT / "tests").rglob("test_*.py")
        if marked.search(path.read_text())
    ]
    known = [Path(path) for paths in stages.TESTS.values() for path in paths]
    assert len(found) >= 5 and all((ROOT / path).exists() for path in known)
    assert not [path for path in found if not any(path.is_relative_to(place) for place in known)]


def test_a_stage_that_fails_stops_no_other_and_is_tried_again_after_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = [script("bad", FAILS), script("good", "print('two')"), script("more", FAILS)]
    assert run(chosen, tmp_path, 60) == {"bad": "failed", "good": "done", "more": "failed"}
    assert "no card at hand" in capsys.readouterr().out and (
        tmp_path / "bad.log"
    ).read_text().startswith("one")
    (tmp_path / "more.failed").unlink()
    (tmp_path / "good.log").unlink()
    assert run([script("bad", ""), *chosen[1:]], tmp_path, 60) == {
        "bad": "done",
        "good": "done",
        "more": "failed",
    }
    told = capsys.readouterr().out
    assert told.index("more ...") < told.index("bad ...") and not (tmp_path / "good.log").exists()
    assert (
        "exit code 0" in (tmp_path / "bad.done").read_text()
        and not (tmp_path / "bad.failed").exists()
    )


def test_what_the_time_does_not_suffice_for_goes_on_with_the_next_call(tmp_path: Path) -> None:
    sleeps = "import time; time.sleep(60)"
    saves = f"import pathlib, signal, sys; signal.signal(15, lambda *_: sys.exit(130)); {sleeps}"
    study, bench, last = (
        script("study", saves, resumes=True),
        script("bench", sleeps),
        script("last", ""),
    )
    assert run([study, bench], tmp_path, 1) == {"study": "unfinished", "bench": "waiting"}
    assert not list(tmp_path.glob("*.done")) and not list(tmp_path.glob("*.failed"))
    assert run([last, bench], tmp_path, 2) == {"last": "done", "bench": "unfinished"}
    assert run([bench], tmp_path, 1) == {"bench": "failed"}  # it had all the time that there is


def test_a_page_names_what_failed_and_what_is_left(tmp_path: Path) -> None:
    (tmp_path / "bad.log").write_text("Traceback\nRuntimeError: a | b\n")
    report = '<s><testcase classname="x" name="y" time="1"><failure message="1 ==&#10; 2"/></testcase></s>'
    (tmp_path / "tests-bridge.xml").write_text(report)
    stages.collect(Stage("tests-bridge", ()), tmp_path)
    page = stages.page(tmp_path, {"bad": "failed", "later": "waiting"}, "make gpu DEVICE=cuda")
    for line in (
        "| bad | failed | RuntimeError: a \\| b |",
        "| later | waiting |  |",
        "| x::y | failure | 1 | 1 == 2 |",
    ):
        assert line in page
    assert "| tests-bridge |  | 1 |  |  |" in page and "`make gpu DEVICE=cuda`" in page


def test_an_unknown_stage_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        stages.main([str(tmp_path), "--device", "cpu", "--only", "trian-*"])
    assert "no stage is called trian-*; there are machine, tests-bridge" in capsys.readouterr().err
