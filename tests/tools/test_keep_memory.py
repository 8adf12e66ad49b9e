"""The allocator setting of training: the memory of large tensors is used again without page
faults.
"""

import subprocess
import sys

import pytest

from arcade_torch.tools import machine

COUNT_FAULTS = """
import resource, sys
import torch
from arcade_torch.tools.machine import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()
for _ in range(20):  # by then it has what it needs
    torch.ones(2**24)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    torch.ones(2**24)  # 64 MiB, 16,384 pages
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(word: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", COUNT_FAULTS, word], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(machine.platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_a_large_tensor_that_was_freed_costs_no_page_faults_again() -> None:
    assert faults("keep") < 200  # without it, one a page or one a huge page: the machine decides


def test_elsewhere_than_on_glibc_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(machine.ctypes, "CDLL", None)
    assert machine.keep_freed_memory() is False
