"""Signpost: its law, and a proof that it cannot be played without memory."""

import itertools

import jax
import numpy as np
import pytest

from arcade_torch.envs_jax import make, probe_ids, registered_ids
from arcade_torch.envs_jax.game import RIGHT
from arcade_torch.envs_jax.oracles import make_oracle, oracle_return, play, random_return
from arcade_torch.envs_jax.render.palette import YELLOW
from arcade_torch.envs_jax.signpost.renderer import BLANK, GATE, KINDS, OPEN, sign_pictures

from .conftest import Walk, draw, one, random_actions

LENGTHS = {"SignpostEasy": 5, "SignpostMedium": 7, "SignpostHard": 10}
LEVELS = pytest.mark.parametrize("id", LENGTHS)


def best_without_memory(corridor):
    """Highest expected return of a player that sees the sign at first and from then on place and
    last action alone.

    What it did with each of the four signs is a tuple of four last actions; a later step maps equal
    last actions to equal actions, and at the gate each class of equal last actions can be right
    about one sign.
    """
    tuples = list(itertools.product(range(5), repeat=4))
    cost = {actions: sum(a != RIGHT for a in actions) / 4 / corridor for actions in tuples}
    value = {actions: len(set(actions)) / 4 for actions in tuples}
    for _ in range(corridor - 1):
        value = {now: max(value[then] - cost[then] for then in followers(now)) for now in tuples}
    return max(value[first] - cost[first] for first in tuples)


def followers(now):
    """What a player that sees the last action alone can do next, for four signs at once."""
    kinds = sorted(set(now))
    for answer in itertools.product(range(5), repeat=len(kinds)):
        yield tuple(answer[kinds.index(action)] for action in now)


def test_without_memory_nobody_can_expect_more_than_a_quarter():
    assert best_without_memory(4) == 0.25


def test_probes_are_no_part_of_the_benchmark():
    assert {f"{name}-v0" for name in LENGTHS} == set(probe_ids())
    assert not set(probe_ids()) & set(registered_ids())


@LEVELS
def test_who_knows_the_sign_or_remembers_it_always_opens_the_gate(id):
    game = make(id)
    for kind in ("state", "frames"):
        episodes = play(game, make_oracle(game, kind), 64, frames=kind == "frames")
        assert (episodes.returns == 1).all()
        assert (episodes.lengths == LENGTHS[id]).all()


@LEVELS
def test_random_play_stumbles_four_times_in_five(id):
    returns = random_return(make(id), 2048)
    assert abs(returns.mean() - (1 / 5 - 4 / 5)) < 4 * returns.std() / np.sqrt(len(returns))


def test_the_law_step_by_step():
    game = make("SignpostEasy")
    actions = random_actions(5, 256)
    walk = Walk(game, actions)
    sign = walk.states.sign[0]
    assert np.bincount(sign, minlength=4).min() > 256 / 4 / 2
    assert (walk.states.sign == sign).all()
    assert (walk.states.x == np.minimum(np.arange(6), 4)[:, None]).all()
    right = actions[4] == sign
    np.testing.assert_allclose(walk.outcomes.reward[:4], -0.25 * (actions[:4] != RIGHT), atol=1e-7)
    np.testing.assert_array_equal(walk.outcomes.reward[4], right)
    np.testing.assert_array_equal(walk.states.score[5], right)
    assert not walk.outcomes.terminated[:4].any() and walk.outcomes.terminated[4].all()
    assert not walk.outcomes.truncated.any()


@pytest.mark.parametrize("size", [128, 256])
@LEVELS
def test_the_pomdp_shows_the_sign_in_the_first_frame_alone(id, size):
    game = make(id, obs_size=size)
    for sign in range(4):
        for x in (0, 1, game.level.corridor):
            state = one(game, sign=sign, x=x, timestep=x)
            full, partial = (draw(game, state, twin)[None] for twin in (False, True))
            assert game.screen.sign.read(full)[0] == sign
            assert game.screen.sign.read(partial)[0] == (sign if x == 0 else BLANK)
            cells = game.screen.corridor.read(full, 1, game.level.cells)[0, 0]
            np.testing.assert_array_equal(
                cells, game.screen.corridor.read(partial, 1, game.level.cells)[0, 0]
            )
            assert cells.tolist().index(max(cells)) == x and (cells % KINDS)[-1] == GATE


def test_the_arrow_of_a_sign_points_where_its_action_goes():
    """Its head, where most of it is, lies there."""
    ink = (sign_pictures(32)[:4] == np.array(YELLOW)).all(-1)
    up = ink[:, :16].sum((1, 2)) > ink[:, 16:].sum((1, 2))
    left = ink[:, :, :16].sum((1, 2)) > ink[:, :, 16:].sum((1, 2))
    assert up.tolist()[:2] == [True, False] and left.tolist()[2:] == [True, False]


def test_an_open_gate_looks_open_and_counts():
    game = make("SignpostEasy")
    state = one(game, x=game.level.corridor, timestep=game.level.corridor)
    after = game.step(jax.random.PRNGKey(0), state, state.sign)[0]
    frame = draw(game, after, True)[None]
    assert game.screen.score.read(frame)[0] == 1
    assert (game.screen.corridor.read(frame, 1, game.level.cells)[0, 0] % KINDS)[-1] == OPEN


def test_the_reference_rules_can_be_asked_for_and_are_the_same_law():
    assert (oracle_return(make("SignpostEasy", rules="reference"), episodes=8) == 1).all()
