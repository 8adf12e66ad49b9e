"""Benchmark files: what is written is read back, and two of them are compared number by number."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.bench.registry import SIZES, TABLES, compare, page, read_results
from tests.tools.test_cli import one_error

RESULTS: dict[str, Any] = {
    "format": 1,
    "machine": {"processor": "x86_64", "cores": 2},
    "size": "tiny",
    "settings": {"envs": {"games": ["G"], "threads": 2}, "memory": {"batch": 16, "threads": 1}},
    "tables": {
        "envs": {
            "rows": [
                {
                    "game": "G",
                    "obs_size": 128,
                    "num_envs": 16,
                    "measure": "env",
                    "frames_per_s": 1000.0,
                },
                {
                    "game": "G",
                    "obs_size": 128,
                    "num_envs": 32,
                    "measure": "env",
                    "frames_per_s": 2000.0,
                },
            ]
        },
        "scans": {
            "rows": [
                {"form": "a|b", "steps": 8, "numbers": "real", "forward_ms": 2.0, "both_ms": 4.0}
            ]
        },
    },
}


def changed(**numbers: float) -> dict[str, Any]:
    """The same results with other numbers in the first row that has them."""
    results = copy.deepcopy(RESULTS)
    for column, value in numbers.items():
        next(row for table in results["tables"].values() for row in table["rows"] if column in row)[
            column
        ] = value
    return results


def written(path: Path, value: Any) -> Path:
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_a_result_equals_itself() -> None:
    found = compare(RESULTS, RESULTS, 0.01)
    assert len(found.pop("same")) == 4 and not any(found.values())


@pytest.mark.parametrize(
    ("numbers", "verdict"),
    [
        ({"frames_per_s": 790.0}, "worse"),  # more is better
        ({"frames_per_s": 810.0}, "same"),
        ({"frames_per_s": 1240.0}, "same"),
        ({"frames_per_s": 1260.0}, "better"),
        ({"frames_per_s": 0.0}, "worse"),
        ({"forward_ms": 2.6}, "worse"),  # less is better
        ({"forward_ms": 2.4}, "same"),
        ({"forward_ms": 1.5}, "better"),
        ({"forward_ms": 0.0}, "better"),
    ],
)
def test_a_rate_that_falls_and_a_time_that_grows_are_worse(
    numbers: dict[str, float], verdict: str
) -> None:
    found = compare(RESULTS, changed(**numbers), 0.2)
    assert {name: len(lines) for name, lines in found.items() if lines} == (
        {"same": 4} if verdict == "same" else {"same": 3, verdict: 1}
    )


def test_comparing_backwards_turns_better_into_worse() -> None:
    (forth,) = compare(RESULTS, changed(both_ms=8.0), 0.2)["worse"]
    (back,) = compare(changed(both_ms=8.0), RESULTS, 0.2)["better"]
    assert forth.endswith("both_ms 4 -> 8 ms (x 0.50)") and back.endswith(
        "both_ms 8 -> 4 ms (x 2.00)"
    )


def test_the_command_names_what_is_worse_missing_and_new_and_exits_with_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = changed(frames_per_s=500.0)
    new["machine"]["cores"] = 4
    new["settings"] = {"memory": {"batch": 64, "threads": 1}, "train": {"threads": 1}}
    new["tables"]["scans"]["rows"][0]["steps"] = 16
    old, other = written(tmp_path / "old.json", RESULTS), written(tmp_path / "new.json", new)
    assert cli.main(["bench", "compare", str(old), str(other)]) == cli.EXIT_FAILED
    said = capsys.readouterr().out
    assert "not the same machine: cores 2 and 4\n" in said
    assert "not the same settings of memory: batch 16 and 64\n" in said
    assert (
        "worse: envs: game G, obs_size 128, num_envs 16, measure env: frames_per_s 1,000 -> 500 "
        "frames/s" in said
    )
    assert said.count("missing: scans") == 2 and said.count("new: scans") == 2
    assert said.endswith("1 same, 1 worse, 0 better, 2 missing, 2 new\n")
    assert cli.main(["bench", "compare", str(old), str(other), "--tolerance", "0.6"]) == cli.EXIT_OK
    assert cli.main(["bench", "compare", str(old), str(old)]) == cli.EXIT_OK


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("", "does not hold JSON"),
        ("[" * 100_000, "does not hold JSON"),
        ("9" * 5000, "does not hold JSON"),
        ([], "is no file of `arcade-torch bench all`"),
        (RESULTS | {"format": 2}, "is no file of `arcade-torch bench all` in format 1"),
        (RESULTS | {"machine": None}, "does not say on which machine"),
        (RESULTS | {"settings": {"envs": 1}}, "settings must be a table of options"),
        (RESULTS | {"tables": {"cooking": {"rows": []}}}, "unknown table 'cooking'"),
        (RESULTS | {"tables": {"envs": []}}, "has no list of rows"),
        (RESULTS | {"tables": {"envs": {"rows": [1]}}}, "has no list of rows"),
        (
            RESULTS | {"tables": {"envs": {"rows": [{"game": "G"}]}}},
            "a row of table envs has no obs_size",
        ),
        (changed(frames_per_s=float("nan")), "frames_per_s is nan, wanted a number"),
        (changed(frames_per_s=-1.0), "frames_per_s is -1.0, wanted a number"),
        (changed(num_envs=32), "has two rows for game G, obs_size 128, num_envs 32"),
    ],
)
def test_a_file_that_is_none_is_refused_in_one_line(
    value: Any, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = written(tmp_path / "good.json", RESULTS), written(tmp_path / "bad.json", value)
    for words in ([str(good), str(bad)], [str(bad), str(good)]):
        assert message in one_error(capsys, ["bench", "compare", *words])
    assert "does not exist" in one_error(
        capsys, ["bench", "compare", str(good), str(tmp_path / "none.json")]
    )
    assert "between 0 and 1" in one_error(
        capsys, ["bench", "compare", str(good), str(good), "--tolerance", "1.5"]
    )


def test_the_page_has_a_table_each_and_hostile_names_stay_in_their_cells() -> None:
    text = page(RESULTS)
    assert text.count("\n## ") == 2
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert any("a\\|b" in row for row in rows)
    assert "| G | 128 | 16 | env | 1,000 |" in rows
    assert "- memory: batch 16, threads 1\n" in text


def test_a_file_from_before_settings_were_kept_is_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    older = {name: value for name, value in RESULTS.items() if name != "settings"}
    old = written(tmp_path / "old.json", older)
    new = written(tmp_path / "new.json", RESULTS)
    assert cli.main(["bench", "compare", str(old), str(new)]) == cli.EXIT_OK
    assert "not the same" not in capsys.readouterr().out


def test_a_benchmark_says_at_what_size_and_on_how_many_threads_it_ran(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["bench", "memory"]
    for name, value in SIZES["tiny"]["memory"].items():
        values = value if isinstance(value, tuple) else [value]
        words += [f"--{name}", *map(str, values)]
    for threads in (1, 2):
        out = tmp_path / f"{threads}.json"
        assert cli.main([*words, "--threads", str(threads), "--out", str(out)]) == cli.EXIT_OK
        said = capsys.readouterr().out
        assert f"threads {threads}" in said and "torch_threads" not in said
        assert "size 8" in said and "batch 2" in said
        settings = read_results(out)["settings"]["memory"]
        assert (settings["size"], settings["batch"], settings["threads"]) == (8, 2, threads)
    table = tmp_path / "table.csv"
    assert cli.main([*words, "--out", str(table)]) == cli.EXIT_OK
    (row, *_) = read_csv(tmp_path / "table_models.csv")
    assert (row["steps"], row["size"], row["batch"], row["threads"]) == ("8", "8", "2", "1")


def test_a_tiny_benchmark_of_everything_is_written_read_and_equals_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bench.json"
    assert cli.main(["bench", "all", "--size", "tiny", "--out", str(out)]) == 0
    results = read_results(out)
    # the tests that tell memories apart are asked for by name
    assert set(results["tables"]) == set(TABLES) - {"memory_tests"}
    assert results["machine"]["torch"]
    assert (
        results["machine"]["keep_memory"] == "train"
    )  # the others show what a loop of your own gets
    assert page(results) == out.with_suffix(".md").read_text()
    capsys.readouterr()
    assert cli.main(["bench", "compare", str(out), str(out)]) == 0
    assert " 0 worse" in capsys.readouterr().out
