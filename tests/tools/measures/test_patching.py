"""Exchanged states against agents of which it is known what their decisions rest on."""

import numpy as np
import pytest
import torch
from torch import Tensor

import arcade_torch
from arcade_torch.models import make_network
from arcade_torch.tools import Policy
from arcade_torch.tools.measures.beliefs.patching import NOBODY, OUTCOMES, Patches, patching
from tests.tools.measures.test_counterfactual import CueEnv, cue_policy
from tests.tools.measures.toys import ToyEnv, linear_policy

LENGTHS = (5, 6, 6, 7, 8, 8)


def test_a_copy_of_the_first_cue_follows_the_state_of_whoever_saw_another() -> None:
    players = len(LENGTHS)
    patches = patching(cue_policy(players), CueEnv(LENGTHS, players), episodes=12)
    assert patches.action.shape == (12, 8)
    assert patches.share("follows") == (1, 1, 1)
    assert patches.share("stays").value == patches.share("other").value == 0
    by_step = patches.by_step()
    assert np.isnan(by_step[0]) and (by_step[1:] == 1).all()
    alive = np.arange(8) < np.array(LENGTHS * 2)[:, None]
    np.testing.assert_array_equal(patches.action != NOBODY, alive)
    # all cues differ, so all donors do, from the second step on
    np.testing.assert_array_equal(patches.differs, alive & (np.arange(8) > 0))


def test_donors_that_decide_alike_are_not_counted() -> None:
    patches = patching(cue_policy(2), CueEnv([6] * 6, 2), episodes=12)
    assert 0 < patches.differs[:, 1:].mean() < 1
    assert patches.share("follows") == (1, 1, 1)


def test_without_memory_a_decision_stays_with_its_frame() -> None:
    patches = patching(linear_policy(0.0, dtype=torch.float32), ToyEnv(LENGTHS), episodes=12)
    assert patches.differs.any()
    assert patches.share("stays") == (1, 1, 1)
    env = arcade_torch.make("SignpostEasy", num_envs=4, observability="partial")
    patches = patching(make_network("small", "mlp"), env, episodes=4)
    np.testing.assert_array_equal(patches.patched[:, 1:], patches.action[:, 1:])


def test_outcomes_of_a_memory_that_forgets_slowly_are_mixed_and_sum_to_1() -> None:
    patches = patching(linear_policy(0.4, dtype=torch.float32), ToyEnv(LENGTHS), episodes=12)
    shares = [patches.share(outcome).value for outcome in OUTCOMES]
    assert sum(shares) == pytest.approx(1)
    assert shares[0] > 0 < shares[1]


def test_an_exchange_changes_nothing_of_the_episodes_themselves() -> None:
    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for begins in is_init.unbind(1):
            state += torch.where(begins[:, None], -state, 1)  # counts steps, in place
            outputs.append(torch.nn.functional.one_hot((state[:, 0] % 3).long(), 3).float())
        return torch.stack(outputs, 1), state

    counter = Policy(
        lambda frames: frames.float().flatten(1), remember, lambda size: torch.zeros(size, 1)
    )
    patches = patching(counter, ToyEnv([7] * 4), episodes=4)
    np.testing.assert_array_equal(patches.action, np.tile(np.arange(7) % 3, (4, 1)))
    assert not patches.differs.any() and np.isnan(patches.share().value)


def test_one_episode_has_no_donor_and_options_out_of_range_are_refused() -> None:
    policy = cue_policy(2)
    with pytest.raises(ValueError, match="batch size of env must be at least 2, for donors; got 1"):
        patching(policy, CueEnv([5], 2), episodes=4)
    with pytest.raises(ValueError, match="episodes must be at least 2; got 1"):
        patching(policy, CueEnv([5, 5], 2), episodes=1)
    last = Patches(*(np.array([[0, 1, NOBODY]]) for _ in range(3)))
    with pytest.raises(ValueError, match="outcome must be one of follows, stays, other"):
        last.share("flees")  # type: ignore[arg-type]
