"""Compiled programs are kept between commands, where nobody else can put one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from arcade_torch.tools.programs import DAYS, keep_programs, programs_folder

NAME = "JAX_COMPILATION_CACHE_DIR"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of a user who has named no folder, before JAX is imported."""
    for name in list(os.environ):
        if name.startswith("JAX_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv(NAME, "")  # so that what a test sets is undone
    monkeypatch.delenv(NAME)
    monkeypatch.delitem(sys.modules, "jax", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_a_command_reads_what_one_before_it_compiled(cache: Path) -> None:
    code = """
from arcade_torch.tools import programs
programs.keep_programs()
import jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event.endswith("/cache_hits")))
import jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(float(jax.jit(lambda x: jnp.sin(x).sum() + 1)(jnp.arange(5.0))), sum(hits))
"""
    results = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        results.append(done.stdout.split())
    assert results[0][0] == results[1][0]
    assert int(results[0][1]) == 0 < int(results[1][1])
    folder = programs_folder()
    assert folder.stat().st_mode & 0o777 == 0o700
    for program in folder.iterdir():
        program.write_bytes(program.read_bytes()[:100])
    damaged = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert damaged.stdout.split() == results[0], damaged.stderr
    assert not damaged.stderr


def test_what_the_user_has_named_stays(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NAME, "")
    keep_programs()
    assert os.environ[NAME] == ""
    assert not list(cache.iterdir())


def test_a_folder_that_others_write_to_is_not_read(cache: Path) -> None:
    folder = programs_folder()
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    keep_programs()
    assert NAME not in os.environ
    folder.chmod(0o700)
    keep_programs()
    assert os.environ[NAME] == str(folder)


def test_without_a_cache_nothing_is_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = cache / "file"
    file.write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    keep_programs()
    assert NAME not in os.environ


def test_old_and_empty_programs_go(cache: Path) -> None:
    folder = programs_folder()
    folder.mkdir(parents=True, mode=0o700)
    for name, text in {"old": "x", "new": "x", "empty": ""}.items():
        (folder / name).write_text(text)
    before = (folder / "old").stat().st_mtime - (DAYS + 1) * 24 * 3600
    os.utime(folder / "old", (before, before))
    keep_programs()
    assert [file.name for file in folder.iterdir()] == ["new"]
