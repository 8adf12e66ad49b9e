"""The linear scan on a CUDA device: the Triton back end is the loop, and how near it comes to the
speed of a copy.

In a rehearsal on the CPU the serial back end stands in.
"""

import importlib.util
import warnings

import pytest
import torch

from arcade_torch.models.scan import _back_end_of, back_end
from arcade_torch.tools.bench.memory import COPY, bench_scans
from tests.models.scan_cases import (
    LENGTHS,
    assert_equals_the_loop,
    assert_nothing_crosses_a_start,
    problem,
)

DTYPES = [torch.float32, torch.float64, torch.complex64, torch.complex128]
NEEDS_TRITON = pytest.mark.usefixtures("triton")

pytestmark = pytest.mark.gpu


@pytest.fixture
def triton(device: str) -> None:
    if device == "cuda" and importlib.util.find_spec("triton") is None:
        pytest.skip("needs triton")


@NEEDS_TRITON
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("steps", [*LENGTHS, 1000])
def test_on_a_card_the_kernels_are_the_loop(steps: int, dtype: torch.dtype, device: str) -> None:
    a, b, start, h0 = problem(3, steps, (70,), dtype, device=device)
    assert _back_end_of(b) == ("triton" if device == "cuda" else "serial")
    assert_equals_the_loop(a, b, start, h0)
    assert_equals_the_loop(
        a.mT.contiguous().mT, b, None, h0 if steps == 1 else None
    )  # a single step reads no a


@NEEDS_TRITON
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("where", [1, 8, 19])
def test_on_a_card_nothing_crosses_a_start(where: int, dtype: torch.dtype, device: str) -> None:
    assert_nothing_crosses_a_start(where, dtype, device)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_without_triton_the_doubling_form_is_the_loop_too(dtype: torch.dtype, device: str) -> None:
    with back_end("doubling"):
        assert_equals_the_loop(*problem(3, 132, (70,), dtype, device=device))


@NEEDS_TRITON
def test_long_scans_beat_the_doubling_form_and_are_compared_with_a_copy(cuda: str) -> None:
    rows = list(bench_scans(16, 1024, 512, torch.device(cuda), 0.1, 3))
    for numbers in ("real", "complex"):
        ours, doubling, copy = (
            next(row for row in rows if (row["form"], row["numbers"]) == (form, numbers))
            for form in ("triton", "doubling", COPY)
        )
        assert ours["error"] < 1e-4
        assert ours["forward_ms"] < doubling["forward_ms"] and ours["both_ms"] < doubling["both_ms"]
        warnings.warn(f"{ours}; a copy: {copy}", stacklevel=1)  # shown at the end of the run
