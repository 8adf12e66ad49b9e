"""The public API as a type checker sees it: the installed wheel, ``mypy --strict``, no ``Any`` in
what users hold.
"""

import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.test_packaging import installed, run, site_packages, source, wheel

__all__ = ["installed", "source", "wheel"]  # fixtures

pytestmark = pytest.mark.slow

PROGRAM = '''
"""What a user writes; every `assert_type` fails if a type leaks as Any."""

from pathlib import Path
from typing import assert_type

import torch

import arcade_torch
from arcade_torch.agents import Agent, EvalResult, TrainConfig, TrainResult, evaluate, load, preset, preset_names, train
from arcade_torch.models import make_memory, memory_names
from arcade_torch.tools import Study, gap_and_bias, report
from arcade_torch.tools.measures.gap_bias.measure import GapBias

assert_type(arcade_torch.registered_ids(), list[str])
assert_type(arcade_torch.__version__, str)
env = arcade_torch.make("CartPoleEasy", num_envs=2, observability="partial", seed=0)
assert_type(env, arcade_torch.ArcadeEnv)
assert_type(env.num_envs, int)
assert_type(env.task, torch.Tensor)
assert_type(env.observability, torch.Tensor)

config = preset("smoke", env="CartPoleEasy")
assert_type(config, TrainConfig)
assert_type(config.total_frames, int)
assert_type(config.learner.gamma, float)
assert_type(preset_names(), list[str])

memory = make_memory("gru", input_size=3, hidden_size=4)
assert_type(memory, torch.nn.Module)
assert_type(memory_names(), list[str])


def use(folder: Path) -> float:
    assert_type(train(config, folder), TrainResult)
    agent = load(folder)
    assert_type(agent, Agent)
    result = evaluate(agent, episodes=2)
    assert_type(result, EvalResult)
    assert_type(result.mean, float)
    table = gap_and_bias(folder)
    assert_type(table, GapBias)
    assert_type(table.rows[0].gap.value, float)
    assert_type(report(folder), Path)
    assert_type(Study.load(folder / "study.toml"), Study)
    return result.mean
'''
WRONG = (
    PROGRAM
    + """
arcade_torch.make("CartPoleEasy", num_envs="two")
number: str = config.total_frames
preset("smoke").no_such_field
arcade_torch.mkae("CartPoleEasy")
"""
)


@pytest.fixture(scope="module")
def checked(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The environment with the wheel alone, and a path entry for the dependencies behind it."""
    (site_packages(installed) / "dependencies.pth").write_text(
        sysconfig.get_paths()["purelib"] + "\n"
    )
    return installed


def mypy(environment: Path, program: str, folder: Path) -> str:
    (folder / "program.py").write_text(program)
    settings = (
        "[mypy]",
        "strict = true",
        "ignore_missing_imports = true",
        f"python_executable = {environment}/bin/python",
    )
    (folder / "mypy.ini").write_text("\n".join(settings) + "\n")
    options = ("--config-file", "mypy.ini", "--cache-dir", str(environment / "cache"))
    command = [sys.executable, "-m", "mypy", *options, "program.py"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout


def test_a_users_program_is_checked_strictly_against_the_installed_wheel(
    checked: Path, tmp_path: Path
) -> None:
    found = mypy(checked, PROGRAM, tmp_path)
    assert found.startswith("Success: no issues found"), found
    origin = run(
        checked / "bin" / "python",
        "-c",
        "import arcade_torch; print(arcade_torch.__file__)",
        cwd=tmp_path,
    )
    assert str(checked) in origin


def test_wrong_uses_are_found(checked: Path, tmp_path: Path) -> None:
    found = mypy(checked, WRONG, tmp_path)
    assert "Found 4 errors" in found, found
