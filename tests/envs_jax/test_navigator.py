"""Navigator, checked against brute force and against what its pictures ought to tell."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.navigator.oracle import FAR, path_lengths
from arcade_torch.envs_jax.navigator.renderer import KINDS
from arcade_torch.envs_jax.navigator.rules import FREE, TNT, TREASURE, draw_distinct
from arcade_torch.envs_jax.oracles import make_oracle, play, random_return
from arcade_torch.envs_jax.render.palette import MAUVE, RED, SKY, YELLOW

from .conftest import batched, draw, fresh, going_on, one, step

SIDES = {"NavigatorEasy": 8, "NavigatorMedium": 10, "NavigatorHard": 12}
UP, DOWN, LEFT, RIGHT, FIRE = range(5)


def chart(game, tnt=(), treasure=None, x=0, y=0, **changes):
    """A state with TNT and treasure at the given (x, y) cells."""
    board = np.zeros((game.level.side,) * 2, np.int8)
    for cell in tnt:
        board[cell] = TNT
    if treasure is not None:
        board[treasure] = TREASURE
    return one(game, x=x, y=y, board=board, **changes)


def deviations(count, rate, total):
    """How many standard deviations each count of a binomial law lies off its mean."""
    return np.abs(count - total * rate) / np.sqrt(total * rate * (1 - rate))


def search(board, x, y):
    """Length of a shortest path from (x, y) to the treasure, by breadth-first search; None where
    there is none.
    """
    queue, seen = deque([(x, y, 0)]), {(x, y)}
    while queue:
        x, y, length = queue.popleft()
        if board[x, y] == TREASURE:
            return length
        for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if (
                min(cell) >= 0
                and max(cell) < len(board)
                and cell not in seen
                and board[cell] != TNT
            ):
                seen.add(cell)
                queue.append((*cell, length + 1))
    return None


@pytest.mark.parametrize("id", SIDES)
def test_nine_distinct_cells_hold_seven_blocks_a_treasure_and_the_agent(id):
    states, side = fresh(id), SIDES[id]
    assert states.board.shape == (4096, side, side)
    assert ((states.board == TNT).sum((1, 2)) == 7).all() and (
        (states.board == TREASURE).sum((1, 2)) == 1
    ).all()
    assert (states.board[np.arange(4096), states.x, states.y] == FREE).all()
    assert (states.timestep == 0).all()


@pytest.mark.parametrize("id", SIDES)
def test_treasure_agent_and_blocks_are_uniform_and_the_first_two_independent(id):
    states, side = fresh(id), SIDES[id]
    cells = side**2
    treasure = (states.board == TREASURE).reshape(4096, -1).argmax(1)
    agent = states.x * side + states.y
    for place in (treasure, agent):
        count = np.bincount(place, minlength=cells)
        assert deviations(count, 1 / cells, 4096).max() < 5
        chi2 = ((count - 4096 / cells) ** 2).sum() / (4096 / cells)
        assert abs(chi2 - (cells - 1)) < 4 * np.sqrt(2 * (cells - 1))
    assert deviations((states.board == TNT).sum(0), 7 / cells, 4096).max() < 5
    assert abs(np.corrcoef(treasure, agent)[0, 1]) < 0.06


def test_distinct_draws_are_uniform_over_all_sets():
    sets = np.asarray(jax.jit(jax.vmap(lambda key: draw_distinct(key, 3, 6)))(env_keys(2, 4000)))
    assert (
        all(len(set(cells)) == 3 for cells in sets.tolist()) and sets.min() == 0 and sets.max() == 5
    )
    count = np.unique(np.sort(sets, 1), axis=0, return_counts=True)[1]
    assert len(count) == 20 and deviations(count, 1 / 20, 4000).max() < 4.5


# What was measured of the published game: the commonest treasure cells (x, y), their share, and the
# shares of episodes with a block overwritten, with the agent on TNT, and with the agent on the
# treasure.
PUBLISHED = {
    "NavigatorEasy": ({(2, 2), (2, 3), (2, 4)}, 0.75, 0.104, 0.092, 0.018),
    "NavigatorMedium": ({(4, 0), (4, 9), (4, 1)}, 0.64, 0.048, 0.056, 0.011),
    "NavigatorHard": ({(9, 11), (9, 0), (9, 10)}, 0.74, 0.048, 0.041, 0.006),
}


@pytest.mark.parametrize("id", SIDES)
def test_the_reference_puts_treasure_and_agent_where_the_published_game_does(id):
    states, side = fresh(id, "reference"), SIDES[id]
    places, share, overwritten, on_tnt, on_treasure = PUBLISHED[id]
    count = (states.board == TREASURE).sum(0)
    assert count.sum() == 4096
    commonest = np.argsort(count.ravel())[-3:]
    assert {(int(cell) // side, int(cell) % side) for cell in commonest} == places
    assert abs(count.ravel()[commonest].sum() / 4096 - share) < 0.03
    blocks = (states.board == TNT).sum((1, 2))
    assert set(blocks.tolist()) == {6, 7} and abs((blocks == 6).mean() - overwritten) < 0.015
    start = states.board[np.arange(4096), states.x, states.y]
    assert (
        abs((start == TNT).mean() - on_tnt) < 0.015
        and abs((start == TREASURE).mean() - on_treasure) < 0.01
    )


def test_the_agent_moves_one_cell_and_stops_at_the_border_at_a_cost():
    game = make("NavigatorEasy")
    for action, (dx, dy) in enumerate([(0, -1), (0, 1), (-1, 0), (1, 0), (0, 0)]):
        for x, y in ((3, 4), (0, 0), (7, 7)):
            new, reward, terminated, truncated = step(
                game, chart(game, [(5, 5)], (1, 6), x=x, y=y), action
            )
            assert (int(new.x), int(new.y)) == (min(max(x + dx, 0), 7), min(max(y + dy, 0), 7))
            assert (int(new.timestep), terminated, truncated) == (1, False, False)
            assert reward == pytest.approx(-0.5 / 64)


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_tnt_kills(rules):
    game = make("NavigatorEasy", rules=rules)
    new, reward, terminated, truncated = step(game, chart(game, [(3, 4)], (7, 7), x=3, y=3), DOWN)
    assert (reward, terminated, truncated, int(new.y)) == (-0.5, True, False, 4)


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_treasure_must_be_opened(rules):
    game = make("NavigatorMedium", rules=rules)
    state, reward, terminated, _ = step(game, chart(game, treasure=(3, 4), x=3, y=3), DOWN)
    assert reward == pytest.approx(-0.5 / 100) and not terminated
    assert step(game, state, UP)[2] is False, "walking over it does nothing"
    assert step(game, state, FIRE)[1:] == (1, True, False)


def test_an_agent_that_stands_on_tnt_dies_of_a_bump_alone():
    """Only the reference begins there."""
    game = make("NavigatorEasy", rules="reference")
    state = chart(game, [(0, 3)], (7, 7), x=0, y=3)
    assert step(game, state, FIRE)[2] is False and step(game, state, RIGHT)[2] is False
    assert step(game, state, LEFT)[1:] == (-0.5, True, False)


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("id", ["NavigatorEasy", "NavigatorHard"])
def test_the_limit_truncates_and_the_reference_then_pays_nothing(id, rules):
    game = make(id, rules=rules)
    limit, paid = SIDES[id] ** 2, rules == "default"
    assert game.max_steps == limit
    for name, action, reward, ends in (
        ("free", UP, -0.5 / limit, False),
        ("tnt", RIGHT, -0.5, True),
        ("won", FIRE, 1.0, True),
    ):
        state = chart(game, [(4, 3)], (3, 3) if name == "won" else (0, 0), x=3, y=3)
        early = step(game, state._replace(timestep=jnp.int32(limit - 2)), action)
        assert early[1:] == (pytest.approx(reward), ends, False)
        last = step(game, state._replace(timestep=jnp.int32(limit - 1)), action)
        assert last[1:] == (pytest.approx(reward * paid), ends, True)


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_return_range_is_attained(rules):
    game = make("NavigatorEasy", rules=rules)
    late = rules == "reference"
    low, high = game.return_range
    # Waiting as long as a death still pays.
    state, total = chart(game, [(1, 0)], (7, 7)), 0.0
    for _ in range(63 - late):
        state, reward, terminated, truncated = step(game, state, FIRE)
        total += reward
        assert not terminated and not truncated
    assert total + step(game, state, RIGHT)[1] == pytest.approx(low)
    if late:  # only the reference lets an agent begin on the treasure
        assert step(game, chart(game, treasure=(0, 0)), FIRE)[1] == high == 1
    else:
        state, first, *_ = step(game, chart(game, treasure=(1, 0)), RIGHT)
        assert first + step(game, state, FIRE)[1] == pytest.approx(high)


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    actions=hnp.arrays(np.int32, (30, 16), elements=st.integers(0, 4)),
)
def test_any_play_ends_as_its_path_says(seed, actions):
    """The end and the return of an episode follow from the path alone."""
    game = batched("NavigatorEasy")
    batch = game.init(env_keys(seed, 16), jnp.zeros(16, bool))
    board, envs = np.asarray(batch.state.board), np.arange(16)
    alive, expected, total = np.ones(16, bool), np.zeros(16), np.zeros(16)
    for action in actions:
        batch, outcome = game.step(going_on(batch), action)
        cell = board[envs, np.asarray(batch.state.x), np.asarray(batch.state.y)]
        dead, won = (action != FIRE) & (cell == TNT), (action == FIRE) & (cell == TREASURE)
        assert np.array_equal(outcome.terminated, dead | won)
        expected += alive * np.where(won, 1, np.where(dead, -0.5, -0.5 / 64))
        total += alive * np.asarray(outcome.reward)
        alive &= ~(dead | won)
    np.testing.assert_allclose(total, expected, atol=1e-5)
    assert np.array_equal(batch.state.board, board)


@pytest.mark.parametrize(
    ("id", "size"), [("NavigatorEasy", 256), ("NavigatorMedium", 128), ("NavigatorHard", 128)]
)
def test_map_and_agent_can_be_read_back(id, size):
    """From every frame of the MDP and the first of the POMDP; afterwards the latter shows the agent
    on an empty map.
    """
    game, compiled, side = make(id, obs_size=size), batched(id, obs_size=size), SIDES[id]
    batch = compiled.init(env_keys(4, 8), jnp.zeros(8, bool))
    for timestep in (0, 1):
        # At the second look the agent stands on TNT in four envs, on the treasure in the others.
        board = np.asarray(batch.state.board).reshape(8, -1)
        if timestep:
            place = np.where(
                np.arange(8) < 4, (board == TNT).argmax(1), (board == TREASURE).argmax(1)
            ).astype(np.int32)
            batch = batch._replace(
                state=batch.state._replace(
                    x=place // side, y=place % side, timestep=jnp.ones(8, jnp.int32)
                )
            )
        agent = np.asarray(batch.state.x) * side + np.asarray(batch.state.y)
        for partial in (False, True):
            frames = np.asarray(compiled.render(batch._replace(partial=jnp.full(8, partial))))
            expected = (board if not (partial and timestep) else 0 * board).astype(int)
            expected[np.arange(8), agent] += KINDS
            codes = game.screen.board.read(frames, side, side)
            assert np.array_equal(codes, expected.reshape(8, side, side).swapaxes(1, 2))


def test_twins_are_equal_at_first_and_then_differ_in_treasure_and_tnt_alone():
    game = make("NavigatorEasy")
    tnt, treasure = [(1, 2), (6, 6), (3, 3)], (5, 0)
    state = chart(game, tnt, treasure, x=3, y=3)
    assert np.array_equal(draw(game, state, False), draw(game, state, True))
    state = state._replace(timestep=jnp.int32(1))
    different = (draw(game, state, False) != draw(game, state, True)).any(-1)
    layout = game.screen.layout
    expected = np.zeros_like(different)
    for x, y in (*tnt, treasure):
        left, top = (layout.offset + 2 + k * layout.pitch for k in (x, y))
        tile = np.s_[top : top + layout.tile, left : left + layout.tile]
        assert different[tile].any(), "also under the agent, by its rim"
        expected[tile] = True
    assert not different[~expected].any()


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("NavigatorEasy")
    base = chart(game, [(3, 3)], (5, 5))
    frame = draw(game, base, False)
    boards = [base.board.at[0, 0].set(kind) for kind in (TNT, TREASURE)] + [
        base.board.at[3, 3].set(FREE)
    ]
    for changes in ({"x": 3}, {"y": 1}, *({"board": board} for board in boards)):
        changed = base._replace(
            **{k: jnp.asarray(v, getattr(base, k).dtype) for k, v in changes.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes
    assert np.array_equal(frame, draw(game, base._replace(timestep=jnp.int32(9)), False)), (
        "time is not shown"
    )


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", SIDES)
def test_things_have_their_colours_and_show_around_the_agent(id, size):
    tiles = make(id, obs_size=size).screen.board.atlas[:, 2:, 2:]
    assert len(np.unique(tiles.reshape(len(tiles), -1), axis=0)) == 2 * KINDS

    def share(kind, colour):
        return (tiles[kind] == colour).all(-1).mean()

    assert share(FREE, MAUVE) == 1
    assert (
        0.5 < share(TNT, RED) < 0.75
        and share(TNT, (255, 255, 255)) > 0.1
        and share(TNT, (0, 0, 0)) > 0.05
    )
    assert 0.55 < share(TREASURE, SKY) < 0.85 and share(TREASURE, SKY) + share(
        TREASURE, MAUVE
    ) == pytest.approx(1)
    for kind, colour, least in ((FREE, MAUVE, 0.4), (TNT, RED, 0.25), (TREASURE, SKY, 0.15)):
        assert 0.28 < share(KINDS + kind, YELLOW) < 0.55 and share(KINDS + kind, colour) > least
    for tile in tiles:
        yellow = (tile == YELLOW).all(-1)
        assert np.array_equal(yellow, yellow[::-1]) and np.array_equal(yellow, yellow.T), (
            "a square in the middle"
        )
    for tile in tiles[:KINDS]:
        red, sky = (tile == RED).all(-1), (tile == SKY).all(-1)
        assert (
            np.array_equal(red, red[::-1])
            and np.array_equal(sky, sky[::-1])
            and np.array_equal(sky, sky[:, ::-1])
        )


def test_path_lengths_equal_breadth_first_search():
    boards = fresh("NavigatorMedium").board[:12].copy()
    boards[0] = FREE
    boards[0, 0, 0], boards[0, 0, 1], boards[0, 1, 0] = TREASURE, TNT, TNT
    lengths = path_lengths(boards)
    for board, length in zip(boards, lengths, strict=True):
        for x in range(10):
            for y in range(10):
                if board[x, y] != TNT:
                    found = search(board, x, y)
                    assert length[x, y] == found or (found is None and length[x, y] >= FAR)


@pytest.mark.parametrize("id", SIDES)
def test_few_maps_are_walled_off(id):
    states = fresh(id)
    length = path_lengths(states.board)[np.arange(4096), states.x, states.y]
    assert (length >= FAR).mean() < {8: 0.008, 10: 0.003, 12: 0.002}[SIDES[id]]
    assert length.min() == 1


@pytest.mark.parametrize(
    ("id", "rules"), [("NavigatorEasy", "default"), ("NavigatorHard", "reference")]
)
def test_oracles_walk_the_shortest_path_with_and_without_the_map(id, rules):
    """The return is 1 - 0.5 d / cells; memory of the first frame is worth as much as the whole
    state.
    """
    game = make(id, rules=rules)
    knowing, first = make_oracle(game, "state"), []

    class Recorder:
        def act(self, seen, is_init):
            first.append(seen)
            return knowing.act(seen, is_init)

    episodes = play(game, Recorder(), 48)
    lengths = [search(*start) for start in zip(first[0].board, first[0].x, first[0].y, strict=True)]
    solvable = np.array([length is not None for length in lengths])
    shortest = np.array([length or 0 for length in lengths])
    assert solvable.sum() > 44
    assert np.array_equal(episodes.lengths[solvable], shortest[solvable] + 1)
    expected = 1 - 0.5 * shortest / game.max_steps
    np.testing.assert_allclose(episodes.returns[solvable], expected[solvable], atol=1e-5)
    remembering = play(game, make_oracle(game, "frames"), 48, frames=True)
    assert np.array_equal(remembering.returns, episodes.returns)


def test_an_oracle_that_is_walled_in_waits():
    game = make("NavigatorEasy")
    oracle = make_oracle(game, "state")
    state = chart(game, [(0, 1), (1, 0)], (5, 5))
    seen = jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)
    assert oracle.act(seen, np.ones(1, bool)).tolist() == [FIRE]


def test_random_play_loses():
    returns = random_return(make("NavigatorEasy"), 128)
    assert -0.68 < returns.mean() < -0.42 and returns.min() > -1 and returns.max() < 1
