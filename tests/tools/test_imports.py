"""What a run remembers of ``--import``: nobody has to type it again, and nothing is imported that
the user has not chosen on this machine.
"""

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents import TrainConfig, train
from arcade_torch.models import memory_names, registry
from arcade_torch.tools import cli, imports
from arcade_torch.tools.imports import VARIABLE

SOURCE = '''
from pathlib import Path
from arcade_torch.models import register_memory
from arcade_torch.models.lru import LRU


class Yours(LRU):
    """A model of somebody's."""


register_memory("yours", Yours)
Path(__file__).with_name("was_imported").touch()
'''
Restart = Callable[[], None]


def in_a_new_process(patch: pytest.MonkeyPatch) -> None:
    """Forget what was imported, as the end of a process does."""
    builtin = {name: make for name, make in registry._FACTORIES.items() if name != "yours"}
    patch.setattr(registry, "_FACTORIES", builtin)
    patch.setenv(VARIABLE, "")
    for name in [name for name in sys.modules if name.startswith("yours_")]:
        patch.delitem(sys.modules, name)
    patch.setattr(imports, "_hashes", {})
    patch.setattr(imports, "_again", set())


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a user's file ``yours.py``, a run that was trained with it, and the user's
    record of the import.
    """
    folder = tmp_path_factory.mktemp("trained")
    (folder / "yours.py").write_text(SOURCE)
    words = ["--memory", "yours", "--preset", "smoke", "--env", "SignpostEasy"]
    with pytest.MonkeyPatch.context() as patch:
        in_a_new_process(patch)
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        words += ["--import", str(folder / "yours.py"), "--out", str(folder / "run")]
        assert cli.main(["train", *words]) == cli.EXIT_OK
    (folder / "was_imported").unlink()
    yield folder


@pytest.fixture
def folder(original: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The same in a new process; what a test changes is put back."""
    in_a_new_process(monkeypatch)
    monkeypatch.setenv("XDG_STATE_HOME", str(original / "state"))
    config = (original / "run/config.json").read_text()
    record = (original / "state/arcade-torch/imports.json").read_text()
    yield original
    (original / "yours.py").write_text(SOURCE)
    (original / "was_imported").unlink(missing_ok=True)
    (original / "run/config.json").write_text(config)
    (original / "state/arcade-torch/imports.json").write_text(record)


def evaluate(folder: Path, *words: str) -> int:
    return cli.main(["evaluate", str(folder / "run"), "--episodes", "2", *words])


def refusal(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What ``evaluate`` says in one line; the file was not imported."""
    (folder / "was_imported").unlink(missing_ok=True)
    assert evaluate(folder) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and not (folder / "was_imported").exists()
    return err


def change_config(folder: Path, **entry: Any) -> None:
    """Change what the run says it imported."""
    file = folder / "run/config.json"
    record = json.loads(file.read_text())
    record["imports"][0] |= entry
    file.write_text(json.dumps(record))


def test_evaluate_needs_no_import_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before: unknown memory 'yours'."""
    assert evaluate(folder) == cli.EXIT_OK
    assert "pqn-yours on SignpostEasy-v0" in capsys.readouterr().out
    assert os.environ[VARIABLE] == str(folder / "yours.py")  # for workers


def test_other_commands_on_a_run_need_none_either(folder: Path, tmp_path: Path) -> None:
    run = str(folder / "run")
    words = ["record", "SignpostEasy", "--player", run, "--max-steps", "2"]
    assert cli.main([*words, "--out", str(tmp_path / "film.gif")]) == cli.EXIT_OK
    words = ["analyze", "recall-density", run, "--episodes", "1", "--out", str(tmp_path)]
    assert cli.main(words) == cli.EXIT_OK


def test_commands_at_once_all_note_what_they_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each read the record, and wrote it without what the others had added."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv(imports.VARIABLE, "")
    monkeypatch.setenv(imports.HASHES_VARIABLE, "")
    trusted = imports._trusted

    def slowly() -> list[Any]:
        entries = trusted()
        time.sleep(0.05)
        return entries

    in_a_new_process(monkeypatch)
    monkeypatch.setattr(imports, "_trusted", slowly)
    files = [tmp_path / f"games_{place}.py" for place in range(4)]
    threads = []
    for file in files:
        file.write_text("")
        imports.load_extensions([str(file)])
        threads.append(threading.Thread(target=imports.import_for_command, args=([str(file)],)))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {name for name, _ in trusted()} == set(map(str, files))


def test_a_run_remembers_nothing_that_it_does_not_need(folder: Path, tmp_path: Path) -> None:
    words = ["--memory", "gru", "--preset", "smoke", "--env", "SignpostEasy"]
    words += ["--import", str(folder / "yours.py"), "--out", str(tmp_path / "run")]
    assert cli.main(["train", *words]) == cli.EXIT_OK
    assert json.loads((tmp_path / "run/config.json").read_text())["imports"] == []


def test_a_changed_file_is_refused_and_given_again_it_is_taken(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "yours.py").write_text(SOURCE + "# another\n")
    said = refusal(folder, capsys)
    assert f"yours.py, which has changed since: pass --import {folder / 'yours.py'}" in said
    assert evaluate(folder, "--import", str(folder / "yours.py")) == cli.EXIT_OK


def test_a_file_that_is_gone_is_refused_and_found_in_its_new_place(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.move(folder / "yours.py", tmp_path / "yours.py")
    assert "which is not there any more: pass --import with its new place" in refusal(
        folder, capsys
    )
    assert evaluate(folder, "--import", str(tmp_path / "yours.py")) == cli.EXIT_OK


def test_a_folder_of_somebody_else_imports_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file is there, its hash is right, but this user has never imported it."""
    (folder / "state/arcade-torch/imports.json").unlink()
    said = refusal(folder, capsys)
    assert "which you have not imported on this machine: pass --import" in said
    assert "if you trust it" in said


@pytest.mark.parametrize("record", ["", "{}", "[1, [2], null]", "[" * 100_000])
def test_a_damaged_record_trusts_nothing(
    folder: Path, record: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "state/arcade-torch/imports.json").write_text(record)
    assert "have not imported on this machine" in refusal(folder, capsys)


def test_a_hostile_folder_cannot_name_another_file(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither a file that is right here with its own hash, nor a module, nor a pipe."""
    other = tmp_path / "yours.py"
    other.write_text(SOURCE)
    change_config(folder, name=str(other))
    assert f"{other}, which you have not imported" in refusal(folder, capsys)
    assert not (tmp_path / "was_imported").exists()
    change_config(folder, name="this", sha256="")
    assert "imported the module this, and modules are never imported again" in refusal(
        folder, capsys
    )
    os.mkfifo(tmp_path / "pipe.py")
    change_config(folder, name=str(tmp_path / "pipe.py"), sha256="0" * 64)
    assert "have not imported" in refusal(folder, capsys)


@pytest.mark.parametrize(
    "entry",
    [{"name": 1}, {"name": ""}, {"name": "a\0b"}, {"sha256": "x"}, {"name": "yours.py"}],
)
def test_damaged_imports_are_one_line(
    folder: Path, entry: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    change_config(folder, **entry)
    assert "config.json is damaged: an import has a name and a sha256" in refusal(folder, capsys)


def test_a_compiled_file_beside_the_source_is_not_run(folder: Path, tmp_path: Path) -> None:
    """Before: Python took a .pyc with the right time and size for the source."""
    import py_compile

    source = tmp_path / "yours_too.py"
    source.write_text("raise SystemExit('compiled')")
    py_compile.compile(str(source), doraise=True)
    stat = source.stat()
    source.write_text("import this_is_not_one_".ljust(stat.st_size)[: stat.st_size])
    os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    with pytest.raises(ValueError, match="which is neither installed"):
        imports.load_extensions([str(source)])


def test_a_run_that_goes_on_with_another_text_remembers_that(folder: Path) -> None:
    """The user gave it himself; what was trained before keeps its name in no other place."""
    words = ["--memory", "yours", "--preset", "smoke", "--env", "SignpostEasy", "--resume"]
    words += ["--out", str(folder / "run")]
    (folder / "run/eval.json").rename(folder / "eval.json")
    try:
        assert cli.main(["train", *words]) == cli.EXIT_OK  # nothing has changed
        assert "yours" in memory_names()
    finally:
        (folder / "eval.json").unlink()
    before = json.loads((folder / "run/config.json").read_text())["imports"]
    (folder / "run/eval.json").unlink()
    config = TrainConfig.from_dict(json.loads((folder / "run/config.json").read_text())["config"])
    train(config, folder / "run", resume=True)  # from Python, which says nothing of imports
    assert json.loads((folder / "run/config.json").read_text())["imports"] == before
    (folder / "yours.py").write_text(SOURCE + "# another\n")
    (folder / "run/eval.json").unlink()
    with pytest.MonkeyPatch.context() as patch:
        in_a_new_process(patch)
        assert cli.main(["train", *words]) == cli.EXIT_BAD_INPUT
        words += ["--import", str(folder / "yours.py")]
        assert cli.main(["train", *words]) == cli.EXIT_OK
    after = json.loads((folder / "run/config.json").read_text())["imports"]
    assert before[0]["name"] == after[0]["name"]
    assert before[0]["sha256"] != after[0]["sha256"]


def test_a_study_does_not_go_on_with_runs_of_an_older_text(folder: Path, tmp_path: Path) -> None:
    """Before: it kept them, and the report was of two models under one name."""
    from arcade_torch.tools.comparable import find_runs
    from arcade_torch.tools.studies.folder import StudyFolder
    from arcade_torch.tools.studies.grid import Study
    from tests.tools.fabricated import write_run

    imports.load_extensions([str(folder / "yours.py")])
    settings = {"games": ["SignpostEasy"], "memories": ["yours"], "seeds": 2}
    plan = Study.from_dict(settings | {"name": "s", "observability": ["full"], "preset": "smoke"})
    study = StudyFolder(tmp_path / "s")
    study.claim(plan)
    for spec in plan.runs():
        run = study.run(spec).path
        write_run(run, spec, 0.5, settings=plan.config(spec).to_dict())
        record = json.loads((run / "config.json").read_text())
        record["imports"] = imports.imports_of(plan.config(spec))
        (run / "config.json").write_text(json.dumps(record))
    study.claim(plan)
    assert not any("yours.py" in note for note in find_runs([tmp_path / "s"]).notes)
    record["imports"][0]["sha256"] = "0" * 64
    (run / "config.json").write_text(json.dumps(record))
    with pytest.raises(FileExistsError, match=r"trained with .*yours\.py as it was before"):
        study.claim(plan)
    assert any("yours.py has changed" in note for note in find_runs([tmp_path / "s"]).notes)
    (run / "eval.json").unlink()
    study.claim(plan)  # it begins anew
    (run / "checkpoints/frames-000000000001").mkdir(parents=True)
    with pytest.raises(FileExistsError, match=r"trained with .*yours\.py as it was before") as told:
        study.claim(plan)  # it would go on from what another text has learned
    assert f"{run} was" in str(told.value) and "delete that folder to train" in str(told.value)
    shutil.rmtree(run)
    study.claim(plan)


def test_a_worker_imports_what_its_study_began_with(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that was edited while a study went on: later runs were trained with the new text, and
    reported as seeds of the same memory.
    """
    file = folder / "yours.py"
    imports.load_extensions([str(file)])
    handed_on = imports.for_workers()

    def begin_worker() -> None:
        in_a_new_process(monkeypatch)
        for name, value in handed_on.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(imports, "_parents", imports._of_parent())

    begin_worker()
    imports.load_extensions()
    assert "yours" in memory_names()
    file.write_text(SOURCE + "# another\n")
    begin_worker()
    with pytest.raises(imports.ImportRefusedError, match=r"yours\.py: it has changed since"):
        imports.load_extensions()
    assert "yours" not in memory_names()
    imports.load_extensions([str(file)])  # the user names it himself
    assert "yours" in memory_names()


def test_a_record_that_cannot_be_kept_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run of such a file was refused later: it had never been imported on this machine."""
    (tmp_path / "state").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv(VARIABLE, "")
    (tmp_path / "mine.py").write_text("NOTHING = 0\n")
    assert cli.main(["list", "envs", "--import", str(tmp_path / "mine.py")]) == cli.EXIT_OK
    assert capsys.readouterr().err.startswith("later commands need --import again: no record")
