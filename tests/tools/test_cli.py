"""The command line: help is quick, bad input is one line with exit code 2, work goes on after an
interruption.
"""

import json
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import tyro

from arcade_torch.agents import preset
from arcade_torch.tools import cli
from arcade_torch.tools.commands.train import Train
from arcade_torch.tools.errors import MissingPackage, need
from arcade_torch.tools.options import whole_number
from tests.own_registry import own_registry  # noqa: F401
from tests.tools.fabricated import small_study, write_study

ROOT = Path(__file__).resolve().parents[2]


def one_error(
    capsys: pytest.CaptureFixture[str], words: Sequence[str], code: int = cli.EXIT_BAD_INPUT
) -> str:
    """Run in this process, check that stderr is a single line and nothing is on stdout, and return
    it.
    """
    assert cli.main(words) == code
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and err.startswith("arcade-torch: "), err
    return err


def test_help_is_quick_and_loads_neither_torch_nor_jax() -> None:
    code = (
        "import sys; from arcade_torch.tools.cli import main; main(['--help']); "
        "print(sorted(sys.modules))"
    )
    start = time.perf_counter()
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert time.perf_counter() - start < 10  # a third of a second on an idle machine
    # NumPy comes with Gymnasium, in whose registry the games stand.
    for heavy in (
        "'torch'",
        "'jax'",
        "'tyro'",
    ):
        assert heavy not in result.stdout
    assert "analyze gap-bias" in result.stdout


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_explains_itself_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*name.split(), "--help"]) == cli.EXIT_OK
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"usage: arcade-torch {name}" in text
    assert f"Example: arcade-torch {name}" in text
    assert not re.findall(r"(--[\w.-]*\w)(?: [A-Z]+)? \(default", text), "an option without a word"
    # under --no-report, "Write the report. (default: True)" would say what the option does not do
    options = text.partition(" -h, --help ")[2]  # usage and description stand above
    assert set(re.findall(r"\B--no-[\w-]+ (\w+)", options)) <= {"Whether"}
    for option in re.findall(r"\B--(no-.*?)(?= --|$)", options):
        assert "(default" not in option, "of what the option switches off: it reads as its own"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "did you mean 'train'?"),
        (["analyze"], "followed by gap-bias or saliency"),
        (["analyze", "gap"], "did you mean 'gap-bias'?"),
        (["analyze", "zzz"], "not 'zzz'"),
        (["train", "--preset", "huge"], "unknown preset 'huge'"),
        (
            ["train", "--total-frame", "5"],
            "Unrecognized options: --total-frame, 5; perhaps you meant --total-frames",
        ),
        (["train", "--seed", "x"], "'x' is no whole number"),
        (["train", "--env-option", "nonsense=1", "--env", "CartPoleEasy"], "nonsense"),
        (["study", "--preset", "demo", "--shard", "3"], "a shard is written 3/10"),
        (["train", "--observability", "half"], "invalid choice 'half'"),
        (["train", "--pqn.gamma", "2"], "pqn.gamma"),
        (["train", "--env-option", "wind"], "NAME=VALUE"),
        (["evaluate"], "Missing from arcade-torch evaluate"),
        (["evaluate", "no/such/run"], "no/such/run"),
        (["study", "no/such.toml"], "no study at no/such.toml"),
        (["report", "no/such/study"], "not the folder of a study"),
        (["analyze", "gap-bias"], "name at least one"),
        (["analyze", "gap-bias", "no/such.csv"], "does not exist"),
        (["analyze", "gap-bias", str(ROOT / "README.md"), "--confidence", "2"], "between 0 and 1"),
        (
            ["bench", "envs", "--out", "x.txt"],
            "--out must be a file that ends in .csv or .json; got 'x.txt'",
        ),
        (["bench", "envs", "--batches", "0"], "--batches must be at least 1"),
        (["bench", "envs", "--repeats", "0"], "--repeats must be at least 1"),
        (["bench", "memory", "--repeats", "0"], "--repeats must be at least 1"),
        (["bench", "recall", "--seed", "-1"], "--seed must be at least 0"),
        (
            ["bench", "recall", "--out", "x.json"],
            "--out must be a file that ends in .csv; got 'x.json'",
        ),
        (["analyze", "recall-density", ".", "--seed", "-1"], "--seed must be at least 0"),
        (["analyze", "contamination", ".", "--seed", "-1"], "--seed must be at least 0"),
        (["bench", "envs", "--batches", "1" + "0" * 30], "--batches must be at most 1,048,576"),
        (["bench", "envs", "--seconds", "nan"], "--seconds must be at least 0, got nan"),
        (["bench", "envs", "--seconds", "inf"], "--seconds must be at most"),
        (["bench", "recall", "--seed", "1" + "0" * 30], "--seed must be at most"),
        (["list", "baselines", "CartPoleEasy", "--seconds", "nan"], "--seconds must be at least 0"),
        (
            ["record", "CartPoleEasy", "--out", "x.gif", "--scale", "1" + "0" * 30],
            "--scale must be at most 32",
        ),
        (["record", "CartPoleEasy", "--out", "x.gif", "--fps", "nan"], "--fps must be"),
        (["train", "--preset", "smoke", "--wait", "nan"], "--wait must be at least 0"),
        (["train", "--preset", "smoke", "--seed", ""], "'' is no whole number"),
        (["train", "--preset", "smoke", "--seed=-1"], "seed"),
        (["train", "--preset", "smoke", "--seed", "1" + "0" * 30], "seed"),
        pytest.param(
            ["record", "SignpostEasy", "--out", "-x.gif"],
            "a value that begins with - is written --out=-x.gif",
            marks=pytest.mark.skipif(
                tyro.__version__ == "1.0.0", reason="this release of tyro takes such a value"
            ),
        ),
        (["demo", "--seeds", "0"], "give the number of seeds (1 to 10000)"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in one_error(capsys, words)
    assert not list(tmp_path.iterdir())


def test_a_current_folder_that_was_removed_is_told_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the current folder is not there any more" in one_error(capsys, ["list", "envs"])


def test_an_unknown_game_is_named_with_the_nearest(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = [
        "train",
        "--preset",
        "smoke",
        "--env",
        "MineSweperEasy",
        "--out",
        str(tmp_path / "run"),
    ]
    assert "did you mean 'MineSweeperEasy'" in one_error(capsys, words)
    assert not (tmp_path / "run").exists()


def test_a_taken_run_folder_is_left_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert "not empty" in one_error(capsys, ["train", "--preset", "smoke", "--out", str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_corrupt_checkpoint_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "checkpoints" / "frames-000000000001").mkdir(parents=True)
    (tmp_path / "checkpoints" / "frames-000000000001" / "meta.json").write_text("{")
    assert "is damaged" in one_error(capsys, ["evaluate", str(tmp_path)])


def test_a_corrupt_study_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "study.json").write_text("{")
    assert "does not hold JSON" in one_error(capsys, ["report", str(tmp_path)])
    (tmp_path / "study.json").write_text('{"study": {"name": "x"}}')
    assert "does not describe a study" in one_error(capsys, ["report", str(tmp_path)])


def test_a_missing_package_is_named_with_its_extra(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_study(tmp_path / "s", small_study())
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert "pip install '.[tools]'" in one_error(capsys, ["report", str(tmp_path / "s")])
    with pytest.raises(MissingPackage, match="the package jinja2 is missing"):
        need("jinja2")


def test_a_missing_option_parser_is_named_too() -> None:
    code = (
        "import sys; sys.modules['tyro'] = None; from arcade_torch.tools.cli import main; "
        "sys.exit(main(['list']))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert result.returncode == 2
    assert result.stderr == "arcade-torch: the package tyro is missing: pip install '.[tools]'\n"


@pytest.mark.parametrize(
    "fault",
    [
        lambda: 1 // 0,
        lambda: int("x"),
        lambda: {}["x"],
        lambda: whole_number(None),  # a TypeError out of a library
        lambda: cli.split_command(None),  # a TypeError in our own code
        lambda: json.loads("x"),  # a ValueError out of a library
    ],
)
def test_a_fault_of_ours_shows_its_traceback_and_exits_with_1(
    fault: Callable[[], Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import list as command

    monkeypatch.setattr(command.List, "run", lambda self: fault())
    assert cli.main(["list"]) == cli.EXIT_FAILED
    said = capsys.readouterr().err
    assert said.startswith("arcade-torch: this is a fault of arcade-torch") and "Traceback" in said
    assert "test_cli.py" in said
    with pytest.raises((ArithmeticError, TypeError, ValueError, KeyError)):
        cli.main(["list", "--debug"])


@pytest.mark.usefixtures("own_registry")
def test_a_failure_below_what_was_imported_is_not_called_ours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import list as command

    (tmp_path / "mine.py").write_text(
        "import arcade_torch.tools\narcade_torch.tools.broken = lambda: 1 // 0\n"
    )
    monkeypatch.setattr(
        command.List, "run", lambda self: sys.modules["arcade_torch.tools"].broken()
    )
    assert cli.main(["list", "--import", str(tmp_path / "mine.py")]) == cli.EXIT_FAILED
    said = capsys.readouterr().err
    assert (
        said.startswith(f"arcade-torch: {tmp_path / 'mine.py'} failed:\n")
        and "ZeroDivisionError" in said
    )


@pytest.mark.usefixtures("own_registry")
@pytest.mark.parametrize("code", ["0", "None", "3", "'no data'"])
def test_a_program_that_ends_in_the_middle_of_its_work_has_failed(
    code: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A memory model that called ``sys.exit`` ended a whole study without a word, with 0 as if it
    were done.
    """
    from arcade_torch.tools.commands import list as command

    text = f"import arcade_torch.tools\ndef ends(): raise SystemExit({code})\n"
    (tmp_path / "mine.py").write_text(f"{text}arcade_torch.tools.ends = ends\n")
    monkeypatch.setattr(command.List, "run", lambda self: sys.modules["arcade_torch.tools"].ends())
    assert cli.main(["list", "--import", str(tmp_path / "mine.py")]) == cli.EXIT_FAILED
    said = capsys.readouterr().err
    assert said.startswith(f"arcade-torch: {tmp_path / 'mine.py'} failed:\n"), said
    assert "in ends\n" in said and "SystemExit" in said.splitlines()[-1]


@pytest.mark.parametrize("words", ["the last layer\nis broken", "the last layer is broken"])
def test_the_last_line_of_a_traceback_says_why_in_one_line(
    words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A study keeps that line: of a run in a process it kept the note of tensordict below it,
    "Failed while executing module '0'.".
    """
    from arcade_torch.tools.commands import list as command

    def fails(self: object) -> int:
        error = RuntimeError(words)
        error.add_note("Failed while executing module '0'.")
        raise error

    monkeypatch.setattr(command.List, "run", fails)
    assert cli.main(["list"]) == cli.EXIT_FAILED
    last = "arcade-torch: RuntimeError: the last layer is broken"
    assert capsys.readouterr().err.splitlines()[-1] == last


def test_an_interruption_says_how_to_go_on(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import study as command

    def interrupted(self: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(command.Demo, "run", interrupted)
    said = one_error(
        capsys, ["demo", "--frames", "4096", "--out", "runs/a b"], cli.EXIT_INTERRUPTED
    )
    assert said.endswith(
        "go on from their checkpoints with: arcade-torch demo --frames 4096 --out 'runs/a b'\n"
    )


@pytest.mark.usefixtures("own_registry")
@pytest.mark.parametrize(
    "words",
    [
        ["demo", "--workers", "3", "--seeds", "2"],
        [
            "study",
            "--preset",
            "demo",
            "--workers",
            "3",
            "--no-report",
            "--engine",
            "inline",
            "--shard",
            "1/2",
        ],
        ["train", "--preset", "smoke", "--env", "PairsEasy", "--out", "1e3", "--resume"],
    ],
)
def test_the_hint_after_an_interruption_keeps_every_option(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.command_class(words[0]), "run", interrupted)
    own_game = str(ROOT / "examples/own_game.py")
    said = one_error(capsys, [*words, "--import", own_game], cli.EXIT_INTERRUPTED)
    assert said.endswith(f": arcade-torch {' '.join(words)} --import {own_game}\n")


def test_a_resume_without_a_run_says_that_one_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "--preset", "smoke", "--total-frames", "128", "--out", str(tmp_path / "run")]
    said = []
    for _ in range(2):
        assert cli.main([*words, "--resume"]) == 0
        said.append(capsys.readouterr().out)
    assert "/run to go on with: this one begins" in said[0]
    assert "this one begins" not in said[1]


def test_a_resume_that_waits_says_what_it_then_finds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: a second one said that no run is there and this one begins, waited, and went on with
    the run that was there then.
    """
    out = tmp_path / "run"
    words = ["train", "--preset", "smoke", "--total-frames", "128", "--out", str(out), "--resume"]
    assert cli.main(words) == 0
    out.rename(tmp_path / "elsewhere")
    capsys.readouterr()

    def wait(path: Path, limit_s: float) -> None:
        (tmp_path / "elsewhere").rename(path)

    monkeypatch.setattr("arcade_torch.agents.runs.folder.wait_until_free", wait)
    assert cli.main([*words, "--wait", "60"]) == 0
    assert "this one begins" not in capsys.readouterr().out


def test_options_given_count_even_where_they_equal_the_presets_and_2e5_is_a_number() -> None:
    words = [
        "--preset",
        "small",
        "--total-frames",
        "2e4",
        "--eval-every",
        "40_000",
        "--ppo.lam",
        "0.5",
    ]
    config = Train.parse(
        [*words, "--env-option", "noise=0.5", "--network-option", "skip=residual"], "train"
    ).settings
    assert (config.total_frames, config.eval_every, config.ppo.lam) == (20_000, 40_000, 0.5)
    assert config.ppo.num_envs == 64  # of the preset
    assert (dict(config.env_options), config.network_options["skip"]) == (
        {"noise": 0.5},
        "residual",
    )


@pytest.mark.skipif(tyro.__version__ == "1.0.0", reason="this release takes such a word for a path")
@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "-run"],
        ["evaluate", "--", "-run", "--episodes", "4"],
        ["analyze", "saliency", "-run"],
    ],
)
def test_a_path_that_begins_with_a_dash_is_said_to_need_its_folder(
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "./-run" not in one_error(capsys, words)
    (tmp_path / "-run").mkdir()
    assert "; a path that begins with - is written ./-run (see " in one_error(capsys, words)


def test_a_warning_that_was_made_an_error_is_told_as_such(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import list as command

    def warn(self: Any) -> None:
        warnings.warn("this goes away", DeprecationWarning, stacklevel=1)

    monkeypatch.setattr(command.List, "run", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cli.main(["list"]) == cli.EXIT_FAILED
    said = capsys.readouterr().err
    assert said.startswith(
        "arcade-torch: Python was told to stop at warnings (-W error, PYTHONWARN"
    )
    assert "DeprecationWarning: this goes away" in said and said.count("\n") == 1


def test_a_transfer_that_jax_is_told_to_forbid_is_told_as_such(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from arcade_torch.tools.commands import list as command

    def put(self: Any) -> None:
        with jax.transfer_guard("disallow"):
            jax.jit(lambda x: x + 1)(np.float32(0))

    monkeypatch.setattr(command.List, "run", put)
    said = one_error(capsys, ["list"], cli.EXIT_FAILED)
    assert "unset JAX_TRANSFER_GUARD (INVALID_ARGUMENT: Disallowed host-to-device transfer" in said


def test_a_folder_may_be_called_like_a_number() -> None:
    parsed = Train.parse(["--preset", "smoke", "--out", "1e3", "--seed", "1e3"], "train")
    assert (parsed.out, parsed.settings.seed) == (Path("1e3"), 1000)


def test_a_run_can_start_from_the_config_of_another_and_change_it(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    config = preset("smoke", env="SignpostEasy", pqn={"lam": 0.5})
    for content in (config.to_dict(), {"config": config.to_dict(), "versions": {}}):
        file.write_text(json.dumps(content))
        assert Train.parse(["--config", str(file)], "train").settings == config
    changed = Train.parse(
        ["--config", str(file), "--seed", "3", "--pqn.gamma", "0.5"], "train"
    ).settings
    assert changed == preset("smoke", env="SignpostEasy", seed=3, pqn={"lam": 0.5, "gamma": 0.5})


def test_a_config_file_that_is_none_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "config.json"
    assert "no config at" in one_error(capsys, ["train", "--config", str(file)])
    for content, message in (
        ("{", "does not hold JSON"),
        ("[]", "holds no config"),
        ('{"x": 1}', "unknown field 'x'"),
        ('{"format": 2, "config": {}, "seed": 1}', "looked at: seed; move them into it"),
    ):
        file.write_text(content)
        assert message in one_error(capsys, ["train", "--config", str(file)])
    assert "not both" in one_error(capsys, ["train", "--config", str(file), "--preset", "smoke"])


def test_a_dry_run_prints_every_run_with_its_frames(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "grid.toml"
    file.write_text('games = ["CartPoleEasy"]\nmemories = ["mlp"]\nseeds = 2\n')
    assert cli.main(["study", str(file), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    out, err = capsys.readouterr()
    assert (
        out.splitlines()[0] == "CartPoleEasy__full__mlp__pqn__seed0  9,998,336 frames"
        and len(out.splitlines()) == 4
    )
    assert err == "4 runs, 39,993,344 frames in all\n"
    assert not (tmp_path / "out").exists()


def test_gap_bias_prints_and_saves_its_table(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    write_study(tmp_path / "s", small_study())
    out = tmp_path / "table.csv"
    assert (
        cli.main(["analyze", "gap-bias", str(tmp_path / "s"), "--draws", "50", "--out", str(out)])
        == 0
    )
    text = capsys.readouterr().out
    assert "mingru" in text and "measured coverage" in text
    assert out.read_text().startswith("agent,without,seeds,mdp_raw")


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("arcade-torch ")


def test_a_home_that_the_shell_left_alone_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: ``--out=~/x`` wrote into a folder that is called ``~``."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", "memory", "at_home", "--out=~/at_home.py"]) == cli.EXIT_OK
    assert (tmp_path / "home/at_home.py").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["home"]
    capsys.readouterr()
    err = one_error(capsys, ["list", "--import=~/no_such.py"])
    assert f"{tmp_path}/home/no_such.py: there is no such file" in err


@pytest.mark.parametrize("columns", [80, 60])
def test_the_page_of_commands_fits_a_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: up to 110 letters a line, whatever the terminal."""
    monkeypatch.setenv("COLUMNS", str(columns))
    assert cli.main(["--help"]) == cli.EXIT_OK
    table = capsys.readouterr().out.partition("in them.")[2].partition("arcade-torch COMMAND")[0]
    assert max(map(len, table.splitlines())) <= columns


def test_an_option_that_every_algorithm_has_is_suggested_for_each(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before: --dqn.num-envs alone, which a training by PPO refuses."""
    err = one_error(capsys, ["train", "--num-envs", "16"])
    assert "perhaps you meant --dqn.num-envs or --ppo.num-envs or --pqn.num-envs (see" in err
    assert "perhaps you meant --memory (see" in one_error(capsys, ["train", "--memry", "lru"])
