"""`arcade-torch bench memory`: what is compared computes the same."""

from pathlib import Path

import pytest
import torch

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.models import linear_scan, scan
from arcade_torch.tools import cli
from arcade_torch.tools.bench.loops import LOOPS, unbind_loop
from arcade_torch.tools.bench.memory import (
    COPY,
    LOOP,
    TORCH_GRU,
    bench_saliency,
    forms,
    scan_forms,
    solve,
    time_passes,
)
from tests.tools.test_cli import one_error

CPU = torch.device("cpu")


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
@pytest.mark.parametrize("form", [LOOP, "doubling"])
def test_every_form_of_the_scan_gives_the_same_values_and_gradients(
    form: str, dtype: torch.dtype
) -> None:
    a, b = (torch.randn(2, 11, 3, dtype=dtype, requires_grad=True) for _ in "ab")
    weight = torch.randn(2, 11, 3, dtype=dtype)
    run = unbind_loop if form == LOOP else linear_scan
    h, *ours = solve(
        form, lambda: ((out := run(a, b)), *torch.autograd.grad(out, (a, b), weight))
    )()
    expected = linear_scan(a, b)
    torch.testing.assert_close(h, expected)
    torch.testing.assert_close(tuple(ours), torch.autograd.grad(expected, (a, b), weight))


def test_a_form_is_solved_by_the_back_end_it_names_in_both_passes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    called = list[str]()
    for name, solvers in scan.BACK_ENDS.items():
        noting = [lambda *args, of=name, do=do: called.append(of) or do(*args) for do in solvers]
        monkeypatch.setitem(scan.BACK_ENDS, name, tuple(noting))
    a, b = (torch.rand(1, 3, 2, requires_grad=True) for _ in "ab")
    for form in ("serial", "doubling"):
        time_passes(
            {form: linear_scan},
            lambda h: h.sum().backward(),
            (a.detach(), b.detach()),
            1e-9,
            1,
            solve,
        )
        assert set(called) == {form} and len(called) >= 3
        called.clear()


@pytest.mark.parametrize("name", LOOPS)
def test_a_model_and_the_same_with_its_loop_agree(name: str) -> None:
    compared = forms([name], 2, 9)
    x, is_init = torch.randn(2, 20, 9), torch.rand(2, 20) < 0.1
    torch.testing.assert_close(
        compared[name, "scan"](x, is_init), compared[name, "loop"](x, is_init)
    )
    assert compared[TORCH_GRU, "torch"](x, is_init).shape == (2, 20, 9)


def test_saliency_is_timed_in_two_stages_and_through_the_whole_network() -> None:
    ours, whole = bench_saliency(4, CPU, 0.01, 1)
    assert (ours["way"], whole["way"]) == ("two stages", "whole network")
    assert ours["both_ms"] > 0 and whole["both_ms"] > 0


def test_the_command_prints_all_tables_and_writes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "bench",
        "memory",
        "mingru",
        "gru",
        "--steps",
        "6",
        "--layers",
        "1",
        "--size",
        "8",
        "--seconds",
        "0.001",
    ]
    words += ["--frames", "4"]
    assert cli.main([*words, "--repeats", "1", "--out", str(tmp_path / "m.csv")]) == cli.EXIT_OK
    out = capsys.readouterr().out
    assert "torch.nn.GRU" in out and LOOP in out and "two stages" in out
    rows = read_csv(tmp_path / "m_models.csv")
    assert [(row["model"], row["form"]) for row in rows] == [
        ("mingru", "scan"),
        ("mingru", "loop"),
        ("gru", "own"),
        (TORCH_GRU, "torch"),
    ]
    assert all(float(row[key]) > 0 for row in rows for key in ("forward_ms", "both_ms"))
    scans = read_csv(tmp_path / "m_scans.csv")
    assert [row["form"] for row in scans] == 2 * [*scan_forms(CPU), COPY]
    assert all(float(row["error"]) < 1e-3 and float(row["forward_ms"]) > 0 for row in scans)
    assert cli.main([*words, "--threads", "0"]) == cli.EXIT_BAD_INPUT
    capsys.readouterr()
    assert "device must be cpu" in one_error(capsys, [*words, "--device", "cuad"])
