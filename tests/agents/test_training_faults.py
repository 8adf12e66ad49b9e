"""Trainings that are ended from outside (a dropped connection, a full disk, a folder that is gone),
and bad weights.
"""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest
import torch
from safetensors.torch import load_file, save_file

from arcade_torch.agents import CheckpointError, RunFolderError, load, preset, train
from arcade_torch.agents.runs import files
from arcade_torch.agents.runs.checkpoint import list_checkpoints
from arcade_torch.agents.runs.files import checksum, read_json, write_json
from arcade_torch.envs_jax import Game, make, register
from arcade_torch.envs_jax.cartpole import CartPole
from tests.own_registry import own_registry  # noqa: F401

CONFIG = preset(
    "smoke", env="CartPoleEasy-v0", total_frames=640, eval_every=0, checkpoint_every=128
)

LONG = """
import sys
from arcade_torch.agents import preset, train
config = preset("smoke", env="CartPoleEasy-v0", total_frames=10**7, eval_every=0, checkpoint_every=0)
result = train(config, sys.argv[1], progress=lambda row: print("update", flush=True))
print(result.status)
"""


@pytest.mark.parametrize("ignored", [False, True], ids=["terminal", "nohup"])
def test_a_dropped_connection_saves_and_nohup_ignores_it(tmp_path: Path, ignored: bool) -> None:
    """Before: SIGHUP ended the process, and what was learned since the last checkpoint was lost."""
    handler = signal.SIG_IGN if ignored else signal.SIG_DFL
    words = [sys.executable, "-c", LONG, str(tmp_path / "run")]
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, handler),
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "update\n"
        process.send_signal(signal.SIGHUP)
        if ignored:
            time.sleep(0.5)
            assert process.poll() is None
            process.send_signal(signal.SIGTERM)
        said = process.stdout.read()
    assert process.returncode == 0 and said.splitlines()[-1] == "interrupted"
    assert len(list_checkpoints(tmp_path / "run" / "checkpoints")) == 1


@pytest.mark.parametrize("how", ["removed", "moved"])
def test_a_run_whose_folder_is_gone_ends_at_its_next_checkpoint(tmp_path: Path, how: str) -> None:
    """Before: it trained to its end, and then failed."""
    run = tmp_path / "run"
    seen: list[int] = []

    def progress(row: dict[str, int]) -> None:
        seen.append(row["frames"])
        if row["frames"] == 128:
            shutil.rmtree(run) if how == "removed" else run.rename(tmp_path / "elsewhere")

    with pytest.raises(
        RunFolderError, match=r"run is not there any more, or its config\.json: the run ends here"
    ):
        train(CONFIG, run, progress=progress)
    assert seen[-1] < 640 and not run.exists()


def test_a_full_disk_ends_a_run_in_one_line_and_it_goes_on_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    write_bytes = Path.write_bytes

    def fill(path: Path, data: bytes) -> int:
        if "frames-000000000384" in str(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_bytes(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", fill)
        message = (
            r"could not write .*weights\.safetensors: No space left on device; frames-000000000256 "
            r"is whole"
        )
        with pytest.raises(RunFolderError, match=message):
            train(CONFIG, run)
    assert read_json(run / "progress.json")["status"] == "failed"
    assert train(CONFIG, run, resume=True).status == "finished"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "run"
    train(CONFIG, folder)
    return folder


def changed(trained: Path, folder: Path, change: object) -> Path:
    """A run whose newest weights are others, with the right checksum."""
    shutil.copytree(trained, folder)
    newest = list_checkpoints(folder / "checkpoints")[0]
    tensors = load_file(newest / "weights.safetensors")
    name = next(
        name for name, value in tensors.items() if value.is_floating_point() and value.numel() > 1
    )
    tensors[name] = change(tensors[name])  # type: ignore[operator]
    save_file(tensors, newest / "weights.safetensors")
    meta = read_json(newest / "meta.json")
    meta["sha256"]["weights.safetensors"] = checksum(newest / "weights.safetensors")
    write_json(newest / "meta.json", meta)
    return newest


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda x: x.fill_(torch.nan), "is not finite: take the checkpoint before"),
        (lambda x: x.index_fill(0, torch.tensor([0]), torch.inf), "is not finite"),
        (lambda x: x.half(), "is torch.float16, the network has torch.float32"),
        (lambda x: x.double(), "is torch.float64, the network has torch.float32"),
    ],
)
def test_weights_that_mean_nothing_are_refused(
    trained: Path, tmp_path: Path, change: object, says: str
) -> None:
    """Before: they were evaluated to a mean with an interval, exit code 0."""
    path = changed(trained, tmp_path / "run", change)
    with pytest.raises(CheckpointError, match=says):
        load(path)


def test_a_disk_that_is_full_at_the_end_still_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    run = tmp_path / "run"
    seen: list[int] = []

    def progress(row: dict[str, int]) -> None:
        seen.append(row["frames"])
        if row["frames"] == 640:
            monkeypatch.setattr(files, "write_atomic", full)
            for module in ("checkpoint", "folder", "files"):
                name = f"arcade_torch.agents.runs.{module}"
                for function in ("write_atomic", "write_json"):
                    if hasattr(sys.modules[name], function):
                        monkeypatch.setattr(f"{name}.{function}", full)

    with pytest.raises(RunFolderError, match=r"could not write .*No space left on device"):
        train(CONFIG, run, progress=progress)
    monkeypatch.undo()
    assert json.loads((run / "config.json").read_text())


def test_a_return_that_is_not_finite_costs_the_training_score_and_not_the_run(
    tmp_path: Path,
    own_registry: None,  # noqa: F811
) -> None:
    """Before: the run failed at its last line, "returns must be finite"."""

    class Huge(CartPole):
        """Rewards that are finite, and whose sum is not."""

        def step(self, key: Any, state: Any, action: Any) -> Any:
            state, reward, terminated, truncated = super().step(key, state, action)
            return state, jnp.full_like(reward, 3e38), terminated, truncated

    def huge(*, id: str, obs_size: int, rules: str) -> Game[Any]:
        game: Any = make("CartPoleEasy", obs_size=obs_size)
        game.__class__ = Huge
        game.id = id
        return game  # type: ignore[no-any-return]

    register("HugeEasy-v0", huge)
    # nothing is learned from them before the replay holds so many
    learner = {"learning_starts": 10_000, "replay_frames": 100_000}
    config = preset("smoke", env="HugeEasy", algorithm="dqn", dqn=learner)
    with pytest.warns(UserWarning, match=r"^train_max_ewm is missing: a return .* is not finite$"):
        result = train(config, tmp_path / "run")
    assert result.status == "finished" and result.train_max_ewm is None
    assert read_json(tmp_path / "run" / "progress.json")["status"] == "finished"
