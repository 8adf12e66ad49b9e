"""The matrix scan against flash-linear-attention (``fla-core`` 0.6.0): its naive forms, which are
plain torch; its kernels need a card. `make test-suites` installs it.
"""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from arcade_torch.models.scan_matrix import MatrixSteps, matrix_scan
from tests.models.written_out import file_of

BATCH, LENGTH, KEYS, VALUES = 3, 41, 5, 4
"""Longer than a chunk of ours."""


def theirs(kind: str, steps: MatrixSteps, h0: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs and last state of the naive form, with one head; ours has no scale."""
    query, key, value, erase, log_decay = steps
    heads: list[Any] = [None if x is None else x.unsqueeze(2) for x in steps]
    begin = h0.unsqueeze(1)
    if kind == "sum":
        naive = file_of("fla", "ops/linear_attn/naive.py").naive_recurrent_linear_attn
        o, last = naive(*heads[:3], scale=1.0, initial_state=begin, output_final_state=True)
    elif kind == "decay":
        naive = file_of("fla", "ops/simple_gla/naive.py").naive_recurrent_simple_gla
        o, last = naive(*heads[:3], log_decay, scale=1.0, initial_state=begin)
    elif kind == "delta":
        assert erase is not None
        naive = file_of("fla", "ops/delta_rule/naive.py").delta_rule_recurrence
        scaled = query * KEYS**0.5  # it divides by that
        # heads come before time; it multiplies values by the strength of writing
        heads = [x.unsqueeze(1) for x in (scaled, key, value / erase, erase)]
        o, last = naive(*heads, initial_state=begin)
        o = o.transpose(1, 2)
    else:
        assert erase is not None
        naive = file_of("fla", "ops/gated_delta_rule/naive.py").naive_recurrent_gated_delta_rule
        heads = [x.unsqueeze(2) for x in (query, key, value / erase)]
        o, last = naive(*heads, erase, log_decay, 1.0, begin, output_final_state=True)
    return o[:, :, 0], last[:, 0]


@pytest.mark.parametrize("kind", ["sum", "decay", "delta", "gated delta"])
@pytest.mark.parametrize("begins", [0, 17])
def test_the_matrix_scan_is_that_of_flash_linear_attention(kind: str, begins: int) -> None:
    generator = torch.Generator().manual_seed(5)
    query, key = F.normalize(torch.randn(2, BATCH, LENGTH, KEYS, generator=generator), dim=-1)
    steps = MatrixSteps(
        query,
        key,
        torch.randn(BATCH, LENGTH, VALUES, generator=generator),
        2 * torch.rand(BATCH, LENGTH, 1, generator=generator) if "delta" in kind else None,
        F.logsigmoid(2 * torch.randn(BATCH, LENGTH, 1, generator=generator))
        if kind in ("decay", "gated delta")
        else None,
    )
    h0 = torch.randn(BATCH, KEYS, VALUES, generator=generator)
    start = torch.zeros(BATCH, LENGTH, dtype=torch.bool)
    start[:, begins] = begins > 0
    o, last = matrix_scan(steps, start, h0)

    # theirs knows no starts: what stands before one is a sequence of its own
    later = MatrixSteps(*(None if x is None else x[:, begins:] for x in steps))
    wanted, wanted_last = theirs(kind, later, torch.zeros_like(h0) if begins else h0)
    torch.testing.assert_close(o[:, begins:], wanted, rtol=0, atol=2e-5)
    torch.testing.assert_close(last, wanted_last, rtol=0, atol=2e-5)
    if begins:
        earlier = MatrixSteps(*(None if x is None else x[:, :begins] for x in steps))
        wanted, _ = theirs(kind, earlier, h0)
        torch.testing.assert_close(o[:, :begins], wanted, rtol=0, atol=2e-5)
