"""The Triton kernels, run on the CPU by Triton's interpreter: they are the loop, values and
gradients.

``make test-triton`` runs these. The interpreter scans a chunk from front to back, a card as a tree:
most tests run both ways, the second by a scan of our own in the interpreter's place, which brackets
as a card does and is much faster.
"""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.models import check_memory, make_memory, scan_triton
from arcade_torch.models import scan as scan_ops
from arcade_torch.models.scan import back_end, linear_scan, scan, scan_backward
from tests.models.scan_cases import (
    LENGTHS,
    assert_close,
    assert_equals_the_loop,
    assert_nothing_crosses_a_start,
    linear_scan_loop,
    problem,
)

ROOT = Path(__file__).resolve().parents[2]
DTYPES = [torch.float32, torch.float64, torch.complex64, torch.complex128]

pytestmark = [
    pytest.mark.triton,
    pytest.mark.filterwarnings("ignore:.* encountered in:RuntimeWarning"),
]


@pytest.fixture(autouse=True)
def _interpreted() -> Iterator[None]:
    """Every scan of these tests runs by the kernels; without the interpreter there is nothing to
    test.
    """
    if importlib.util.find_spec("triton") is None:
        pytest.skip("needs the triton extra: make test-triton")
    if os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("needs TRITON_INTERPRET=1: make test-triton")
    with back_end("triton"):
        yield


def tree_scan(self: Any, inputs: Any) -> list[Any]:
    """A scan in log2(n) rounds, of whole arrays (Hillis and Steele 1986), in place of one entry
    after the other.
    """
    arrays = [np.moveaxis(x.handle.data, self.axis, 0) for x in inputs]
    rows, shift = np.arange(len(arrays[0])).reshape(-1, *[1] * (arrays[0].ndim - 1)), 1

    def tensor(array: Any, like: Any) -> Any:
        return self.to_tensor(np.ascontiguousarray(array), like.dtype)

    while shift < len(rows):
        left = [
            tensor(np.roll(array, shift, axis=0), x)
            for array, x in zip(arrays, inputs, strict=True)
        ]
        right = [tensor(array, x) for array, x in zip(arrays, inputs, strict=True)]
        joined = self.combine_fn.fn(*left, *right)
        arrays = [
            np.where(rows < shift, array, x.handle.data.reshape(array.shape))
            for array, x in zip(arrays, joined, strict=True)
        ]
        shift *= 2
    return [
        tensor(np.moveaxis(array, 0, self.axis), x) for array, x in zip(arrays, inputs, strict=True)
    ]


@pytest.fixture
def tree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks are scanned as a tree."""
    from triton.runtime import interpreter

    monkeypatch.setattr(interpreter.ScanOps, "generic_scan", tree_scan)


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("steps", LENGTHS)
def test_the_kernels_are_the_loop_values_and_gradients(steps: int, dtype: torch.dtype) -> None:
    for features in ((), (5,), (3, 23)):
        assert_equals_the_loop(*problem(2, steps, features, dtype))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("steps", [2, 33, 132])
def test_they_are_the_loop_in_the_order_of_the_interpreter(steps: int, dtype: torch.dtype) -> None:
    assert_equals_the_loop(*problem(1, steps, (2,), dtype))


@pytest.mark.usefixtures("tree")
@given(
    batch=st.integers(0, 3),
    steps=st.integers(2, 40),
    features=st.sampled_from([(), (1,), (3,), (8,), (33,), (2, 3)]),
    dtype=st.sampled_from(DTYPES),
    resets=st.sampled_from([0.0, 0.1, 1.0]),
    chunk=st.sampled_from([8, 16, 64]),
    given_start=st.booleans(),
    given_state=st.booleans(),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=30)
def test_any_shape_flags_and_chunk_equal_the_loop(
    batch, steps, features, dtype, resets, chunk, given_start, given_state, seed
):
    torch.manual_seed(seed)
    a, b, start, h0 = problem(batch, steps, features, dtype, resets)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan_triton, "CHUNK", chunk)
        assert_equals_the_loop(a, b, start if given_start else None, h0 if given_state else None)


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("dtype", DTYPES[2:], ids=str)
def test_strides_of_any_kind_are_read_where_they_stand(dtype: torch.dtype) -> None:
    a, b, start, h0 = problem(3, 20, (7,), dtype)
    h = scan(a, b, start, h0)
    grad = torch.randn_like(h)
    expected = scan_backward(a, start, h0, h, grad)
    strided = [x.mT.contiguous().mT for x in (a, b, h, grad)]
    every_other = [
        torch.stack([x, torch.full_like(x, torch.nan)], -1).flatten(-2)[..., ::2] for x in strided
    ]
    flags = torch.stack([start, ~start], -1).flatten(-2)[:, ::2]
    conjugated = [x.conj_physical().conj() for x in (a, b, h, grad)]
    assert conjugated[0].is_conj() and not every_other[0].is_contiguous()
    for x, y, z, w in (strided, every_other, conjugated):
        assert torch.equal(scan(x, y, flags, h0.mT.contiguous().mT), h)
        for ours, theirs in zip(scan_backward(x, flags, h0, z, w), expected, strict=True):
            assert torch.equal(ours, theirs) and ours.is_contiguous()


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("shape", [(5,), (1, 1, 5), (1, 20, 1), (2, 1, 5), ()])
def test_expanded_factors_and_gradients_are_not_spread_out(shape: tuple[int, ...]) -> None:
    _, b, start, h0 = problem(2, 20, (5,))
    a = torch.rand(shape, dtype=torch.float64, requires_grad=True)
    h, loop = linear_scan(a, b, start, h0), linear_scan_loop(a, b, start, h0)
    ours, theirs = (torch.autograd.grad(x.sum(), a)[0] for x in (h, loop))
    assert_close([h, ours], [loop.detach(), theirs], 1e-12)


@pytest.mark.usefixtures("tree")
def test_of_no_sequences_or_no_features_nothing_comes_out() -> None:
    for shape in ((0, 4, 3), (2, 4, 0)):
        a = torch.rand(shape, requires_grad=True)
        h = linear_scan(
            a,
            torch.rand(shape),
            torch.zeros(shape[:2], dtype=torch.bool),
            torch.rand(shape[0], shape[2]),
        )
        assert h.shape == torch.autograd.grad(h.sum(), a)[0].shape == shape


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128], ids=str)
def test_gradients_equal_finite_differences_and_so_do_theirs(dtype, monkeypatch):
    monkeypatch.setattr(scan_triton, "CHUNK", 8)
    a, b, start, h0 = problem(2, 10, (1,), dtype, resets=0.0)
    start[0, 8], start[1, 0] = (
        True,
        True,
    )  # at the end of a chunk of either direction, and at the beginning
    inputs = [x.requires_grad_() for x in (a, b, h0)]
    assert torch.autograd.gradcheck(
        lambda a, b, h0: linear_scan(a, b, start, h0), inputs, fast_mode=dtype.is_complex
    )
    short = [x.detach()[:1, :3].requires_grad_() for x in (a, b)]
    short.append(h0.detach()[:1].requires_grad_())
    flags = torch.tensor([[False, True, False]])
    assert torch.autograd.gradgradcheck(
        lambda a, b, h0: linear_scan(a, b, flags, h0), short, fast_mode=True
    )


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("where", [1, 8, 11, 16, 19])
def test_what_stands_before_a_start_has_exactly_no_influence(
    where: int, dtype: torch.dtype, monkeypatch
) -> None:
    monkeypatch.setattr(scan_triton, "CHUNK", 8)
    assert_nothing_crosses_a_start(where, dtype)


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_a_nan_lasts_to_the_end_of_its_episode_as_in_the_other_back_ends(
    dtype: torch.dtype, monkeypatch
) -> None:
    monkeypatch.setattr(scan_triton, "CHUNK", 8)
    a, b, start, h0 = problem(2, 30, (3,), dtype, resets=0.0)
    start[:, 20] = True
    b[0, 5, 1] = torch.nan
    h0[1, 2] = torch.inf
    grad = torch.randn_like(b)
    grad[0, 25, 0] = torch.nan
    found = {}
    for name in scan_ops.BACK_ENDS:
        with back_end(name):
            h = scan(a, b, start, h0)
            found[name] = [torch.isfinite(x) for x in (h, *scan_backward(a, start, h0, h, grad))]
    assert not found["triton"][0][0, 5:20, 1].any() and found["triton"][0][:, 20:].all()
    assert not found["triton"][2][0, 20:26, 0].any() and found["triton"][2][0, :20, 0].all()
    for name in ("serial", "doubling"):
        assert all(torch.equal(x, y) for x, y in zip(found["triton"], found[name], strict=True)), (
            name
        )


@pytest.mark.usefixtures("tree")
def test_vmap_and_compiled_graphs_reach_the_kernels() -> None:
    a, b, start, h0 = problem(4, 9, (3,))
    expected = linear_scan(a, b, start, h0)
    mapped = torch.vmap(linear_scan)(*(x.unflatten(0, (2, 2)) for x in (a, b, start, h0)))
    torch.testing.assert_close(mapped.flatten(0, 1), expected)
    compiled = torch.compile(linear_scan, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(a, b, start, h0), expected)


@pytest.mark.usefixtures("tree")
@pytest.mark.parametrize("name", ["lru", "mingru"])
def test_memory_models_keep_their_laws(name: str) -> None:
    assert max(check_memory(make_memory(name, 3, 4)).values()) < 1e-9


def test_another_dtype_is_refused_in_one_line() -> None:
    x = torch.ones(1, 3, 2, dtype=torch.bfloat16)
    with pytest.raises(RuntimeError, match=r"no Triton kernel for torch\.bfloat16"):
        scan(x, x, None, x[:, 0])
    assert not scan_triton.runs_triton(x)


def test_they_compile_for_cards_move_16_bytes_at_a_time_and_spill_nothing(tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    command = [sys.executable, "-W", "ignore", "-m", "tests.models.triton_targets"]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == 3 * 4 * 2 and all(row["code"] > 0 for row in rows)
    for row in rows:
        assert row["spilled"] == 0, row
        narrow = {size: count for size, count in row["accesses"].items() if size not in ("1", "16")}
        # the initial state of complex64, a load for each part of a chunk's first rows
        pairs_of_floats = row["kernel"].endswith("complex") and row["dtype"] == "fp32"
        assert narrow == ({"8": 2} if pairs_of_floats else {}), row
        assert row["accesses"]["16"] >= 12, row
