"""What a study's own report would refuse is refused before anything runs; a report that fails can
be written again.
"""

import codecs
import os
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.tools import cli
from arcade_torch.tools.commands import study as command
from arcade_torch.tools.studies.engines import Inline
from arcade_torch.tools.studies.grid import STUDY_PRESETS, Study, study_preset
from arcade_torch.tools.studies.runner import planned, study
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_study import Fabricator, change_config

TOML = 'games = "SignpostEasy"\nmemories = ["mlp", "lru"]\nseeds = 1\npreset = "smoke"\n'


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"games": ["SignpostEasy", "SignpostEasy-v0"]},
            "SignpostEasy, SignpostEasy-v0 are one game",
        ),
        (
            {"games": ["NoisyCartPoleEasy", "NoisyPoleEasy"]},
            "NoisyCartPoleEasy, NoisyPoleEasy are one game",
        ),
        ({"games": ["NoisyCartPoleEasy-v0", "TetrisEasy", "NoisyPoleEasy-v0"]}, "are one game"),
        (
            {"memories": ["mlp", "fart", "linear_transformer"]},
            "fart, linear_transformer are one memory model",
        ),
        (
            {"baseline": "gru"},
            "baseline = 'gru' is none of the agents that this study trains, mingru, mlp",
        ),
        ({"baseline": ""}, "baseline = '' is none"),
        (
            {"baseline": "pqn-mlp"},
            "baseline = 'pqn-mlp' is none of the agents that this study trains",
        ),
        (
            {"baseline": "ppo-gru", "algorithms": ["pqn", "ppo"]},
            "this study trains, pqn-mingru, pqn-mlp, ppo-mingru",
        ),
        (
            {"sizes": ["1x8"], "settings": {"network_options": {"layers": 2}}},
            "settings may not hold network_options.layers: in this study the key sizes decides it",
        ),
        (
            {"sizes": ["1x8"], "settings": {"network_options": {"hidden_size": 2}}},
            "settings may not hold network_options.hidden_size: in this study the key sizes",
        ),
        (
            {"settings": {"network_options": {"zork": 1}}},
            "unknown network option zork; allowed are encoder, hidden_size",
        ),
        (
            {"settings": {"network_options": {"hidden_size": -1}}},
            "hidden_size must be at least 1 and at most 32768, got -1",
        ),
        ({"sizes": ["1x99999"]}, "hidden_size must be at least 1 and at most 32768, got 99999"),
        (
            {"settings": {"network_options": {"memory_options": {"zork": 1}}}},
            "memory 'mingru' has other options: got an unexpected keyword argument 'zork'",
        ),
        (
            {
                "memories": ["frame_stack", "mlp"],  # the first has such an option
                "settings": {"network_options": {"memory_options": {"frames": 7}}},
            },
            "memory 'mlp' has other options: got an unexpected keyword argument 'frames'",
        ),
        ({"settings": {"network": "zork"}}, "unknown network 'zork': known are paper, small"),
        ({"settings": {"env_options": {"zork": 1}}}, "has no option 'zork'"),
        ({"settings": {"obs_size": 48}}, "obs_size is 48, allowed: 128, 256"),
        ({"settings": {"rules": "zork"}}, "rules must be 'default' or 'reference'; got 'zork'"),
        ({"observability": "both"}, "must be full or partial, or a list of the two"),
        ({"memories": ["mlp", "mlp"]}, "memories names something twice"),
        ({"seeds": [0, 1, 1.0]}, "seeds names something twice"),
        ({"observability": ["full", "full"]}, "observability names something twice"),
        ({"algorithms": ["pqn", "pqn"]}, "algorithms names something twice"),
    ],
)
def test_what_the_report_would_refuse_is_refused_before_anything_runs(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as refusal:
        study(small_study(**changes), tmp_path / "s", Fabricator(small_study()))
    assert not (tmp_path / "s").exists() and "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"baseline": "MLP"},
        {"baseline": "mingru"},
        {"memories": ["mingru"]},  # the default baseline is not asked for
        {"baseline": "pqn-mlp", "algorithms": ["pqn", "ppo"]},
        {"games": ["SignpostEasy-v0", "SignpostHard"]},
        {"memories": ["mlp", "feedforward", "fart"]},
    ],
)
def test_other_studies_are_planned(changes: dict[str, Any]) -> None:
    assert planned(small_study(**changes))


def test_ready_made_studies_are_planned() -> None:
    for name in STUDY_PRESETS:
        assert planned(study_preset(name), "1/50")


def test_a_baseline_that_a_file_asks_for_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "one.toml"
    file.write_text(TOML.replace('"mlp", ', "") + 'baseline = "mlp"\n')
    assert cli.main(["study", str(file), "--out", str(tmp_path / "s")]) == 2
    said = capsys.readouterr().err
    assert (
        "baseline = 'mlp' is none of the agents that this study trains, lru" in said
        and said.count("\n") == 1
    )
    assert not (tmp_path / "s").exists()


def test_a_finished_run_that_the_report_could_not_read_is_refused_at_the_start(
    tmp_path: Path,
) -> None:
    folder = write_study(tmp_path / "s", small_study())
    run = folder.run(small_study().runs()[1]).path
    change_config(run, lambda config: config.update(memory=""))
    engine = Fabricator(small_study(seeds=3))
    with pytest.raises(ValueError, match="does not describe a run"):
        study(small_study(seeds=3), tmp_path / "s", engine)
    (run / "config.json").write_text("{")
    with pytest.raises(ValueError, match=r"config\.json does not hold JSON"):
        study(small_study(seeds=3), tmp_path / "s", engine)
    assert engine.done == []


def test_a_study_may_begin_with_a_mark_of_its_encoding(tmp_path: Path) -> None:
    file = tmp_path / "marked.toml"
    file.write_bytes(codecs.BOM_UTF8 + TOML.replace("\n", "\r\n").encode())
    assert Study.load(file).games == ("SignpostEasy",)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "latin-1"])
def test_a_study_in_another_encoding_is_refused_in_one_line(
    encoding: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "other.toml"
    file.write_bytes((TOML + 'question = "Schrödinger?"\n').encode(encoding))
    assert cli.main(["study", str(file), "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert "other.toml is not TOML" in said and said.count("\n") == 1


def test_what_is_no_regular_file_is_no_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    large = tmp_path / "large.toml"
    with large.open("wb") as stream:
        stream.truncate(1 << 40)
    for path in (tmp_path / "pipe.toml", tmp_path, large, Path("/dev/zero")):
        assert cli.main(["study", str(path), "--dry-run"]) == 2
        said = capsys.readouterr().err
        assert ("not a regular file" in said or "bytes" in said) and said.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "code"), [(ValueError("out of paper"), 1), (OSError(5, "Input/output error"), 1)]
)
def test_a_report_that_fails_says_how_to_write_it_again(
    error: Exception,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*args: object, **how: object) -> None:
        raise error

    what = small_study()
    monkeypatch.setattr(command, "make_engine", lambda *words: Fabricator(what))
    monkeypatch.setattr(Inline, "run", None)
    file = tmp_path / "toy.toml"
    file.write_text(
        'games = "MineSweeperEasy"\nmemories = ["mingru", "mlp"]\nseeds = 2\npreset = "smoke"\n'
    )
    file.write_text(file.read_text() + "total_frames = 2048\n")
    root = tmp_path / "s"
    with monkeypatch.context() as broken:
        broken.setattr(command, "write_page", fails)
        assert cli.main(["study", str(file), "--out", str(root)]) == code
    said = capsys.readouterr()
    assert "8 of 8 runs finished" in said.out
    assert (
        f"the runs are kept, their report failed; write it again with: arcade-torch report {root}"
        in said.err
    )
    skip = ["--skip", "saliency", "recall", "counterfactual", "contamination", "references"]
    assert cli.main(["report", str(root), *skip]) == 0
    assert (root / "report.html").exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[settings]\nthreads = 'two'", "threads must be a whole number; got 'two'"),
        ("[settings.pqn]\ngama = 0.9", "unknown field 'pqn.gama'"),
        ("[settings.env_options]\nzork = 1", "has no option 'zork'"),
        ("[settings.network_options.memory_options]\nzork = 1", "memory 'mlp' has other options"),
        ("algorithms = ['pqn', 'zork']", "algorithm must be"),
    ],
)
@pytest.mark.parametrize("dry", [True, False])
def test_what_a_file_says_is_refused_with_its_name(
    line: str, message: str, dry: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What only the config of a run refuses did not name the file."""
    file = tmp_path / "one.toml"
    file.write_text(TOML + line + "\n")
    words = ["--dry-run"] if dry else ["--out", str(tmp_path / "s")]
    assert cli.main(["study", str(file), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"arcade-torch: {file}: ") and message in said and said.count("\n") == 1
    with pytest.raises(ValueError, match=r"one\.toml: .*" + message.split(" ")[-1]):
        study(file, tmp_path / "s", Fabricator(small_study()))
    assert not (tmp_path / "s").exists()


def test_a_number_of_seeds_that_is_no_whole_one_is_told_what_may_stand_there(
    tmp_path: Path,
) -> None:
    with pytest.raises(ValueError, match=r"seeds must be a list, or the number of them; got 1\.5"):
        small_study(seeds=1.5)
