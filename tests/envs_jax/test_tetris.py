"""Tetris, checked against a plain simulation of single cells and against what its pictures ought to
tell.
"""

import re
from dataclasses import astuple
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import Batch, env_keys, make
from arcade_torch.envs_jax.oracles import RandomPlayer, _play_block, make_oracle
from arcade_torch.envs_jax.tetris import rules as law
from arcade_torch.envs_jax.tetris.oracle import drop_rows, plan, put, read_board, read_preview
from arcade_torch.envs_jax.tetris.renderer import BAND
from arcade_torch.envs_jax.tetris.rules import LEVELS, SHAPES

from .conftest import Walk, batched, draw, random_actions

I, O, T, S, Z, J, L = range(7)  # noqa: E741
TURN, DROP, LEFT, RIGHT, WAIT = range(5)
ENVS = 16  # of every compiled batch here
BOTH_RULES = ("default", "reference")


def compiled(id, rules="default"):
    """The compiled game that Walk uses too: the cache tells apart names that mean the same."""
    return batched(id.removesuffix("-v0") + "-v0", rules=rules)


def one(game, **changes):
    """A first state with some of its variables replaced."""
    first = compiled(game.id, game.rules).init(env_keys(0, ENVS), jnp.zeros(ENVS, bool)).state
    state = jax.tree.map(lambda leaf: np.asarray(leaf)[0], first)
    return state._replace(**{k: np.asarray(v, getattr(state, k).dtype) for k, v in changes.items()})


def step(game, state, action):
    """One step of one state, by the compiled function of a whole batch."""
    rows = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (ENVS, *leaf.shape)), state)
    zeros = jnp.zeros(ENVS, jnp.int32)
    batch = Batch(env_keys(0, ENVS), rows, zeros > 0, zeros, zeros, zeros.astype(jnp.float32))
    batch, outcome = compiled(game.id, game.rules).step(batch, jnp.full(ENVS, action, jnp.int32))
    new = jax.tree.map(lambda leaf: np.asarray(leaf)[0], batch.state)
    return new, float(outcome.reward[0]), bool(outcome.terminated[0]), bool(outcome.truncated[0])


def board(*rows, tile=1):
    """A board from its lowest rows, "#" for a block."""
    grid = np.zeros((20, 10), np.int8)
    for at, row in enumerate(rows, 20 - len(rows)):
        grid[at] = [tile * (c == "#") for c in row]
    return grid


FULL = "#" * 10
ALMOST = "####.#####"


def messy(batch, seed=0):
    """The batch with piles that have gaps and complete rows, as if a piece had just locked in
    each.
    """
    random = np.random.default_rng(seed)
    piles = random.integers(1, 8, (ENVS, 20, 10)) * (random.random((ENVS, 20, 10)) < 0.8)
    piles[np.arange(ENVS)[:, None], np.arange(20), random.integers(0, 10, (ENVS, 20))] = 0
    piles *= np.arange(20)[:, None] >= random.integers(5, 18, ENVS)[:, None, None]
    for pile, count in zip(piles, random.integers(0, 5, ENVS), strict=True):
        pile[random.choice(np.arange(10, 20), count, replace=False)] = 1 + count
    state = batch.state._replace(
        board=jnp.asarray(piles, jnp.int8), just_locked=jnp.ones(ENVS, bool)
    )
    return batch._replace(state=state)


def simulate(state, action, level, solid):
    """The law once more, cell by cell, for one env; returns what is to be compared."""
    grid, lines, reward = state.board.copy(), int(state.lines), 0.0
    piece, rot, px, py, age = (
        int(v) for v in (state.piece, state.rot, state.px, state.py, state.frames_since_spawn)
    )
    over = False

    def free(rot, px, py):
        cells = [(py + r, px + c) for r, c in np.argwhere(SHAPES[piece, rot])]
        return all(r < 20 and 0 <= c < 10 and not grid[r, c] for r, c in cells)

    if state.just_locked:
        kept = [row for row in grid if not row.all()]
        gone = 20 - len(kept)
        grid = np.array([[0] * 10] * gone + kept, np.int8)
        reward += 0.1 * (min(gone, 10 - lines) if solid else gone)
        lines += gone
        piece, rot, px, py, age = int(state.next[0]), 0, 3, 0, 0
        over = not free(rot, px, py)

    target = {TURN: ((rot + 1) % 4, px), LEFT: (rot, px - 1), RIGHT: (rot, px + 1)}.get(
        action, (rot, px)
    )
    if free(*target, py):
        rot, px = target
    length = level.fall if action != DROP else (level.drop if age else 1)
    way = range(1, length + 1) if solid else [length]
    if all(free(rot, px, py + d) for d in way):
        py += length
    elif free(rot, px, py + 1):
        py += 1
    locks = not free(rot, px, py + 1)
    if locks:
        for r, c in np.argwhere(SHAPES[piece, rot]):
            grid[py + r, px + c] = piece + 1
    time = int(state.time) + 1
    if over and lines < 10 and (solid or time < 3000):
        reward -= 1
    flags = (over or lines >= 10, time >= 3000)
    return (
        (grid.tolist(), piece, rot, px, py, lines, locks, min(age + 1, 10), time, over),
        reward,
        flags,
    )


@pytest.mark.parametrize("rules", BOTH_RULES)
@pytest.mark.parametrize("id", ["TetrisEasy", "TetrisHard"])
def test_every_step_equals_a_plain_simulation(id, rules):
    game = compiled(id, rules)
    batch = game.init(env_keys(1, ENVS), jnp.zeros(ENVS, bool))
    batch = messy(batch)
    running, cleared, tops = np.ones(ENVS, bool), 0, 0
    for action in random_actions(60, ENVS, seed=2):
        before = jax.tree.map(np.asarray, batch.state)
        batch, outcome = game.step(batch, action)
        after, outcome = jax.tree.map(np.asarray, (batch.state, outcome))
        for env in np.flatnonzero(running):
            old, new = (
                jax.tree.map(lambda leaf, env=env: leaf[env], states) for states in (before, after)
            )
            expected, reward, flags = simulate(
                old, int(action[env]), LEVELS[id], rules == "default"
            )
            got = (
                new.board.tolist(),
                *(v.item() for v in (new.piece, new.rot, new.px, new.py, new.lines)),
            )
            got += tuple(
                v.item() for v in (new.just_locked, new.frames_since_spawn, new.time, new.terminal)
            )
            assert got == expected
            assert abs(outcome.reward[env] - reward) < 1e-6
            assert (outcome.terminated[env], outcome.truncated[env]) == flags
            cleared, tops = cleared + int(new.lines - old.lines), tops + int(new.terminal)
        running &= ~outcome.done
    assert cleared > 20 and tops > 5, "the walk ought to see lines and ends"


def test_each_rotation_turns_the_piece_clockwise():
    def corner(shape):
        return {tuple(cell) for cell in np.argwhere(shape) - np.argwhere(shape).min(0)}

    assert (SHAPES.sum((2, 3)) == 4).all() and not SHAPES[:, 0, 0].any()
    for piece in range(7):
        for rot in range(4):
            assert corner(np.rot90(SHAPES[piece, rot], -1)) == corner(SHAPES[piece, (rot + 1) % 4])
    patterns = {frozenset(corner(SHAPES[piece, rot])) for piece in range(7) for rot in range(4)}
    assert len(patterns) == 2 + 1 + 4 + 2 + 2 + 4 + 4


def dealt(id, rules, envs=256, count=40):
    """The pieces that come if each locks at once, and the previews beside them: [count, envs],
    [count, envs, P].
    """
    level = LEVELS[id]

    def run(keys):
        no = jnp.bool_(False)  # the game itself sets the flags of an end
        start = law.reset(keys[0], level, rules)._replace(terminated=no, truncated=no)

        def one_more(state, key):
            new = law.spawn(key, state._replace(just_locked=jnp.bool_(True)), level, rules)
            return new, (state.piece, state.next)

        return start.bag, jax.lax.scan(one_more, start, keys)[1]

    keys = env_keys(5, envs * count).reshape(envs, count, 2)
    bag, (pieces, previews) = jax.jit(jax.vmap(run))(keys)
    return np.asarray(bag), np.asarray(pieces), np.asarray(previews)


@pytest.mark.parametrize("id", LEVELS)
def test_pieces_come_in_complete_bags(id):
    bag, pieces, previews = dealt(id, "default")
    assert np.array_equal(pieces[:, :7], bag)
    for start in range(0, 35, 7):
        assert (np.sort(pieces[:, start : start + 7]) == np.arange(7)).all()
    for ahead in range(LEVELS[id].previews):
        assert np.array_equal(previews[:, :-4, ahead], pieces[:, 1 + ahead : 37 + ahead])
    assert (pieces[:, 7:14] != pieces[:, :7]).any(1).mean() > 0.99, "each bag is shuffled anew"


@pytest.mark.parametrize(
    ("id", "order"),
    [
        ("TetrisHard", [0, 1, 2, 3, 4, 5, 6]),
        ("TetrisMedium", [0, 1, 2, 4, 5, 6, 0]),
        ("TetrisEasy", [0, 1, 2, 3, 6, 0, 1]),
    ],
)
def test_the_reference_deals_its_first_bag_wrongly_and_the_later_ones_in_full(id, order):
    bag, pieces, _ = dealt(id, "reference")
    assert np.array_equal(pieces[:, :7], bag[:, order])
    for start in range(7, 35, 7):
        assert (np.sort(pieces[:, start : start + 7]) == np.arange(7)).all()


def test_every_order_of_the_bag_is_equally_likely():
    bags = np.asarray(jax.jit(jax.vmap(law.shuffled))(env_keys(2, 8192)))
    assert (np.sort(bags) == np.arange(7)).all()
    for place in range(7):
        observed = np.bincount(bags[:, place], minlength=7)
        assert ((observed - 8192 / 7) ** 2 / (8192 / 7)).sum() < 27.9, (
            "chi-square, 6 degrees, p = 0.0001"
        )
    pairs = np.bincount(bags[:, 0] * 7 + bags[:, 1], minlength=49)[~np.eye(7, dtype=bool).ravel()]
    assert ((pairs - 8192 / 42) ** 2 / (8192 / 42)).sum() < 85, "chi-square, 41 degrees"


@pytest.mark.parametrize("action", [WAIT, DROP])
def test_long_falls_stop_at_a_thin_roof(action):
    """The reference looks at the last cell alone, and passes through."""
    roof = board(".." + "#" * 6 + "..", *["." * 10] * 11)
    for rules in BOTH_RULES:
        game = make("TetrisHard", rules=rules)
        state = one(game, board=roof, piece=I, py=6, frames_since_spawn=5)
        new, *_ = step(game, state, action)
        expected = (6, True) if rules == "default" else (8 + (action == DROP), False)
        assert (new.py, new.just_locked) == expected


@pytest.mark.parametrize(("gap", "expected"), [(0, 0), (1, 1), (2, 1), (3, 3), (4, 3)])
def test_a_soft_drop_goes_the_whole_way_or_one_cell(gap, expected):
    game = make("TetrisHard")
    new, *_ = step(game, one(game, piece=I, py=18 - gap, frames_since_spawn=1), DROP)
    assert (new.py, new.just_locked) == (18 - gap + expected, gap == expected)


def test_a_soft_drop_is_one_cell_at_the_step_of_the_spawn_and_replaces_gravity():
    for id, drop in (("TetrisEasy", 2), ("TetrisHard", 3)):
        game = make(id)
        assert step(game, one(game), DROP)[0].py == 1
        assert step(game, one(game, frames_since_spawn=1), DROP)[0].py == drop
        assert step(game, one(game), WAIT)[0].py == LEVELS[id].fall


def test_the_levels_are_those_of_the_page():
    page = (Path(__file__).parents[2] / "docs/games/tetris.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?:previews|cells .*) \| (\d) \| (\d) \| (\d) \|$", page, re.MULTILINE)
    assert [tuple(map(int, level)) for level in zip(*rows, strict=True)] == list(
        map(astuple, LEVELS.values())
    )


@pytest.mark.parametrize(("action", "edge"), [(LEFT, -1), (RIGHT, 8)])
def test_walls_stop_a_piece(action, edge):
    game = make("TetrisEasy")
    state = one(game, piece=T, rot=1)
    for _ in range(8):
        state = step(game, state, action)[0]
    assert (state.px, state.rot) == (edge if action == LEFT else 7, 1)
    blocked = one(game, piece=I, rot=1, px=-2)
    assert step(game, blocked, TURN)[0].rot == 1, "no kick off the wall"


def test_a_row_shows_for_one_frame_and_pays_at_the_next_step():
    game = make("TetrisEasy")
    pile = board("#.........", ALMOST, ALMOST, tile=3)
    state = one(game, board=pile, piece=I, rot=1, px=2, py=15, next=[T, O, S], frames_since_spawn=4)
    lock, reward, terminated, truncated = step(game, state, WAIT)
    assert lock.just_locked and (reward, terminated, truncated) == (0, False, False)
    assert (lock.board[18:] > 0).all() and lock.lines == 0 and lock.piece == I
    new, reward, terminated, truncated = step(game, lock, LEFT)
    assert reward == pytest.approx(0.2) and not (terminated or truncated) and new.lines == 2
    assert (new.piece, new.px, new.py, new.rot) == (T, 2, 1, 0), (
        "the new piece obeys, and falls, at once"
    )
    assert (
        np.array_equal(new.board[19], [3, 0, 0, 0, 1, 0, 0, 0, 0, 0]) and (new.board > 0).sum() == 3
    )


@pytest.mark.parametrize(("rules", "paid"), [("default", 0.1), ("reference", 0.4)])
def test_lines_beyond_the_tenth(rules, paid):
    game = make("TetrisEasy", rules=rules)
    state = one(game, board=board(FULL, FULL, FULL, FULL), lines=9, just_locked=True)
    new, reward, terminated, truncated = step(game, state, WAIT)
    assert (new.lines, terminated, truncated) == (13, True, False)
    assert reward == pytest.approx(paid)
    assert game.return_range == pytest.approx((-1, 0.9 + paid))


TOPPED = board("....#.....", "....#.....", *["....#....."] * 17)


@pytest.mark.parametrize("rules", BOTH_RULES)
def test_a_new_piece_without_room_ends_the_game(rules):
    game = make("TetrisEasy", rules=rules)
    new, reward, terminated, truncated = step(game, one(game, board=TOPPED, just_locked=True), WAIT)
    assert (reward, terminated, truncated, bool(new.terminal)) == (-1, True, False, True)
    alive = step(game, one(game, board=board(*["....#....."] * 17), just_locked=True), WAIT)
    assert (alive[1], alive[2], bool(alive[0].terminal)) == (0, False, False)


@pytest.mark.parametrize(("rules", "reward"), [("default", -1.0), ("reference", 0.0)])
def test_topping_out_at_the_limit_costs_one_except_in_the_reference(rules, reward):
    game = make("TetrisEasy", rules=rules)
    assert step(game, one(game, board=TOPPED, just_locked=True, time=2999), WAIT)[1:] == (
        reward,
        True,
        True,
    )


@pytest.mark.parametrize("rules", BOTH_RULES)
def test_ten_lines_win_even_if_the_next_piece_has_no_room(rules):
    game = make("TetrisEasy", rules=rules)
    pile = TOPPED.copy()
    pile[0], pile[19] = pile[1], 1
    new, reward, terminated, truncated = step(
        game, one(game, board=pile, lines=9, just_locked=True), WAIT
    )
    assert (
        new.terminal and reward == pytest.approx(0.1) and (terminated, truncated) == (True, False)
    )


@pytest.mark.parametrize("rules", BOTH_RULES)
@pytest.mark.parametrize("id", ["TetrisEasy", "TetrisHard"])
def test_the_time_limit_truncates_but_does_not_terminate(id, rules):
    game = make(id, rules=rules)
    assert game.max_steps == 3000
    assert step(game, one(game, time=2998), WAIT)[1:] == (0, False, False)
    assert step(game, one(game, time=2999), WAIT)[1:] == (0, False, True)
    row = one(game, board=board(ALMOST), piece=I, rot=1, px=2, py=15, time=2999)
    new, reward, terminated, truncated = step(game, row, WAIT)
    assert (new.board[19] > 0).all() and (reward, terminated, truncated) == (0, False, True), (
        "its reward is lost"
    )


@settings(max_examples=6)
@given(
    actions=hnp.arrays(np.int32, (60, ENVS), elements=st.integers(0, 4)),
    seed=st.integers(0, 2**32 - 1),
)
def test_blocks_are_neither_lost_nor_made(actions, seed):
    """Four cells a locked piece, minus ten a line; the falling piece never stands in the pile."""
    states = Walk(make("TetrisHard"), actions, seed=seed).states
    over = np.logical_or.accumulate(states.terminal)
    locked = np.cumsum(states.just_locked, 0)
    cleared = 10 * states.lines
    assert np.array_equal(
        ((states.board > 0).sum((2, 3)) - 4 * locked + cleared)[~over], np.zeros((~over).sum())
    )
    for t, env in zip(*np.nonzero(~over & ~states.just_locked), strict=True):
        cells = np.argwhere(SHAPES[states.piece[t, env], states.rot[t, env]])
        rows, columns = cells[:, 0] + states.py[t, env], cells[:, 1] + states.px[t, env]
        assert (columns >= 0).all() and not states.board[t, env, rows, columns].any()


def expected_codes(state, partial):
    """What each cell of one state ought to show, with a loop over the piece's cells."""
    codes = np.zeros((20, 10), int) if partial else state.board.astype(int)
    for row, column in np.argwhere(SHAPES[state.piece, state.rot]):
        codes[state.py + row, state.px + column] = state.piece + 1
    codes[(state.board > 0).all(1)] = BAND
    return codes


@pytest.mark.parametrize("size", [128, 256])
def test_both_pictures_can_be_read_back(size):
    """Pile, piece, bands and previews from the MDP picture; the same without the pile from the
    POMDP picture.
    """
    game, walk = make("TetrisEasy", obs_size=size), compiled("TetrisEasy")
    render = jax.jit(jax.vmap(game.render))
    batch = messy(walk.init(env_keys(4, ENVS), jnp.arange(ENVS) % 2 == 0), seed=3)
    running, bands = np.ones(ENVS, bool), 0
    for number, action in enumerate(random_actions(41, ENVS, seed=8)):
        if number % 4 == 0:
            frames, states = (
                np.asarray(render(batch.state, batch.partial)),
                jax.tree.map(np.asarray, batch.state),
            )
            codes = read_board(frames, game.screen)
            for which in range(3):
                assert np.array_equal(
                    read_preview(frames, game.screen, which), states.next[:, which]
                )
            for env in np.flatnonzero(running):
                state = jax.tree.map(lambda leaf, env=env: leaf[env], states)
                assert np.array_equal(codes[env], expected_codes(state, env % 2 == 0))
                bands += (codes[env] == BAND).any()
        batch, outcome = walk.step(batch, action)
        running &= ~np.asarray(outcome.done)
    assert bands > 5


def test_the_pomdp_hides_the_pile_and_nothing_else():
    game = make("TetrisEasy")
    state = one(game, board=board("##.##.####", FULL, "#.#.#.#.##", tile=5), lines=4)
    full, partial = draw(game, state, False), draw(game, state, True)
    assert np.array_equal(
        draw(game, state._replace(board=jnp.zeros_like(state.board)), False)[:90], partial[:90]
    )
    bottom = 14 + 100
    changed = (full != partial).any(-1)
    assert changed.any() and not changed[: bottom - 15].any() and not changed[bottom:].any()
    assert not changed[bottom - 10 : bottom - 5].any(), "a complete row looks the same"
    assert not changed[:, :39].any() and not changed[:, 89:].any(), "walls, previews and text stay"
    assert (full[bottom - 8, 37:91] == 255).all() and (partial[bottom - 8, 37:91] == 255).all()
    assert not (full[bottom - 3, [37, 90]]).any(), "a band alone reaches beyond the walls"


def test_the_locked_piece_stays_in_the_pomdp_picture_for_one_frame():
    game = make("TetrisEasy")
    state = one(game, piece=O, py=16, frames_since_spawn=3)
    lock, *_ = step(game, state, WAIT)
    assert lock.just_locked
    after, *_ = step(game, lock, WAIT)
    seen = [read_board(draw(game, s, True)[None], game.screen)[0] for s in (lock, after)]
    assert (seen[0][18:, 4:6] == O + 1).all() and (seen[1][10:] == 0).all()


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("TetrisMedium")
    base = one(game, board=board("#.#......."), piece=T, py=4, rot=0, next=[S, Z], lines=2)
    frame = draw(game, base, False)
    recoloured = board("#.#.......", tile=4)
    changes = [
        {"board": recoloured},
        {"board": board("##........")},
        {"piece": J},
        {"px": 4},
        {"py": 5},
        {"rot": 1},
    ]
    changes += [{"next": [Z, Z]}, {"next": [S, L]}, {"lines": 13}]
    for change in changes:
        changed = base._replace(
            **{k: jnp.asarray(v, getattr(base, k).dtype) for k, v in change.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), change


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", LEVELS)
def test_the_well_and_the_previews_stand_where_the_geometry_says(id, size):
    screen, cell = make(id, obs_size=size).screen, 5 * size // 128
    corner = {128: 14, 256: 28}[size]
    assert (screen.board.x, screen.board.y) == (corner + 5 * cell, corner)
    row = screen.layers.background[corner + 3 * cell]
    assert list(np.flatnonzero((row == 255).all(-1))) == [corner + 5 * cell - 1, corner + 15 * cell]
    assert len(screen.previews) == LEVELS[id].previews
    for k, slot in enumerate(screen.previews):
        assert (slot.x, slot.y) == (corner + 16 * cell, corner + 3 * cell + 2 + 3 * cell * k)
        assert len(np.unique(slot.pictures.reshape(7, -1), axis=0)) == 7
        assert slot.y + slot.pictures.shape[1] < corner + 20 * cell
    assert len(np.unique(screen.board.atlas[:, cell // 2, cell // 2], axis=0)) == BAND + 1
    score = screen.score.pictures[13, : corner - screen.score.y]
    ink = (screen.score.pictures[13] == np.array([255, 48, 71])).all(-1).sum()
    assert (score == np.array([255, 48, 71])).all(-1).sum() == ink, (
        "the well does not cover the score"
    )


def test_a_plan_ends_where_the_game_takes_it():
    """The players' idea of the law against the law itself, on boards that leave little room."""
    game = compiled("TetrisHard")
    batch = game.init(env_keys(6, ENVS), jnp.zeros(ENVS, bool))
    batch = messy(batch, seed=5)
    pile, piece = np.asarray(batch.state.board) > 0, np.asarray(batch.state.next)[:, 0]
    pile = drop_rows(pile, pile.all(-1))
    plans = plan(pile, piece, fall=2, drop=3, tunnels=False)
    pick = np.random.default_rng(0).integers(0, plans.rot.shape[1], ENVS)
    piles, rows = put(pile, piece, plans), np.arange(ENVS)
    landed = np.zeros(ENVS, bool)
    for action in plans.actions[rows, pick].T:
        batch, _ = game.step(batch, action.astype(np.int32))
        locked, grid = np.asarray(batch.state.just_locked), np.asarray(batch.state.board) > 0
        for env in np.flatnonzero(locked & ~landed):
            assert np.array_equal(grid[env], piles[env, pick[env]])
        landed |= locked
    assert landed.all()


def oracle_returns(id, kind):
    game = compiled(id)
    return _play_block(game, make_oracle(game.game, kind), env_keys(0, ENVS), kind == "frames")


@pytest.mark.parametrize("id", ["TetrisEasy", "TetrisHard"])
def test_memory_of_what_was_seen_plays_as_well_as_sight(id):
    """Ten lines in every episode, by the same steps."""
    state, frames = oracle_returns(id, "state"), oracle_returns(id, "frames")
    np.testing.assert_allclose(state.returns, 1.0, atol=1e-5)
    np.testing.assert_allclose(frames.returns, 1.0, atol=1e-5)
    assert np.array_equal(state.lengths, frames.lengths)


def test_random_play_tops_out():
    returns = _play_block(compiled("TetrisHard"), RandomPlayer(), env_keys(0, ENVS), False).returns
    assert returns.min() >= -1 and returns.mean() < -0.95
