"""What fuzzing (tests/fuzz) found, a test a defect: hostile input is refused in one line of ours,
nothing is lost.
"""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict

import arcade_torch
from arcade_torch.agents import TrainConfig, load, preset
from arcade_torch.agents.runs.checkpoint import (
    CheckpointError,
    load_checkpoint,
    load_latest,
    save_checkpoint,
)
from arcade_torch.agents.runs.files import CsvLog, checksum, is_final, read_csv, read_json
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

CONFIG = preset("smoke")


@pytest.fixture(scope="module")
def env() -> arcade_torch.ArcadeEnv:
    return arcade_torch.make("CartPoleEasy", num_envs=2)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"num_envs": 10**12}, ValueError, "num_envs is above 1048576"),
        ({"seed": "7"}, TypeError, "seed is '7', expected a whole number"),
        ({"seed": 0.5}, TypeError, "seed is 0.5, expected a whole number"),
        ({"debug": torch.zeros(0)}, TypeError, "debug is .*, allowed: True, False"),
        (
            {"categorical_actions": "no"},
            TypeError,
            "categorical_actions is 'no', allowed: True, False",
        ),
        (
            {"obs_size": torch.zeros(2, 2)},
            ValueError,
            r"obs_size is tensor\(\[\[0\., 0\.\], \[0\., 0\.\]\]\), allowed",
        ),
        ({"device": 10**30}, ValueError, "device is 1000.*, allowed: 'cpu', 'cuda'"),
    ],
)
def test_make_refuses_values_that_broke_inside(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as found:
        arcade_torch.make(**{"id": "CartPoleEasy", "num_envs": 2, **options})
    assert "\n" not in str(found.value)


def test_an_endless_name_is_cut_in_the_message() -> None:
    with pytest.raises(ValueError, match=r"xxx\.\.\. \(5002 characters\)"):
        arcade_torch.make("x" * 5000)


@pytest.mark.parametrize(
    ("entries", "error", "message"),
    [
        ({}, ValueError, "no entry 'action'; it has none"),
        ({"action": TensorDict({}, [2])}, TypeError, "'action' is a TensorDict, expected a tensor"),
        ({"action": torch.zeros(2).to_sparse()}, TypeError, "expected a dense one"),
        (
            {"action": torch.zeros(2).long(), "next": torch.zeros(2)},
            TypeError,
            "'next' is a Tensor, expected a TensorDict",
        ),
        (
            {"action": torch.zeros(2).long(), "_step": torch.zeros(2).bool()},
            ValueError,
            "'_step' is false in all envs",
        ),
        (
            {"action": torch.zeros(2).long(), "_step": torch.zeros(2)},
            TypeError,
            "'_step' has dtype torch.float32",
        ),
    ],
)
@pytest.mark.parametrize("way", ["step", "step_and_maybe_reset"])
def test_a_step_refuses_a_tensordict_it_cannot_use(
    env: arcade_torch.ArcadeEnv,
    way: str,
    entries: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    with pytest.raises(error, match=message):
        getattr(env, way)(TensorDict(entries, [2]))


def test_what_is_no_tensordict_is_no_step(env: arcade_torch.ArcadeEnv) -> None:
    for one in ({"action": torch.zeros(2)}, None, torch.zeros(2)):
        with pytest.raises(TypeError, match="expected a TensorDict of batch size"):
            env.step(one)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mask", "error", "message"),
    [
        (torch.zeros(2), TypeError, "'_reset' has dtype torch.float32"),
        (torch.tensor([-6, 0]), TypeError, "'_reset' has dtype torch.int64"),
        (torch.zeros(2, 0).bool(), ValueError, r"'_reset' has shape \(2, 0\)"),
        (TensorDict({}, [2]), TypeError, "'_reset' is a TensorDict"),
    ],
)
def test_reset_refuses_a_mask_that_is_none(
    env: arcade_torch.ArcadeEnv, mask: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        env.reset(TensorDict({"_reset": mask}, [2]))


def test_a_partial_reset_refuses_entries_that_cannot_stay(env: arcade_torch.ArcadeEnv) -> None:
    mask = torch.tensor([True, False])
    for wrong in (torch.zeros(2, 5), TensorDict({"x": torch.zeros(2)}, [2])):
        with pytest.raises(ValueError, match=r"entry 'pixels' is a .*, expected shape"):
            env.reset(TensorDict({"_reset": mask, "pixels": wrong}, [2]))
        with pytest.raises(ValueError, match=r"entry 'pixels' is a .*, expected shape"):
            env.step(
                TensorDict({"_step": mask, "pixels": wrong, "action": torch.zeros(2).long()}, [2])
            )
    with pytest.raises(TypeError, match=r"'x' is a torch\.sparse_coo tensor, expected a dense one"):
        env.reset(TensorDict({"_reset": mask, "x": torch.zeros(2, 5).to_sparse()}, [2]))


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        (
            "step_count",
            torch.zeros(2, dtype=torch.bfloat16),
            ValueError,
            r"'step_count' is bfloat16 \(2,\)",
        ),
        ("step_count", torch.zeros(2).to_sparse(), TypeError, "expected a dense one"),
        ("step_count", TensorDict({}, [2]), TypeError, "'step_count' is a TensorDict"),
        ("state", torch.zeros(2), ValueError, r"no entry 'state\."),
        ("game", torch.zeros(2, 5), ValueError, r"'game' is torch.float32 \(2, 5\)"),
    ],
)
def test_a_state_with_something_else_in_it_is_refused_whole(
    env: arcade_torch.ArcadeEnv, key: str, value: Any, error: type[Exception], message: str
) -> None:
    before = env.get_state()
    with pytest.raises(error, match=message):
        env.set_state(env.get_state().exclude(key).set(key, value))
    with pytest.raises(TypeError, match="the state is a Tensor: pass what"):
        env.set_state(torch.zeros(2))  # type: ignore[arg-type]
    after = env.get_state()
    assert all(torch.equal(before.get(name), after.get(name)) for name in before.keys(True, True))


def checkpoint(folder: Path) -> Path:
    return save_checkpoint(folder, CONFIG, 64, {"w": torch.ones(4)}, {"frames": 64})


def forge(path: Path, part: str, data: bytes) -> None:
    """Replace a part and its checksum, as somebody would who knows about it."""
    (path / part).write_bytes(data)
    meta = json.loads((path / "meta.json").read_text())
    meta["sha256"][part] = checksum(path / part)
    (path / "meta.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("data", [b"", b"\x00" * 40, b"\xff" * 9, b"PK\x03\x04junk"])
@pytest.mark.parametrize("part", ["weights.safetensors", "trainer.pt"])
def test_forged_parts_of_a_checkpoint_are_damage(tmp_path: Path, part: str, data: bytes) -> None:
    path = checkpoint(tmp_path)
    forge(path, part, data)
    with pytest.raises(CheckpointError, match=part) as found:
        load_checkpoint(path)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("frames", [float("inf"), float("nan"), 1.5, "64", None])
def test_a_count_of_frames_that_is_none_is_damage(tmp_path: Path, frames: Any) -> None:
    path = checkpoint(tmp_path)
    meta = json.loads((path / "meta.json").read_text())
    (path / "meta.json").write_text(json.dumps(meta | {"frames": frames}))
    with pytest.raises(CheckpointError, match="frames must be "):
        load_checkpoint(path)


def test_json_of_endless_depth_or_digits_is_damage(tmp_path: Path) -> None:
    path = checkpoint(tmp_path)
    for text in ("[" * 100_000, "9" * 5000):
        (path / "meta.json").write_text(text)
        with pytest.raises(CheckpointError, match="is not JSON"):
            load_checkpoint(path)
        with pytest.raises(ValueError, match="does not hold JSON"):
            read_json(path / "meta.json")


def test_the_name_of_the_latest_checkpoint_need_not_be_text(tmp_path: Path) -> None:
    checkpoint(tmp_path)
    (tmp_path / "latest").write_bytes(b"\x9c\xff")
    assert load_latest(tmp_path).frames == 64


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (3.5, "a config must be a table of fields; got 3.5"),
        ({"algorithm": ["pqn"]}, "algorithm must be"),
        ({"a\nb": 1}, r"unknown field 'a\\nb'"),
        ({"pqn": {"gamma": 10**400}}, r"pqn\.gamma must be a number"),
    ],
)
def test_a_config_of_any_json_is_refused_in_one_line(values: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as found:
        TrainConfig.from_dict(values)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    "data", [b"\xff\xfe\n", b"framez,loss\n1,2\n", b"frames,frames\n1,\n", b'frames,"a\n']
)
def test_a_log_that_is_none_is_refused_and_kept(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "metrics.csv"
    file.write_bytes(data)
    if data.startswith(b'frames,"'):
        return CsvLog(file, ("frames", "loss"), keep_frames=9).close()
    with pytest.raises(ValueError, match="is damaged"):
        CsvLog(file, ("frames", "loss"), keep_frames=9)
    assert file.read_bytes() == data


@pytest.mark.parametrize(
    "changes",
    [
        {"returns": 5},
        {"returns": [[1]]},
        {"returns": [10**400]},
        {"mean": {}},
        {"lengths": [0.5]},
        {"frames": "x"},
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


def test_weights_that_are_fine_still_load(tmp_path: Path) -> None:
    path = checkpoint(tmp_path)
    save_file({"w": torch.zeros(4)}, path / "weights.safetensors")
    forge(path, "weights.safetensors", (path / "weights.safetensors").read_bytes())
    assert torch.equal(load_checkpoint(path).weights["w"], torch.zeros(4))


def test_a_preset_takes_no_object_for_the_numbers_of_a_learner() -> None:
    with pytest.raises(ValueError, match=r"pqn must be a PQNConfig or a table of its fields; got"):
        preset("smoke", pqn=object())


def test_a_folder_with_a_line_break_in_its_name_is_refused_in_one_line() -> None:
    with pytest.raises(CheckpointError, match=r"no such  folder is not a folder") as refused:
        load("no such \nfolder")
    assert len(str(refused.value).splitlines()) == 1


def test_a_folder_with_a_name_that_is_too_long_is_refused_in_one_line() -> None:
    with pytest.raises(CheckpointError, match=r"cannot be looked at: File name too long"):
        load("9" * 300)


def test_what_cannot_be_compared_is_no_twin() -> None:
    class Odd:
        def __eq__(self, other: object) -> bool:
            raise RuntimeError("no equality here")

        __hash__ = None  # type: ignore[assignment]

    with pytest.raises(ValueError, match=r"observability must be"):
        preset("smoke", observability=Odd())


def test_a_checkpoint_with_a_name_that_is_too_long_is_refused_in_one_line() -> None:
    with pytest.raises(CheckpointError, match=r"cannot be looked at: File name too long"):
        load_checkpoint(Path("9" * 300))


def test_a_value_of_several_lines_is_refused_in_one() -> None:
    with pytest.raises(ValueError, match=r"env must be a string; got tensor") as refused:
        preset("smoke", env=torch.zeros(2, 2))
    assert len(str(refused.value).splitlines()) == 1


def test_a_sparse_entry_cannot_stay_while_others_are_reset(env: arcade_torch.ArcadeEnv) -> None:
    seen = env.reset()
    seen["step_count"] = seen["step_count"].to_sparse()
    seen["_reset"] = torch.tensor([[True], [False]])
    with pytest.raises(TypeError, match=r"entry 'step_count' is a torch.sparse_coo tensor"):
        env.reset(seen)
