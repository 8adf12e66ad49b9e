"""`arcade-torch bench memory`: what is compared computes the same, and memory is counted exactly."""

from pathlib import Path

import pytest
import torch

from arcade_torch.models import linear_scan, lru
from arcade_torch.tools import cli
from arcade_torch.tools.bench.back_ends import bench_back_ends
from arcade_torch.tools.bench.harness import KINDS, REST, op_breakdown, peak_bytes
from arcade_torch.tools.bench.memory import LOOPS, TORCH_GRU, bench_saliency, forms
from arcade_torch.tools.bench.scans import FORMS
from arcade_torch.tools.files import read_csv


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_the_scan_gives_the_same_values_and_gradients(name: str, dtype: torch.dtype) -> None:
    a, b = (torch.randn(2, 11, 3, dtype=dtype, requires_grad=True) for _ in "ab")
    weight = torch.randn(2, 11, 3, dtype=dtype)
    h, expected = FORMS[name](a, b), linear_scan(a, b)
    torch.testing.assert_close(h, expected)
    for ours, theirs in zip(
        torch.autograd.grad(h, (a, b), weight), torch.autograd.grad(expected, (a, b), weight), strict=True
    ):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("name", LOOPS)
def test_a_model_and_the_same_with_its_loop_agree(name: str) -> None:
    compared = forms([name], 2, 9)
    x, is_init = torch.randn(2, 20, 9), torch.rand(2, 20) < 0.1
    torch.testing.assert_close(compared[name, "scan"](x, is_init), compared[name, "loop"](x, is_init))
    assert compared[TORCH_GRU, "torch"](x, is_init).shape == (2, 20, 9)


def test_a_loop_that_fails_leaves_the_scan_as_it_was() -> None:
    loop = forms(["lru"], 1, 9)["lru", "loop"]
    with pytest.raises(ValueError, match="must be"):
        loop(torch.randn(2, 20, 8), torch.zeros(2, 20, dtype=torch.bool))
    assert lru.linear_scan is linear_scan


def test_peak_memory_is_what_was_held_at_a_time_and_not_what_was_allocated() -> None:
    def work() -> object:
        for _ in range(5):
            x = torch.zeros(1000)
            y = x + 1
            del x, y
        return None

    assert 8000 <= peak_bytes(work) < 8200


def test_back_ends_are_timed_beside_a_copy_and_compared_with_the_loop() -> None:
    names = ("doubling", "serial")
    rows = list(bench_back_ends(torch.device("cpu"), (5, 9), 2, 3, names=names, repeats=2))
    keys = [(row.steps, row.numbers, row.back_end) for row in rows]
    assert keys == [(t, numbers, name) for t in (5, 9) for numbers in ("real", "complex") for name in names]
    for row in rows:
        assert row.error < 1e-5 and min(row.forward_ms, row.backward_ms, row.forward_share, row.backward_share) > 0


def test_saliency_in_two_stages_holds_less_memory_than_the_whole_network() -> None:
    ours, whole = bench_saliency(24, 0.01, 1)
    assert (ours["way"], whole["way"]) == ("two stages", "whole network")
    assert ours["both_ms"] > 0 and ours["peak_mib"] < whole["peak_mib"]


def test_kinds_of_operation_share_the_time_of_the_work() -> None:
    x, weight = torch.rand(4, 8, 32, 32, requires_grad=True), torch.rand(8, 8, 3, 3, requires_grad=True)
    shares = op_breakdown(lambda: torch.nn.functional.conv2d(x, weight).square().sum().backward())
    assert set(shares) == {*KINDS, REST} and sum(shares.values()) == pytest.approx(1)
    assert shares["convolutions"] > 0.2 and shares["recurrence"] == 0


def test_the_command_prints_all_tables_and_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "memory", "mingru", "gru", "--steps", "6", "--layers", "1", "--size", "8", "--seconds", "0.001"]
    words += ["--frames", "4"]
    assert cli.main([*words, "--repeats", "1", "--out", str(tmp_path / "m.csv")]) == cli.EXIT_OK
    out = capsys.readouterr().out
    assert "torch.nn.GRU" in out and "serial operator (in use)" in out and "two stages" in out
    rows = read_csv(tmp_path / "m_models.csv")
    assert [(row["model"], row["form"]) for row in rows] == [
        ("mingru", "scan"),
        ("mingru", "loop"),
        ("gru", "own"),
        (TORCH_GRU, "torch"),
    ]
    assert all(float(row[key]) > 0 for row in rows for key in ("forward_ms", "both_ms", "peak_mib"))
    scans = read_csv(tmp_path / "m_scans.csv")
    assert len(scans) == 2 * len(FORMS) and all(float(row["error"]) < 1e-3 for row in scans)
    assert cli.main([*words, "--threads", "0"]) == cli.EXIT_BAD_INPUT
