"""Counterfactual recall beside an exchange in numpy, of windows that begin late in their episodes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools import Policy, counterfactual
from arcade_torch.tools.measures.counterfactual.measure import (
    Counterfactual,
    counterfactual_of_windows,
)
from arcade_torch.tools.measures.windows import Window
from tests.tools.measures.toys import (
    ACTIONS,
    FEATURES,
    ToyEnv,
    in_place,
    linear_policy,
    matrices,
)

Array = NDArray[np.float64]
RHO, GAIN, WHITE = 0.7, 0.4, 255.0
LENGTHS = (9, 9, 10, 9, 7)
FIRSTS = (0, 3, 4, 2, 1)
EFFECTS = ("flip", "distance", "change")


def policy(kind: str) -> Policy:
    """A linear memory that is 1 where an episode starts and changes its state in place; its outputs
    are Q-values or logits.
    """
    encoder, head = matrices()

    def read(out: Tensor, output: str) -> Tensor:
        return out.softmax(-1) if output == "probs" else out

    return Policy(
        lambda frames: (frames.double() / WHITE).flatten(1) @ encoder.T,
        in_place(RHO, head, GAIN),
        lambda size: torch.zeros(size, FEATURES, dtype=torch.float64),
        read=read,
        offers=("q",) if kind == "q" else ("logits", "probs"),
    )


def states_by_hand(frames: Array) -> Array:
    """The state [T, F] after every frame of a whole episode."""
    encoder, _ = matrices()
    state = np.ones(FEATURES)
    states = np.zeros((len(frames), FEATURES))
    for step, frame in enumerate(frames):
        state = RHO * state + encoder.numpy() @ (frame.ravel() / WHITE)
        states[step] = state
    return states


def decision_by_hand(frames: Array) -> Array:
    """The outputs [A] on the last frame of a whole episode."""
    _, head = matrices()
    return np.asarray(GAIN * head.numpy() @ states_by_hand(frames)[-1])


def episodes() -> list[Array]:
    """Whole episodes; two have their first and their fifth frame in common."""
    rng = np.random.default_rng(3)
    frames = [rng.integers(0, 256, (length, 4, 4, 3)).astype(float) for length in LENGTHS]
    frames[1][0] = frames[0][0]
    frames[1][4] = frames[0][4]
    return frames


def windows() -> list[Window]:
    """The ends of `episodes`, with the states before them."""
    found = []
    for number, (frames, first) in enumerate(zip(episodes(), FIRSTS, strict=True)):
        steps = len(frames) - first
        is_init = torch.arange(first, len(frames)) == 0
        state = torch.zeros(1, FEATURES, dtype=torch.float64)
        if first:
            state = torch.from_numpy(states_by_hand(frames)[first - 1])[None].clone()
        action = torch.zeros(steps, dtype=torch.int64)
        pixels = torch.from_numpy(frames[first:]).to(torch.uint8)
        rewards = torch.zeros(steps)
        found.append(
            Window(pixels, action, is_init, action, rewards, state, True, 0, number, first)
        )
    return found


def softmax(values: Array) -> Array:
    shares = np.exp(values - values.max())
    return np.asarray(shares / shares.sum())


def effects_by_hand(before: Array, after: Array, kind: str) -> tuple[float, float, float]:
    """What an exchange did to outputs: flip, distance and change."""
    best = before.argmax()
    if kind == "q":
        gap = np.ptp(np.sort(before)[-2:])
        shares, moved = softmax(before / gap), softmax(after / gap)
    else:
        shares, moved = softmax(before), softmax(after)
        before, after = np.log(shares), np.log(moved)
        gap = np.ptp(np.sort(before)[-2:])
    distance = abs(moved - shares).sum() / 2
    return float(after.argmax() != best), distance, abs(after[best] - before[best]) / gap


def exchanged(frames: Array, given: Array, steps: slice) -> Array:
    """The episode with some of its frames from another one."""
    mixed = frames.copy()
    mixed[steps] = given[steps]
    return mixed


def means_by_hand(frames: list[Array], number: int, steps: slice, kind: str) -> tuple[Any, Any]:
    """Means of the effects over all donors that have certain steps in their window, and the step of
    the decision where these are all before it, and over those whose frames differ.
    """
    own = frames[number]
    newest = steps.stop - 1
    effects = []
    differ = []
    for donor, other in enumerate(frames):
        has_steps = FIRSTS[donor] <= max(steps.start, 0) and newest < len(other)
        if donor == number or not has_steps:
            continue
        mixed = exchanged(own, other, steps)
        effects.append(effects_by_hand(decision_by_hand(own), decision_by_hand(mixed), kind))
        differ.append((mixed != own).any())
    nothing = (np.nan,) * 3
    every = np.mean(effects, axis=0) if effects else nothing
    differing = np.array(effects)[differ].mean(axis=0) if any(differ) else nothing
    return every, differing


def measured(kind: str, **options: Any) -> Counterfactual:
    return counterfactual_of_windows(policy(kind), windows(), target=kind, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["q", "logits", "probs"])
@pytest.mark.parametrize("block", [1, 3])
def test_exchanged_frames_do_what_they_do_by_hand(kind: str, block: int) -> None:
    found = measured(kind, donors=4, block=block)
    frames = episodes()
    assert found.lengths.tolist() == [
        length - first for length, first in zip(LENGTHS, FIRSTS, strict=True)
    ]
    for number, (length, first) in enumerate(zip(LENGTHS, FIRSTS, strict=True)):
        for lag in range(length - first):
            newest = length - 1 - lag
            steps = slice(max(first, newest - block + 1), newest + 1)
            every, differing = means_by_hand(frames, number, steps, kind)
            for place, effect in enumerate(EFFECTS):
                by_lag = found.by_lag(effect)[number, lag]  # type: ignore[arg-type]
                assert by_lag == pytest.approx(every[place], rel=1e-9, nan_ok=True)
                by_lag = found.by_lag(effect, differing=True)[number, lag]  # type: ignore[arg-type]
                assert by_lag == pytest.approx(differing[place], rel=1e-9, nan_ok=True)
        assert np.isnan(found.flip[number, length - first :]).all()
    assert found.clean_error < 1e-9 and found.dropped == 0


@pytest.mark.parametrize("kind", ["q", "probs"])
def test_an_exchanged_state_does_what_it_does_by_hand(kind: str) -> None:
    found = measured(kind, donors=4)
    frames = episodes()
    for number, own in enumerate(frames):
        last = len(own) - 1
        effects = []
        for donor, other in enumerate(frames):
            if donor != number and FIRSTS[donor] <= last < len(other):
                mixed = exchanged(own, other, slice(0, last))
                effects.append(
                    effects_by_hand(decision_by_hand(own), decision_by_hand(mixed), kind)
                )
        for place, effect in enumerate(EFFECTS):
            wanted = np.mean(effects, axis=0)[place] if effects else np.nan
            by_state = found.by_state(effect)[number]  # type: ignore[arg-type]
            assert by_state == pytest.approx(wanted, rel=1e-9, nan_ok=True)
    assert found.alone == 1 == np.isnan(found.by_state()).sum()  # the one of ten frames


def test_certainty_is_the_probability_of_the_action_that_is_taken() -> None:
    outputs = [decision_by_hand(frames) for frames in episodes()]
    for kind in ("logits", "probs"):
        wanted = [softmax(values).max() for values in outputs]
        np.testing.assert_allclose(measured(kind).certainty, wanted, rtol=1e-9)
    wanted = [softmax(values / np.ptp(np.sort(values)[-2:])).max() for values in outputs]
    np.testing.assert_allclose(measured("q").certainty, wanted, rtol=1e-9)
    assert len(outputs[0]) == ACTIONS


def test_fewer_donors_are_drawn_by_the_seed_and_are_some_of_all() -> None:
    every = measured("q", donors=4)
    some = [measured("q", donors=2, seed=seed) for seed in (0, 0, 1, 2)]
    np.testing.assert_array_equal(some[0].distance, some[1].distance)
    assert some[0].distance.shape[-1] == 2
    drawn = [np.sort(found.distance[0, 0]).round(9) for found in some]
    assert any((one != drawn[0]).any() for one in drawn[2:])
    for one in drawn:
        assert np.isin(one, every.distance[0, 0].round(9)).all() and one[0] != one[1]


def test_the_seed_draws_the_episodes_that_are_played_and_their_ends() -> None:
    memory = linear_policy(RHO, pixel_scale=WHITE)
    lengths = [8, 9, 10, 11]
    one, same, other = (
        counterfactual(memory, ToyEnv(lengths), episodes=4, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.distance, same.distance)
    # of the same length and end, and with other frames
    assert one.lengths.tolist() == other.lengths.tolist() == lengths
    assert not np.isclose(np.nanmean(one.certainty), np.nanmean(other.certainty))
    ends = counterfactual(memory, ToyEnv(lengths), episodes=4, end="random").lengths
    assert ends.tolist() != lengths and ends.min() >= 3
    assert counterfactual(memory, ToyEnv(lengths), episodes=4, cap=5).lengths.tolist() == [5] * 4


def test_pasts_differ_by_frames_actions_or_states_and_short_episodes_are_dropped() -> None:
    one = windows()[1]
    other_frames = replace(one, frames=255 - one.frames)
    other_actions = replace(one, last_action=one.last_action + 1)
    other_state = replace(one, state=one.state + 1)
    last = one.frames.clone()
    last[-1] = 0
    other_decision = replace(one, frames=last)
    for other, differs in (
        (one, 0),
        (other_frames, 1),
        (other_actions, 1),
        (other_state, 1),
        (other_decision, 0),
    ):
        found = counterfactual_of_windows(policy("q"), [one, other, one.up_to(1)], donors=1)
        assert found.memory_differs.tolist() == [[differs], [differs]]
        assert found.dropped == 1 and len(found.lengths) == 2


def test_the_clean_error_is_what_running_many_versions_does() -> None:
    alone = policy("q")
    step = 1e-6

    def remember(features: Tensor, *others: Any) -> tuple[Tensor, Any]:
        out, state = alone.remember(features, *others)
        return out + step * len(features), state

    together = replace(alone, remember=remember)
    found = counterfactual_of_windows(together, windows(), donors=2)
    assert found.clean_error == pytest.approx(step * 2 * found.lengths.max(), rel=1e-6)
