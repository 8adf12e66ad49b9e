"""Contamination against models whose answer is known."""

from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from arcade_torch.agents import Agent, preset
from arcade_torch.agents.evaluation import held_out_seed
from arcade_torch.agents.policy import build_network
from arcade_torch.tools import Policy, contamination
from arcade_torch.tools.measures.contamination.measure import (
    contamination_example,
    disturbed_frames,
    replayed,
    shuffle_order,
)
from arcade_torch.tools.measures.windows import greedy_window, greedy_windows
from tests.tools.measures.toys import Net, ToyEnv, frames, linear_policy, window

ENV = (14, 20, 30)


def test_a_linear_memory_forgets_noise_at_its_own_rate() -> None:
    rho = 0.7
    found = contamination(
        linear_policy(rho, dtype=torch.float32),
        ToyEnv(ENV),
        sigmas=(0.1,),
        delays=(0, 1, 3),
        starts=40,
    )
    moved = found.mean("change")[0]
    spread = contamination(
        linear_policy(rho, dtype=torch.float32),
        ToyEnv(ENV),
        sigmas=(0.2,),
        delays=(0, 1, 3),
        starts=40,
    )
    np.testing.assert_allclose(
        spread.mean("change")[0], 2 * moved, rtol=1e-3
    )  # linear in sigma, same draw
    assert moved[0] > moved[1] > moved[2] > 0


def test_the_relative_change_is_rho_to_the_delay_over_the_spread_of_values() -> None:
    rho, policy = 0.6, linear_policy(0.6, dtype=torch.float32)
    w = window(8)
    clean = policy.encode(w.frames)[None]
    noisy = clean.clone()
    noisy[0, 2] += 5.0
    before, after = (replayed(policy, w, e, 2, False)[0] for e in (clean, noisy))
    at_once, later = after[2] - before[2], after[6] - before[6]
    torch.testing.assert_close(later, rho**4 * at_once, rtol=1e-3, atol=1e-2)
    torch.testing.assert_close(after[:2], before[:2])


@pytest.mark.parametrize("target", ["q", "probs"])
def test_flip_change_and_divergence_are_those_of_a_slow_replay(
    target: Literal["q", "probs"], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, env = linear_policy(0.8, dtype=torch.float32, gain=2e-4), ToyEnv([9, 12])
    monkeypatch.setattr(
        "arcade_torch.tools.measures.contamination.measure.disturbed_frames",
        lambda frames, places, *rest: 255 - frames[torch.as_tensor(places)].float(),
    )
    found = contamination(
        policy, env, sigmas=(0.1,), delays=(0, 2), starts=12, seed=1, target=target
    )
    windows = list(greedy_windows(policy, env, episodes=28, seed=1))
    for point, (number, place) in enumerate(found.points):
        w = windows[number]
        dirty = w.frames.float()
        dirty[place] = 255 - dirty[place]
        clean, moved = (policy.remember(policy.encode(o)[None], None, w.is_init[None], None)[0][0].double().numpy()
                        for o in (w.frames, dirty))  # fmt: skip
        for k, t in enumerate((place, place + 2)):
            if t > w.n:
                assert np.isnan(found.change[point, 0, k])
                continue
            p, q = (np.exp(y[t]) / np.exp(y[t]).sum() for y in (clean, moved))
            a, b = (p, q) if target == "probs" else (clean[t], moved[t])
            difference = (b - b.mean()) - (a - a.mean())
            assert found.change[point, 0, k] == pytest.approx(
                abs(difference).max() / (a.max() - a.min()), rel=1e-4
            )
            assert found.flip[point, 0, k] == (a.argmax() != b.argmax())
            if target == "probs":
                assert found.kl[point, 0, k] == pytest.approx((p * np.log(p / q)).sum(), rel=1e-3)


def test_delays_beyond_the_end_of_an_episode_are_missing_and_counted_so() -> None:
    found = contamination(
        linear_policy(0.9, dtype=torch.float32), ToyEnv([10]), delays=(0, 5, 9, 50), starts=40
    )
    left = 9 - found.points[:, 1]
    for k, delay in enumerate((0, 5, 9, 50)):
        assert (np.isfinite(found.flip[:, 0, k]) == (left >= delay)).all()
    assert found.counts()[0].tolist() == [(left >= delay).sum() for delay in (0, 5, 9, 50)]
    assert (
        np.isnan(found.mean("flip")[0, -1]) and np.isnan(found.kl).all()
    )  # Q-values have no distribution


def test_delays_that_no_episode_reaches_are_refused() -> None:
    with pytest.raises(
        ValueError,
        match="was long enough: 2 frames are needed, and 9 steps after the disturbed one",
    ):
        contamination(
            linear_policy(0.9, dtype=torch.float32), ToyEnv([6]), delays=(9, 50), starts=4
        )


def test_start_points_lie_before_the_last_frame_and_four_at_most_in_an_episode() -> None:
    found = contamination(
        linear_policy(0.5, dtype=torch.float32), ToyEnv(ENV), starts=50, delays=(0,)
    )
    assert len(found.points) == 50
    lengths = np.array(ENV)[found.points[:, 0] % len(ENV)]
    assert (found.points[:, 1] < lengths - 1).all()
    assert np.bincount(found.points[:, 0]).max() <= 4
    assert len(np.unique(found.points, axis=0)) == 50 and found.skipped == 0


def test_noise_has_the_asked_strength_its_draw_is_shared_and_clipping_keeps_the_range() -> None:
    o = torch.full((3, 64, 64, 3), 128, dtype=torch.uint8)
    noisy = (
        disturbed_frames(o, np.array([0, 2]), np.array([0.0, 0.1, 0.3]), False, seed=0).unflatten(
            0, (2, 3)
        )
        - 128
    )
    assert not noisy[:, 0].any()
    assert noisy[:, 1].std().item() == pytest.approx(25.5, rel=0.02)
    torch.testing.assert_close(noisy[:, 2], 3 * noisy[:, 1], rtol=1e-3, atol=1e-2)
    assert not torch.equal(noisy[0, 1], noisy[1, 1])
    clipped = disturbed_frames(o, np.array([0]), np.array([1.0]), True, seed=0)
    assert clipped.min() == 0 and clipped.max() == 255


def test_pixels_that_are_outside_of_the_range_are_not_clipped_to_it() -> None:
    """Before: frames of zero mean lost all that was below 0, noise or none, without a word."""
    o = torch.linspace(-1.0, 1.0, 48).reshape(1, 4, 4, 3)
    hit = np.array([0])
    with pytest.raises(
        ValueError, match="clip=True keeps pixels in 0 to 1, got frames from -1 to 1"
    ):
        disturbed_frames(o, hit, np.array([0.0]), True, seed=0, white=1.0)
    torch.testing.assert_close(disturbed_frames(o, hit, np.array([0.0]), False, 0, 1.0), o)
    inside = disturbed_frames((o + 1) / 2, hit, np.array([0.0]), True, 0, 1.0)
    torch.testing.assert_close(inside, (o + 1) / 2)


def test_a_shuffle_moves_the_named_frames_only_and_always_moves_some() -> None:
    for seed in range(30):
        order = shuffle_order(12, 1, 3, np.random.default_rng(seed))
        assert order[[0, 1, *range(4, 12)]].tolist() == [0, 1, *range(4, 12)]
        assert sorted(order[2:4]) == [2, 3] and order[2] == 3
    with pytest.raises(ValueError, match="cannot permute frames 2 to 3 of 3"):
        shuffle_order(3, 1, 3, np.random.default_rng(0))


def test_a_memory_that_adds_up_does_not_notice_the_order_and_one_that_forgets_does() -> None:
    sums, fades = (linear_policy(rho, dtype=torch.float32) for rho in (1.0, 0.9))
    same, moved = (
        contamination(p, ToyEnv(ENV), delays=(0, 3), starts=12, shuffle=True) for p in (sums, fades)
    )
    assert same.mean("change").max() < 1e-4 < moved.mean("change").min()
    short = contamination(fades, ToyEnv([5, 20]), starts=4, delays=(0,), shuffle=True)
    assert short.skipped >= 3 and len(short.points) == 4


def acting_policy(inertia: float) -> Policy:
    """Q depends on the frame and, by ``inertia``, on the previous action."""

    def remember(e: Tensor, last_action: Tensor, is_init: Tensor, state: Any) -> tuple[Tensor, Any]:
        return e + inertia * torch.nn.functional.one_hot(last_action, e.shape[-1]), state

    return Policy(lambda o: o.float().flatten(-3)[..., :5] / 255, remember)


def test_feedback_lets_a_flip_live_on_through_the_actions_and_teacher_forcing_does_not() -> None:
    sticky = acting_policy(10.0)  # repeats its last action for ever
    forced, free = (
        contamination(
            sticky, ToyEnv(ENV), sigmas=(30.0,), delays=(0, 1, 4), starts=40, feedback=feedback
        )
        for feedback in (False, True)
    )
    assert forced.mean("flip")[0, 0] > 0.2 and forced.mean("flip")[0, 1:].max() == 0
    np.testing.assert_allclose(free.mean("flip")[0, 0], forced.mean("flip")[0, 0])
    alive = np.isfinite(free.flip[:, 0, 2])
    np.testing.assert_array_equal(free.flip[alive, 0, 2], free.flip[alive, 0, 0])


def test_a_policy_has_a_divergence_that_is_zero_where_nothing_changes() -> None:
    config = preset("smoke", env="MineSweeperEasy", memory="lru", algorithm="ppo")
    agent = Agent(config, build_network(config).eval())
    found = contamination(agent, sigmas=(0.0, 1.0), delays=(0, 1, 2), starts=6, cap=8)
    assert found.target == "probs"
    assert np.nanmax(np.abs(found.kl[:, 0])) < 1e-9 < found.mean("kl")[1, 0]
    with pytest.raises(ValueError, match="target must be q, logits or probs, not value"):
        contamination(agent, target="value", starts=1)


def test_an_example_holds_the_clean_outputs_and_differs_in_the_hit_frames_alone() -> None:
    policy = linear_policy(0.9, dtype=torch.float32)
    found = contamination_example(policy, ToyEnv([30]), horizon=10, seed=3)
    w = greedy_window(policy, ToyEnv([30]), seed=held_out_seed(3), max_steps=11)
    clean = replayed(policy, w, policy.features(w.frames)[None], 10, False)[0, -1].double().numpy()
    np.testing.assert_allclose(found.values[0], clean - clean.mean(), rtol=1e-5)
    np.testing.assert_array_equal(found.frames[0], w.frames)
    assert found.hits.tolist() == [-1, 1, 5, 9] and found.sigma == 1
    changed = (found.frames != found.frames[0]).any((2, 3, 4))
    assert [np.flatnonzero(row).tolist() for row in changed] == [[], [1], [5], [9]]
    assert (abs(found.values[1:] - found.values[0]).max(1) > 1e-3).all()
    shares = contamination_example(
        linear_policy(0.9, gain=2e-4), ToyEnv([30]), horizon=4, target="probs"
    ).values
    np.testing.assert_allclose(shares.sum(1), 1)  # probabilities stay as they are


def test_the_shuffled_example_shows_the_same_frames_in_another_order() -> None:
    sums, fades = (linear_policy(rho, dtype=torch.float32) for rho in (1.0, 0.9))
    same, moved = (
        contamination_example(policy, ToyEnv([30]), shuffle=True, horizon=4)
        for policy in (sums, fades)
    )
    for found in (same, moved):
        assert found.hits.tolist() == [-1, -1] and found.order[0].tolist() == list(range(15))
        assert found.order[1, [0, 1, 11, 12, 13, 14]].tolist() == [0, 1, 11, 12, 13, 14]
        assert (
            sorted(found.order[1]) == list(range(15)) and (found.order[1] != found.order[0]).any()
        )
        np.testing.assert_array_equal(found.frames[1], found.frames[0][found.order[1]])
    np.testing.assert_allclose(same.values[1], same.values[0], rtol=1e-4)
    assert abs(moved.values[1] - moved.values[0]).max() > 1e-3


@pytest.mark.parametrize("feedback", [False, True])
def test_no_noise_and_no_memory_leave_every_row_of_an_example_as_the_clean_one(
    feedback: bool,
) -> None:
    for net, how in (
        (Net("gru", torch.float32), {"sigma": 0.0}),
        (Net("mlp", torch.float32), {"sigma": 1.0}),
    ):
        policy = Policy(net.encode, net.remember, net.initial_state)
        found = contamination_example(policy, ToyEnv([12]), horizon=5, feedback=feedback, **how)  # type: ignore[arg-type]
        np.testing.assert_allclose(found.values, np.tile(found.values[0], (4, 1)), atol=1e-5)
        assert (found.frames[1:] != found.frames[0]).any() == (how["sigma"] > 0)


def test_an_example_wants_two_steps_and_an_episode_that_has_them() -> None:
    policy = linear_policy(0.9, dtype=torch.float32)
    assert contamination_example(policy, ToyEnv([2, 3]), horizon=2).hits.tolist() == [-1, 1]
    with pytest.raises(ValueError, match="horizon must be at least 2; got 1"):
        contamination_example(policy, ToyEnv([30]), horizon=1)
    with pytest.raises(ValueError, match="none of 2 episodes was long enough: 4 frames are needed"):
        contamination_example(policy, ToyEnv([2, 3]), horizon=3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigmas": ()}, "sigmas must be numbers"),
        ({"sigmas": (-1.0,)}, "sigmas must be numbers"),
        ({"delays": (-1,)}, "delays must be whole numbers"),
        ({"delays": ()}, "delays must be whole numbers"),
        ({"delays": (0.5,)}, "delays must be whole numbers"),
        ({"starts": 0}, "starts must be at least 1"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    policy = linear_policy(0.5, dtype=torch.float32)
    with pytest.raises(ValueError, match=message):
        contamination(policy, ToyEnv([5]), **options)
    with pytest.raises(ValueError, match="long enough: 11 frames are needed"):
        contamination(policy, ToyEnv([5]), starts=1, shuffle=True)


def test_measuring_leaves_the_mode_and_the_weights_of_a_network_alone() -> None:
    net = Net("gru", torch.float32).train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    policy = Policy(net.encode, net.remember, net.initial_state, module=net)
    contamination(policy, ToyEnv([8]), starts=4, delays=(0, 1))
    assert net.training and all(
        torch.equal(value, before[name]) for name, value in net.state_dict().items()
    )
    assert (
        all(parameter.grad is None for parameter in net.parameters())
        and frames(1).dtype == torch.uint8
    )
