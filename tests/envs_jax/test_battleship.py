"""BattleShip, checked against brute force and against what its pictures ought to tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.battleship.oracle import ship_scores
from arcade_torch.envs_jax.battleship.renderer import COVERED, HIT, KINDS, MISS
from arcade_torch.envs_jax.battleship.rules import (
    SHIPS,
    pick_line,
    pick_line_in_turn,
    place_ship,
)
from arcade_torch.envs_jax.oracles import oracle_return, random_return
from arcade_torch.envs_jax.render.palette import BRASS, NICKEL, RED

from .conftest import batched, draw, fresh, one, step

SIDES = {"BattleShipEasy": 8, "BattleShipMedium": 10, "BattleShipHard": 12}
KEY = jax.random.PRNGKey(0)
UP, DOWN, LEFT, RIGHT, FIRE = range(5)


def sea(game, ships=(), shots=(), x=0, y=0, **changes):
    """A state with ship cells and shots at the given (x, y) cells."""
    board = np.zeros((game.level.side,) * 2, np.int8)
    guesses = board.copy()
    for cell in ships:
        board[cell] = 1
    for cell in shots:
        guesses[cell] = 1
    return one(game, x=x, y=y, board=board, guesses=guesses, **changes)


def places(occupied, length):
    """Every way to put a straight ship on free cells, by brute force: frozensets of (x, y)."""
    side = len(occupied)
    found = []
    for x in range(side):
        for y in range(side):
            for dx, dy in ((1, 0), (0, 1)):
                cells = [(x + k * dx, y + k * dy) for k in range(length)]
                if max(map(max, cells)) < side and not any(occupied[cell] for cell in cells):
                    found.append(frozenset(cells))
    return found


def splits(cells, lengths):
    """Whether the cells can be cut into straight ships of the given lengths."""
    if not lengths:
        return not cells
    side = 1 + max(max(cell) for cell in cells)
    taken = np.ones((side, side), bool)
    for cell in cells:
        taken[cell] = False
    return any(splits(cells - ship, lengths[1:]) for ship in places(taken, lengths[0]))


@pytest.mark.parametrize("id", SIDES)
def test_every_sea_holds_straight_ships_of_two_three_three_and_four_cells(id):
    states = fresh(id)
    side = SIDES[id]
    assert states.board.shape == (4096, side, side)
    assert (states.board.sum((1, 2)) == 12).all()
    for board in states.board[:20]:
        assert splits(frozenset(map(tuple, np.argwhere(board))), SHIPS)
    for counter in (states.guesses, states.hits, states.repeats, states.timestep):
        assert (counter == 0).all()


def put_ship(draw, occupied, length):
    """The cells of a ship, bool [side, side], where cells of a bool [side, side] are taken."""
    cells = jnp.arange(len(occupied))
    columns = list((occupied.astype(jnp.int32) << cells).sum(1))
    ship = jnp.stack(place_ship(draw, columns, length))
    return (ship[:, None] >> cells) & 1 == 1


def test_a_ship_takes_every_free_place_with_equal_chance():
    """Counting through the draws visits each legal place exactly once and then begins again."""
    put = {
        n: jax.jit(jax.vmap(put_ship, in_axes=(0, None, None)), static_argnums=2)
        for n in set(SHIPS)
    }
    generator = np.random.default_rng(0)
    for length in sorted(set(SHIPS)):
        for density in (0.0, 0.1, 0.25):
            occupied = generator.random((8, 8)) < density
            expected = places(occupied, length)
            ships = np.asarray(
                put[length](jnp.arange(112, dtype=jnp.uint32), jnp.asarray(occupied), length)
            )
            found = [frozenset(map(tuple, np.argwhere(ship))) for ship in ships]
            assert sorted(map(sorted, found[: len(expected)])) == sorted(map(sorted, expected))
            assert found[len(expected) :] == [
                found[i % len(expected)] for i in range(len(expected), 112)
            ]


@pytest.mark.parametrize("side", [8, 12])
def test_a_gpu_picks_the_lines_that_a_cpu_picks(side):
    generator = np.random.default_rng(side)
    lines = generator.integers(0, 1 << side, (500, 2 * side), np.int32)
    lines[generator.random(lines.shape) < 0.3] = 0
    draws = generator.integers(0, 2**32, 500, np.uint32)
    picks = [jax.vmap(pick)(draws, list(lines.T)) for pick in (pick_line, pick_line_in_turn)]
    for one_way, other_way in zip(*picks, strict=True):
        assert np.array_equal(one_way, other_way)
    number, bits, rank = picks[0]
    assert np.array_equal(bits, lines[np.arange(500), number])
    assert (rank >= 0).all() and (rank < np.bitwise_count(bits)).all()


def test_touching_ships_are_allowed():
    boards = fresh("BattleShipEasy").board.astype(bool)
    square = boards[:, :-1, :-1] & boards[:, 1:, :-1] & boards[:, :-1, 1:] & boards[:, 1:, 1:]
    assert 0.05 < square.any((1, 2)).mean() < 0.6


@pytest.mark.parametrize("id", SIDES)
def test_the_cursor_starts_on_any_cell_with_equal_chance_whatever_the_sea(id):
    states, side = fresh(id), SIDES[id]
    cells = side**2
    count = np.bincount(states.x * side + states.y, minlength=cells)
    chi2 = ((count - 4096 / cells) ** 2).sum() / (4096 / cells)
    assert count.min() > 0 and abs(chi2 - (cells - 1)) < 4 * np.sqrt(2 * (cells - 1))
    rate = 12 / cells
    on_ship = states.board[np.arange(4096), states.x, states.y].mean()
    assert abs(on_ship - rate) < 4 * np.sqrt(rate * (1 - rate) / 4096), (
        "cursor and ships ought to be independent"
    )


def test_the_cursor_of_the_reference_never_starts_in_the_last_column_or_row():
    """B1; the ships are those of the default rules."""
    states = fresh("BattleShipEasy", "reference")
    for coordinate in (states.x, states.y):
        assert set(coordinate.tolist()) == set(range(7))
    assert (states.board == fresh("BattleShipEasy").board).all()


def test_the_cursor_moves_one_cell_and_stops_at_the_border():
    game = make("BattleShipEasy")
    for action, (dx, dy) in enumerate([(0, -1), (0, 1), (-1, 0), (1, 0)]):
        for x, y in ((3, 4), (0, 0), (7, 7)):
            new, reward, terminated, truncated = step(game, sea(game, [(3, 4)], x=x, y=y), action)
            assert (int(new.x), int(new.y)) == (min(max(x + dx, 0), 7), min(max(y + dy, 0), 7))
            assert (int(new.timestep), reward, terminated, truncated) == (1, 0, False, False)
            assert not np.asarray(new.guesses).any()


@pytest.mark.parametrize("id", ["BattleShipEasy", "BattleShipHard"])
def test_a_ship_pays_water_does_not_and_repeats_cost(id):
    game = make(id)
    state = sea(game, ships=[(2, 1)], x=2, y=1)
    new, reward, terminated, truncated = step(game, state, FIRE)
    assert reward == pytest.approx(1 / 12) and not terminated and not truncated
    assert (int(new.hits), int(new.repeats), int(new.guesses[2, 1])) == (1, 0, 1)
    assert int(new.guesses.sum()) == 1
    again, reward, terminated, _ = step(game, new, FIRE)
    assert reward == pytest.approx(-2 / SIDES[id] ** 2) and not terminated
    assert (int(again.hits), int(again.repeats)) == (1, 1)
    new, reward, _, _ = step(game, sea(game, ships=[(2, 1)], x=1, y=2), FIRE)
    assert reward == 0 and (int(new.hits), int(new.repeats), int(new.guesses[1, 2])) == (0, 0, 1)


@pytest.mark.parametrize("id", ["BattleShipEasy", "BattleShipHard"])
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_firing_at_one_water_cell_ends_at_the_lowest_return(id, rules):
    game = make(id, rules=rules)
    state, total, shots, terminated = sea(game, [(5, 5)]), 0.0, 0, False
    while not terminated:
        state, reward, terminated, truncated = step(game, state, FIRE)
        total, shots = total + reward, shots + 1
        assert not truncated
    late = rules == "reference"
    cells = SIDES[id] ** 2
    assert shots == 1 + cells // 2 + late
    assert total == pytest.approx(-1 - late * 2 / cells, abs=1e-5)
    assert total == pytest.approx(game.return_range[0], abs=1e-5)


@pytest.mark.parametrize(("rules", "repeats", "action", "ends"), [
    ("default", 31, FIRE, True),
    ("default", 30, FIRE, False),
    ("default", 31, UP, False),
    ("reference", 31, FIRE, False),
    ("reference", 32, FIRE, True),
    ("reference", 32, UP, False),
])  # fmt: skip
def test_the_repeats_are_judged_after_the_shot_or_late_in_the_reference(
    rules, repeats, action, ends
):
    game = make("BattleShipEasy", rules=rules)
    state = sea(game, shots=[(0, 0)], repeats=repeats, timestep=60)
    assert step(game, state, action)[2] is ends


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("id", ["BattleShipEasy", "BattleShipHard"])
def test_the_time_limit_truncates_but_does_not_terminate(id, rules):
    game = make(id, rules=rules)
    limit = 2 * SIDES[id] ** 2
    assert game.max_steps == limit
    for action in (UP, FIRE):
        assert step(game, sea(game, [(3, 3)], timestep=limit - 2), action)[2:] == (False, False)
        assert step(game, sea(game, [(3, 3)], timestep=limit - 1), action)[2:] == (False, True)


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_twelfth_hit_wins(rules):
    game = make("BattleShipEasy", rules=rules)
    state = sea(game, ships=[(4, 2)], x=4, y=2, hits=11)
    new, reward, terminated, truncated = step(game, state, FIRE)
    assert (int(new.hits), terminated, truncated) == (12, True, False) and reward == pytest.approx(
        1 / 12
    )
    assert step(game, state._replace(timestep=jnp.int32(127)), FIRE)[2:] == (True, True)


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    actions=hnp.arrays(
        np.int32, (30, 16), elements=st.sampled_from([UP, DOWN, LEFT, RIGHT, FIRE, FIRE, FIRE])
    ),
)
def test_any_play_keeps_the_books(seed, actions):
    """Marks, counters and return agree at every moment; nothing but shots changes them."""
    game = batched("BattleShipEasy")
    batch = game.init(env_keys(seed, 16), jnp.zeros(16, bool))
    first = np.asarray(batch.state.board)
    shots = np.zeros(16, int)
    for action in actions:
        batch, _ = game.step(batch, action)
        shots += action == FIRE
    state = jax.tree.map(np.asarray, batch.state)
    assert np.array_equal(state.board, first)
    assert np.array_equal(state.hits, (state.board & state.guesses).sum((1, 2)))
    assert np.array_equal(state.guesses.sum((1, 2)) + state.repeats, shots)
    np.testing.assert_allclose(
        batch.episode_reward, state.hits / 12 - state.repeats / 32, atol=1e-5
    )


@pytest.mark.parametrize(
    ("id", "size"), [("BattleShipEasy", 256), ("BattleShipMedium", 128), ("BattleShipHard", 128)]
)
def test_all_marks_and_the_cursor_can_be_read_back(id, size):
    game, compiled, side = make(id, obs_size=size), batched(id, obs_size=size), SIDES[id]
    batch = compiled.init(env_keys(4, 8), jnp.zeros(8, bool))
    guesses = np.random.default_rng(1).integers(0, 2, (8, side, side), dtype=np.int8)
    batch = batch._replace(state=batch.state._replace(guesses=jnp.asarray(guesses)))
    state = jax.tree.map(np.asarray, batch.state)
    for partial in (False, True):
        frames = np.asarray(compiled.render(batch._replace(partial=jnp.full(8, partial))))
        codes = game.screen.board.read(frames, side, side)
        expected = np.where(guesses == 1, np.where(state.board == 1, HIT, MISS), COVERED)
        if partial:
            elsewhere = np.ones(expected.shape, bool)
            elsewhere[np.arange(8), state.x, state.y] = False
            expected[elsewhere] = COVERED
        expected[np.arange(8), state.x, state.y] += KINDS
        assert np.array_equal(codes, expected.swapaxes(1, 2))


def test_a_mark_appears_in_both_twins_in_the_frame_after_its_shot():
    game = make("BattleShipEasy")
    before = sea(game, ships=[(2, 3)], x=2, y=3)
    after = step(game, before, FIRE)[0]
    for partial in (False, True):
        codes = [
            game.screen.board.read(draw(game, state, partial)[None], 8, 8)[0]
            for state in (before, after)
        ]
        assert (codes[0][3, 2], codes[1][3, 2]) == (KINDS, KINDS + HIT)


def test_twins_differ_only_where_marks_lie_away_from_the_cursor():
    game = make("BattleShipEasy")
    assert np.array_equal(*(draw(game, sea(game, [(5, 5)]), partial) for partial in (False, True)))
    state = sea(game, ships=[(1, 2)], shots=[(0, 0), (1, 2), (6, 3)], hits=1)
    different = (draw(game, state, False) != draw(game, state, True)).any(-1)
    layout = game.screen.layout
    expected = np.zeros_like(different)
    for x, y in ((1, 2), (6, 3)):
        left, top = (layout.offset + 2 + k * layout.pitch for k in (x, y))
        tile = np.s_[top : top + layout.tile, left : left + layout.tile]
        assert different[tile].any()
        expected[tile] = True
    assert not different[~expected].any()


def test_every_visible_variable_changes_the_picture():
    game = make("BattleShipEasy")
    base = sea(game, ships=[(1, 1)], shots=[(0, 0), (1, 1)])
    frame = draw(game, base, False)
    for changes in (
        {"x": 3},
        {"y": 1},
        {"guesses": base.guesses.at[4, 4].set(1)},
        {"board": base.board.at[0, 0].set(1)},
        {"hits": 7},
    ):
        changed = base._replace(
            **{k: jnp.asarray(v, getattr(base, k).dtype) for k, v in changes.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes
    unseen = base._replace(
        board=base.board.at[5, 5].set(1), repeats=jnp.int32(9), timestep=jnp.int32(80)
    )
    assert np.array_equal(frame, draw(game, unseen, False)), "ships, repeats and time are not shown"


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", SIDES)
def test_marks_have_one_colour_and_leave_the_tile_visible(id, size):
    tiles = make(id, obs_size=size).screen.board.atlas[:, 2:, 2:]
    assert len(np.unique(tiles.reshape(len(tiles), -1), axis=0)) == 2 * KINDS
    for cursor, base in ((0, NICKEL), (KINDS, BRASS)):
        for mark, colour in ((HIT, RED), (MISS, (0, 0, 0))):
            pixels = {tuple(int(c) for c in pixel) for pixel in tiles[cursor + mark].reshape(-1, 3)}
            assert pixels == {base, colour}
        cross = (tiles[cursor + HIT] == RED).all(-1)
        ring = (tiles[cursor + MISS] == 0).all(-1)
        for mark in (cross, ring):
            assert np.array_equal(mark, mark[::-1]) and np.array_equal(mark, mark[:, ::-1])
        assert cross.diagonal().all() and ring[0].any() and not ring[0, 0]
        middle = len(ring) // 2
        assert not ring[middle, middle]


@pytest.mark.parametrize("id", SIDES)
def test_a_closed_walk_that_fires_where_no_mark_is_seen_wins_without_any_memory(id):
    game, side = make(id), SIDES[id]
    walk = [(0, y) for y in range(side)]
    for row in range(side):
        columns = range(1, side) if row % 2 == 0 else range(side - 1, 0, -1)
        walk += [(x, side - 1 - row) for x in columns]
    moves = np.zeros((side, side), np.int32)
    steps = {(0, -1): UP, (0, 1): DOWN, (-1, 0): LEFT, (1, 0): RIGHT}
    for (x, y), (next_x, next_y) in zip(walk, walk[1:] + walk[:1], strict=True):
        moves[x, y] = steps[next_x - x, next_y - y]

    def play(carry, _):
        state, over, earned = carry
        seen = (
            state.guesses[state.x, state.y] == 1
        )  # the POMDP's picture shows the mark under the cursor
        action = jnp.where(seen, jnp.asarray(moves)[state.x, state.y], FIRE)
        state, reward, terminated, truncated = game.step(KEY, state, action)
        return (state, over | terminated | truncated, earned + jnp.where(over, 0.0, reward)), None

    def episode(state):
        return jax.lax.scan(play, (state, False, 0.0), length=2 * side**2)[0][2]

    first = jax.tree.map(lambda leaf: leaf[:256], fresh(id))
    np.testing.assert_allclose(jax.jit(jax.vmap(episode))(first), 1.0, atol=1e-5)


def test_the_state_oracle_hits_every_ship_cell():
    np.testing.assert_allclose(oracle_return(make("BattleShipMedium"), "state", 64), 1.0, atol=1e-5)


def test_the_frames_oracle_finds_nearly_all():
    returns = oracle_return(make("BattleShipEasy"), "frames", 48)
    assert returns.mean() > 0.97 and returns.max() > 1 - 1e-5


def test_random_play_loses():
    returns = random_return(make("BattleShipEasy"), 128)
    assert -0.2 < returns.mean() < -0.05 and returns.min() >= -1 - 1e-5 and returns.max() <= 1


def test_scores_follow_what_is_known():
    known = np.full((1, 8, 8), -1)
    flat = ship_scores(known, 4.0)[0]
    assert flat[4, 4] > flat[0, 0] > 0 and np.array_equal(flat, flat.T)
    known[0, 3, 3] = 1
    near = ship_scores(known, 4.0)[0]
    assert near[3, 4] > near[4, 4] and near[2, 3] == near[3, 2] > near[0, 0]
    known[0, :, :4] = 0
    assert (ship_scores(known, 4.0)[0][:, :4] == 0).all()
