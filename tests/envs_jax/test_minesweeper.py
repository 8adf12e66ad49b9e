"""MineSweeper, checked against brute force and against what its pictures ought to tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.minesweeper.oracle import mine_chances
from arcade_torch.envs_jax.minesweeper.renderer import KINDS
from arcade_torch.envs_jax.minesweeper.rules import COVERED_MINE, SWEPT

from .conftest import Walk, batched, draw, one, random_actions, step

LEVELS = {"MineSweeperEasy": (4, 2), "MineSweeperMedium": (6, 6), "MineSweeperHard": (8, 10)}


def boards(id, count=512, seed=0, rules="default"):
    """Fresh states of many envs, with numpy leaves."""
    game = batched(id, rules=rules)
    return jax.tree.map(np.asarray, game.init(env_keys(seed, count), jnp.zeros(count, bool)).state)


def board(game, mines, x=0, y=0, **changes):
    """A state with mines at the given (x, y) cells."""
    side = game.level.side
    grid = np.zeros((side, side), np.int8)
    for cell in mines:
        grid[cell] = COVERED_MINE
    return one(game, x=x, y=y, grid=grid, neighbours=brute_force(grid), **changes)


def brute_force(grid):
    side = len(grid)
    return np.array(
        [
            [
                sum(
                    grid[i, j] == 1
                    for i in range(max(x - 1, 0), min(x + 2, side))
                    for j in range(max(y - 1, 0), min(y + 2, side))
                )
                for y in range(side)
            ]
            for x in range(side)
        ],
        np.int8,
    )


@pytest.mark.parametrize("id", LEVELS)
def test_boards_have_their_mines_anywhere_and_numbers_equal_brute_force(id):
    side, mines = LEVELS[id]
    fresh = boards(id)
    assert fresh.grid.shape == (512, side, side)
    assert ((fresh.grid == COVERED_MINE).sum((1, 2)) == mines).all()
    assert ((fresh.grid == COVERED_MINE).any(0)).all(), "some cell never had a mine"
    for grid, neighbours in zip(fresh.grid[:40], fresh.neighbours[:40], strict=True):
        assert np.array_equal(neighbours, brute_force(grid))


@pytest.mark.parametrize("id", LEVELS)
def test_mines_and_cursor_are_uniform(id):
    side, mines = LEVELS[id]
    fresh = boards(id, 4096, seed=1)
    for observed, rate in (
        ((fresh.grid == COVERED_MINE).sum(0).ravel(), mines / side**2),
        (np.bincount(fresh.x * side + fresh.y, minlength=side**2), 1 / side**2),
    ):
        z = (observed - 4096 * rate) / np.sqrt(4096 * rate * (1 - rate))
        assert np.abs(z).max() < 4.5
    both = (fresh.grid[np.arange(4096), fresh.x, fresh.y] == COVERED_MINE).mean()
    assert abs(both - mines / side**2) < 0.02, "cursor and mines ought to be independent"


def test_the_cursor_of_the_reference_never_starts_in_the_last_column_or_row():
    """M3; the mines are those of the default rules."""
    states = boards("MineSweeperEasy", rules="reference")
    for coordinate in (states.x, states.y):
        assert set(coordinate.tolist()) == set(range(3))
    assert (states.grid == boards("MineSweeperEasy").grid).all()


def test_the_cursor_moves_one_cell_and_stops_at_the_border():
    game = make("MineSweeperEasy")
    for action, (dx, dy) in enumerate([(0, -1), (0, 1), (-1, 0), (1, 0)]):
        new, reward, terminated, truncated = step(
            game, board(game, [(3, 3), (3, 2)], x=1, y=1), action
        )
        assert (int(new.x), int(new.y), int(new.timestep)) == (1 + dx, 1 + dy, 1)
        assert (reward, terminated, truncated) == (0, False, False)
        for x, y in ((0, 0), (3, 3)):
            new = step(game, board(game, [], x=x, y=y), action)[0]
            assert (int(new.x), int(new.y)) == (min(max(x + dx, 0), 3), min(max(y + dy, 0), 3))


@pytest.mark.parametrize("id", LEVELS)
def test_a_safe_cell_pays_its_share_once(id):
    game = make(id)
    state = board(game, [(3, 3)])
    new, reward, terminated, _ = step(game, state, 4)
    assert reward == pytest.approx(1 / game.level.safe) and not terminated
    assert (int(new.score), int(new.repeats), int(new.grid[0, 0])) == (1, 0, SWEPT)
    assert int((new.grid == SWEPT).sum()) == 1, "nothing else opens, not even around a 0"
    again, reward, terminated, _ = step(game, new, 4)
    assert reward == pytest.approx(-2 / game.level.cells) and not terminated
    assert (int(again.score), int(again.repeats)) == (1, 1)


@pytest.mark.parametrize(("options", "expected"), [({}, 0.0), ({"mine_reward": -0.5}, -0.5)])
def test_a_mine_ends_the_game(options, expected):
    game = make("MineSweeperEasy", **options)
    new, reward, terminated, truncated = step(game, board(game, [(2, 1)], x=2, y=1), 4)
    assert (reward, terminated, truncated) == (expected, True, False)
    assert int(new.score) == 0 and int(new.grid[2, 1]) == SWEPT
    assert game.return_range[0] == pytest.approx(1 / 14 - 7 / 8 + min(expected, -1 / 8)), (
        "a mine in place of a repeat"
    )


@pytest.mark.parametrize("id", LEVELS)
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_repeats_end_the_game_at_the_documented_lowest_return(id, rules):
    game = make(id, rules=rules)
    state, total, fires = board(game, [(3, 3)]), 0.0, 0
    terminated = False
    while not terminated:
        state, reward, terminated, _ = step(game, state, 4)
        total, fires = total + reward, fires + 1
    late = rules == "reference"
    assert fires == 1 + game.level.cells // 2 + late
    assert total == pytest.approx(1 / game.level.safe - 1 - late * 2 / game.level.cells, abs=1e-5)
    assert total == pytest.approx(game.return_range[0], abs=1e-5)


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("action", [0, 4])
def test_the_time_limit_truncates_but_does_not_terminate(rules, action):
    """A sweep at the last step is cut at once; the reference lets one step follow."""
    game = make("MineSweeperEasy", rules=rules)
    last = board(game, [(3, 3)], timestep=31)
    _, _, terminated, truncated = step(game, last, action)
    assert not terminated and truncated is (rules == "default" or action != 4)
    assert step(game, board(game, [(3, 3)], timestep=32), action)[3] is True
    assert step(game, board(game, [(3, 3)], timestep=30), action)[3] is False


@pytest.mark.parametrize(("rules", "repeats", "action", "ends"), [
    ("default", 7, 4, True),
    ("default", 7, 0, False),
    ("reference", 7, 4, False),
    ("reference", 8, 4, True),
    ("reference", 8, 0, False),
])  # fmt: skip
def test_the_repeats_are_judged_after_the_sweep_or_late_in_the_reference(
    rules, repeats, action, ends
):
    game = make("MineSweeperEasy", rules=rules)
    state = board(game, [(3, 3)], repeats=repeats, timestep=20)
    state = state._replace(grid=state.grid.at[0, 0].set(SWEPT))
    assert step(game, state, action)[2] is ends


def test_sweeping_the_last_safe_cell_terminates_with_return_one():
    game = make("MineSweeperEasy")
    grid = np.full((4, 4), SWEPT, np.int8)
    grid[0, 0], grid[3, 3], grid[2, 2] = 0, COVERED_MINE, COVERED_MINE
    state = one(game, x=0, y=0, grid=grid, score=13)
    new, reward, terminated, truncated = step(game, state, 4)
    assert (terminated, truncated, int(new.score)) == (True, False, 14)
    assert reward == pytest.approx(1 / 14)


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", LEVELS)
def test_template_matching_recovers_every_number_at_every_size(id, size):
    """Board, cursor and numbers can be read back from the MDP picture alone."""
    game = make(id, obs_size=size)
    compiled = batched(id, obs_size=size)
    side = game.level.side
    states = [compiled.init(env_keys(4, 24), jnp.zeros(24, bool))]
    for action in random_actions(60, 24, seed=8):
        states.append(compiled.step(states[-1], action)[0])
    for batch in states[:: len(states) // 4]:
        codes = game.screen.board.read(np.asarray(compiled.render(batch)), side, side)
        state = jax.tree.map(np.asarray, batch.state)
        expected = np.where(state.grid == SWEPT, 1 + state.neighbours, 0)
        expected[np.arange(24), state.x, state.y] += KINDS
        assert np.array_equal(codes, expected.swapaxes(1, 2))
    assert (codes > 0).sum() > 24 * 2


@pytest.mark.parametrize("id", LEVELS)
def test_the_pomdp_shows_the_number_under_the_cursor_alone(id):
    game = make(id)
    grid = np.full((game.level.side,) * 2, SWEPT, np.int8)
    neighbours = (np.arange(grid.size) % 9).reshape(grid.shape)
    state = one(game, x=2, y=1, grid=grid, neighbours=neighbours)
    codes = game.screen.board.read(draw(game, state, True)[None], game.level.side, game.level.side)[
        0
    ]
    assert codes[1, 2] == KINDS + 1 + neighbours[2, 1]
    assert (np.delete(codes.ravel(), game.level.side + 2) == 0).all()


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("MineSweeperEasy")
    base = board(game, [(3, 3)], x=1, y=1)
    frame = draw(game, base, False)
    swept = base.grid.at[0, 2].set(SWEPT)
    for changes in ({"x": 2}, {"y": 0}, {"grid": swept}, {"score": 5}):
        changed = base._replace(
            **{
                name: jnp.asarray(value, getattr(base, name).dtype)
                for name, value in changes.items()
            }
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes
    more = base._replace(grid=swept, neighbours=base.neighbours.at[0, 2].add(1))
    assert not np.array_equal(draw(game, more, False), draw(game, base._replace(grid=swept), False))


def test_digits_keep_a_margin_inside_their_tile():
    for size in (128, 256):
        for id in LEVELS:
            screen = make(id, obs_size=size).screen
            tiles = screen.board.atlas[:, 2:, 2:]
            white = (tiles == 255).all(-1)
            assert white[1:KINDS].any((1, 2)).all()
            assert not white[:, [0, -1]].any() and not white[:, :, [0, -1]].any()


def test_mine_chances_follow_certain_deductions():
    known = np.full((1, 4, 4), -1)
    known[0, 0, 0] = 0
    chance = mine_chances(known, 2, 30)[0]
    assert (chance[:2, :2] == 0).all() and (chance[2:, :] > 0).all()
    known[0, 0, 0] = 3
    assert (mine_chances(known, 4, 200)[0][[0, 1, 1], [1, 0, 1]] > 0.95).all()


def test_random_walks_never_sweep_more_than_there_is():
    walk = Walk(make("MineSweeperEasy"), random_actions(32, 64))
    assert walk.states.score.max() <= 14
    assert np.array_equal(walk.states.timestep[:, 0], np.arange(33))
