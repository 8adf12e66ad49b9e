"""Actions that are masked out, with values of minus infinity or no probability, and outputs that are
no numbers.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.nn.functional import one_hot

from arcade_torch.tools import Policy, contamination, counterfactual, recall_density, saliency
from arcade_torch.tools.measures.masked import divergence
from arcade_torch.tools.measures.policy import read_plain
from tests.tools.measures.toys import ACTIONS, SIZE, ToyEnv, linear_policy, window

TARGETS = ["q", "logits", "probs"]


def with_masked(policy: Policy, kind: str, value: float = -torch.inf) -> Policy:
    """The same policy with one more action, which is masked out; the mask is added to its outputs,
    which are of ``kind``.
    """

    def remember(*read: Any) -> tuple[Tensor, Any]:
        out, state = policy.remember(*read)
        return torch.cat(
            [out[..., :1], torch.full_like(out[..., :1], value), out[..., 1:]], -1
        ), state

    offers = ("q", "value") if kind == "q" else ("logits", "probs")
    return replace(policy, remember=remember, read=read_plain, offers=offers)


def plain(kind: str) -> Policy:
    """A memory that forgets by halves, whose outputs are of ``kind``."""
    policy = linear_policy(0.5, dtype=torch.float32, pixel_scale=255.0)
    return replace(policy, offers=("q", "value") if kind == "q" else ("logits", "probs"))


@pytest.mark.parametrize("kind", TARGETS)
def test_an_action_that_is_masked_out_changes_no_measure(kind: str) -> None:
    target: Any = kind
    noise = {"sigmas": (1.0,), "delays": (0, 1, 2), "starts": 20, "target": target}
    without, with_mask = (
        contamination(policy, ToyEnv([6, 8]), **noise)
        for policy in (plain(kind), with_masked(plain(kind), kind))
    )
    assert without.mean("flip")[0, 0] > 0.2
    np.testing.assert_array_equal(with_mask.flip, without.flip)
    np.testing.assert_allclose(with_mask.change, without.change, rtol=1e-5)
    np.testing.assert_allclose(with_mask.kl, without.kl, rtol=1e-5, atol=1e-9)
    assert np.isfinite(with_mask.kl).any() == (kind != "q")
    exchange = {"episodes": 6, "donors": 2, "target": target}
    without, with_mask = (
        counterfactual(policy, ToyEnv([6] * 6), **exchange)
        for policy in (plain(kind), with_masked(plain(kind), kind))
    )
    for effect in ("flip", "distance", "change"):
        values = getattr(with_mask, effect)
        assert np.isfinite(values).any()
        # of Q-values the softmax is in units of the gap, in which a masked action has no part
        np.testing.assert_allclose(values, getattr(without, effect), rtol=1e-5, atol=1e-9)
    frames = window(5).frames
    one, other = (
        saliency(policy, frames, target=target).per_frame
        for policy in (plain(kind), with_masked(plain(kind), kind))
    )
    np.testing.assert_allclose(other, one, rtol=1e-5)


def test_a_policy_that_offers_probabilities_alone_is_measured_as_one_that_has_logits() -> None:
    def read(out: Tensor, output: str) -> Tensor:
        assert output == "probs", "it offers nothing else"
        return out.softmax(-1)

    with_logits = plain("logits")
    alone = replace(with_logits, read=read, offers=("probs",))
    noise: dict[str, Any] = {"sigmas": (1.0,), "delays": (0, 1), "starts": 10, "feedback": True}
    wanted, got = (
        contamination(policy, ToyEnv([6, 8]), **noise, target="probs")
        for policy in (with_logits, alone)
    )
    assert wanted.mean("flip").max() > 0
    for name in ("flip", "change", "kl"):
        np.testing.assert_allclose(getattr(got, name), getattr(wanted, name), 1e-4, 1e-7)
    before, after = (
        counterfactual(policy, ToyEnv([6] * 6), episodes=6, donors=2, target="probs")
        for policy in (with_logits, alone)
    )
    for name in ("flip", "distance", "change"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), 1e-4, 1e-7)


def of_probs(rho: float = 0.5) -> TensorDictSequential:
    """A policy that writes probabilities, one of them 0, of the last frame alone."""
    policy = linear_policy(rho, dtype=torch.float32, pixel_scale=255.0)

    def probs(pixels: Tensor) -> Tensor:
        out, _ = policy.remember(
            policy.encode(pixels)[:, None], None, torch.ones(len(pixels), 1).bool(), None
        )
        return torch.cat([out[:, 0].softmax(-1), torch.zeros(len(pixels), 1)], -1)

    return TensorDictSequential(TensorDictModule(probs, ["pixels"], ["probs"]))


def test_a_probability_that_becomes_zero_has_a_large_divergence_and_no_infinite_one() -> None:
    p = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    q = torch.tensor([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 0.5]], dtype=torch.float64)
    same, large, half = divergence(p.log(), q.log()).tolist()
    assert same == 0 and half == pytest.approx(np.log(2))
    assert 50 < large < 60 and divergence(p.log(), p.log()).tolist() == [0, 0, 0]


def test_of_probabilities_of_one_the_change_is_the_flip() -> None:
    """An action that alone has a probability, before and after, is no decision without others."""
    policy = linear_policy(0.5, dtype=torch.float32, pixel_scale=255.0)

    def remember(*read: Any) -> tuple[Tensor, Any]:
        out, state = policy.remember(*read)
        return one_hot(out.argmax(-1), ACTIONS).to(out).log(), state

    sure = replace(policy, remember=remember, offers=("logits", "probs"), read=read_plain)
    changes = contamination(sure, ToyEnv([6, 8]), sigmas=(1.0,), delays=(0, 1), starts=20)
    assert 0 < changes.mean("flip")[0, 0] < 1
    np.testing.assert_array_equal(changes.change, changes.flip)


def test_the_logits_of_probabilities_of_zero_have_no_gradient() -> None:
    """Before: 0 times infinity, and all shares were 0."""
    found = saliency(of_probs(), window(4).frames, target="logits")
    assert len(found.output) == ACTIONS + 1 and np.isfinite(found.maps).all()
    assert found.shares().tolist() == [0, 0, 0, 1]
    assert recall_density(of_probs(), ToyEnv([4]), episodes=1, target="logits").silent == 0
    changes = contamination(of_probs(), ToyEnv([6]), sigmas=(1.0,), delays=(0, 1), starts=4)
    assert np.isfinite(changes.kl).all() and changes.kl[:, 0, 0].max() > 0


def test_probabilities_are_shares_as_a_distribution_takes_them() -> None:
    """Before: gradients of numbers that sum to anything, whose sum no decision depends on."""
    policy = linear_policy(0.0, dtype=torch.float32, pixel_scale=255.0)

    def weights(pixels: Tensor, softmax: bool) -> Tensor:
        out, _ = policy.remember(
            policy.encode(pixels)[:, None], None, torch.ones(len(pixels), 1).bool(), None
        )
        return out[:, 0].softmax(-1) if softmax else 7 * out[:, 0].exp()

    shares, numbers = (
        saliency(
            TensorDictModule(partial(weights, softmax=softmax), ["pixels"], ["probs"]),
            window(3).frames,
        )
        for softmax in (True, False)
    )
    np.testing.assert_allclose(numbers.output, shares.output, rtol=1e-5)
    np.testing.assert_allclose(numbers.per_frame, shares.per_frame, rtol=1e-4)


def test_gradients_that_are_no_numbers_are_refused() -> None:
    """Before: all shares were 0, and recall density counted a trajectory without any gradient."""
    encode = linear_policy(0.5, dtype=torch.float32).encode

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        return (features - features.detach()).sqrt() + features, None

    policy = Policy(encode, remember)
    with pytest.raises(ValueError, match=r"^gradients must be numbers, got NaN or infinity for 4"):
        saliency(policy, window(4).frames)
    with pytest.raises(ValueError, match=r"^gradients must be numbers"):
        recall_density(policy, ToyEnv([4]), episodes=1)


def test_a_masked_policy_is_tried_like_any_other() -> None:
    """Before: nothing was small beside infinity."""
    causal = linear_policy(0.5, dtype=torch.float32)

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        out, state = causal.remember(features, *rest)
        return out + out.mean(1, keepdim=True), state

    ahead = with_masked(Policy(causal.encode, remember, causal.initial_state), "q")
    with pytest.raises(ValueError, match="in one go"):
        saliency(ahead, window(5).frames)

    def detached(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        return causal.remember(features.detach(), *rest)

    cut = with_masked(Policy(causal.encode, detached, causal.initial_state), "q")
    with pytest.raises(ValueError, match="no gradient"):
        saliency(cut, window(5).frames)


MEASURES: dict[str, Callable[[Any], Any]] = {
    "saliency": lambda policy: saliency(policy, window(6).frames),
    "recall density": lambda policy: recall_density(policy, ToyEnv([9]), episodes=1),
    "counterfactual": lambda policy: counterfactual(policy, ToyEnv([9] * 2), episodes=2, donors=1),
    "contamination": lambda policy: contamination(
        policy, ToyEnv([9]), sigmas=(1.0,), delays=(0, 1), starts=4
    ),
}


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("measure", MEASURES)
def test_outputs_that_are_no_numbers_are_refused(measure: str, late: bool) -> None:
    """Before: NaN was the best action of all frames, and nothing changed it."""
    causal = linear_policy(0.5, dtype=torch.float32)

    def encode(frames: Tensor) -> Tensor:
        features = causal.encode(frames)
        is_late = frames.reshape(-1, SIZE * SIZE * 3)[:, :1] == 5  # the first pixel counts steps
        return torch.where(is_late | (not late), torch.nan, features)

    policy = replace(causal, encode=encode)
    if measure == "saliency" and late:
        frames = window(6).frames
        frames[-1, 0, 0, 0] = 5
        with pytest.raises(ValueError, match=r"^the policy's outputs must be numbers, got NaN"):
            saliency(policy, frames)
        return
    with pytest.raises(ValueError, match=r"^the policy's outputs must be numbers, got NaN"):
        MEASURES[measure](policy)


@pytest.mark.parametrize("measure", MEASURES)
def test_an_infinite_output_is_refused(measure: str) -> None:
    """Before: it counted as masked out, though it is the best action of all frames."""
    causal = linear_policy(0.5, dtype=torch.float32)

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        out, state = causal.remember(features, *rest)
        return out + torch.tensor([0.0, torch.inf, 0.0])[: out.shape[-1]], state

    policy = Policy(causal.encode, remember, causal.initial_state)
    with pytest.raises(ValueError, match=r"^the policy's outputs must be numbers, got infinity"):
        MEASURES[measure](policy)


@pytest.mark.parametrize("reduce", ["per_action", "sum"])
def test_a_decision_without_an_action_is_refused(reduce: Any) -> None:
    """Before: an error of torch about an empty list, or a trajectory without any gradient."""
    causal = linear_policy(0.5, dtype=torch.float32)

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        out, state = causal.remember(features, *rest)
        return out - torch.inf, state

    policy = Policy(causal.encode, remember, causal.initial_state)
    with pytest.raises(ValueError, match="all of its 3 actions are masked out"):
        saliency(policy, window(6).frames, reduce=reduce)


@pytest.mark.parametrize("feedback", [False, True])
def test_a_noisy_frame_that_gives_no_numbers_is_refused(feedback: bool) -> None:
    """Before, with feedback: the decision on the first noisy frame counted as another one."""
    policy = Policy(
        lambda o: o.float().flatten(-3)[..., :ACTIONS].sqrt(),  # noise goes below 0
        lambda features, action, is_init, state: (features, state),
    )
    with pytest.raises(ValueError, match=r"^the policy's outputs must be numbers, got NaN"):
        contamination(
            policy, ToyEnv([14]), sigmas=(30.0,), delays=(0,), starts=1, feedback=feedback
        )


@pytest.mark.parametrize("kind", TARGETS)
def test_outputs_that_tie_and_stay_as_they_are_have_not_changed(kind: str) -> None:
    """Before: nothing divided by nothing, and the control without memory was NaN in place of 0.

    Two actions are alike always; they differ where a frame is noisy (its numbers are not whole).
    """

    def remember(features: Tensor, *rest: Any) -> tuple[Tensor, Any]:
        noisy = (features - features.round()).abs()
        alike = torch.zeros_like(noisy)
        never = torch.full_like(noisy, -torch.inf)
        return torch.cat([alike, noisy, never], -1), None

    read = _probabilities if kind == "probs" else read_plain
    policy = Policy(
        lambda o: o.to(torch.float64).flatten(1)[:, :1],
        remember,
        read=read,
        offers=("q",) if kind == "q" else ("logits", "probs"),
    )
    target: Any = kind
    noise = contamination(
        policy, ToyEnv([6, 8]), sigmas=(1.0,), delays=(0, 1, 2), starts=8, target=target
    )
    assert np.isnan(noise.change[:, 0, 0]).all()  # it changed, and there is no spread to measure by
    assert noise.mean("change")[0, 1:].tolist() == [0, 0]
    exchanged = counterfactual(policy, ToyEnv([6] * 4), episodes=4, donors=2, target=target)
    for effect in ("flip", "distance", "change"):
        assert exchanged.profile(effect).tolist() == [0] * 6  # type: ignore[arg-type]
        assert exchanged.memory_reliance(effect).value == 0  # type: ignore[arg-type]


def _probabilities(out: Tensor, output: str) -> Tensor:
    return out.softmax(-1) if output == "probs" else out
