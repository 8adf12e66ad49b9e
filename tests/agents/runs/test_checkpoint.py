"""Checkpoints are whole or refused, and small files are never half written."""

import dataclasses
import json
import shutil
import warnings

import pytest
import torch

from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs import checkpoint as module
from arcade_torch.agents.runs.checkpoint import (
    CheckpointError,
    list_checkpoints,
    load_checkpoint,
    load_latest,
    save_checkpoint,
)
from arcade_torch.agents.runs.files import CsvLog, read_log

CONFIG = preset("smoke")


def save(folder, frames, value=1.0):
    state = {"counters": {"frames": frames}, "h": {"a": {"b": torch.full((2, 3), value)}}}
    return save_checkpoint(folder, CONFIG, frames, {"w": torch.full((4,), value)}, state)


def test_what_is_saved_is_loaded(tmp_path):
    save(tmp_path, 64, 2.5)
    found = load_latest(tmp_path, expect=CONFIG)
    assert (found.frames, found.config) == (64, CONFIG)
    assert torch.equal(found.weights["w"], torch.full((4,), 2.5))
    assert torch.equal(found.trainer["h"]["a"]["b"], torch.full((2, 3), 2.5))


def test_weights_that_two_names_share_are_saved_under_both(tmp_path):
    tied = torch.rand(2, 3)
    path = save_checkpoint(tmp_path, CONFIG, 64, {"in": tied, "out": tied, "row": tied[1]}, {})
    weights = load_checkpoint(path).weights
    assert torch.equal(weights["in"], tied) and torch.equal(weights["out"], tied)
    assert torch.equal(weights["row"], tied[1])


def test_the_newest_is_the_one_that_was_saved_last_not_the_one_with_most_frames(tmp_path):
    save(tmp_path, 192, 1.0)
    save(tmp_path, 128, 2.0)
    assert load_latest(tmp_path).frames == 128


def test_the_last_two_are_kept_and_the_newest_comes_first(tmp_path):
    for frames in (64, 128, 192):
        save(tmp_path, frames)
    assert [p.name for p in list_checkpoints(tmp_path)] == [
        "frames-000000000192",
        "frames-000000000128",
    ]
    assert (tmp_path / "latest").read_text().strip() == "frames-000000000192"
    assert not list(tmp_path.glob(".*"))


def test_a_newest_checkpoint_that_was_not_copied_is_told(tmp_path):
    """A copy that was stopped, or made while the run trained, was another agent without a word."""
    save(tmp_path, 64, 1.0)
    shutil.rmtree(save(tmp_path, 128, 2.0))
    said = "frames-000000000128, the newest by its name in latest, is missing; going on from"
    with pytest.warns(RuntimeWarning, match=f"{said} frames-000000000064"):
        assert load_latest(tmp_path).frames == 64
    (tmp_path / "latest").unlink()
    assert load_latest(tmp_path).frames == 64
    (tmp_path / "latest").write_text("../nonsense")
    assert load_latest(tmp_path).frames == 64


@pytest.mark.parametrize("part", ["weights.safetensors", "trainer.pt", "meta.json"])
@pytest.mark.parametrize("how", ["cut", "flipped", "missing"])
def test_a_damaged_checkpoint_is_refused_and_the_previous_one_takes_over(tmp_path, part, how):
    save(tmp_path, 64, 1.0)
    file = save(tmp_path, 128, 2.0) / part
    data = file.read_bytes()
    if how == "cut":
        file.write_bytes(data[: len(data) // 2])
    elif how == "flipped":
        file.write_bytes(data[:-20] + bytes([data[-20] ^ 0xFF]) + data[-19:])
    else:
        file.unlink()
    with pytest.raises(CheckpointError, match=part):
        load_checkpoint(tmp_path / "frames-000000000128")
    with pytest.warns(RuntimeWarning, match="going on from frames-000000000064"):
        assert load_latest(tmp_path, expect=CONFIG).frames == 64


def test_nothing_whole_is_an_error_that_says_so(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        load_latest(tmp_path)
    (save(tmp_path, 64) / "trainer.pt").unlink()
    with pytest.raises(CheckpointError, match=r"no whole checkpoint.*trainer\.pt is missing"):
        load_latest(tmp_path)


def test_a_checkpoint_of_another_run_is_refused_with_the_fields(tmp_path):
    save(tmp_path, 64)
    other = dataclasses.replace(
        CONFIG, env="MineSweeperEasy", pqn=dataclasses.replace(CONFIG.pqn, lam=0.5)
    )
    words = r"env \('CartPoleEasy' != 'MineSweeperEasy'\), pqn\.lam \(0\.8 != 0\.5\)"
    with pytest.raises(CheckpointError, match=words):
        load_latest(tmp_path, expect=other)
    with pytest.raises(CheckpointError, match="another run"):
        load_checkpoint(tmp_path / "frames-000000000064", expect=other)


def test_an_unknown_format_is_refused(tmp_path):
    file = save(tmp_path, 64) / "meta.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": 99}))
    with pytest.raises(CheckpointError, match="has format 99; this version reads format 2"):
        load_latest(tmp_path)


def test_a_checkpoint_of_version_0_1_is_refused_in_one_line_that_says_so(tmp_path):
    for frames in (64, 128):
        file = save(tmp_path, frames) / "meta.json"
        old = json.loads(file.read_text())
        # a name of then; the config is not to be looked at
        old["config"]["pqn"]["epsilon_share"] = 0.25
        file.write_text(json.dumps(old | {"format": 1}))
    with pytest.raises(CheckpointError) as refused:
        load_latest(tmp_path)
    said = "made by arcade-torch 0.1; this version reads format 2: train it again, or use the version that made it"
    assert str(refused.value) == f"checkpoint {tmp_path / 'frames-000000000128'} was {said}"


def test_a_process_that_dies_while_saving_leaves_the_previous_checkpoint(tmp_path, monkeypatch):
    save(tmp_path, 64, 1.0)
    for name in ("save", "checksum"):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                save(tmp_path, 128, 2.0)
        assert not list(tmp_path.glob(".frames*"))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load_latest(tmp_path, expect=CONFIG).frames == 64
    save(tmp_path, 128, 2.0)
    assert load_latest(tmp_path).frames == 128


def test_code_hidden_in_a_checkpoint_is_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    path = save(tmp_path, 64)
    torch.save({"x": Trap()}, path / "trainer.pt")
    meta = json.loads((path / "meta.json").read_text())
    meta["sha256"]["trainer.pt"] = module.checksum(path / "trainer.pt")
    (path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match=r"trainer\.pt"):
        load_checkpoint(path)
    assert not (tmp_path / "sprung").exists()


def test_of_a_log_only_whole_lines_are_read_and_a_newer_version_may_have_other_columns(tmp_path):
    file = tmp_path / "m.csv"
    file.write_text("frames,x,old\n10,1,2\n20\n30,1,2,3\nabc,1,2\n40,3,4\n50,5,")
    assert [row["frames"] for row in read_log(file)] == ["10", "40"]
    log = CsvLog(file, ("frames", "new", "x"), keep_frames=50)
    log.append({"frames": 50, "new": 7, "x": 8})
    log.close()
    assert file.read_text() == "frames,new,x\n10,,1\n40,,3\n50,7,8\n"


def test_a_log_is_cut_back_to_a_frame_count(tmp_path):
    log = CsvLog(tmp_path / "m.csv", ("frames", "x"))
    for frames in (10, 20, 30):
        log.append({"frames": frames, "x": frames / 3})
    log.close()
    with (tmp_path / "m.csv").open("a") as stream:
        stream.write("40,0.")
    again = CsvLog(tmp_path / "m.csv", ("frames", "x"), keep_frames=20)
    again.append({"frames": 30, "x": None})
    again.close()
    rows = [(r["frames"], r["x"]) for r in read_log(tmp_path / "m.csv")]
    assert rows == [("10", "3.3333333"), ("20", "6.6666667"), ("30", "")]
