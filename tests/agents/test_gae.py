"""Laws of the generalised advantage estimate."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from arcade_torch.agents.targets import gae, q_lambda_return

B, T = 3, 7


def draw(seed: int, steps: int = T, ends: float = 0.3) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Random reward, value, value of the true next observation (float64 [B, T]), terminated and truncated."""
    g = torch.Generator().manual_seed(seed)
    reward, value, after = (torch.randn(B, steps, generator=g, dtype=torch.float64) for _ in range(3))
    terminated, truncated = (torch.rand(B, steps, generator=g) < ends / 2 for _ in range(2))
    return reward, value, after, terminated, truncated


def by_hand(reward, value, after, terminated, truncated, gamma, lam):
    """The sum over future errors, written out for every step: no recursion, no vectors."""
    out = torch.zeros_like(reward)
    for b in range(reward.shape[0]):
        for t in range(reward.shape[1]):
            weight = 1.0
            for k in range(t, reward.shape[1]):
                following = 0.0 if terminated[b, k] else float(after[b, k])
                out[b, t] += weight * (float(reward[b, k]) + gamma * following - float(value[b, k]))
                if terminated[b, k] or truncated[b, k]:
                    break
                weight *= gamma * lam
    return out


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    steps=st.integers(1, 20),
    gamma=st.floats(0, 1),
    lam=st.floats(0, 1),
    ends=st.floats(0, 1),
)
def test_it_equals_the_sum_of_errors_written_out(seed, steps, gamma, lam, ends):
    data = draw(seed, steps, ends)
    torch.testing.assert_close(gae(*data, gamma, lam), by_hand(*data, gamma, lam))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), steps=st.integers(1, 20), lam=st.floats(0, 1), ends=st.floats(0, 1))
def test_advantage_plus_value_is_the_lambda_return_where_both_see_the_same_values(seed, steps, lam, ends):
    reward, value, after, terminated, truncated = draw(seed, steps, ends)
    after[:, :-1] = torch.where((terminated | truncated)[:, :-1], after[:, :-1], value[:, 1:])
    flags = terminated, truncated
    expected = q_lambda_return(reward, after, *flags, 0.9, lam)
    torch.testing.assert_close(gae(reward, value, after, *flags, 0.9, lam) + value, expected)


def test_lambda_zero_is_the_one_step_error():
    reward, value, after, terminated, _ = data = draw(1)
    torch.testing.assert_close(gae(*data, 0.9, 0.0), reward + 0.9 * after * ~terminated - value)


def test_lambda_one_without_ends_is_the_discounted_sum_minus_the_value():
    reward, value, after, *_ = draw(2)
    after[:, :-1] = value[:, 1:]
    none = torch.zeros(B, T, dtype=torch.bool)
    expected = -value
    for t in range(T):
        expected[:, t] += sum(0.9 ** (k - t) * reward[:, k] for k in range(t, T)) + 0.9 ** (T - t) * after[:, -1]
    torch.testing.assert_close(gae(reward, value, after, none, none, 0.9, 1.0), expected)


def test_gamma_zero_is_the_reward_minus_the_value():
    reward, value, *_ = data = draw(3)
    torch.testing.assert_close(gae(*data, 0.0, 0.95), reward - value)


def test_when_every_step_terminates_the_advantage_is_the_reward_minus_the_value():
    reward, value, after, *_ = draw(4)
    every, none = torch.ones(B, T, dtype=torch.bool), torch.zeros(B, T, dtype=torch.bool)
    torch.testing.assert_close(gae(reward, value, after, every, none, 0.9, 0.8), reward - value)


def test_a_termination_at_the_last_step_removes_the_bootstrap_there():
    reward, value, after, *_ = draw(5)
    none = torch.zeros(B, T, dtype=torch.bool)
    last = none.clone()
    last[:, -1] = True
    torch.testing.assert_close(gae(reward, value, after, last, none, 0.9, 0.8)[:, -1], reward[:, -1] - value[:, -1])
    truncated, running = (gae(reward, value, after, none, flags, 0.9, 0.8) for flags in (last, none))
    torch.testing.assert_close(truncated, running)


def test_a_truncation_inside_cuts_the_recursion_but_keeps_the_bootstrap():
    reward, value, after, *_ = draw(6)
    none = torch.zeros(B, T, dtype=torch.bool)
    truncated = none.clone()
    truncated[:, 3] = True
    out = gae(reward, value, after, none, truncated, 0.9, 1.0)
    torch.testing.assert_close(out[:, 3], reward[:, 3] + 0.9 * after[:, 3] - value[:, 3])
    moved = reward.clone()
    moved[:, 4:] += 100.0
    torch.testing.assert_close(gae(moved, value, after, none, truncated, 0.9, 1.0)[:, :4], out[:, :4])


def test_time_limit_terminal_treats_truncation_as_termination():
    reward, value, after, terminated, truncated = draw(7)
    none = torch.zeros_like(terminated)
    torch.testing.assert_close(
        gae(reward, value, after, terminated, truncated, 0.9, 0.8, "terminal"),
        gae(reward, value, after, terminated | truncated, none, 0.9, 0.8),
    )


def test_values_behind_a_termination_never_matter_even_if_they_are_not_numbers():
    reward, value, after, terminated, truncated = draw(8)
    terminated[:, 2] = True
    poisoned = torch.where(terminated, torch.nan, after)
    torch.testing.assert_close(
        gae(reward, value, poisoned, terminated, truncated, 0.9, 0.8),
        gae(reward, value, after, terminated, truncated, 0.9, 0.8),
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [({"gamma": 1.5}, "gamma=1.5"), ({"lam": -0.1}, "lambda=-0.1"), ({"time_limit": "never"}, "'never'")],
)
def test_bad_arguments_are_named(change, words):
    with pytest.raises(ValueError, match=words):
        gae(*draw(0), **({"gamma": 0.9, "lam": 0.8} | change))
