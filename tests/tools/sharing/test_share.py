"""``arcade-torch push`` and ``pull`` with a folder in place of the hub."""

import json
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.agents import evaluate, from_pretrained, preset, train
from arcade_torch.agents.runs.files import checksum, read_json, write_json
from arcade_torch.agents.runs.shipped import SHIPPED
from arcade_torch.tools import cli
from arcade_torch.tools.commands.share import is_folder
from arcade_torch.tools.commands.train import _read_config
from arcade_torch.tools.sharing import share
from arcade_torch.tools.sharing.card import model_card
from tests.tools.test_cli import one_error

NEEDED = {"config.json", "model.safetensors", "README.md", "results.json", ".eval_results"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of an agent that has learned nothing."""
    folder = tmp_path_factory.mktemp("runs") / "one"
    config = preset("smoke", env="SignpostEasy", observability="partial", total_frames=128)
    return train(config, folder).run_dir


@pytest.fixture
def pushed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    folder = tmp_path / "shared"
    assert cli.main(["push", str(run), str(folder), "--episodes", "8", "--no-film"]) == 0
    out = capsys.readouterr().out
    assert f"pushed: {folder}" in out and "sha256" in out and "OWNER/" in out
    return folder


def test_a_pushed_folder_has_the_files_of_the_hub(pushed: Path) -> None:
    assert {path.name for path in pushed.iterdir()} == NEEDED
    results = json.loads((pushed / "results.json").read_text())
    assert results["sha256"]["model.safetensors"] == checksum(pushed / "model.safetensors")
    assert results["n_eval_episodes"] == 8 and results["frames"] == 128
    assert results["training"]["versions"]["arcade_torch"]


def test_a_run_that_no_command_line_started_is_repeated_by_its_config(
    run: Path, pushed: Path
) -> None:
    """The page of a run that Ray had trained named the addresses of the cluster, and that of any
    other run of a study the command ``arcade-torch`` alone.
    """
    said = json.loads((pushed / "results.json").read_text())["training"]["command"]
    assert said == "arcade-torch train --config config.json"
    assert _read_config(pushed / "config.json") == _read_config(run / "config.json")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["/venv/ray/default_worker.py", "--gcs-address=10.0.0.7:38725"],
            "arcade-torch train --config config.json",
        ),
        (["/venv/tools/worker.py"], "arcade-torch train --config config.json"),
        (["mine.py", "--memory", "yours"], "arcade-torch train --config config.json"),
        (
            ["arcade-torch", "train", "--config", "/home/me/a.json", "--resume"],
            "arcade-torch train --config config.json",
        ),
        (
            ["x", "train", "--out=/home/me/a", "--wait", "60", "--env", "SignpostEasy"],
            "arcade-torch train --env SignpostEasy",
        ),
        (["x", "study", "/home/me/s.toml", "--out", "a"], "arcade-torch study s.toml"),
    ],
)
def test_a_command_that_is_shared_names_no_place_and_repeats_the_run(
    words: list[str], said: str
) -> None:
    assert share._command({"command": words}) == said


def test_the_page_of_a_memory_of_ones_own_says_that_it_has_to_be_registered(pushed: Path) -> None:
    """Its example ended in an error for everybody else."""
    results = json.loads((pushed / "results.json").read_text())
    assert "register" not in (pushed / "README.md").read_text()
    page = model_card("shared", results | {"memory": "two_traces"}, "")
    assert 'register_memory("two_traces", ...)' in page
    for ours in ("lru", "feedforward"):
        assert "register" not in model_card("shared", results | {"memory": ours}, "")


def test_the_model_card_is_yaml_that_boards_read(pushed: Path) -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    text = (pushed / "README.md").read_text()
    front, page = text.removeprefix("---\n").split("\n---\n", 1)
    about = yaml.safe_load(front)
    results = json.loads((pushed / "results.json").read_text())
    entry = about["model-index"][0]["results"][0]
    assert entry["task"]["type"] == "reinforcement-learning"
    assert entry["metrics"][0]["type"] == "mean_reward"
    assert entry["metrics"][0]["value"].startswith(f"{results['mean_reward']:.3f} +/- ")
    assert "reinforcement-learning" in about["tags"] and about["library_name"] == "arcade-torch"
    assert (
        'from_pretrained(\n    "shared",\n    sha256="' in page and str(pushed.parent) not in text
    )
    (row,) = yaml.safe_load((pushed / ".eval_results" / "arcade-torch.yaml").read_text())
    assert row["value"] == pytest.approx(results["mean_reward"], abs=1e-4)
    assert row["dataset"]["id"] == "popgym-arcade" and row["date"]


def test_nothing_of_this_machine_is_pushed(pushed: Path, run: Path) -> None:
    for file in pushed.rglob("*"):
        if file.is_file():
            assert str(run.parent).encode() not in file.read_bytes(), file


def test_the_round_trip_gives_equal_bits(run: Path, pushed: Path, tmp_path: Path) -> None:
    sha256 = checksum(pushed / "model.safetensors")
    out = tmp_path / "pulled"
    assert cli.main(["pull", str(pushed), "--sha256", sha256, "--out", str(out)]) == 0
    for file in pushed.rglob("*"):
        if file.is_file():
            assert (out / file.relative_to(pushed)).read_bytes() == file.read_bytes()
    one = evaluate(from_pretrained(run), episodes=4)
    other = evaluate(from_pretrained(out, sha256=sha256), episodes=4)
    np.testing.assert_array_equal(one.returns, other.returns)
    again = tmp_path / "again"
    assert cli.main(["push", str(out), str(again), "--episodes", "8", "--no-film"]) == 0
    assert (again / "model.safetensors").read_bytes() != b""
    assert from_pretrained(again).frames == from_pretrained(out).frames


def test_what_was_pulled_stands_where_a_run_folder_can(
    pushed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["evaluate", str(pushed), "--episodes", "4"]) == 0
    film = tmp_path / "film.gif"
    words = ["record", "SignpostEasy", "--player", str(pushed), "--out", str(film)]
    assert cli.main([*words, "--max-steps", "3"]) == 0
    assert film.read_bytes().startswith(b"GIF")


def test_a_film_is_pushed_where_an_extra_writes_one(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("PIL", reason="needs the tools extra")
    folder = tmp_path / "with-film"
    assert cli.main(["push", str(run), str(folder), "--episodes", "4"]) == 0
    films = [path.name for path in folder.glob("replay.*")]
    assert len(films) == 1 and films[0] in (folder / "README.md").read_text()


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_push_that_is_stopped_leaves_the_agent_that_was_there(
    run: Path, pushed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights were new, and the page, the hash and the return those of the agent before."""
    before = contents(pushed)

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(share, "_evaluated", stopped)
    words = ["--half", "--episodes", "8", "--no-film"]
    assert cli.main(["push", "signpost-full-lru", str(pushed), *words]) == cli.EXIT_INTERRUPTED
    assert contents(pushed) == before
    assert cli.main(["push", str(run), str(tmp_path / "new"), *words]) == cli.EXIT_INTERRUPTED
    assert [path.name for path in tmp_path.iterdir()] == [pushed.name]


def test_a_film_of_the_agent_before_does_not_stay(pushed: Path) -> None:
    (pushed / "replay.gif").write_bytes(b"GIF89a")
    (pushed / "mine.txt").touch()
    words = ["--episodes", "8", "--no-film"]
    assert cli.main(["push", "signpost-full-lru", str(pushed), *words]) == 0
    assert {path.name for path in pushed.iterdir()} == NEEDED | {"mine.txt"}
    sha256 = read_json(pushed / "results.json")["sha256"]["model.safetensors"]
    assert from_pretrained(pushed, sha256=sha256).config.observability == "full"


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_files_that_are_not_those_of_the_results_are_not_pulled(
    name: str, pushed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights with one bit turned were pulled, beside results that were not theirs."""
    results = read_json(pushed / "results.json")
    results["sha256"][name] = "0" * 64
    write_json(pushed / "results.json", results)
    out = tmp_path / "pulled"
    said = one_error(capsys, ["pull", str(pushed), "--out", str(out)])
    assert name in said and f"results.json says {'0' * 64}" in said
    assert not out.exists()


@pytest.mark.parametrize("text", ["[]", "{", '{"sha256": 3}', '{"sha256": {}}'])
def test_an_agent_without_hashes_in_its_results_is_pulled(
    text: str, pushed: Path, tmp_path: Path
) -> None:
    (pushed / "results.json").write_text(text)
    assert cli.main(["pull", str(pushed), "--out", str(tmp_path / "pulled")]) == 0


def test_what_could_not_be_pulled_whole_can_be_pulled_again(
    pushed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder with a part of the files was left, and refused from then on."""
    out = tmp_path / "pulled"
    words = ["pull", str(pushed), "--out", str(out)]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        said = one_error(capsys, words, cli.EXIT_FAILED)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(out) in said and "ulimit -f" in said
    assert [path.name for path in tmp_path.iterdir()] == [pushed.name]
    assert cli.main(words) == 0
    assert contents(out) == contents(pushed)


def test_settings_that_are_not_those_of_the_weights_are_not_pushed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page named the command of one run beside the weights of another."""
    mixed = tmp_path / "mixed"
    (mixed / "checkpoints").mkdir(parents=True)
    for file in run.glob("checkpoints/*/*"):
        (mixed / file.relative_to(run)).parent.mkdir(exist_ok=True)
        (mixed / file.relative_to(run)).write_bytes(file.read_bytes())
    record = read_json(run / "config.json")
    record["config"]["env"] = "CartPoleEasy-v0"
    write_json(mixed / "config.json", record)
    said = one_error(capsys, ["push", str(mixed), str(tmp_path / "out"), "--episodes", "4"])
    assert "env ('CartPoleEasy-v0' != 'SignpostEasy-v0')" in said
    assert not (tmp_path / "out").exists()


def test_an_agent_of_the_package_is_named_like_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = "signpost-partial-lru"
    assert cli.main(["evaluate", name, "--episodes", "16"]) == 0
    assert "pqn-lru on SignpostEasy-v0 (partial)" in capsys.readouterr().out
    words = ["recall-density", name, "signpost-partial-mlp", "--episodes", "8"]
    assert cli.main(["analyze", *words]) == 0
    assert list((tmp_path / "analysis").glob("*.png"))
    assert cli.main(["figure", *words, "--out", "figures"]) == 0
    assert list((tmp_path / "figures").glob("*.png"))
    words = ["record", "SignpostEasy", "--player", name, "--out", "film.gif"]
    assert cli.main([*words, "--max-steps", "3"]) == 0
    assert not (SHIPPED / name / "analysis").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["push", "nowhere", "./x"], "nowhere does not exist"),
        (["push", "signpost-partial-lru", "no repo"], "must be owner/name, or a folder"),
        (["push", "signpost-partial-lru", "./full"], "holds no shared agent"),
        (["push", "signpost-partial-lru", "./x", "--episodes", "0"], "--episodes must be at least"),
        (["pull", "./nowhere"], "nowhere does not exist"),
        (["pull", "nonsense"], "must be owner/name, or a folder"),
        (["pull", "signpost-partial-lru", "--sha256", "0" * 64], "nothing of it was read"),
        (["pull", "signpost-partial-lru", "--sha256", "12"], "64 hexadecimal digits"),
        (["pull", "signpost-partial-lru", "--revision", "v1"], "left out: it is a folder"),
        (["pull", "signpost-partial-lru", "--out", "./full"], "full exists"),
        (["play", "SignpostEasy", "--agent", "nobody"], "must be a run folder, or one of"),
        (
            ["play", "SignpostEasy", "--agent", "signpost-partial-lru", "--scores", "a.csv"],
            "--scores is for people",
        ),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    assert message in one_error(capsys, words)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_folder_is_told_from_a_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_folder("./one/two") and is_folder("/one") and is_folder("~/one")
    assert not is_folder("one/two")
    (tmp_path / "one" / "two").mkdir(parents=True)
    assert is_folder("one/two")


def test_without_the_package_the_hub_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from arcade_torch.agents import hub

    def missing(name: str) -> Any:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(hub, "import_module", missing)
    assert "pip install '.[hub]'" in one_error(capsys, ["pull", "some/body"])
