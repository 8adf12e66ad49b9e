"""Facts of all games: what they name, and that they are the state's alone."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import BatchedGame, Game, MixedGames, check_game, env_keys, make
from arcade_torch.envs_jax.game import FIRE

from ..arcade_torch.stub import CoinGame, StubGame
from ..few import few_games
from .conftest import ALL_IDS, one

ENVS, STEPS = 4, 132  # a time limit of BattleShip and MineSweeper is reached
EASY = [*(id for id in ALL_IDS if "Easy" in id), "SignpostEasy-v0"]
CLASSES = ("b", "i")
NAMES = {
    "AutoEncodeEasy-v0": {"asked"},
    "BattleShipEasy-v0": {"ship", "shot"},
    "BreakoutEasy-v0": {"ball_x", "ball_y", "ball_dx", "ball_dy"},
    "CartPoleEasy-v0": {"position", "velocity", "angle", "angular_velocity"},
    "CountRecallEasy-v0": {"query", "answer", "dealt"},
    "MineSweeperEasy-v0": {"mine", "swept"},
    "NavigatorEasy-v0": {"treasure_x", "treasure_y", "agent_x", "agent_y"},
    "NoisyCartPoleEasy-v0": {"position", "velocity", "angle", "angular_velocity"},
    "SignpostEasy-v0": {"sign"},
    "SkittlesEasy-v0": {"block", "agent_x"},
    "TetrisEasy-v0": {"piece", "next_piece", "filled"},
}


@functools.cache
def walk(id: str) -> tuple[Any, dict[str, np.ndarray]]:
    """States of random play, beyond ends too, and their facts: leaves [STEPS, ENVS, ...]."""
    game = make(id)

    @jax.jit
    def run():
        first = jax.vmap(game.reset)(env_keys(0, ENVS))

        def step(state, key):
            action = jax.random.randint(key, (ENVS,), 0, 5)
            keys = jax.random.split(key, ENVS)
            following = jax.vmap(game.step)(keys, state, action)[0]
            return following, (state, jax.vmap(game.facts)(state))

        return jax.lax.scan(step, first, jax.random.split(jax.random.PRNGKey(1), STEPS))[1]

    return jax.tree.map(np.asarray, run())


def at(tree: Any, step: int, env: int) -> Any:
    """One state of a walk."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[step, env]), tree)


@pytest.mark.parametrize("id", few_games(EASY))
def test_facts_have_names_and_one_shape_and_type_at_all_states(id: str) -> None:
    states, facts = walk(id)
    assert set(facts) == NAMES[id]
    shapes = jax.eval_shape(make(id).facts, at(states, 0, 0))
    for name, values in facts.items():
        is_class = values.dtype.kind in CLASSES
        assert is_class or values.dtype == np.float32
        assert shapes[name].shape == values.shape[2:] and shapes[name].dtype == values.dtype


@pytest.mark.parametrize("id", few_games(EASY))
def test_many_states_at_once_have_the_facts_of_one_at_a_time_with_x64_too(id: str) -> None:
    states, facts = walk(id)
    alone = jax.jit(make(id).facts)
    with jax.enable_x64(True):
        for step, env in ((0, 0), (7, 1), (STEPS - 1, ENVS - 1)):
            for name, value in alone(at(states, step, env)).items():
                assert value.dtype == facts[name].dtype
                np.testing.assert_array_equal(value, facts[name][step, env])


@pytest.mark.parametrize("id", few_games(EASY))
def test_both_twins_have_the_same_facts(id: str) -> None:
    batched = BatchedGame(make(id))
    keys = jnp.repeat(env_keys(3, 1), 2, axis=0)
    twins = batched.facts(batched.init(keys, jnp.array([False, True])))
    for full, partial in twins.values():
        np.testing.assert_array_equal(full, partial)


def test_facts_share_no_memory_with_the_state() -> None:
    batched = BatchedGame(make("SignpostEasy"))
    batch = batched.init(env_keys(0, 4), jnp.zeros(4, bool))
    sign = batched.facts(batch)["sign"]
    np.testing.assert_array_equal(sign, batch.state.sign)
    assert sign.unsafe_buffer_pointer() != batch.state.sign.unsafe_buffer_pointer()


@pytest.mark.parametrize("id", ["MineSweeperEasy-v0", "BattleShipEasy-v0", "NavigatorEasy-v0"])
def test_what_lies_on_the_board_stays_there_through_the_end(id: str) -> None:
    states, facts = walk(id)
    assert (states.terminated | states.truncated).any()
    counts = {"mine": 2, "ship": 12}
    for name in {"mine", "ship", "treasure_x", "treasure_y"} & set(facts):
        assert (facts[name] == facts[name][0]).all()
        assert name not in counts or (facts[name].sum((2, 3)) == counts[name]).all()


def test_a_mine_that_was_hit_is_still_one() -> None:
    game = make("MineSweeperEasy")
    first = game.reset(jax.random.PRNGKey(0))
    mine = game.facts(first)["mine"]
    x, y = np.argwhere(np.asarray(mine))[1]
    on_it = first._replace(x=jnp.int32(x), y=jnp.int32(y))
    after, _, terminated, _ = game.step(jax.random.PRNGKey(1), on_it, FIRE)
    assert terminated and bool(game.facts(after)["swept"][x, y])
    np.testing.assert_array_equal(game.facts(after)["mine"], mine)


def test_the_treasure_is_where_the_board_has_it() -> None:
    states, facts = walk("NavigatorEasy-v0")
    x = facts["treasure_x"][0].astype(int)
    y = facts["treasure_y"][0].astype(int)
    assert (states.board[0][np.arange(ENVS), x, y] == 2).all()
    assert len(set(x)) > 1 and len(set(y)) > 1


def test_the_suit_that_is_asked_for_is_the_one_that_pays() -> None:
    game = make("AutoEncodeEasy")
    step = jax.jit(game.step)
    key = jax.random.PRNGKey(0)
    for given in (0, 5, 25):
        for suit in range(4):
            state = one(game, timestep=30, given=given, selected=suit)
            pays = float(step(key, state, FIRE)[1]) > 0
            assert pays == (suit == int(game.facts(state)["asked"]))
    assert int(game.facts(one(game, timestep=25))["asked"]) == -1
    assert int(game.facts(one(game, timestep=60, given=26))["asked"]) == -1


def test_the_answer_of_countrecall_is_the_one_that_pays() -> None:
    game = make("CountRecallEasy")
    step = jax.jit(game.step)
    key = jax.random.PRNGKey(0)
    for turn in (0, 10, 25):
        facts = game.facts(one(game, timestep=turn))
        assert float(facts["dealt"].sum()) == turn
        for answer in range(14):
            pays = float(step(key, one(game, timestep=turn, answer=answer), FIRE)[1]) > 0
            assert pays == (answer == float(facts["answer"]))
    over = game.facts(one(game, timestep=26))
    assert int(over["query"]) == -1 and np.isnan(over["answer"])


def test_the_ball_moves_as_its_facts_say() -> None:
    _, facts = walk("BreakoutEasy-v0")
    moved = np.diff(facts["ball_x"][:8], axis=0)
    is_free = np.isin(facts["ball_x"][:7], range(1, 9))  # beside a wall it turns round
    is_free &= np.isin(facts["ball_y"][:7], range(8, 18))
    assert is_free.any()
    np.testing.assert_array_equal(moved[is_free], facts["ball_dx"][:7][is_free])


def test_a_mixture_gives_the_facts_that_its_games_share() -> None:
    games = [make("CartPoleEasy"), make("NoisyCartPoleEasy")]
    mixed = MixedGames(games)
    batch = mixed.init(env_keys(0, 4), jnp.zeros(4, bool))
    facts = mixed.facts(batch)
    assert set(facts) == NAMES["CartPoleEasy-v0"]
    alone = BatchedGame(games[1])
    np.testing.assert_array_equal(
        facts["angle"][2:], alone.facts(alone.init(env_keys(0, 4), jnp.zeros(4, bool)))["angle"][2:]
    )


def test_a_mixture_without_a_shared_fact_is_refused_in_one_line() -> None:
    mixed = MixedGames([make("SignpostEasy"), make("MineSweeperEasy"), make("MineSweeperMedium")])
    batch = mixed.init(env_keys(0, 3), jnp.zeros(3, bool))
    with pytest.raises(ValueError, match=r"no fact in common .*sign int32.*mine bool") as error:
        mixed.facts(batch)
    assert "\n" not in str(error.value)
    sizes = MixedGames([make("MineSweeperEasy"), make("MineSweeperMedium")])
    with pytest.raises(ValueError, match="no fact in common"):
        sizes.facts(sizes.init(env_keys(0, 2), jnp.zeros(2, bool)))


def test_a_game_without_facts_has_none_alone_and_in_a_mixture() -> None:
    game = StubGame()
    assert game.facts(game.reset(jax.random.PRNGKey(0))) == {}
    mixed = MixedGames([StubGame(), CoinGame()])
    assert mixed.facts(mixed.init(env_keys(0, 2), jnp.zeros(2, bool))) == {}


@pytest.mark.parametrize(
    ("facts", "complaint"),
    [
        (jnp.zeros(3), "facts gives an array, wanted a dictionary"),
        ({"a.b": jnp.zeros(3)}, "facts names 'a.b'"),
        ({"a": "b"}, "facts cannot be traced"),
        ({"a": jnp.zeros(3, jnp.uint32)}, "gives 'a' as uint32"),
        ({"a": jnp.zeros(3, jnp.float16)}, "gives 'a' as float16"),
    ],
)
def test_facts_that_no_measure_can_read_are_refused(facts: Any, complaint: str) -> None:
    class Wrong(StubGame):
        def facts(self, state: Any) -> Any:
            return facts

    game: Game[Any] = Wrong()
    with pytest.raises(ValueError, match=complaint):
        check_game(game)


class Forgetful(StubGame):
    """A fact that has no value."""

    def facts(self, state: Any) -> dict[str, jax.Array]:
        return {"answer": jnp.where(state.clock.count < 0, state.total, jnp.nan)}


def test_a_fact_without_a_value_is_no_error_where_jax_looks_for_nan():
    """JAX_DEBUG_NANS=1 raised FloatingPointError, and NaN is what says that there is no value."""
    game = Forgetful()
    batched = BatchedGame(game)
    batch = batched.init(env_keys(0, 2), np.zeros(2, bool))
    with jax.debug_nans(True):
        assert np.isnan(batched.facts(batch)["answer"]).all()
        alone = game.facts(game.reset(jax.random.PRNGKey(0)))
        assert np.isnan(alone["answer"])
        with pytest.raises(FloatingPointError):
            jnp.zeros(1) / jnp.zeros(1)
