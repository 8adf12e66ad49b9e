"""Laws of the Q(lambda) return and of the generalised advantage estimate; two errors of the
published learners.
"""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives.value import TDLambdaEstimator

from arcade_torch.agents import QLambdaEstimator, gae, q_lambda_return
from tests.agents.fakes import lambda_return, summed_errors

B, T = 3, 7
NO, ALL = torch.zeros(B, T, dtype=torch.bool), torch.ones(B, T, dtype=torch.bool)
CASES = {
    "seed": st.integers(0, 10**6),
    "steps": st.integers(1, 20),
    "lam": st.floats(0, 1),
    "ends": st.floats(0, 1),
}


def draw(
    seed: int, steps: int = T, ends: float = 0.3
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Random reward, value, value of the true next observation (float64 [B, T]), terminated and
    truncated.
    """
    g = torch.Generator().manual_seed(seed)
    reward, value, after = (
        torch.randn(B, steps, generator=g, dtype=torch.float64) for _ in range(3)
    )
    terminated, truncated = (torch.rand(B, steps, generator=g) < ends / 2 for _ in range(2))
    return reward, value, after, terminated, truncated


def at(step: int) -> Tensor:
    """True at one step of every row."""
    flags = NO.clone()
    flags[:, step] = True
    return flags


def returns(reward, value, after, terminated, truncated, *numbers):
    """The return, with the arguments of ``gae``."""
    return q_lambda_return(reward, after, terminated, truncated, *numbers)


def advantages(reward, value, after, terminated, truncated, *numbers):
    """The advantage plus the value, which has the laws of a return."""
    return gae(reward, value, after, terminated, truncated, *numbers) + value


both = pytest.mark.parametrize("estimate", [returns, advantages])


@given(**CASES, gamma=st.floats(0, 1))
def test_they_equal_the_sums_written_out(seed, steps, lam, ends, gamma):
    reward, value, after, *flags = draw(seed, steps, ends)
    expected = lambda_return(reward, after, *flags, gamma, lam)
    torch.testing.assert_close(
        q_lambda_return(reward, after, *flags, gamma, lam), expected, rtol=1e-9, atol=1e-9
    )
    expected = summed_errors(reward, value, after, *flags, gamma, lam)
    torch.testing.assert_close(
        gae(reward, value, after, *flags, gamma, lam), expected, rtol=1e-9, atol=1e-9
    )


@given(**CASES)
def test_advantage_plus_value_is_the_return_where_both_see_the_same_values(seed, steps, lam, ends):
    reward, value, after, terminated, truncated = draw(seed, steps, ends)
    after[:, :-1] = torch.where((terminated | truncated)[:, :-1], after[:, :-1], value[:, 1:])
    data = reward, value, after, terminated, truncated, 0.9, lam
    torch.testing.assert_close(advantages(*data), returns(*data))


@given(**CASES)
def test_the_estimator_gives_the_numbers_of_torchrls_in_its_layout(seed, steps, lam, ends):
    reward, _, after, terminated, truncated = draw(seed, steps, ends)
    flags = {"terminated": terminated, "done": terminated | truncated, "reward": reward}
    batch = TensorDict(
        {"next": {key: value.unsqueeze(-1) for key, value in flags.items()}}, reward.shape
    )
    ours = QLambdaEstimator(gamma=0.9, lmbda=lam).value_estimate(
        batch, next_value=after.unsqueeze(-1)
    )
    torch.testing.assert_close(
        ours.squeeze(-1), q_lambda_return(reward, after, terminated, truncated, 0.9, lam)
    )
    theirs = TDLambdaEstimator(gamma=0.9, lmbda=lam, value_network=None, vectorized=False)
    torch.testing.assert_close(
        ours, theirs.value_estimate(batch, next_value=after.unsqueeze(-1)), rtol=1e-5, atol=1e-5
    )


@both
def test_float64_keeps_its_precision(estimate):
    """In 0.1 a float32 constant cut targets to seven digits."""
    data = [x if x.dtype == torch.bool else x + 1e6 for x in draw(1)]
    assert estimate(*data, 0.99, 0.95).dtype == torch.float64
    expected = (
        lambda_return(data[0], data[2], *data[3:], 0.99, 0.95) if estimate is returns else None
    )
    if expected is None:
        expected = summed_errors(*data, 0.99, 0.95) + data[1]
    torch.testing.assert_close(estimate(*data, 0.99, 0.95), expected, rtol=1e-14, atol=0)


@both
def test_the_result_has_the_dtype_of_the_rewards(estimate):
    reward, value, after, *flags = draw(1)
    estimator = gae if estimate is advantages else returns
    for dtype in (torch.float32, torch.bfloat16):
        for values in ((value, after), (value.float(), after)):
            assert estimator(reward.to(dtype), *values, *flags, 0.9, 0.8).dtype == dtype


@both
def test_lambda_zero_is_the_one_step_target(estimate):
    reward, value, after, terminated, truncated = draw(1)
    found = estimate(reward, value, after, terminated, truncated, 0.9, 0.0)
    torch.testing.assert_close(found, reward + 0.9 * after * ~terminated)


@both
def test_lambda_one_without_ends_is_the_discounted_sum_plus_the_last_bootstrap(estimate):
    reward, value, after, *_ = draw(2)
    after[:, :-1] = value[:, 1:]
    expected = torch.stack(
        [sum(0.9 ** (k - t) * reward[:, k] for k in range(t, T)) for t in range(T)], 1
    )
    expected = expected + 0.9 ** torch.arange(T, 0, -1) * after[:, -1:]
    torch.testing.assert_close(estimate(reward, value, after, NO, NO, 0.9, 1.0), expected)


@both
def test_gamma_zero_and_an_end_at_every_step_leave_the_reward(estimate):
    reward, value, after, *flags = draw(3)
    torch.testing.assert_close(estimate(reward, value, after, *flags, 0.0, 0.8), reward)
    torch.testing.assert_close(estimate(reward, value, after, ALL, NO, 0.9, 0.8), reward)
    torch.testing.assert_close(
        estimate(reward, value, after, NO, ALL, 0.9, 0.8), reward + 0.9 * after
    )


@both
def test_the_last_step_loses_its_bootstrap_by_termination_and_not_by_truncation(estimate):
    reward, value, after, *_ = draw(5)
    ended = estimate(reward, value, after, at(-1), NO, 0.9, 0.8)
    torch.testing.assert_close(ended[:, -1], reward[:, -1])
    truncated, running = (
        estimate(reward, value, after, NO, flags, 0.9, 0.8) for flags in (at(-1), NO)
    )
    torch.testing.assert_close(truncated, running)


@both
def test_a_truncation_inside_cuts_the_recursion_but_keeps_the_bootstrap(estimate):
    reward, value, after, *_ = draw(6)
    out = estimate(reward, value, after, NO, at(3), 0.9, 1.0)
    torch.testing.assert_close(out[:, 3], reward[:, 3] + 0.9 * after[:, 3])
    reward[:, 4:] += 100.0
    assert torch.equal(estimate(reward, value, after, NO, at(3), 0.9, 1.0)[:, :4], out[:, :4])


@both
def test_time_limit_terminal_treats_truncation_as_termination(estimate):
    reward, value, after, terminated, truncated = draw(8)
    found = estimate(reward, value, after, terminated, truncated, 0.9, 0.8, "terminal")
    torch.testing.assert_close(
        found, estimate(reward, value, after, terminated | truncated, NO, 0.9, 0.8)
    )


@both
def test_values_behind_a_termination_never_matter_even_if_they_are_not_numbers(estimate):
    reward, value, after, _, truncated = draw(9)
    poisoned = torch.where(at(2), torch.nan, after)
    found, expected = (
        estimate(reward, value, x, at(2), truncated, 0.9, 0.8) for x in (poisoned, after)
    )
    assert torch.equal(found, expected) and found.isfinite().all()


def test_numbers_worked_out_by_hand():
    reward, value = torch.ones(1, 3), torch.full((1, 3), 2.0)
    no, end = NO[:1, :3], torch.tensor([[False, False, True]])
    assert q_lambda_return(reward, value, no, end, 0.9, 0.9)[0, 2].item() == pytest.approx(2.8)
    terminated = q_lambda_return(reward, value, end, no, 0.9, 0.9)[0]
    assert terminated[1:].tolist() == pytest.approx([1.99, 1.0])


@both
@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((1.5, 0.8), r"gamma .*1.5"),
        ((0.9, -0.1), r"lambda .*-0.1"),
        ((0.9, 0.8, "never"), "'never'"),
    ],
)
def test_bad_arguments_are_named(estimate, numbers, words):
    with pytest.raises(ValueError, match=words):
        estimate(*draw(0), *numbers)
    reward, value, after, *flags = draw(0)
    with pytest.raises(ValueError, match=r"rewards must be a floating one; got torch.int64"):
        estimate(reward.long(), value, after, *flags, 0.9, 0.8)
    with pytest.raises(ValueError, match="one shape"):
        estimate(reward, value, after[:, :-1], *flags, 0.9, 0.8)


# -- errors of the published learners, written out here: ours do not have them ---------------------


def published_feed_forward_targets(reward, best):
    """The memory-free learner: the scan starts with the last value in the place of "the next best
    Q" once too often.
    """
    target = torch.zeros_like(reward)
    target[:, -1] = reward[:, -1] + 0.99 * best[:, T]
    following, next_best = (
        target[:, -1],
        best[:, T],
    )  # should be best[:, T - 1] for the step that comes now
    for t in range(T - 2, -1, -1):
        target[:, t] = reward[:, t] + 0.99 * (0.05 * next_best + 0.95 * following)
        following, next_best = target[:, t], best[:, t]
    return target


def test_the_published_off_by_one_is_in_one_target_of_a_window_and_not_in_ours():
    reward, *_ = draw(10)
    best = torch.randn(B, T + 1, dtype=torch.float64)
    published, exact = (
        published_feed_forward_targets(reward, best),
        lambda_return(reward, best[:, 1:], NO, NO, 0.99, 0.95),
    )
    torch.testing.assert_close(q_lambda_return(reward, best[:, 1:], NO, NO, 0.99, 0.95), exact)
    error = published[:, T - 2] - exact[:, T - 2]
    torch.testing.assert_close(error, 0.99 * 0.05 * (best[:, T] - best[:, T - 1]))
    decay = (0.99 * 0.95) ** torch.arange(
        T - 2, -1, -1, dtype=torch.float64
    )  # earlier steps inherit it
    torch.testing.assert_close(published[:, :-1] - exact[:, :-1], error.unsqueeze(1) * decay)
    torch.testing.assert_close(published[:, -1], exact[:, -1])


def test_the_published_target_of_a_truncated_step_lacks_the_value_of_its_final_frame_and_ours_has_it():
    reward, _, after, *_ = draw(11)
    ours = q_lambda_return(reward, after, NO, at(5), 0.99, 0.95)
    published = lambda_return(reward, after, at(5), NO, 0.99, 0.95)  # done, whatever the reason
    torch.testing.assert_close(ours[:, 5] - published[:, 5], 0.99 * after[:, 5])
    torch.testing.assert_close(ours[:, 6:], published[:, 6:])
    torch.testing.assert_close(
        q_lambda_return(reward, after, NO, at(5), 0.99, 0.95, "terminal"), published
    )
