"""The flag against XLA's wrong sums: set where it is known, needed, and in time; else one line, or
nothing.
"""

import json
import os
import subprocess
import sys

import pytest

from arcade_torch.envs_jax import xla_flags
from arcade_torch.envs_jax.xla_flags import AFFECTED, FLAG, guard_sums

PROGRAM = """
import json, os, warnings
{before}
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import arcade_torch.envs_jax
import jax, jax.numpy as jnp
i = jnp.arange(32769, dtype=jnp.float32)
x = jnp.stack([i, 0 * i, 0 * i], 1)
sums = jax.jit(jax.vmap(lambda row: ((jnp.eye(3) @ row) ** 2).sum()))(x)
said = [str(one.message) for one in caught if "issue 39103" in str(one.message)]
print(json.dumps([os.environ.get("XLA_FLAGS"), said, float(sums[-1])]))
"""
is_affected = pytest.mark.skipif(
    xla_flags._jaxlib() not in AFFECTED, reason="this jaxlib computes sums rightly"
)


def run(before="", **flags):
    """XLA_FLAGS, what was said, and a sum that a wrong XLA gets wrong, in a new process."""
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment = {**clean, **flags, "JAX_PLATFORMS": "cpu"}
    program = PROGRAM.format(before=before)
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@is_affected
def test_sums_are_right_after_the_import_even_if_jax_was_imported_before():
    assert run() == [f"{FLAG}=", [], float(32768**2)]
    assert run("import jax", XLA_FLAGS="--xla_cpu_enable_fast_math=false") == [
        f"--xla_cpu_enable_fast_math=false {FLAG}=",
        [],
        float(32768**2),
    ]


@is_affected
def test_what_the_user_has_set_stays():
    assert run(XLA_FLAGS=f"{FLAG}=-reduce")[:2] == [f"{FLAG}=-reduce", []]


@is_affected
def test_too_late_is_said_in_one_line():
    flags, said, _ = run("import jax; jax.devices()")
    assert flags is None and len(said) == 1
    assert f"XLA_FLAGS={FLAG}=" in said[0] and "\n" not in said[0]


def test_other_versions_are_left_alone(monkeypatch):
    monkeypatch.setattr(xla_flags, "_jaxlib", lambda: "0.10.1")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    guard_sums()
    assert "XLA_FLAGS" not in os.environ


def test_a_file_of_flags_is_left_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(xla_flags, "_jaxlib", lambda: AFFECTED[0])
    monkeypatch.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    with pytest.warns(UserWarning, match="issue 39103"):
        guard_sums()
    assert os.environ["XLA_FLAGS"] == str(tmp_path / "flags")
