"""Contamination beside a replay in numpy: noise, seeds, start flags and states of long episodes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools import Policy, contamination, contamination_example
from arcade_torch.tools.measures.windows import greedy_windows
from tests.tools.measures.toys import ACTIONS, FEATURES, ToyEnv, in_place, matrices

Array = NDArray[np.float64]
LENGTHS = (9, 14, 7)
RHO = 0.8
SIGMAS = (0.1, 0.4)
WHITE = 2.0


class BrightEnv(ToyEnv):
    """Frames are floats from 0 to `WHITE`."""

    def frame(self, row: int, step: int) -> Tensor:
        return super().frame(row, step).double() * (WHITE / 255)


class OneEnv(BrightEnv):
    """Plays the same episodes whatever the seed."""

    def set_seed(self, seed: int) -> None:
        super().set_seed(0)


def noting_policy() -> tuple[Policy, list[Tensor]]:
    """A linear memory that is 1 where an episode starts and changes its state in place, and the
    frames that it encodes, in their order.
    """
    encoder, head = matrices()
    frames: list[Tensor] = []

    def encode(pixels: Tensor) -> Tensor:
        frames.extend(pixels)
        return pixels.flatten(1) @ encoder.T

    def initial_state(size: int) -> Tensor:
        return torch.zeros(size, FEATURES, dtype=torch.float64)

    return Policy(encode, in_place(RHO, head), initial_state), frames


def outputs_by_hand(frames: Array) -> Array:
    """The outputs [T, A] of `noting_policy` over a whole episode."""
    encoder, head = (matrix.numpy() for matrix in matrices())
    state = np.ones(FEATURES)
    outputs = np.zeros((len(frames), ACTIONS))
    for step, frame in enumerate(frames):
        state = RHO * state + encoder @ frame.ravel()
        outputs[step] = head @ state
    return outputs


def episode(env: ToyEnv, seed: int, row: int, length: int) -> Array:
    """The frames of an episode from its first."""
    env.set_seed(seed)
    return torch.stack([env.frame(row, step) for step in range(length)]).numpy()


def noisy_frames(encoded: list[Tensor], env: ToyEnv, seeds: set[int]) -> Array:
    """Those frames, [n, ...] in the order in which they were met, that are of no episode."""
    known = set()
    for seed in seeds:
        for row, length in enumerate(LENGTHS):
            known |= {frame.tobytes() for frame in episode(env, seed, row, length)}
    noisy = {frame.numpy().tobytes(): frame.numpy() for frame in encoded}
    return np.stack([frame for key, frame in noisy.items() if key not in known])


@pytest.mark.parametrize(("cap", "clip"), [(512, False), (5, False), (512, True)])
def test_noise_and_changes_are_those_of_a_replay_by_hand(cap: int, clip: bool) -> None:
    policy, encoded = noting_policy()
    env = BrightEnv(LENGTHS)
    delays = (0, 1, 3)
    found = contamination(
        policy,
        env,
        sigmas=SIGMAS,
        delays=delays,
        starts=15,
        seed=2,
        cap=cap,
        clip=clip,
        white=WHITE,
    )
    assert len(found.points) == 15 and np.isnan(found.kl).all() and found.clean_error < 1e-9
    windows = list(greedy_windows(policy, env, episodes=20, seed=2, cap=cap))
    assert any(window.first > 0 for window in windows) == (cap == 5)
    noisy = noisy_frames(encoded, env, {window.seed for window in windows})
    noisy = noisy.reshape(15, len(SIGMAS), *noisy.shape[1:])
    draws = []
    for point, (number, place) in enumerate(found.points):
        window = windows[number]
        length = window.first + window.n + 1
        frames = episode(env, window.seed, window.row, length)
        hit = window.first + place
        clean = outputs_by_hand(frames)
        for strength, sigma in enumerate(SIGMAS):
            draws.append((noisy[point, strength] - frames[hit]) / (sigma * WHITE))
            disturbed = frames.copy()
            disturbed[hit] = noisy[point, strength]
            moved = outputs_by_hand(disturbed)
            for column, step in enumerate(hit + np.array(delays)):
                change = found.change[point, strength, column]
                flip = found.flip[point, strength, column]
                if step >= length:
                    assert np.isnan(change) and np.isnan(flip)
                    continue
                before = clean[step] - clean[step].mean()
                after = moved[step] - moved[step].mean()
                wanted = abs(after - before).max() / np.ptp(before)
                assert change == pytest.approx(wanted, rel=1e-9)
                assert flip == (before.argmax() != after.argmax())
    assert (noisy.min() >= 0 and noisy.max() <= WHITE) == clip
    if clip:
        return
    weak, strong = np.stack(draws).reshape(15, 2, -1).swapaxes(0, 1)
    np.testing.assert_allclose(weak, strong, atol=1e-9)  # one draw for all strengths
    assert weak.mean() == pytest.approx(0, abs=0.15) and weak.std() == pytest.approx(1, abs=0.1)
    assert len(np.unique(weak.round(6))) > 0.99 * weak.size  # and another one for every point


def test_the_seed_draws_start_points_and_noise_of_the_same_episodes() -> None:
    first, again, other = (
        contamination(
            noting_policy()[0], OneEnv(LENGTHS), sigmas=(0.3,), delays=(0,), starts=8, seed=seed
        )
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.change, again.change)
    assert (first.points != other.points).any()


def example(seed: int, env: ToyEnv, **options: Any) -> tuple[Any, list[Tensor]]:
    """An example, and the frames that its policy encoded."""
    policy, encoded = noting_policy()
    found = contamination_example(policy, env, horizon=4, seed=seed, white=WHITE, **options)
    return found, encoded


def test_the_seed_draws_the_noise_and_the_order_of_an_example_and_its_episode() -> None:
    one, other = (example(seed, OneEnv([30]))[0] for seed in (0, 1))
    np.testing.assert_array_equal(one.values[0], other.values[0])
    assert (one.values[1:] != other.values[1:]).any(1).all()
    one, other = (example(seed, OneEnv([30]), shuffle=True)[0] for seed in (0, 1))
    np.testing.assert_array_equal(one.frames[0], other.frames[0])
    assert (one.order[1] != other.order[1]).any()
    one, other = (example(seed, BrightEnv([30]))[0] for seed in (0, 1))
    assert (one.frames[0] != other.frames[0]).any()


@pytest.mark.parametrize("clip", [False, True])
def test_noise_of_an_example_has_its_strength_and_is_clipped_at_white(clip: bool) -> None:
    found, encoded = example(0, OneEnv([30]), sigma=0.5, clip=clip)
    noisy = noisy_frames(encoded, OneEnv([30]), {0})
    # the outputs follow from these frames
    clean = episode(OneEnv([30]), 0, 0, 5)
    for row, hit in enumerate(found.hits[1:]):
        disturbed = clean.copy()
        disturbed[hit] = noisy[row]
        wanted = outputs_by_hand(disturbed)[-1]
        np.testing.assert_allclose(found.values[1 + row], wanted - wanted.mean(), rtol=1e-9)
    noise = (noisy - clean[found.hits[1:]]) / WHITE
    assert (noisy.min() >= 0 and noisy.max() <= WHITE) == clip
    if not clip:
        assert noise.std() == pytest.approx(0.5, abs=0.1)


def test_the_clean_error_is_what_encoding_a_frame_alone_does() -> None:
    policy, _ = noting_policy()
    step = 1e-6

    def encode(pixels: Tensor) -> Tensor:
        return policy.encode(pixels) + step * len(pixels)

    together = replace(policy, encode=encode)
    found = contamination(together, OneEnv([9]), sigmas=(0.3,), delays=(0,), starts=4, white=WHITE)
    _, head = matrices()
    wanted = step * 8 * abs(head.numpy().sum(1)).max()  # eight frames less than in the episode
    assert found.clean_error == pytest.approx(wanted, rel=1e-4)
