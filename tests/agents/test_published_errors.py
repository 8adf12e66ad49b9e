"""Two errors in the targets of the published learners, written out here, and that ours do not have them."""

import torch

from arcade_torch.agents.targets import q_lambda_return

GAMMA, LAM, T = 0.99, 0.95, 12


def experience(seed=0):
    """Reward, best Q of o_0 .. o_T (one more than steps), and no ends: float64 [1, T] and [1, T + 1]."""
    g = torch.Generator().manual_seed(seed)
    reward = torch.randn(1, T, generator=g, dtype=torch.float64)
    best = torch.randn(1, T + 1, generator=g, dtype=torch.float64)
    return reward, best, torch.zeros(1, T, dtype=torch.bool)


def published_feed_forward_targets(reward, best, done):
    """The memory-free learner: the scan starts with the last value in the place of "the next best Q" once too often."""
    going = 1.0 - done.double()
    last = best[:, T] * going[:, -1]
    target = torch.zeros_like(reward)
    target[:, -1] = reward[:, -1] + GAMMA * last
    following, next_best = target[:, -1], last  # should be best[:, T - 1] for the step that comes now
    for t in range(T - 2, -1, -1):
        mixed = (1 - LAM) * next_best + LAM * following
        target[:, t] = reward[:, t] + GAMMA * going[:, t] * mixed
        following, next_best = target[:, t], best[:, t]
    return target


def explicit_targets(reward, best, done):
    """n-step returns from t, mixed with weights (1 - lambda) lambda^(n - 1), the last one with what is left."""
    target = torch.zeros_like(reward)
    for t in range(T):
        weight, discounted = 1.0, 0.0
        for n, k in enumerate(range(t, T)):
            discounted = discounted + GAMMA**n * reward[0, k]
            tail = 0.0 if done[0, k] else GAMMA ** (n + 1) * best[0, k + 1]
            if done[0, k] or k == T - 1:
                target[0, t] += weight * (discounted + tail)
                break
            target[0, t] += weight * (1 - LAM) * (discounted + tail)
            weight *= LAM
    return target


def test_the_published_off_by_one_is_in_one_target_of_a_window_and_not_in_ours():
    reward, best, no = experience()
    published, exact = published_feed_forward_targets(reward, best, no), explicit_targets(reward, best, no)
    ours = q_lambda_return(reward, best[:, 1:], no, no, GAMMA, LAM)
    torch.testing.assert_close(ours, exact)
    error = published[0, T - 2] - exact[0, T - 2]
    torch.testing.assert_close(error, GAMMA * (1 - LAM) * (best[0, T] - best[0, T - 1]))
    assert error.abs() > 1e-3
    decay = (GAMMA * LAM) ** torch.arange(T - 2, -1, -1, dtype=torch.float64)  # earlier steps inherit it
    torch.testing.assert_close(published[0, : T - 1] - exact[0, : T - 1], error * decay)
    torch.testing.assert_close(published[:, -1], exact[:, -1])


def test_the_published_target_of_a_truncated_step_lacks_the_value_of_its_final_frame_and_ours_has_it():
    reward, best, no = experience(1)
    cut = no.clone()
    cut[0, 5] = True
    ours = q_lambda_return(reward, best[:, 1:], no, cut, GAMMA, LAM)
    published = explicit_targets(reward, best, cut)  # done, whatever the reason
    torch.testing.assert_close(ours[0, 5] - published[0, 5], GAMMA * best[0, 6])
    torch.testing.assert_close(ours[:, 6:], published[:, 6:])
    torch.testing.assert_close(q_lambda_return(reward, best[:, 1:], no, cut, GAMMA, LAM, "terminal"), published)
