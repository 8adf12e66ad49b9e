"""The command line: help is quick, bad input is one line with exit code 2, work goes on after an interruption."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from arcade_torch.tools import cli
from arcade_torch.tools.optional import MissingPackage, need
from tests.tools.fabricated import small_study, write_study

ROOT = Path(__file__).resolve().parents[2]


def one_error(capsys: pytest.CaptureFixture[str], words: Sequence[str], code: int = cli.EXIT_BAD_INPUT) -> str:
    """Run in this process, check that stderr is a single line and nothing is on stdout, and return it."""
    assert cli.main(words) == code
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and err.startswith("arcade-torch: "), err
    return err


def test_help_is_quick_and_loads_neither_torch_nor_jax() -> None:
    code = "import sys; from arcade_torch.tools.cli import main; main(['--help']); print(sorted(sys.modules))"
    start = time.perf_counter()
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert time.perf_counter() - start < 10  # a tenth of a second on an idle machine
    for heavy in ("'torch'", "'jax'", "'numpy'", "'tyro'"):
        assert heavy not in result.stdout
    assert "analyze gap-bias" in result.stdout


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_explains_itself_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*name.split(), "--help"]) == cli.EXIT_OK
    text = " ".join(capsys.readouterr().out.split())
    assert f"usage: arcade-torch {name}" in text
    assert f"Example: arcade-torch {name}" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "did you mean 'train'?"),
        (["analyze"], "followed by gap-bias or saliency"),
        (["analyze", "gap"], "not 'gap'"),
        (["train", "--preset", "huge"], "unknown preset 'huge'"),
        (["train", "--total-frame", "5"], "Unrecognized options: --total-frame, 5; perhaps you meant --total-frames"),
        (["train", "--seed", "x"], "invalid literal for int() with base 10: 'x'"),
        (["train", "--observability", "half"], "invalid choice 'half'"),
        (["train", "--pqn.gamma", "2"], "pqn.gamma"),
        (["train", "--env-option", "wind"], "NAME=VALUE"),
        (["evaluate"], "Missing from arcade-torch evaluate"),
        (["evaluate", "no/such/run"], "no/such/run"),
        (["study", "no/such.toml"], "no study at no/such.toml"),
        (["report", "no/such/study"], "not the folder of a study"),
        (["analyze", "gap-bias"], "name at least one"),
        (["analyze", "gap-bias", "no/such.csv"], "does not exist"),
        (["analyze", "gap-bias", "README.md", "--confidence", "2"], "between 0 and 1"),
        (["bench", "envs", "--out", "x.txt"], "must end in .csv or .json"),
        (["bench", "envs", "--batches", "0"], "at least 1 env"),
        (["demo", "--seeds", "0"], "seeds must be at least 1"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in one_error(capsys, words)
    assert not list(tmp_path.iterdir())


def test_an_unknown_game_is_named_with_the_nearest(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["train", "--preset", "smoke", "--env", "MineSweperEasy", "--out", str(tmp_path / "run")]
    assert "did you mean 'MineSweeperEasy'" in one_error(capsys, words)
    assert not (tmp_path / "run").exists()


def test_a_taken_run_folder_is_left_alone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert "not empty" in one_error(capsys, ["train", "--preset", "smoke", "--out", str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_corrupt_checkpoint_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "checkpoints" / "frames-000000000001").mkdir(parents=True)
    (tmp_path / "checkpoints" / "frames-000000000001" / "meta.json").write_text("{")
    assert "is damaged" in one_error(capsys, ["evaluate", str(tmp_path)])


def test_a_corrupt_study_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "study.json").write_text("{")
    assert "is not valid JSON" in one_error(capsys, ["report", str(tmp_path)])
    (tmp_path / "study.json").write_text('{"study": {"name": "x"}}')
    assert "does not describe a study" in one_error(capsys, ["report", str(tmp_path)])


def test_a_missing_package_is_named_with_its_extra(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_study(tmp_path / "s", small_study())
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert "pip install 'arcade-torch[tools]'" in one_error(capsys, ["report", str(tmp_path / "s")])
    with pytest.raises(MissingPackage, match="the package jinja2 is missing"):
        need("jinja2")


def test_a_missing_option_parser_is_named_too() -> None:
    code = "import sys; sys.modules['tyro'] = None; from arcade_torch.tools.cli import main; sys.exit(main(['list']))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 2
    assert result.stderr == "arcade-torch: the package tyro is missing: pip install 'arcade-torch[tools]'\n"


def test_a_bug_is_an_internal_error_and_debug_shows_where(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import list as command

    def broken(self: object) -> int:
        return 1 // 0

    monkeypatch.setattr(command.List, "run", broken)
    assert "internal error: ZeroDivisionError" in one_error(capsys, ["list"], cli.EXIT_FAILED)
    with pytest.raises(ZeroDivisionError):
        cli.main(["list", "--debug"])


def test_an_interruption_says_how_to_go_on(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from arcade_torch.tools.commands import demo as command

    def interrupted(self: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(command.Demo, "run", interrupted)
    said = one_error(capsys, ["demo", "--frames", "4096", "--out", "runs/a b"], cli.EXIT_INTERRUPTED)
    again = "arcade-torch demo --game SignpostEasy --frames 4096 --seeds 4 --out 'runs/a b'"
    assert f"go on from their checkpoints with: {again}" in said


def test_options_given_count_even_where_they_equal_the_presets_and_2e5_is_a_number() -> None:
    from arcade_torch.tools.commands.train import parse

    words = ["--preset", "small", "--total-frames", "2e4", "--eval-every", "40_000", "--pqn.lam", "0.5"]
    config = parse([*words, "--env-option", "noise=0.5", "--network-option", "skip=residual"], "train").config
    assert (config.total_frames, config.eval_every, config.pqn.lam) == (20_000, 40_000, 0.5)
    assert config.pqn.num_envs == 64  # of the preset
    assert (dict(config.env_options), config.network_options["skip"]) == ({"noise": 0.5}, "residual")


def test_a_dry_run_prints_the_command_of_every_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "grid.toml"
    file.write_text('games = ["CartPoleEasy"]\nmemories = ["mlp"]\nseeds = 2\n')
    assert cli.main(["study", str(file), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    assert capsys.readouterr().out.count("arcade-torch train --preset paper --env CartPoleEasy") == 4
    assert not (tmp_path / "out").exists()


def test_gap_bias_prints_and_saves_its_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    write_study(tmp_path / "s", small_study())
    out = tmp_path / "table.csv"
    assert cli.main(["analyze", "gap-bias", str(tmp_path / "s"), "--draws", "50", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "mingru" in text and "measured coverage" in text
    assert out.read_text().startswith("agent,without,seeds,mdp_raw")


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("arcade-torch ")
