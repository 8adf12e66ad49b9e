"""Studies, tables and records that are none are refused in one line, and nothing is lost."""

import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.agents.runs.final import is_final
from arcade_torch.agents.runs.folder import RunFolder
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures.logs import Rate, curves_of_runs
from arcade_torch.tools.files import read_rows, write_between
from arcade_torch.tools.options import name_and_value
from arcade_torch.tools.play.scores import COLUMNS, append_score, replay
from arcade_torch.tools.runs import Run
from arcade_torch.tools.scores import read_scores
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from tests.tools.fabricated import small_study, write_study


@pytest.mark.parametrize(
    "changes",
    [
        {"returns": 5},
        {"returns": [[1]]},
        {"returns": [10**400]},
        {"mean": {}},
        {"lengths": [0.5]},
        {"frames": "x"},
        {"frames": -1},
        {"seconds": -0.5},
        {"lengths": [3, 4]},
        {"returns": [], "lengths": []},
        {"status": "interrupted"},
    ],
)
def test_a_final_evaluation_with_other_things_than_numbers_is_made_again(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    good = {"status": "finished", "frames": 64, "seconds": 1.0, "mean": 0.5, "train_max_ewm": 0.5}
    good |= {"returns": [0.5], "lengths": [3]}
    assert is_final(good) and not is_final(good | changes)
    (tmp_path / "eval.json").write_text(json.dumps(good | changes))
    assert RunFolder(tmp_path).finished() is None
    study = write_study(tmp_path / "s", small_study())
    (study.run(small_study().runs()[0]).path / "eval.json").write_text(json.dumps(good | changes))
    assert study.write_results(small_study())[0]["status"] == "unfinished"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": 10**12}, "1 to 10000"),  # would have made the list of them
        ({"total_frames": 10**400}, r"from 1 to 10\*\*15"),
        ({"seeds": [10**400]}, r"below 2\*\*32"),
        ({"games": ["../../x"]}, r"names of folders.*got '\.\./\.\./x'"),
        ({"games": ["CartPoleEasy+SkittlesEasy"]}, r"train --env A\+B trains an agent of several"),
        ({"memories": ["a/b"]}, "names of folders"),
        ({"name": ".."}, "name must be made of letters"),
        ({"settings": 5}, "settings must be a mapping of option names"),
        ({"settings": {"--out": "x y"}, "preset": None}, "preset must be a string"),
        ({"question": 5}, "question must be a string"),
    ],
)
def test_a_study_that_would_hang_or_leave_its_folder_is_refused(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        small_study(**changes)


def test_a_study_that_is_no_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a study must be a table"):
        Study.from_dict([1])  # type: ignore[arg-type]
    (tmp_path / "x.toml").write_text("a = [")
    with pytest.raises(ValueError, match="is not TOML"):
        Study.load(tmp_path / "x.toml")


def test_records_of_runs_that_hold_no_table_are_damage(tmp_path: Path) -> None:
    study = write_study(tmp_path, small_study())
    config = study.run(small_study().runs()[0]).path / "config.json"
    values = json.loads(config.read_text())
    for damage in ("[1]", json.dumps({"config": values["config"] | {"seed": {}}})):
        config.write_text(damage)
        with pytest.raises(ValueError, match=r"config\.json"):
            find_runs([study.root])
    config.write_text(json.dumps(values | {"versions": 3.5}))
    assert len(find_runs([study.root]).runs) == 8
    record = json.loads((study.root / "study.json").read_text())
    (study.root / "study.json").write_text(json.dumps(record | {"also": 5}))
    StudyFolder(study.root).claim(small_study())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xff\xfe", "is not CSV in UTF-8"),
        (b"a,b\n1\n", "fewer cells"),
        (b"a,a\n1,2\n", "names a column twice"),
        (b'a,"b\nc"\n1,2\n', "over several lines"),
    ],
)
def test_a_table_that_is_none_is_refused_by_name(tmp_path: Path, data: bytes, message: str) -> None:
    file = tmp_path / "x.csv"
    file.write_bytes(data)
    for read in (read_csv, read_scores, lambda file: read_rows(file, Rate)):
        with pytest.raises(ValueError, match=message):
            read(file)


def test_a_published_table_without_names_or_numbers_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.csv"
    for text, message in (
        ("model,mdp_mean,pomdp_mean\nm,1,2\n", "no column for game"),
        ("model,env,mdp_mean,pomdp_mean\nm,E,x,2\n", "score 'x' is not a number"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_scores(file)


def test_a_file_of_somebody_else_is_not_overwritten_by_a_score(tmp_path: Path) -> None:
    file = tmp_path / "thesis.txt"
    file.write_text("one precious line\n")
    with pytest.raises(ValueError, match="would lose what it holds"):
        append_score(file, dict.fromkeys(COLUMNS, ""))
    assert file.read_text() == "one precious line\n"


@pytest.mark.parametrize(
    ("cell", "value", "message"),
    [
        ("actions", "0a", "actions must be digits from 0 to 4"),
        ("actions", "07", "actions must be digits from 0 to 4"),
        ("seed", "٣", "seed must be a whole number; got '٣'"),
        ("options", "[]", "options must be a JSON object"),
        ("options", "{", "options must be a JSON object"),
    ],
)
def test_a_damaged_line_of_human_scores_is_not_replayed(
    cell: str, value: str, message: str
) -> None:
    row = dict.fromkeys(COLUMNS, "") | {
        "game": "CartPoleEasy-v0",
        "obs_size": "128",
        "rules": "default",
    }
    row |= {"options": "{}", "seed": "0", "actions": "012", "observability": "full"}
    with pytest.raises(ValueError, match=message):
        replay(row | {cell: value})


def test_seeds_that_never_met_make_no_curve(tmp_path: Path) -> None:
    """Seed 0 was seen at 10 and 20 frames, seed 1 at 14 and 16: between 14 and 16 the longest log
    has nothing.
    """
    runs = [Run(tmp_path / name) for name in ("seed0", "seed1")]
    for run, frames in zip(runs, ((10, 12, 20), (14, 16)), strict=True):
        run.path.mkdir()
        rows = "".join(f"{each},0.5,0,8\n" for each in frames)
        (run.path / "eval.csv").write_text(f"frames,mean,std,n\n{rows}")
    group = ("mlp", "MineSweeperEasy", "full")
    assert curves_of_runs({group: runs}) == {}
    assert len(curves_of_runs({group: runs[:1]})) == 1


def test_small_things_that_are_no_text_or_no_json(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_bytes(b"\xff")
    with pytest.raises(ValueError, match="is not text in UTF-8"):
        write_between(page, "a", "b", "c")
    assert name_and_value("x=" + "9" * 5000) == ("x", "9" * 5000)


@pytest.mark.parametrize(("mark", "words"), [(";", "semicolons"), ("\t", "tabs")])
def test_a_table_that_a_spreadsheet_divided_otherwise_says_so(
    tmp_path: Path, mark: str, words: str
) -> None:
    header = mark.join(("agent", "game", "observability", "seed", "score"))
    file = tmp_path / "scores.csv"
    file.write_text(f"{header}\nlru{mark}TetrisEasy{mark}full{mark}0{mark}0,5\n")
    with pytest.raises(ValueError, match=f"more cells .*: it is divided by {words}, wanted are"):
        read_csv(file)
