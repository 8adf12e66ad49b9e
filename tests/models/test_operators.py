"""The operators behind the scans, lifted to start flags: however steps are bracketed, the scan
comes out.
"""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.models import MatrixSteps, linear_scan, matrix_scan

F64 = torch.float64


def linear(left, right):
    """h -> a h + b after h -> a h + b, elementwise."""
    (a, b), (c, d) = left, right
    return c * a, c * b + d


def matrix(left, right):
    """S -> M S + X after S -> M S + X."""
    (m, x), (n, z) = left, right
    return n @ m, n @ x + z


def lifted(operator):
    """The operator on (element, start): what stands left of a start is not looked at."""

    def combine(left, right):
        flag = right[1]
        return (right[0] if flag else operator(left[0], right[0])), left[1] or flag

    return combine


def bracketed(combine, elements, generator):
    """The elements combined along a random binary tree."""
    if len(elements) == 1:
        return elements[0]
    cut = int(torch.randint(1, len(elements), (), generator=generator))
    return combine(
        bracketed(combine, elements[:cut], generator), bracketed(combine, elements[cut:], generator)
    )


@given(length=st.integers(2, 20), resets=st.sampled_from([0.0, 0.2]), seed=st.integers(0, 2**16))
@settings(max_examples=40, deadline=None)
def test_the_linear_scan_is_the_lifted_operator_over_any_tree(length, resets, seed):
    torch.manual_seed(seed)
    a, b, h0 = (
        torch.randn(1, length, 3, dtype=F64),
        torch.randn(1, length, 3, dtype=F64),
        torch.randn(1, 3, dtype=F64),
    )
    start = torch.rand(1, length) < resets
    elements = [((a[0, t], b[0, t]), bool(start[0, t])) for t in range(length)]
    carried = ((torch.zeros(3, dtype=F64), h0[0]), False)
    # Right of a start the carried element is gone, and a there multiplies the state of an episode's
    # beginning: zeros.
    (_, h), _ = bracketed(lifted(linear), [carried, *elements], torch.Generator().manual_seed(seed))
    torch.testing.assert_close(linear_scan(a, b, start, h0)[0, -1], h, rtol=1e-10, atol=1e-10)


@given(length=st.integers(2, 20), resets=st.sampled_from([0.0, 0.2]), seed=st.integers(0, 2**16))
@settings(max_examples=40, deadline=None)
def test_the_matrix_scan_is_the_lifted_operator_over_any_tree(length, resets, seed):
    torch.manual_seed(seed)
    query, key = (
        torch.nn.functional.normalize(torch.randn(1, length, 3, dtype=F64), dim=-1) for _ in "qk"
    )
    value, beta = torch.randn(1, length, 2, dtype=F64), 2 * torch.rand(1, length, 1, dtype=F64)
    alpha, h0, start = (
        torch.rand(1, length, 1, dtype=F64),
        torch.randn(1, 3, 2, dtype=F64),
        torch.rand(1, length) < resets,
    )
    elements = []
    for t in range(length):
        transition = alpha[0, t] * (
            torch.eye(3, dtype=F64) - beta[0, t] * torch.outer(key[0, t], key[0, t])
        )
        elements.append(((transition, torch.outer(key[0, t], value[0, t])), bool(start[0, t])))
    carried = ((torch.zeros(3, 3, dtype=F64), h0[0]), False)
    (_, last), _ = bracketed(
        lifted(matrix), [carried, *elements], torch.Generator().manual_seed(seed)
    )
    steps = MatrixSteps(query, key, value, beta, alpha.log())
    torch.testing.assert_close(matrix_scan(steps, start, h0)[1][0], last, rtol=1e-10, atol=1e-10)
