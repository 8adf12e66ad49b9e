"""Moved states against agents of which it is known what their states hold."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from arcade_torch.tools import Policy, steering
from arcade_torch.tools.measures.beliefs.patching import NOBODY
from arcade_torch.tools.measures.beliefs.recording import Recording, flat_state, shifted_state
from arcade_torch.tools.measures.beliefs.steering import MIN_FITTED, Directions
from tests.tools.measures.test_counterfactual import CueEnv, cue_policy
from tests.tools.measures.toys import ToyEnv, linear_policy

CUES, ROWS, STEPS = 4, 24, 6
EPISODES = 2 * ROWS


class FactEnv(CueEnv):
    """Cues that are named as a class and as a number, beside a fact that nobody is shown."""

    def facts(self) -> TensorDict:
        cue = torch.arange(ROWS) % self.cues
        hidden = np.random.default_rng(self.seed).integers(0, 3, ROWS)
        facts = {"cue": cue, "number": cue.float(), "hidden": torch.from_numpy(hidden)}
        return TensorDict({**facts, "sky": torch.ones(ROWS)}, batch_size=(ROWS,))


def env() -> FactEnv:
    return FactEnv([STEPS - row % 2 for row in range(ROWS)], CUES)


def turning_policy(by_number: bool = False) -> Policy:
    """Repeats the first cue, of which its state is a linear function, another at each step, with
    two numbers beside it that it does not use.
    """
    generator = torch.Generator().manual_seed(0)
    width = CUES + 2
    turn = torch.linalg.qr(torch.randn(width, width, generator=generator)).Q
    mix = torch.randn(width, width, generator=generator)

    def encode(frames: Tensor) -> Tensor:
        cue = frames[:, 0, 0, 1].long()
        if by_number:
            held = torch.zeros(len(cue), CUES)
            held[:, 0] = cue
        else:
            held = torch.nn.functional.one_hot(cue, CUES).float()
        unused = torch.stack([cue * 0.3 + 0.1 * torch.rand(len(cue)), torch.rand(len(cue))], 1)
        return torch.cat([held, unused], 1)

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for t in range(features.shape[1]):
            first = torch.cat([features[:, t] @ mix, torch.zeros(len(state), 1)], 1)
            turned = torch.cat([state[:, :-1] @ turn, state[:, -1:] + 1], 1)
            state = torch.where(is_init[:, t, None], first, turned)
            back = torch.stack([torch.linalg.matrix_power(turn.T, int(n)) for n in state[:, -1]])
            held = torch.einsum("nd,nde->ne", state[:, :-1], back) @ mix.inverse()
            if by_number:
                held = -((held[:, :1] - torch.arange(CUES)) ** 2)
            outputs.append(held[:, :CUES])
        return torch.stack(outputs, 1), state

    return Policy(encode, remember, lambda size: torch.zeros(size, width + 1))


@pytest.mark.parametrize("by_number", [False, True])
def test_a_decision_follows_the_fact_that_a_state_holds_linearly_in_all_cases(
    by_number: bool,
) -> None:
    moves = steering(turning_policy(by_number), env(), episodes=EPISODES)
    assert moves.names.tolist() == ["cue", "number", "hidden"]  # the sky does not vary
    fact = "number" if by_number else "cue"
    assert moves.patches(fact).differs.sum() > EPISODES
    assert moves.patches(fact).share() == (1, 1, 1)
    assert moves.patches(fact, "state").share() == (1, 1, 1)
    assert moves.patches(fact, "random").share().value < 0.8
    # nothing can follow before a state, or beyond an end
    assert (moves.moved[:, :, 0] == NOBODY).all()
    assert (moves.moved[:, 1::2, -1] == NOBODY).all() and (moves.moved[:, 0::2, -1] >= 0).any()


def test_a_fact_that_the_state_does_not_hold_moves_no_more_decisions_than_chance() -> None:
    moves = steering(cue_policy(CUES), env(), episodes=EPISODES)
    assert moves.patches("cue").share() == (1, 1, 1)
    assert moves.patches("hidden", "state").share() == (1, 1, 1)
    assert moves.patches("hidden").differs.sum() > EPISODES
    by_chance = moves.patches("hidden", "random").share().value
    assert moves.patches("hidden").share().value <= by_chance < 0.1


def test_only_donors_with_another_value_are_counted() -> None:
    game = env()
    moves = steering(cue_policy(CUES), game, episodes=ROWS)
    was_moved = moves.moved[0] != NOBODY
    # here the cue is the decision
    np.testing.assert_array_equal(was_moved[:, 1:], (moves.action != moves.donor_action)[:, 1:])
    np.testing.assert_array_equal(moves.patches("cue").differs, was_moved)
    np.testing.assert_array_equal(moves.random[0] != NOBODY, was_moved)


def test_moves_change_nothing_of_the_episodes_and_without_memory_there_are_none() -> None:
    moves = steering(turning_policy(), env(), episodes=EPISODES)
    cue = np.arange(EPISODES) % ROWS % CUES
    alive = moves.action != NOBODY
    np.testing.assert_array_equal(moves.action[alive], np.where(alive, cue[:, None], 0)[alive])
    sight = cue_policy(CUES)
    stateless = Policy(sight.encode, lambda features, *others: (features, None))
    moves = steering(stateless, env(), episodes=ROWS)
    assert moves.names.tolist() == [] and moves.moved.shape == (0, *moves.action.shape)


def directions(values: np.ndarray, count: int = 200) -> tuple[Directions, np.ndarray]:
    """Directions of states that are [3 * value, noise, 7], and the noise."""
    noise = np.random.default_rng(0).normal(size=(count, 2))
    flat = np.nan_to_num(values.astype(float))
    states = np.stack([3 * flat, noise, np.full_like(noise, 7)], -1)
    return Directions(Recording(states, states, {"a": values}, np.full(count, 2))), noise


def test_a_direction_is_the_difference_between_the_means_of_classes() -> None:
    values = np.random.default_rng(1).integers(0, 3, (200, 2))
    values[:50, 1] = -1  # these have no value
    found, noise = directions(values)
    given = np.array([0, 2, -1, 1])
    moves, is_other = found.moves("a", 1, given, np.array([1, 0, 1, 3]))
    assert is_other.tolist() == [True, True, False, False]
    means = [noise[50:, 1][values[50:, 1] == k].mean() for k in range(3)]
    np.testing.assert_allclose(moves[0], [6, means[2] - means[0], 0], atol=1e-6)
    np.testing.assert_allclose(moves[1], -moves[0], atol=1e-6)
    assert not moves[2:].any()


def test_a_class_that_no_episode_had_at_a_step_has_no_direction_there() -> None:
    """Before: such a state was moved to the middle of all others, and counted."""
    values = np.random.default_rng(1).integers(0, 3, (200, 2))
    values[:, 1] %= 2
    found, _ = directions(values)
    given = np.array([0, 2, 1, 0])
    donors = np.array([1, 0, 3, 2])
    assert found.moves("a", 0, given, donors)[1].all()
    moves, is_other = found.moves("a", 1, given, donors)
    assert is_other.tolist() == [False, False, True, True] and not moves[:2].any()
    np.testing.assert_allclose(moves[2:, 0], [-3, 3], atol=1e-6)
    never = np.array([0, 3, 1, 0])
    assert found.moves("a", 0, never, donors)[1].tolist() == [False, False, True, True]


def test_a_number_that_was_the_same_in_all_episodes_at_a_step_has_no_direction_there() -> None:
    values = np.random.default_rng(1).normal(size=(200, 2))
    values[:, 1] = 0.1
    found, _ = directions(values)
    given = np.array([0.1, 0.5])
    swapped = np.array([1, 0])
    assert found.moves("a", 0, given, swapped)[1].all()
    moves, is_other = found.moves("a", 1, given, swapped)
    assert not is_other.any() and not moves.any()


def test_a_random_move_is_as_long_and_leaves_what_never_varies() -> None:
    values = np.random.default_rng(1).normal(size=(200, 2)).astype(np.float32)
    found, _ = directions(values)
    moves, _ = found.moves("a", 0, np.array([0.5, 2.5, np.nan]), np.array([1, 0, 0]))
    np.testing.assert_allclose(moves[:, 0], [6, -6, 0], atol=1e-5)
    chance = found.at_random(moves, 0, np.random.default_rng(0))
    lengths = np.linalg.norm(moves, axis=1)
    np.testing.assert_allclose(np.linalg.norm(chance, axis=1), lengths, rtol=1e-5)
    assert not chance[:, 2].any() and not chance[2].any()


def test_few_episodes_give_no_direction() -> None:
    values = np.random.default_rng(1).normal(size=(MIN_FITTED - 1, 2))
    assert directions(values, len(values))[0].slopes("a", 0) is None
    values = np.random.default_rng(1).normal(size=(MIN_FITTED, 2, 10))
    states = np.zeros((MIN_FITTED, 2, 3))
    many = Directions(Recording(states, states, {"a": values}, np.full(MIN_FITTED, 2)))
    assert many.slopes("a", 0) is None  # ten numbers from sixteen episodes
    assert many.slopes("a", 2) is None  # beyond the longest


def test_a_shifted_state_is_moved_number_by_number_and_whole_numbers_stay() -> None:
    state = TensorDict(
        {
            "b": torch.randn(2, 3, dtype=torch.complex64),
            "a": {"count": torch.tensor([1, 2]), "x": torch.randn(2, 2)},
        },
        batch_size=2,
    )
    before = flat_state(state, 2)
    by = np.random.default_rng(0).normal(size=before.shape).astype(np.float32)
    moved = flat_state(shifted_state(state, by), 2)
    np.testing.assert_allclose(moved[:, 1:], (before + by)[:, 1:], rtol=1e-6)
    np.testing.assert_array_equal(moved[:, 0], before[:, 0])
    np.testing.assert_array_equal(flat_state(state, 2), before)


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match=r"ToyEnv has no facts\(\)"):
        steering(linear_policy(0.4, dtype=torch.float32), ToyEnv([4] * 8), episodes=8)
    with pytest.raises(ValueError, match="batch size of env must be at least 2, for donors; got 1"):
        steering(cue_policy(2), CueEnv([5], 2), episodes=8)
    moves = steering(cue_policy(CUES), env(), episodes=ROWS)
    with pytest.raises(ValueError, match="fact must be one of cue, number, hidden; got 'sky'"):
        moves.patches("sky")
    with pytest.raises(ValueError, match="arm must be one of state, fact, random"):
        moves.patches("cue", "leg")  # type: ignore[arg-type]
