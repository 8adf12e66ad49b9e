"""A file behind ``--import`` that imports a module beside it: what a run learned with one text of
that module does not go on with another without a word.
"""

import importlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from arcade_torch.models import memory_names
from arcade_torch.tools import cli, imports
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from tests.tools.fabricated import write_run
from tests.tools.test_imports import in_a_new_process

SOURCE = """
from arcade_torch.models import register_memory
from beside_yours import Yours

register_memory("yours", Yours)
"""
BESIDE = """
from arcade_torch.models.lru import LRU


class Yours(LRU):
    pass
"""
WORDS = ["--memory", "yours", "--preset", "smoke", "--env", "SignpostEasy"]


def again(patch: pytest.MonkeyPatch) -> None:
    """Begin a new process."""
    in_a_new_process(patch)
    patch.setattr(imports, "_beside", {})
    patch.setattr(imports, "_before", {})
    patch.delitem(sys.modules, "beside_yours", raising=False)
    importlib.invalidate_caches()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of ``yours.py`` and ``beside_yours.py``."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "yours.py").write_text(SOURCE)
    (tmp_path / "beside_yours.py").write_text(BESIDE)
    again(monkeypatch)
    yield tmp_path
    sys.modules.pop("beside_yours", None)


def change(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Edit the module, and begin a new process."""
    (folder / "beside_yours.py").write_text(f"{BESIDE}\n# another\n")
    again(patch)


def test_a_run_whose_file_imported_another_text_is_refused_and_given_again_it_is_taken(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was evaluated, and trained on, with a model that it had never learned with."""
    given = ["--import", str(folder / "yours.py")]
    assert cli.main(["train", *WORDS, "--out", str(folder / "run"), *given]) == cli.EXIT_OK
    again(monkeypatch)
    evaluate = ["evaluate", str(folder / "run"), "--episodes", "2"]
    assert cli.main(evaluate) == cli.EXIT_OK
    for words in (evaluate, ["train", *WORDS, "--out", str(folder / "run"), "--resume"]):
        change(folder, monkeypatch)
        capsys.readouterr()
        assert cli.main(words) == cli.EXIT_BAD_INPUT
        said = capsys.readouterr().err
        assert "beside_yours.py by way of" in said and "it has changed since: put it back" in said
        assert said.count("\n") == 1
    again(monkeypatch)
    assert cli.main([*evaluate, *given]) == cli.EXIT_OK


def test_a_module_that_the_user_has_imported_himself_is_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a notebook it stands in ``sys.modules`` before the file is imported again."""
    imports.import_for_command([str(folder / "yours.py")])
    config = study().config(study().runs()[0])
    text = json.dumps({"imports": imports.imports_of(config)})
    (folder / "config.json").write_text(text)
    again(monkeypatch)
    importlib.import_module("beside_yours")
    imports.import_again(folder)
    assert "yours" in memory_names()


def study() -> Study:
    settings = {"games": ["SignpostEasy"], "memories": ["yours"], "seeds": 1}
    return Study.from_dict(settings | {"name": "s", "observability": ["full"], "preset": "smoke"})


def test_a_study_does_not_go_on_with_runs_of_another_text(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imports.load_extensions([str(folder / "yours.py")])
    place = StudyFolder(folder / "s")
    (cell,) = study().runs()
    run = place.run(cell).path
    place.claim(study())
    write_run(run, cell, 0.5, settings=study().config(cell).to_dict())
    record = json.loads((run / "config.json").read_text())
    record["imports"] = imports.imports_of(study().config(cell))
    (run / "config.json").write_text(json.dumps(record))
    assert [Path(entry["name"]).name for entry in record["imports"]] == [
        "yours.py",
        "beside_yours.py",
    ]
    place.claim(study())
    change(folder, monkeypatch)
    imports.load_extensions([str(folder / "yours.py")])
    with pytest.raises(FileExistsError, match=r"trained with .*beside_yours\.py as it was before"):
        place.claim(study())


def test_a_worker_refuses_another_text_than_its_study_began_with(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imports.load_extensions([str(folder / "yours.py")])
    handed_on = imports.for_workers()
    monkeypatch.setenv(imports.HASHES_VARIABLE, handed_on[imports.HASHES_VARIABLE])
    monkeypatch.setattr(imports, "_parents", imports._of_parent())

    again(monkeypatch)
    monkeypatch.setenv(imports.VARIABLE, handed_on[imports.VARIABLE])
    imports.load_extensions()
    assert "yours" in memory_names()

    change(folder, monkeypatch)
    monkeypatch.setenv(imports.VARIABLE, handed_on[imports.VARIABLE])
    with pytest.raises(imports.ImportRefusedError, match=r"beside_yours\.py: it has changed since"):
        imports.load_extensions()


def test_what_a_run_says_of_modules_beside_is_not_opened(folder: Path) -> None:
    """It may come from somebody else."""
    entry = {"name": str(folder / "pipe"), "sha256": "0" * 64, "by": str(folder / "yours.py")}
    (folder / "config.json").write_text(json.dumps({"imports": [entry]}))
    with pytest.raises(imports.ImportRefusedError, match="has changed since"):
        imports.import_again(folder)
    assert "yours" not in memory_names() and "beside_yours" not in sys.modules


LATE = """
from arcade_torch.models import register_memory
from arcade_torch.models.lru import LRU


class Yours(LRU):
    def forward(self, *args):
        import beside_yours

        return super().forward(*args)


register_memory("yours", Yours)
"""


@pytest.mark.parametrize("checked", ["", "--no-check-memory"])
def test_a_module_that_is_imported_only_when_the_model_runs_is_remembered_too(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    checked: str,
) -> None:
    """It could be edited between start and resume, without a word."""
    (folder / "yours.py").write_text(LATE)
    given = ["--import", str(folder / "yours.py"), *([checked] if checked else [])]
    assert cli.main(["train", *WORDS, "--out", str(folder / "run"), *given]) == cli.EXIT_OK
    evaluate = ["evaluate", str(folder / "run"), "--episodes", "2"]
    again(monkeypatch)
    assert cli.main(evaluate) == cli.EXIT_OK
    change(folder, monkeypatch)
    capsys.readouterr()
    assert cli.main(evaluate) == cli.EXIT_BAD_INPUT
    said = capsys.readouterr().err
    assert "beside_yours.py by way of" in said and "it has changed since: put it back" in said


def test_a_run_that_goes_on_with_another_text_remembers_that(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hash of a module that is imported late is that of the text which it goes on with."""
    (folder / "yours.py").write_text(LATE)
    run = folder / "run"
    given = [*WORDS, "--out", str(run), "--import", str(folder / "yours.py"), "--no-check-memory"]
    assert cli.main(["train", *given]) == cli.EXIT_OK
    before = (run / "config.json").read_text()
    (run / "eval.json").unlink()
    shutil.rmtree(run / "checkpoints")
    change(folder, monkeypatch)
    assert cli.main(["train", *given, "--resume"]) == cli.EXIT_OK
    after = (run / "config.json").read_text()
    assert "beside_yours.py" in before and "beside_yours.py" in after and before != after
    again(monkeypatch)
    assert cli.main(["evaluate", str(run), "--episodes", "2"]) == cli.EXIT_OK


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_study_goes_on_with_runs_that_import_late(
    folder: Path, monkeypatch: pytest.MonkeyPatch, is_finished: bool
) -> None:
    """The process that plans them runs no model, and has not imported what they do."""
    (folder / "yours.py").write_text(LATE)
    imports.load_extensions([str(folder / "yours.py")])
    place = StudyFolder(folder / "s")
    (cell,) = study().runs()
    place.claim(study())
    run = place.run(cell).path
    settings = study().config(cell)
    write_run(run, cell, 0.5, settings=settings.to_dict())
    if not is_finished:
        (run / "eval.json").unlink()
        (run / "checkpoints" / "frames-000000001024").mkdir(parents=True)
    importlib.import_module("beside_yours")
    (run / "config.json").write_text(
        json.dumps({"config": settings.to_dict(), "imports": imports.imports_of(settings)})
    )
    assert "beside_yours.py" in (run / "config.json").read_text()
    again(monkeypatch)
    imports.load_extensions([str(folder / "yours.py")])
    place.claim(study())
    change(folder, monkeypatch)
    imports.load_extensions([str(folder / "yours.py")])
    with pytest.raises(FileExistsError, match=r"trained with .*beside_yours\.py as it was before"):
        place.claim(study())
