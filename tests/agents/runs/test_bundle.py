"""An agent to share: two files that go together, of which nothing is read that is not known."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load, save

from arcade_torch.agents import build_network, evaluate, from_pretrained, preset, pretrained_names
from arcade_torch.agents.policy import agent_of
from arcade_torch.agents.pretrained import read_shared
from arcade_torch.agents.runs import bundle
from arcade_torch.agents.runs.bundle import find_checkpoint, load_bundle, write_bundle
from arcade_torch.agents.runs.checkpoint import Checkpoint
from arcade_torch.agents.runs.files import CheckpointError, checksum
from arcade_torch.agents.runs.shipped import SHIPPED, agent_folder
from arcade_torch.models import register_memory, registry
from arcade_torch.models.lru import LRU

MOST_SHIPPED = 8 * 2**20
"""Bytes of all agents of the package together."""
OTHER = "0" * 64


@pytest.fixture
def checkpoint() -> Checkpoint:
    config = preset("smoke", env="SignpostEasy", memory="lru", algorithm="ppo", seed=3)
    return Checkpoint(config, 512, build_network(config).state_dict(), None, Path())


def damage(folder: Path, name: str, change: Any) -> None:
    file = folder / name
    file.write_bytes(change(file.read_bytes()))


def test_what_is_written_is_read_to_the_bit(checkpoint: Checkpoint, tmp_path: Path) -> None:
    sha256 = write_bundle(tmp_path, checkpoint, {"needs": []})
    read = load_bundle(tmp_path, sha256)
    assert sha256 == checksum(tmp_path / "model.safetensors")
    assert read.config == checkpoint.config and read.frames == 512 and read.trainer is None
    assert read.weights.keys() == checkpoint.weights.keys()
    for name, value in checkpoint.weights.items():
        assert torch.equal(read.weights[name], value) and read.weights[name].dtype == value.dtype
    assert load_bundle(tmp_path, sha256.upper()).frames == 512


@pytest.mark.parametrize("half", [False, True])
def test_equal_agents_are_equal_files_whose_tensors_begin_at_eight_bytes(
    tmp_path: Path, half: bool
) -> None:
    """As safetensors has it, so that a file may be mapped; what it writes has any order."""
    for name in ("w", "longer", "the longest"):
        agent = Checkpoint(preset("smoke"), 64, {name: torch.ones(3)}, None, Path())
        hashes = {write_bundle(tmp_path, agent, {}, half) for _ in range(16)}
        assert len(hashes) == 1
        assert int.from_bytes((tmp_path / "model.safetensors").read_bytes()[:8], "little") % 8 == 0


def test_half_as_many_bytes_are_rounded_weights(checkpoint: Checkpoint, tmp_path: Path) -> None:
    write_bundle(tmp_path / "one", checkpoint, {})
    write_bundle(tmp_path / "half", checkpoint, {}, half=True)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("half", "one")]
    assert sizes[0] < 0.6 * sizes[1]
    for name, value in load_bundle(tmp_path / "half").weights.items():
        wanted = checkpoint.weights[name]
        if wanted.dtype == torch.float32:
            wanted = wanted.half().float()
        assert value.dtype == wanted.dtype and torch.equal(value, wanted)


def test_of_half_an_agent_only_weights_of_single_precision_are_rounded(tmp_path: Path) -> None:
    weights = {
        "mean": torch.tensor([0.1], dtype=torch.float64),
        "half": torch.tensor([0.1], dtype=torch.bfloat16),
        "count": torch.tensor([2**40 + 1]),
        "mask": torch.tensor([True]),
    }
    write_bundle(tmp_path, Checkpoint(preset("smoke"), 64, weights, None, Path()), {}, half=True)
    read = load_bundle(tmp_path).weights
    for name, value in weights.items():
        assert read[name].dtype == value.dtype and torch.equal(read[name], value)


def test_an_agent_from_a_folder_acts_as_before(checkpoint: Checkpoint, tmp_path: Path) -> None:
    write_bundle(tmp_path, checkpoint, {})
    one = evaluate(agent_of(checkpoint), episodes=8)
    other = evaluate(from_pretrained(tmp_path), episodes=8)
    assert (one.returns == other.returns).all() and (one.lengths == other.lengths).all()


def test_another_hash_is_refused_before_anything_is_read(
    checkpoint: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bundle(tmp_path, checkpoint, {})

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("it was read")

    for name in ("load", "_header", "_settings"):
        monkeypatch.setattr(bundle, name, refuse)
    with pytest.raises(CheckpointError, match=r"not 0000.*nothing of it was read"):
        load_bundle(tmp_path, OTHER)
    with pytest.raises(ValueError, match="sha256 must be 64 hexadecimal digits"):
        load_bundle(tmp_path, "abc")


def test_the_hash_of_the_weights_vouches_for_the_settings(
    checkpoint: Checkpoint, tmp_path: Path
) -> None:
    sha256 = write_bundle(tmp_path, checkpoint, {})
    damage(tmp_path, "config.json", lambda text: text.replace(b'"seed": 3', b'"seed": 4'))
    with pytest.raises(
        CheckpointError, match=r"not the one that model\.safetensors was saved with"
    ):
        load_bundle(tmp_path, sha256)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("model.safetensors", lambda data: data[:-1], "cannot be read"),
        ("model.safetensors", lambda data: b"\x80\x04." + data, "cannot be read"),
        ("model.safetensors", lambda data: b"", "cannot be read"),
        ("model.safetensors", lambda data: save(load(data)), "not the one"),
        ("config.json", lambda data: data * 2000, "at most 1,048,576 are read"),
    ],
)
def test_damage_is_told(
    checkpoint: Checkpoint, tmp_path: Path, name: str, change: Any, message: str
) -> None:
    write_bundle(tmp_path, checkpoint, {})
    damage(tmp_path, name, change)
    with pytest.raises(CheckpointError, match=message):
        load_bundle(tmp_path)


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ({"format": 1, "frames": 1}, "arcade-torch 0.1"),
        ({"format": 2, "frames": -1, "config": {}}, "frames must be"),
        ({"format": 2, "frames": 1, "config": {"no": 1}}, "does not describe an agent"),
        ([], "does not describe an agent"),
    ],
)
def test_settings_of_no_agent_are_refused(about: Any, message: str, tmp_path: Path) -> None:
    text = json.dumps(about).encode()
    (tmp_path / "config.json").write_bytes(text)
    header = {"config_sha256": hashlib.sha256(text).hexdigest()}
    (tmp_path / "model.safetensors").write_bytes(save({"w": torch.zeros(1)}, header))
    with pytest.raises(CheckpointError, match=message):
        load_bundle(tmp_path)


def test_settings_of_a_network_that_is_far_larger_are_refused_before_it_is_made(
    checkpoint: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ``config.json`` of some bytes took all memory: the kernel ended the process."""
    large = replace(checkpoint.config, network_options={"hidden_size": 32768})
    write_bundle(tmp_path, replace(checkpoint, config=large), {})
    monkeypatch.setattr("arcade_torch.agents.policy.build_network", None)
    with pytest.raises(CheckpointError, match=r"a network of [\d,]+ numbers, its weights hold"):
        from_pretrained(tmp_path)


def test_a_missing_file_is_named(checkpoint: Checkpoint, tmp_path: Path) -> None:
    write_bundle(tmp_path, checkpoint, {})
    (tmp_path / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        load_bundle(tmp_path)
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        find_checkpoint(tmp_path.parent)


def test_a_memory_that_is_not_known_is_not_fetched(
    checkpoint: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    register_memory("somebodys", LRU)
    theirs = replace(checkpoint, config=replace(checkpoint.config, memory="somebodys"))
    write_bundle(tmp_path, theirs, {})
    assert from_pretrained(tmp_path).config.memory == "somebodys"
    monkeypatch.setattr(registry, "_FACTORIES", {"lru": LRU})
    with pytest.raises(CheckpointError, match=r"'somebodys'.*no code is taken.*--import FILE\.py"):
        read_shared(tmp_path)


def test_names_and_folders_that_are_not_there_are_told(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="did you mean 'signpost-partial-lru'"):
        from_pretrained("signpost-partial-lr")
    with pytest.raises(ValueError, match="is a folder here, which has none"):
        from_pretrained(tmp_path, revision="main")
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(CheckpointError, match=r"has no model\.safetensors"):
        from_pretrained(tmp_path, sha256=OTHER)


def test_a_folder_that_is_there_goes_before_an_agent_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert agent_folder("signpost-full-lru") == SHIPPED / "signpost-full-lru"
    (tmp_path / "signpost-full-lru").mkdir()
    assert agent_folder("signpost-full-lru") == Path("signpost-full-lru")


def test_the_agents_of_the_package_are_small_whole_and_say_how_they_were_made() -> None:
    names = pretrained_names()
    assert len(names) >= 4
    files = [path for path in SHIPPED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MOST_SHIPPED
    for name in names:
        results = json.loads((SHIPPED / name / "results.json").read_text())
        for file, sha256 in results["sha256"].items():
            assert checksum(SHIPPED / name / file) == sha256
        config = load_bundle(SHIPPED / name, results["sha256"]["model.safetensors"]).config
        game = config.env.removesuffix("-v0").removesuffix("Easy").lower()
        assert name == f"{game}-{config.observability}-{config.memory}"
        assert results["n_eval_episodes"] == 1024
        assert abs(results["mean_reward"] - results["mean_reward_float32"]) < 0.01
        assert results["training"]["command"].startswith("arcade-torch train ")


@pytest.mark.parametrize("name", ["signpost-partial-lru", "signpost-partial-mlp"])
def test_an_agent_of_the_package_earns_what_it_says(name: str) -> None:
    results = json.loads((SHIPPED / name / "results.json").read_text())
    result = evaluate(from_pretrained(name), episodes=128)
    assert abs(result.mean - results["mean_reward"]) <= 3 * result.ci + 0.02
