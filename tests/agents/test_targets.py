"""Laws of the Q(lambda) return."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from arcade_torch.agents.targets import q_lambda_return

B, T = 3, 7


def draw(seed: int, steps: int = T, end_share: float = 0.3) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random reward, next value (float64 [B, T]), terminated and truncated (bool [B, T])."""
    g = torch.Generator().manual_seed(seed)
    reward, value = (torch.randn(B, steps, generator=g, dtype=torch.float64) for _ in range(2))
    terminated, truncated = (torch.rand(B, steps, generator=g) < end_share / 2 for _ in range(2))
    return reward, value, terminated, truncated


def explicit_return(
    reward: list[float],
    value: list[float],
    terminated: list[bool],
    truncated: list[bool],
    t: int,
    gamma: float,
    lam: float,
) -> float:
    """G[t] as a mixture of n-step returns: (1 - lam) sum lam^(n-1) G^(n), the last one taking the remaining weight."""
    total, weight, discounted, n = 0.0, 1.0, 0.0, 0
    while True:
        k = t + n
        discounted += gamma**n * reward[k]
        tail = 0.0 if terminated[k] else gamma ** (n + 1) * value[k]
        if terminated[k] or truncated[k] or k == len(reward) - 1:
            return total + weight * (discounted + tail)
        total += weight * (1 - lam) * (discounted + tail)
        weight *= lam
        n += 1


def explicit(reward: Tensor, value: Tensor, terminated: Tensor, truncated: Tensor, gamma: float, lam: float) -> Tensor:
    rows = [[x[b].tolist() for x in (reward, value, terminated, truncated)] for b in range(reward.shape[0])]
    return torch.tensor(
        [[explicit_return(*row, t, gamma, lam) for t in range(reward.shape[1])] for row in rows], dtype=torch.float64
    )


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    steps=st.integers(1, 20),
    gamma=st.floats(0, 1),
    lam=st.floats(0, 1),
    ends=st.floats(0, 1),
)
def test_it_equals_the_explicit_mixture_of_n_step_returns(seed, steps, gamma, lam, ends):
    data = draw(seed, steps, ends)
    torch.testing.assert_close(q_lambda_return(*data, gamma, lam), explicit(*data, gamma, lam))


def test_lambda_zero_is_the_one_step_target():
    reward, value, terminated, truncated = draw(1)
    expected = reward + 0.9 * value * ~terminated
    torch.testing.assert_close(q_lambda_return(reward, value, terminated, truncated, 0.9, 0.0), expected)


def test_lambda_one_without_ends_is_the_discounted_sum_plus_the_last_bootstrap():
    reward, value, *_ = draw(2)
    none = torch.zeros(B, T, dtype=torch.bool)
    expected = torch.zeros(B, T, dtype=torch.float64)
    for t in range(T):
        for k in range(t, T):
            expected[:, t] += 0.9 ** (k - t) * reward[:, k]
        expected[:, t] += 0.9 ** (T - t) * value[:, -1]
    torch.testing.assert_close(q_lambda_return(reward, value, none, none, 0.9, 1.0), expected)


def test_when_every_step_terminates_the_return_is_the_reward():
    reward, value, *_ = draw(3)
    all_, none = torch.ones(B, T, dtype=torch.bool), torch.zeros(B, T, dtype=torch.bool)
    torch.testing.assert_close(q_lambda_return(reward, value, all_, none, 0.9, 0.8), reward)


def test_when_every_step_is_truncated_each_bootstraps_from_its_own_final_frame():
    reward, value, *_ = draw(4)
    all_, none = torch.ones(B, T, dtype=torch.bool), torch.zeros(B, T, dtype=torch.bool)
    torch.testing.assert_close(q_lambda_return(reward, value, none, all_, 0.9, 0.8), reward + 0.9 * value)


def test_a_termination_at_the_last_step_removes_the_bootstrap_there_only():
    reward, value, *_ = draw(5)
    none = torch.zeros(B, T, dtype=torch.bool)
    last = none.clone()
    last[:, -1] = True
    out = q_lambda_return(reward, value, last, none, 0.9, 1.0)
    torch.testing.assert_close(out[:, -1], reward[:, -1])
    torch.testing.assert_close(out[:, -2], reward[:, -2] + 0.9 * reward[:, -1])


def test_a_truncation_inside_cuts_the_recursion_but_keeps_the_bootstrap():
    reward, value, terminated, _ = draw(6)
    terminated = torch.zeros_like(terminated)
    truncated = terminated.clone()
    truncated[:, 3] = True
    out = q_lambda_return(reward, value, terminated, truncated, 0.9, 1.0)
    torch.testing.assert_close(out[:, 3], reward[:, 3] + 0.9 * value[:, 3])
    moved = reward.clone()
    moved[:, 4:] += 100.0
    torch.testing.assert_close(q_lambda_return(moved, value, terminated, truncated, 0.9, 1.0)[:, :4], out[:, :4])


def test_a_truncation_at_the_last_step_bootstraps_like_the_window_end():
    reward, value, *_ = draw(7)
    none = torch.zeros(B, T, dtype=torch.bool)
    last = none.clone()
    last[:, -1] = True
    torch.testing.assert_close(
        q_lambda_return(reward, value, none, last, 0.9, 0.8), q_lambda_return(reward, value, none, none, 0.9, 0.8)
    )


def test_time_limit_terminal_treats_truncation_as_termination():
    reward, value, terminated, truncated = draw(8)
    none = torch.zeros_like(terminated)
    torch.testing.assert_close(
        q_lambda_return(reward, value, terminated, truncated, 0.9, 0.8, "terminal"),
        q_lambda_return(reward, value, terminated | truncated, none, 0.9, 0.8),
    )


def test_values_behind_a_termination_never_matter_even_if_they_are_not_numbers():
    reward, value, terminated, truncated = draw(9)
    terminated[:, 2] = True
    poisoned = torch.where(terminated, torch.nan, value)
    torch.testing.assert_close(
        q_lambda_return(reward, poisoned, terminated, truncated, 0.9, 0.8),
        q_lambda_return(reward, value, terminated, truncated, 0.9, 0.8),
    )


def test_the_published_numbers_of_truncation_and_termination():
    reward, value = torch.ones(1, 3), torch.full((1, 3), 2.0)
    no, end = torch.zeros(1, 3, dtype=torch.bool), torch.tensor([[False, False, True]])
    truncated = q_lambda_return(reward, value, no, end, 0.9, 0.9)
    terminated = q_lambda_return(reward, value, end, no, 0.9, 0.9)
    assert truncated[0, 2].item() == pytest.approx(2.8)
    assert terminated[0, 2].item() == pytest.approx(1.0)
    assert terminated[0, 1].item() == pytest.approx(1.99)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"gamma": 1.5}, "gamma=1.5"), ({"lam": -0.1}, "lambda=-0.1"), ({"time_limit": "never"}, "'never'")],
)
def test_bad_arguments_are_named(change, words):
    arguments = {"gamma": 0.9, "lam": 0.8} | change
    with pytest.raises(ValueError, match=words):
        q_lambda_return(*draw(0), **arguments)


def test_shapes_that_differ_are_refused():
    reward, value, terminated, truncated = draw(0)
    with pytest.raises(ValueError, match="one shape"):
        q_lambda_return(reward, value[:, :-1], terminated, truncated, 0.9, 0.8)
