"""Checkpoints, logs and configs that are none are refused in one line, and nothing is lost."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from arcade_torch.agents import TrainConfig, load, preset
from arcade_torch.agents.runs.checkpoint import (
    CheckpointError,
    load_checkpoint,
    load_latest,
    save_checkpoint,
)
from arcade_torch.agents.runs.files import CsvLog, checksum, read_json

CONFIG = preset("smoke")


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
        ([0] * 10**4, r"a table of fields; got \[0, 0, .*\(30000 characters\)"),
    ],
)
def test_a_config_of_any_json_is_refused_in_one_line(values: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as found:
        TrainConfig.from_dict(values)
    assert "\n" not in str(found.value) and len(str(found.value)) < 400


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


def test_weights_that_are_fine_still_load(tmp_path: Path) -> None:
    path = checkpoint(tmp_path)
    save_file({"w": torch.zeros(4)}, path / "weights.safetensors")
    forge(path, "weights.safetensors", (path / "weights.safetensors").read_bytes())
    assert torch.equal(load_checkpoint(path).weights["w"], torch.zeros(4))


def test_a_preset_takes_no_object_for_the_numbers_of_a_learner() -> None:
    with pytest.raises(ValueError, match=r"pqn must be a PQNConfig or a table of its fields; got"):
        preset("smoke", pqn=object())


def test_a_folder_with_a_line_break_in_its_name_is_refused_in_one_line() -> None:
    with pytest.raises(CheckpointError, match=r"no such  folder does not exist") as refused:
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
