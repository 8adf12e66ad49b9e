"""The paper's score, episode bookkeeping, schedules, optimiser."""

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from arcade_torch.agents import EvalResult
from arcade_torch.agents.learner import linear, make_optimizer, set_learning_rate
from arcade_torch.agents.metrics import EpisodeStats, ewm, paper_score


def test_the_ewm_is_the_explicit_weighted_sum():
    x, alpha = np.random.default_rng(0).normal(size=30), 2 / 11
    weights = [
        [(1 - alpha) ** t] + [alpha * (1 - alpha) ** (t - k) for k in range(1, t + 1)]
        for t in range(30)
    ]
    expected = [np.dot(w, x[: len(w)]) for w in weights]
    np.testing.assert_allclose(ewm(x, span=10), expected)


def test_the_score_of_a_constant_curve_is_the_constant():
    assert paper_score([10, 20, 500], [0.3, 0.3, 0.3]) == pytest.approx(0.3)


def test_the_score_is_the_best_smoothed_point_not_the_last():
    frames = np.arange(1, 2001) * 100
    returns = np.where(frames < 100_000, 1.0, -1.0)
    assert paper_score(frames, returns) == pytest.approx(1.0)
    assert paper_score(frames, -returns) == pytest.approx(1.0 - 2 * (1 - 2 / 101) ** 500, abs=1e-3)


def test_the_score_of_a_step_matches_the_geometric_series():
    """Half the axis at 0, half at 1: 500 points of alpha = 2/101 reach 1 - (1 - alpha)^500 of the
    step.
    """
    grid = np.linspace(0, 1000, 1000)
    returns = (np.arange(1000) >= 500).astype(float)
    assert paper_score(grid, returns) == pytest.approx(1 - (1 - 2 / 101) ** 500, abs=1e-12)


def test_the_axis_begins_at_frame_zero_whenever_the_first_episode_ended():
    """A ramp over the second half of 1,000 points is followed (1 - alpha) / alpha points late."""
    assert paper_score([500, 1000], [0.0, 1.0]) == pytest.approx(1 - 49.5 / 499.5, abs=1e-3)


def test_beyond_the_history_the_curve_is_constant():
    assert paper_score([50, 100], [0.2, 0.2], max_frames=1000) == pytest.approx(0.2)
    late = paper_score([1, 100], [0.0, 1.0], max_frames=10_000)
    assert late > 0.99


@pytest.mark.parametrize(
    "history",
    [
        ([], []),
        ([1, 2], [0.0]),
        ([2, 1], [0.0, 0.0]),
        ([1, np.nan, 3], [0.0] * 3),
        ([1, np.inf], [0.0, 0.0]),
    ],
)
def test_a_history_that_is_none_is_refused(history):
    with pytest.raises(ValueError):
        paper_score(*history)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    envs=st.integers(1, 4),
    steps=st.integers(1, 12),
    cut=st.integers(0, 12),
)
def test_episode_returns_are_followed_across_windows(seed, envs, steps, cut):
    g = torch.Generator().manual_seed(seed)
    reward, done = torch.randn(envs, steps, generator=g), torch.rand(envs, steps, generator=g) < 0.3
    expected, last = [], np.zeros((envs, steps))
    for i in range(envs):
        start, newest = 0, np.nan
        for t in range(steps):
            if done[i, t]:
                newest = float(reward[i, start : t + 1].double().sum())
                expected.append(newest)
                start = t + 1
            last[i, t] = newest
    so_far, running = (
        torch.zeros(envs, steps, dtype=torch.float64),
        torch.zeros(envs, dtype=torch.float64),
    )
    for t in range(steps):
        running = running + reward[:, t]
        so_far[:, t] = running
        running = torch.where(done[:, t], 0.0, running)
    stats, seen, means = (
        EpisodeStats(np.full(envs, np.nan)),
        [],
        [],
    )  # means of the windows in which an episode ended
    for part in (slice(0, min(cut, steps)), slice(min(cut, steps), steps)):
        if reward[:, part].shape[1]:
            mean = stats.update(so_far[:, part], done[:, part])
            if np.isnan(last[:, part]).any():
                assert mean is None
            else:
                assert mean == pytest.approx(last[:, part].mean(), abs=1e-6)
            seen += stats.finished.tolist()
            if len(stats.finished):
                means.append(stats.finished.mean())
        saved, stats = stats.state_dict(), EpisodeStats(np.full(envs, np.nan))
        stats.load_state_dict(saved)
    np.testing.assert_allclose(sorted(seen), sorted(expected), atol=1e-6)
    assert stats.episodes == len(expected)
    assert stats.smooth == (pytest.approx(ewm(means, span=100)[-1], abs=1e-6) if means else None)


def test_an_environment_that_has_not_ended_yet_is_no_success():
    """Zeros in the place of first returns are what the published score of Tetris without memory is
    made of.
    """
    stats, lost = EpisodeStats(np.full(2, np.nan)), torch.full((2, 4), -1.0)
    ends = torch.tensor([[False, True, False, True], [False, False, False, False]])
    assert stats.update(lost, ends) is None and stats.finished.tolist() == [-1.0, -1.0]
    assert (
        stats.update(lost, ends.flip(0)) is None
    )  # the second has nothing at the beginning of this window
    assert stats.update(lost, ends & False) == -1.0


def test_the_interval_is_that_of_the_normal_mean():
    assert EvalResult(np.array([1.0, 3.0]), np.ones(2)).ci == pytest.approx(
        12.706, abs=1e-3
    )  # Student's, not 1.96
    one = EvalResult(np.array([1.0]), np.ones(1))  # before: +- 0.000 (95 %)
    assert math.isnan(one.ci) and one.half_width is None
    assert one.text == "return 1.000 of one episode, which gives no interval"


def test_linear_meets_both_ends_and_stays():
    assert linear(1.0, 0.05, 0, 100) == 1.0
    assert linear(1.0, 0.05, 50, 100) == pytest.approx(0.525)
    assert linear(1.0, 0.05, 100, 100) == linear(1.0, 0.05, 10**9, 100) == 0.05
    assert linear(1.0, 0.05, 0, 0) == 0.05


def radam_by_hand(gradients, lr):
    """Liu et al. 2020, algorithm 2, on one number."""
    b1, b2, m, v, x = 0.9, 0.999, 0.0, 0.0, 0.0
    limit = 2 / (1 - b2) - 1
    for t, g in enumerate(gradients, 1):
        m, v = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g * g
        rho = limit - 2 * t * b2**t / (1 - b2**t)
        step = m / (1 - b1**t)
        if rho > 5:
            r = ((rho - 4) * (rho - 2) * limit / ((limit - 4) * (limit - 2) * rho)) ** 0.5
            step *= r * (1 - b2**t) ** 0.5 / (v**0.5 + 1e-8)
        x -= lr * step
    return x


def test_the_optimiser_is_rectified_adam_of_the_paper():
    gradients = [0.3, -1.0, 0.5, 0.7, 0.1, -0.2, 0.9, 0.4, 0.6, -0.8]
    x = torch.nn.Parameter(torch.zeros(1, dtype=torch.float64))
    optimizer = make_optimizer([x], 1.0)
    set_learning_rate(optimizer, 0.01)
    for g in gradients:
        x.grad = torch.tensor([g], dtype=torch.float64)
        optimizer.step()
    assert x.item() == pytest.approx(radam_by_hand(gradients, 0.01), rel=1e-6)


def test_ppo_has_plain_adam_with_a_larger_epsilon():
    x = torch.nn.Parameter(torch.zeros(1))
    optimizer = make_optimizer([x], 0.1, "adam")
    x.grad = torch.ones(1)
    optimizer.step()
    assert x.item() == pytest.approx(-0.1 / (1 + 1e-5), rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_fused_radam_is_torchs_radam(dtype):
    torch.manual_seed(0)
    weights = [
        torch.randn(7, 5, 3, 3, dtype=dtype).to(memory_format=torch.channels_last),
        torch.randn(9, dtype=dtype),
    ]
    ours, theirs = ([nn.Parameter(x.clone()) for x in weights] for _ in range(2))
    fused, plain = make_optimizer(ours, 1e-2), torch.optim.RAdam(theirs, lr=1e-2)
    tolerance = (
        {"rtol": 1e-5, "atol": 1e-6} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-13}
    )
    for step in range(40):  # the first five know no variance yet
        set_learning_rate(fused, 1e-2 / (1 + step))
        set_learning_rate(plain, 1e-2 / (1 + step))
        for x, y in zip(ours, theirs, strict=True):
            x.grad = torch.randn_like(x) * 10 ** float(torch.randn(()))
            y.grad = x.grad.clone()
        fused.step()
        plain.step()
        for x, y in zip(ours, theirs, strict=True):
            torch.testing.assert_close(x, y, **tolerance)


def test_radam_in_one_pass_moves_a_weight_that_has_a_gradient_now_and_then_as_torch_does() -> None:
    """A part of a network that is used in some steps alone has fewer steps than the others."""
    ours = [torch.nn.Parameter(torch.linspace(-1, 1, 5)) for _ in range(3)]
    theirs = [torch.nn.Parameter(p.detach().clone()) for p in ours]
    fused, plain = make_optimizer(ours, 1e-2), torch.optim.RAdam(theirs, lr=1e-2)
    generator = torch.Generator().manual_seed(0)
    for step in range(20):
        used = [number for number in range(3) if step % (number + 1) == number]
        for number in range(3):
            gradient = torch.randn(5, generator=generator) if number in used else None
            for parameters in (ours, theirs):
                parameters[number].grad = None if gradient is None else gradient.clone()
        fused.step()
        plain.step()
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "plain"),
    [("radam", torch.optim.RAdam), ("adam", functools.partial(torch.optim.Adam, eps=1e-5))],
)
def test_complex_weights_move_as_torch_moves_them(kind: Any, plain: Any) -> None:
    """No fused kernel of torch takes them, and a memory may have them (``check_memory``)."""
    generator = torch.Generator().manual_seed(0)
    weights = [
        torch.randn(3, 2, dtype=torch.complex64, generator=generator),
        torch.randn(4, generator=generator),
    ]
    ours, theirs = ([nn.Parameter(x.clone()) for x in weights] for _ in range(2))
    optimizer = make_optimizer(ours, 1e-2, kind)
    reference = plain(theirs, lr=1e-2)
    for _ in range(12):
        for x, y in zip(ours, theirs, strict=True):
            x.grad = torch.randn(x.shape, dtype=x.dtype, generator=generator)
            y.grad = x.grad.clone()
        optimizer.step()
        reference.step()
    for x, y, start in zip(ours, theirs, weights, strict=True):
        assert (x - start).abs().min() > 1e-3
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)
