"""``rules="reference"`` is the law of the published games."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import env_keys, make, registered_ids
from arcade_torch.envs_jax.navigator.rules import LEVELS as MAPS
from arcade_torch.envs_jax.tetris.rules import SHAPES
from tests.parity.reference import published, resets, without_picture
from tests.parity.translations import TASKS, translation_of
from tests.parity.walk import STEPS, walk

pytestmark = pytest.mark.parity

RESETS = 4096
# Kept in our states alone, or drawn where the published state says nothing.
NOT_COMPARED = {"noise", "safe", "flicker_key", "terminated", "truncated"}


@pytest.mark.parametrize("task", TASKS)
def test_both_games_pay_and_end_alike_at_every_step(task, rows):
    rows[task] = plain, rare = walk(task, seed=TASKS.index(task))
    assert plain.steps >= 10_000 and plain.episodes > 0 and rare.limits > 0
    assert not plain.mismatches and not rare.mismatches, (plain, rare)


@pytest.mark.parametrize(
    "task", ["AutoEncodeEasy", "CartPoleEasy", "MineSweeperEasy", "NavigatorEasy", "TetrisHard"]
)
def test_the_comparison_notices_the_default_rules(task):
    plain, rare = walk(task, rules="default", steps=STEPS // 2)
    assert plain.reward + rare.reward > 0 or plain.ending + rare.ending > 0


@pytest.mark.parametrize("task", TASKS)
def test_first_states_have_the_same_law(task):
    """Means of every entry of the state, and of its square, over 4096 episodes of each game."""
    game, say = make(task, rules="reference"), translation_of(task)
    reference, params = without_picture(task)
    theirs = resets(reference, jax.random.PRNGKey(1), RESETS, params)
    theirs = jax.vmap(lambda state: say.to_ours(game, state))(theirs)
    ours = jax.vmap(game.reset)(env_keys(1, RESETS))
    for name in set(ours._fields) - NOT_COMPARED:
        a, b = (
            np.asarray(getattr(states, name), np.float64).reshape(RESETS, -1)
            for states in (ours, theirs)
        )
        for power in (1, 2):
            apart = (a**power).mean(0) - (b**power).mean(0)
            spread = np.sqrt(((a**power).var(0) + (b**power).var(0)) / RESETS)
            fixed = spread == 0
            assert not apart[fixed].any(), f"{name}: {apart[fixed]}"
            assert (np.abs(apart[~fixed]) < 5 * spread[~fixed]).all(), name


@pytest.mark.parametrize("task", MAPS)
def test_the_published_treasure_lies_where_our_two_entries_of_the_free_cells_say(task):
    side = MAPS[task].side
    reference, params = without_picture(task)
    boards = np.asarray(resets(reference, jax.random.PRNGKey(2), 512, params).board)
    whole = boards[(boards == 1).sum((1, 2)) == 7]  # no block was replaced by the treasure
    assert len(whole) > 256
    for board in whole:
        free = np.flatnonzero(board != 1)
        x, y = (free[entry] for entry in MAPS[task].usual_place)
        assert board[x // side, y % side] == 2


def test_all_published_games_are_compared_and_pieces_have_the_same_shapes():
    from popgym_arcade.environments.tetris import TETROMINOES
    from popgym_arcade.registration import REGISTERED_ENVIRONMENTS

    assert set(REGISTERED_ENVIRONMENTS) == set(TASKS)
    assert {f"{task}-v0" for task in TASKS} <= set(registered_ids())
    assert (np.asarray(TETROMINOES).astype(bool) == SHAPES).all()


def test_the_game_without_its_picture_is_the_published_game():
    """What the walks step is what a user of the published package steps: the same state, reward and
    end.
    """
    whole, params = published("MineSweeperEasy")
    bare, _ = without_picture("MineSweeperEasy")
    key = jax.random.PRNGKey(0)
    _, state = whole.reset_env(key, params)
    for action in (4, 1, 4, 4):
        full, quick = (
            game.step_env(key, state, jnp.int32(action), params)[1:4] for game in (whole, bare)
        )
        assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), full, quick))
        state = full[0]
