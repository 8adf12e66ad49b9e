"""Run folders that accidents and strangers have been at: ``agents.load``, resuming, the small
files, configs.
"""

import json
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.agents import TrainConfig, load, preset, train
from arcade_torch.agents.runs.checkpoint import list_checkpoints, load_checkpoint, load_latest
from arcade_torch.agents.runs.files import CsvLog, checksum
from arcade_torch.agents.runs.folder import METRIC_COLUMNS, RunFolder
from arcade_torch.agents.trainer import Trainer
from tests.fuzz.contract import attempt, content, fuzz, unchanged
from tests.fuzz.hostile import NAMES, anything, json_bytes, mutated, mutated_value, seeds

pytestmark = pytest.mark.slow

CONFIG = preset(
    "smoke", env="CartPoleEasy-v0", memory="mingru", total_frames=256, checkpoint_every=128
)
SAME = ("meta.json", "weights.safetensors", "trainer.pt")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run; every input has to leave it as it was, or is repaired after."""
    folder = tmp_path_factory.mktemp("fuzz") / "run"
    train(CONFIG, folder)
    yield folder


def _damage(folder: Path, rng: random.Random) -> None:
    """One to three accidents in a folder of runs."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        file, other = rng.choice(files), rng.choice(files)
        kind = rng.randrange(10)
        if kind < 4:
            file.write_bytes(mutated(file.read_bytes(), rng.randrange(2**32)))
        elif kind == 4:
            file.unlink()
        elif kind == 5:
            one, two = file.read_bytes(), other.read_bytes()
            file.write_bytes(two), other.write_bytes(one)
        elif kind == 6:
            file.unlink()
            file.mkdir()
        elif kind == 7 and not (folder / "checkpoints" / "latest").is_dir():
            (folder / "checkpoints" / "latest").write_bytes(
                rng.choice(NAMES).encode("utf-8", "replace")
            )
        elif file.suffix == ".json":
            _rewrite_json(file, rng)
        if not any(path.is_file() for path in folder.rglob("*")):
            return


def _rewrite_json(file: Path, rng: random.Random) -> None:
    try:
        value = json.loads(file.read_bytes())
    except (ValueError, RecursionError):  # an earlier change has broken it already
        return
    if rng.random() < 0.05:
        file.write_bytes(b"[" * 100_000)
    else:
        file.write_bytes(json_bytes(mutated_value(value, rng.randrange(2**32))))


def _forge(checkpoint: Path, rng: random.Random) -> None:
    """A checkpoint by somebody who knows about checksums."""
    part = rng.choice(SAME)
    file = checkpoint / part
    if part == "meta.json":
        _rewrite_json(file, rng)
        return
    if part == "trainer.pt" and rng.random() < 0.7:
        state = torch.load(file, weights_only=True)
        torch.save(_changed(state, rng), file)
    else:
        file.write_bytes(mutated(file.read_bytes(), rng.randrange(2**32)))
    meta = json.loads((checkpoint / "meta.json").read_text())
    meta["sha256"][part] = checksum(file)
    (checkpoint / "meta.json").write_text(json.dumps(meta))


def _changed(state: Any, rng: random.Random) -> Any:
    """A trainer's state with something else in one place."""
    if isinstance(state, dict) and state and rng.random() < 0.9:
        key = rng.choice(list(state))
        if rng.random() < 0.1:
            return {name: value for name, value in state.items() if name != key}
        return state | {key: _changed(state[key], rng)}
    if isinstance(state, list) and state and rng.random() < 0.5:
        at = rng.randrange(len(state))
        return [*state[:at], _changed(state[at], rng), *state[at + 1 :]]
    if isinstance(state, torch.Tensor) and rng.random() < 0.6:
        return rng.choice(
            (
                state.double(),
                state.unsqueeze(0),
                state.flatten()[:0],
                state.bool(),
                torch.full_like(state, -1),
            )
        )
    return rng.choice(
        (
            None,
            "x",
            -1,
            10**30,
            [],
            {},
            0.5,
            float("nan"),
            torch.zeros(3),
            {"__tensordict__": 5},
            b"x",
        )
    )


def _repair(folder: Path, before: dict[str, bytes]) -> None:
    if folder.exists():
        shutil.rmtree(folder)
    for name, data in before.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)


@fuzz(1_000)
@given(seed=seeds)
def test_a_damaged_run_is_loaded_from_what_is_whole_or_refused(run: Path, seed: int) -> None:
    rng = random.Random(seed)
    before = content(run)
    where = rng.choice((run, run, run / "checkpoints", list_checkpoints(run / "checkpoints")[0]))
    try:
        if rng.random() < 0.5:
            _damage(run, rng)
        else:
            for checkpoint in list_checkpoints(run / "checkpoints"):
                _forge(checkpoint, rng)
        with unchanged(run) if run.exists() else _nothing():
            attempt("agents.load", lambda: load(where))
    finally:
        _repair(run, before)


class _nothing:
    def __enter__(self) -> None: ...
    def __exit__(self, *error: object) -> None: ...


@pytest.fixture(scope="module")
def trainer() -> Iterator[Trainer]:
    made = Trainer(CONFIG)
    yield made
    made.close()


@fuzz(800)
@given(seed=seeds)
def test_a_forged_trainers_state_is_taken_or_refused(
    run: Path, trainer: Trainer, seed: int
) -> None:
    rng = random.Random(seed)
    before = content(run)
    try:
        for checkpoint in list_checkpoints(run / "checkpoints"):
            _forge(checkpoint, rng)
        with unchanged(run):
            attempt(
                "resume: checkpoint",
                lambda: load_latest(run / "checkpoints", CONFIG, use=trainer.load),
            )
    finally:
        _repair(run, before)


@fuzz(1_000)
@given(seed=seeds)
def test_a_damaged_folder_is_resumed_or_refused_before_anything_is_written(
    run: Path, seed: int
) -> None:
    rng = random.Random(seed)
    before = content(run)
    try:
        _damage(run, rng)
        if rng.random() < 0.5 and (run / "config.json").is_file():
            _rewrite_json(run / "config.json", rng)
        folder = RunFolder(run)

        def look() -> None:
            folder.check(CONFIG, resume=True)
            folder.finished()

        with unchanged(run) if run.exists() else _nothing():
            attempt("resume: folder", look)
    finally:
        _repair(run, before)


@fuzz(150)
@given(seed=seeds)
def test_a_finished_run_is_returned_made_again_or_refused(run: Path, seed: int) -> None:
    """The result that ``train(resume=True)`` of a finished run reads."""
    rng = random.Random(seed)
    before = content(run)
    try:
        _rewrite_json(run / "eval.json", rng)
        if RunFolder(run).finished() is not None:
            attempt("resume: finished run", lambda: train(CONFIG, run, resume=True))
    finally:
        _repair(run, before)


@fuzz(5_000)
@given(seed=seeds)
def test_logs_are_cut_back_whatever_stands_in_them(run: Path, seed: int) -> None:
    file = run / "metrics.csv"
    before = file.read_bytes()
    try:
        file.write_bytes(mutated(before, seed))
        attempt(
            "resume: metrics.csv", lambda: CsvLog(file, METRIC_COLUMNS, keep_frames=128).close()
        )
    finally:
        file.write_bytes(before)


@fuzz(8_000)
@given(seeds)
def test_a_config_is_read_or_refused(seed: int) -> None:
    value = mutated_value(CONFIG.to_dict(), seed)
    attempt("TrainConfig.from_dict", lambda: TrainConfig.from_dict(value))


PRESETS = st.sampled_from(("smoke", "paper", "small", "huge"))
CHANGES = st.dictionaries(st.sampled_from(tuple(CONFIG.to_dict())), anything, max_size=3)


@fuzz(3_000)
@given(PRESETS, CHANGES)
def test_a_preset_takes_changes_or_refuses_them(name: str, changes: dict[str, Any]) -> None:
    attempt("preset", lambda: preset(name, **changes))


@fuzz(1_000)
@given(st.sampled_from(NAMES) | st.text(max_size=8))
def test_no_name_of_a_folder_surprises_load(name: str) -> None:
    attempt("agents.load of a name", lambda: load(Path("no such place") / name))
    attempt("load_checkpoint of a name", lambda: load_checkpoint(Path("no such place") / name))
