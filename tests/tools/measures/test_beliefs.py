"""Probes against states of which it is known what they hold."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import arcade_torch
from arcade_torch.models import make_network
from arcade_torch.tools import Policy, beliefs
from arcade_torch.tools.measures.beliefs.measure import Beliefs, Split, beliefs_of
from arcade_torch.tools.measures.beliefs.recording import Recording, flat_state
from arcade_torch.tools.measures.beliefs.ridge import Ridge
from tests.tools.measures.toys import ToyEnv

EPISODES, STEPS, WIDTH = 160, 6, 10
NOISE = 0.15  # of a score that is 0 in truth


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def one_hot(values: np.ndarray, count: int) -> np.ndarray:
    return np.eye(count)[values]


def recording(
    states: np.ndarray, facts: Mapping[str, np.ndarray], features: np.ndarray | None = None
) -> Recording:
    """A recording of episodes of different lengths, whose features are noise by default."""
    lengths = STEPS - np.arange(len(states)) % 3
    features = rng(9).normal(size=(*states.shape[:2], 4)) if features is None else features
    return Recording(states, features, facts, lengths)


def cues(seed: int = 1) -> np.ndarray:
    """A class for each episode, the same at all its steps: int [EPISODES, STEPS]."""
    return np.repeat(rng(seed).integers(0, 4, (EPISODES, 1)), STEPS, axis=1)


def noise(width: int = WIDTH, seed: int = 2) -> np.ndarray:
    return rng(seed).normal(size=(EPISODES, STEPS, width))


FACTS = {
    "cue": cues(),
    "speed": rng(3).normal(size=(EPISODES, STEPS)).astype(np.float32),
    "mine": rng(4).random((EPISODES, 1, 3, 3)).repeat(STEPS, 1) < 0.4,
    "place": rng(5).normal(5, 100, size=(EPISODES, STEPS, 2)),
}


def as_state() -> np.ndarray:
    """A state that is the facts."""
    flat = [
        one_hot(FACTS["cue"], 4),
        FACTS["speed"][..., None],
        FACTS["mine"].reshape(EPISODES, STEPS, -1),
        FACTS["place"],
    ]
    return np.concatenate(flat, axis=-1)


def test_a_state_that_is_the_fact_scores_1_and_a_frame_of_noise_0() -> None:
    found = beliefs_of(recording(as_state(), FACTS))
    assert found.names.tolist() == list(FACTS)
    assert found.is_class.tolist() == [True, False, True, False]
    assert found.cells.tolist() == [1, 1, 9, 2]
    for fact in FACTS:
        state = found.score(fact)
        assert state.value == pytest.approx(1, abs=1e-4)
        assert state.low > 0.999
        assert -NOISE < found.score(fact, "frame").value < NOISE
        by_step, low, high = found.by_step(fact)
        np.testing.assert_allclose(by_step, 1, atol=1e-4)
        assert (low <= by_step).all() and (by_step <= high + 1e-12).all()


def test_a_state_of_noise_is_no_better_than_a_guess_and_hardly_worse() -> None:
    for width in (WIDTH, 600):  # fewer and more numbers than steps to fit
        found = beliefs_of(recording(noise(width), FACTS))
        for fact in FACTS:
            score = found.score(fact)
            assert -NOISE < score.value < NOISE
            assert score.low < 0.1


def test_facts_of_other_episodes_cannot_be_read() -> None:
    order = rng(6).permutation(EPISODES)
    permuted = {name: values[order] for name, values in FACTS.items()}
    found = beliefs_of(recording(as_state(), permuted))
    for fact in FACTS:
        assert -NOISE < found.score(fact).value < NOISE


def test_a_fact_that_no_episode_shares_is_not_learned_from_steps_of_the_same_episode() -> None:
    # every episode has a name of its own in its state, and a number: only leakage could join them
    state = np.repeat(rng(7).normal(size=(EPISODES, 1, 200)), STEPS, axis=1)
    number = np.repeat(rng(8).normal(size=(EPISODES, 1)), STEPS, axis=1)
    found = beliefs_of(recording(state, {"number": number}))
    assert -NOISE < found.score("number").value < NOISE
    split = Split.of(np.full(EPISODES, STEPS), STEPS, seed=0)
    parts = np.stack([split.fit, split.choose, split.score])
    assert (parts.sum(0) == 1).all()  # each step once
    assert (parts == parts[..., :1]).all()  # whole episodes
    assert parts[..., 0].sum(1).tolist() == [80, 40, 40]


def test_scores_are_r2_and_the_way_from_chance_to_1() -> None:
    speed = FACTS["speed"]
    half = np.stack([speed + rng(10).normal(size=speed.shape)], -1)  # as much noise as signal
    found = beliefs_of(recording(half, {"speed": speed}))
    assert found.score("speed").value == pytest.approx(0.5, abs=0.12)
    is_right = rng(11).random(cues().shape) < 0.7
    seen = np.where(is_right, cues(), rng(12).integers(0, 4, cues().shape))
    found = beliefs_of(recording(one_hot(seen, 4), {"cue": cues()}))
    accuracy = 1 - found.state_loss.sum() / steps_scored(found)
    chance = 1 - found.guess_loss.sum() / steps_scored(found)
    assert accuracy == pytest.approx(0.7 + 0.3 / 4, abs=0.06)
    assert found.score("cue").value == pytest.approx((accuracy - chance) / (1 - chance))


def steps_scored(found: Beliefs) -> int:
    """Steps of the episodes that are scored."""
    lengths = STEPS - np.arange(found.episodes) % 3
    split = Split.of(lengths, STEPS, seed=0)
    return int(split.score.sum())


def test_an_invertible_linear_map_of_the_state_changes_hardly_anything() -> None:
    state = as_state() + 0.5 * noise(as_state().shape[-1])
    turned = state @ rng(13).normal(size=(state.shape[-1],) * 2) + 7
    plain = beliefs_of(recording(state, FACTS))
    mapped = beliefs_of(recording(turned, FACTS))
    for fact in FACTS:
        assert mapped.score(fact).value == pytest.approx(plain.score(fact).value, abs=0.05)


def test_the_dual_form_is_the_primal_one() -> None:
    inputs = rng(0).normal(size=(30, 12)) * np.arange(1, 13) + 3
    inputs[:, 5] = 2  # constant
    targets = rng(1).normal(size=(30, 3))
    new = rng(2).normal(size=(7, 12))
    primal = Ridge.of(inputs, targets, is_dual=False)
    dual = Ridge.of(inputs, targets, is_dual=True)
    assert Ridge.of(inputs, targets).is_dual is False
    assert Ridge.of(inputs[:5], targets[:5]).is_dual is True
    penalties = [1e-4, 0.1, 10.0]
    for one, other in zip(
        primal.predict(new, penalties), dual.predict(new, penalties), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-8)
    # the normal equations, as they stand in books
    scaled = (inputs - inputs.mean(0)) / primal.scale
    wanted = np.linalg.solve(
        scaled.T @ scaled + 0.1 * 30 * np.eye(12), scaled.T @ (targets - targets.mean(0))
    )
    np.testing.assert_allclose(primal.weights(0.1), wanted, rtol=1e-8, atol=1e-12)


def test_an_input_that_is_constant_but_for_rounding_is_not_read() -> None:
    """Before: the mean of many .1 is not quite .1, and this was taken for the input's spread."""
    inputs = rng(0).normal(size=(320, 2))
    targets = rng(1).normal(size=(320, 1))
    new = rng(2).normal(size=(50, 2))
    wanted = Ridge.of(inputs, targets).predict(new, [1e-6])[0]
    for constant in (0.1, 1000.1):
        beside = np.column_stack([inputs, np.full(320, constant)])
        assert beside[:, 2].std() > 0  # the rounding is there
        other = np.column_stack([new, np.full(50, constant + 100)])
        given = Ridge.of(beside, targets).predict(other, [1e-6])[0]
        np.testing.assert_allclose(given, wanted, rtol=1e-9)


def test_constant_facts_and_cells_are_left_out_and_named() -> None:
    mine = FACTS["mine"].copy()
    mine[:, :, 0] = True
    facts = {"mine": mine, "sky": np.ones((EPISODES, STEPS), np.int32), "cue": FACTS["cue"]}
    found = beliefs_of(recording(as_state(), facts))
    assert found.names.tolist() == ["mine", "cue"] and found.constant.tolist() == ["sky"]
    assert found.cells.tolist() == [6, 1]
    with pytest.raises(ValueError, match="nothing to read: sky are the same in all 160 episodes"):
        beliefs_of(recording(as_state(), {"sky": facts["sky"]}))
    with pytest.raises(ValueError, match="fact must be one of mine, cue"):
        found.score("sky")


def test_values_that_do_not_exist_are_neither_learned_nor_scored() -> None:
    cue = cues()
    cue[:, :2] = -1
    speed = FACTS["speed"].copy()
    speed[:, 3:] = np.nan
    block = np.stack([cue, cues()], -1)  # cells that exist at different steps
    facts = {"cue": cue, "speed": speed, "block": block}
    found = beliefs_of(recording(as_state(), facts))
    for fact in facts:
        assert found.score(fact).value == pytest.approx(1, abs=1e-4)
    assert np.isnan(found.by_step("cue")[0][:2]).all()
    assert np.isfinite(found.by_step("cue")[0][2:]).all()
    assert np.isnan(found.by_step("speed")[0][3:]).all()


def test_a_fact_that_only_rarely_can_be_read_is_scored_by_step() -> None:
    state = noise(4, seed=14)
    state[:, 3:] = one_hot(cues()[:, 3:], 4)  # learned at step 3
    found = beliefs_of(recording(state, {"cue": cues()}))
    by_step = found.by_step("cue")[0]
    assert (by_step[3:] > 0.95).all() and (by_step[:3] < 0.4).all()


def test_numbers_of_a_state_are_flat_and_complex_ones_are_pairs() -> None:
    state = {"b": torch.tensor([[1.0 + 2.0j], [3.0 + 4.0j]]), "a": torch.tensor([[True], [False]])}
    np.testing.assert_array_equal(flat_state(state, 2), [[1, 1, 2], [0, 3, 4]])
    assert flat_state(None, 3).shape == (3, 0)
    assert flat_state({}, 3).shape == (3, 0)


def first_frame_policy() -> Policy:
    """Keeps the features of the first frame of the episode, and walks to the right."""

    def encode(frames: Tensor) -> Tensor:
        return frames.float()[:, ::4, ::4].flatten(1)

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for t in range(features.shape[1]):
            state = torch.where(is_init[:, t, None], features[:, t], state)
            outputs.append(torch.nn.functional.one_hot(torch.full((len(state),), 3), 5).float())
        return torch.stack(outputs, 1), state

    return Policy(encode, remember, lambda size: torch.zeros(size, 32 * 32 * 3))


def test_whoever_keeps_the_first_frame_knows_the_sign_to_the_end() -> None:
    env = arcade_torch.make("SignpostEasy", num_envs=16, observability="partial")
    found = beliefs(first_frame_policy(), env, episodes=48)
    assert found.names.tolist() == ["sign"] and found.episodes == 48
    np.testing.assert_allclose(found.by_step("sign")[0], 1)
    frame = found.by_step("sign", "frame")[0]
    assert frame[0] == 1 and (frame[1:] < 0.5).all()
    env.set_observability("full")
    np.testing.assert_allclose(
        beliefs(first_frame_policy(), env, episodes=48).by_step("sign", "frame")[0], 1
    )


def test_an_agent_without_memory_has_the_score_of_its_frames_and_no_state() -> None:
    env = arcade_torch.make("SignpostEasy", num_envs=8, observability="full")
    found = beliefs(make_network("small", "mlp"), env, episodes=16, max_steps=3)
    assert found.state_width == 0 and found.frame_width > 0
    assert np.isnan(found.score("sign").value) and not found.score("sign").exists
    assert np.isfinite(found.score("sign", "frame").value)
    assert found.guess_loss.shape == (1, 4, 3)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"episodes": 7}, "episodes must be at least 8; got 7"),
        ({"max_steps": 0}, "max_steps must be at least 1; got 0"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], complaint: str) -> None:
    env = arcade_torch.make("SignpostEasy", num_envs=8)
    with pytest.raises(ValueError, match=complaint):
        beliefs(first_frame_policy(), env, **options)


def test_an_env_without_facts_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"ToyEnv has no facts\(\)"):
        beliefs(first_frame_policy(), ToyEnv([4] * 8), episodes=8)
