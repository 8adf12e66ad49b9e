"""A game of one's own that does not keep the contract is refused with one line that says what is
wrong.
"""

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

from arcade_torch.envs_jax import (
    BatchedGame,
    Game,
    check_game,
    env_keys,
    make,
    probe_ids,
    register,
    registered_ids,
)
from arcade_torch.envs_jax.game import UNSET
from arcade_torch.envs_jax.render import Layers, blank, number_slot
from tests.few import few
from tests.own_registry import own_registry  # noqa: F401


class State(NamedTuple):
    count: jax.Array  # int32
    seen: jax.Array  # bool [3]


class Right(Game[State]):
    """Keeps the contract; the tests break it in one place each."""

    id, obs_size, rules, max_steps, return_range = "RightEasy-v0", 128, "default", 5, (0.0, 1.0)
    wrong = ""

    def reset(self, key):
        return State(jnp.int32(0), jnp.zeros(3, bool))

    def step(self, key, state, action):
        count = state.count + 1
        return State(count, state.seen), jnp.float32(0.2), jnp.bool_(False), count >= self.max_steps

    def render(self, state, partial):
        return jnp.full((self.obs_size, self.obs_size, 3), state.count, jnp.uint8)


def with_methods(**methods):
    """A game that keeps the contract but for some methods or attributes."""
    return type("Wrong", (Right,), {"id": "WrongEasy-v0", **methods})()


def step_giving(**changes):
    """A step that gives something else in some places."""

    def step(self, key, state, action):
        following = {
            "state": state,
            "reward": jnp.float32(0),
            "terminated": jnp.bool_(0),
            "truncated": jnp.bool_(0),
        }
        return tuple(
            {**following, **{name: make(state) for name, make in changes.items()}}.values()
        )

    return step


WRONG = [
    (
        {"render": lambda s, state, partial: jnp.zeros((64, 64, 3), jnp.uint8)},
        "render gives uint8 [64, 64, 3], wanted uint8 [128, 128, 3]",
    ),
    (
        {"render": lambda s, state, partial: jnp.zeros((3, 128, 128), jnp.uint8)},
        "render gives uint8 [3, 128, 128], wanted uint8 [128, 128, 3]",
    ),
    (
        {"render": lambda s, state, partial: jnp.zeros((128, 128, 3))},
        "render gives float32 [128, 128, 3], wanted uint8 [128, 128, 3]",
    ),
    (
        {"render": lambda s, state, partial: (0, 1)},
        "render gives a tuple, wanted uint8 [128, 128, 3]",
    ),
    (
        {
            "render": lambda s, state, partial: (
                jnp.zeros((128, 128, 3), jnp.uint8) if partial else None
            )
        },
        "render cannot be traced by JAX, wanted a pure function of arrays; use jnp.where instead "
        "of if",
    ),
    (
        {"step": step_giving(reward=lambda s: s.count)},
        "step gives reward as int32 [], wanted float32 []",
    ),
    (
        {"step": step_giving(reward=lambda s: jnp.zeros(1))},
        "step gives reward as float32 [1], wanted float32 []",
    ),
    (
        {"step": step_giving(terminated=lambda s: s.count)},
        "step gives terminated as int32 [], wanted bool []",
    ),
    (
        {"step": step_giving(truncated=lambda s: s.seen)},
        "step gives truncated as bool [3], wanted bool []",
    ),
    (
        {"step": lambda s, key, state, action: (state, 0.0, False)},
        "step gives 3 values, wanted 4: state, reward",
    ),
    (
        {"step": lambda s, key, state, action: state.count},
        "step gives an array, wanted 4: state, reward",
    ),
    (
        {"step": step_giving(state=lambda s: (s.count, s.seen))},
        "step gives a state of another structure, with [0], [1]; wanted that of reset, a State "
        "with count, seen",
    ),
    (
        {"step": step_giving(state=lambda s: None)},
        "step gives a state of another structure, with nothing; wanted that",
    ),
    (
        {"step": step_giving(state=lambda s: s._replace(count=s.count + 0.5))},
        "step gives state entry count as float32 [], wanted int32 []",
    ),
    (
        {"step": step_giving(state=lambda s: s._replace(seen=s.seen[:2]))},
        "step gives state entry seen as bool [2], wanted bool [3]",
    ),
    (
        {"reset": lambda s, key: (), "step": step_giving()},
        "reset gives a state without any array",
    ),
    (
        {"reset": lambda s, key: key.no_such},
        "reset cannot be traced by JAX, wanted a pure function of arrays (Attr",
    ),
    ({"reset": lambda s, key: None}, "reset gives None, wanted a state: a tree of arrays"),
    (
        {"step": lambda s, key, state, action: [state, 0.0, False, False]},
        "step gives a list, wanted 4: state, reward, terminated, truncated (a tuple)",
    ),
    ({"memory_kind": "telepathy"}, "memory_kind is 'telepathy', wanted recall, counting, "),
    ({"oracles": {"stat": len}}, "oracles is {'stat': "),
    (
        {"oracles": [1]},
        "oracles is [1], wanted a dictionary with players under 'state' or 'frames'",
    ),
    ({"max_steps": 0}, "max_steps is 0, wanted an int of 1 or more"),
    ({"obs_size": 128.0}, "obs_size is 128.0, wanted an int of 1 or more"),
    ({"return_range": (1.0, 0.0)}, "return_range is (1.0, 0.0), wanted (lowest, highest)"),
    ({"return_range": ("a", "b")}, "return_range is ('a', 'b'), wanted (lowest, highest)"),
    ({"num_actions": 3}, "num_actions is 3, wanted 5, the same in every game"),
]


@pytest.mark.parametrize(("methods", "message"), WRONG)
def test_a_game_that_breaks_the_contract_is_refused_in_one_line(methods, message):
    with pytest.raises(ValueError, match=re.escape(f"WrongEasy-v0: {message}")) as error:
        check_game(with_methods(**methods))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("methods", "message"), WRONG[:1] + WRONG[-9:-8])
def test_it_is_refused_when_it_is_first_made_and_when_it_is_batched(methods, message, own_registry):  # noqa: F811
    register("WrongEasy-v0", lambda *, id, obs_size, rules: with_methods(**methods))
    with pytest.raises(ValueError, match=re.escape(message)):
        make("WrongEasy")
    with pytest.raises(ValueError, match=re.escape(message)):
        BatchedGame(with_methods(**methods))


def test_a_game_that_keeps_the_contract_is_made(own_registry):  # noqa: F811
    register("RightEasy-v0", lambda *, id, obs_size, rules: Right())
    assert make("RightEasy").max_steps == 5


def test_a_factory_that_does_not_make_what_it_was_asked_for_is_refused(own_registry):  # noqa: F811
    register("RightEasy-v0", lambda *, id, obs_size, rules: Right())
    register("OtherEasy-v0", lambda *, id, obs_size, rules: Right())
    register("NoneEasy-v0", lambda *, id, obs_size, rules: None)
    with pytest.raises(
        ValueError,
        match="the factory of RightEasy-v0 made 'RightEasy-v0' with obs_size 128, wanted",
    ):
        make("RightEasy", obs_size=256)
    with pytest.raises(
        ValueError,
        match="the factory of OtherEasy-v0 made 'RightEasy-v0' with obs_size 128, wanted",
    ):
        make("OtherEasy")
    with pytest.raises(
        ValueError, match="the factory of NoneEasy-v0 made a NoneType, wanted a Game"
    ):
        make("NoneEasy")


@pytest.mark.parametrize("action", [jnp.zeros(1, jnp.int32), 0.5, jnp.bool_(True)])
def test_an_action_that_would_broadcast_or_be_rounded_is_refused(action):
    game = Right()
    state = game.reset(jax.random.PRNGKey(0))
    with pytest.raises(ValueError, match=r"action is .*, expected integers \[\], one an env"):
        game.step(jax.random.PRNGKey(0), state, action)
    batched = BatchedGame(game)
    batch = batched.init(env_keys(0, 2), jnp.zeros(2, bool))
    with pytest.raises(ValueError, match=r"action is .*, expected integers \[2\], one an env"):
        jax.eval_shape(batched.step, batch, jnp.asarray(action).repeat(2)[:, None])


def test_methods_that_a_game_has_of_another_base_are_wrapped_too():
    class Rules:
        def reset(self, key):
            assert key.dtype == jnp.uint32
            return State(jnp.arange(3).sum(), jnp.zeros(3, bool))

    class Mixed(Rules, Right):
        pass

    with jax.enable_x64(True):
        assert Mixed().reset(jax.random.key(0)).count.dtype == jnp.int32


def test_an_attribute_that_is_missing_is_named():
    class Nameless(Right):
        id = None

    with pytest.raises(ValueError, match="Nameless: id is None, wanted the versioned id"):
        check_game(Nameless())


def test_a_game_that_forgets_what_it_was_asked_for_is_refused_in_one_line(own_registry):  # noqa: F811
    class Forgets(Right):
        obs_size = 256

        def __init__(self, *, id, obs_size, rules):
            self.rules = rules

    class Bare(Game[State]):
        reset, step, render = Right.reset, Right.step, Right.render

        def __init__(self, *, id, obs_size, rules):
            self.rules = rules

    register("ForgetsEasy-v0", Forgets)
    register("BareEasy-v0", Bare)
    with pytest.raises(ValueError, match="made 'RightEasy-v0' with obs_size 256, wanted 'Forg"):
        make("ForgetsEasy")
    with pytest.raises(ValueError, match="made None with obs_size None, wanted 'BareEasy-v0' wi"):
        make("BareEasy")


UNTRACED = {
    "if state.count > 1: pass": "use jnp.where instead of if",
    "int(state.count)": "use .astype instead of int and float",
    "float(state.count)": "use .astype instead of int and float",
    "list(range(state.count))": "use jnp.array(...) instead of a list, and jax.lax.fori_loop",
    "[4, 5][action]": "use jnp.array(...) instead of a list, and jax.lax.fori_loop",
    "numpy.array([4, 5])[action]": "use jnp instead of np",
    "numpy.maximum(state.count, 1)": "use jnp instead of np",
    "state.no_such": "wanted a pure function of arrays (AttributeError: ",
}


@pytest.mark.parametrize("statement", UNTRACED)
def test_what_cannot_be_traced_is_named_by_its_line_and_says_what_to_write(statement):
    source = f"import numpy\n\ndef step(self, key, state, action):\n    {statement}\n"
    module = {"__name__": "mine"}
    exec(compile(source, "/somewhere/mine.py", "exec"), module)
    with pytest.raises(ValueError, match="step cannot be traced by JAX") as error:
        check_game(with_methods(step=module["step"]))
    assert UNTRACED[statement] in str(error.value)
    assert str(error.value).endswith("; mine.py, line 4)")
    assert "\n" not in str(error.value)


def test_a_state_that_is_kept_in_the_game_is_refused_in_one_line():
    class Keeps(Right):
        def reset(self, key):
            self.kept = State(key[0].astype(jnp.int32), jnp.zeros(3, bool))
            return self.kept

        def step(self, key, state, action):
            return super().step(key, self.kept, action)

    message = "RightEasy-v0: step uses an array that an earlier call kept outside of the state, in "
    with pytest.raises(ValueError, match=message + "self or a global: keep") as error:
        check_game(Keeps())
    assert "\n" not in str(error.value)


def test_nothing_is_compiled_by_the_check():
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name)
    )
    check_game(Right())
    assert not [name for name in compiled if "backend_compile" in name]


@pytest.mark.parametrize("id", registered_ids() + probe_ids())
@pytest.mark.parametrize("obs_size", [128, 256])
def test_every_game_of_the_package_keeps_the_contract(id, obs_size):
    check_game(make(id, obs_size=obs_size))


# -- playing ---------------------------------------------------------------------------------------


class Counter(Right):
    """Shows how many steps it has taken; the tests break it in one place each."""

    highest = 5

    def __init__(self):
        slot = number_slot(128, self.highest, (0, 0, 0), (9, 9, 9))
        self.layers = Layers(blank(128, 128, (0, 0, 0)), slot)

    def render(self, state, partial):
        return self.layers.draw(jnp.where(partial & (state.count == 1), 0, state.count))


def counter_with(**methods):
    return type("Wrong", (Counter,), {"id": "WrongEasy-v0", **methods})()


def step_paying(reward=0.2, ends=True, state=lambda s: s):
    """A step that counts, and does one thing otherwise."""

    def step(self, key, before, action):
        count = before.count + 1
        after = state(State(count, before.seen))
        return after, jnp.float32(reward), jnp.bool_(False), (count >= self.max_steps) & ends

    return step


PLAYED_WRONG = [
    (
        {"highest": 3},
        "render after step 4: place 0 (Slot at x 43, y 1) has no picture 4: codes are 0 to 3",
    ),
    (
        {"step": step_paying(ends=False), "highest": 9},
        "neither terminated nor truncated up to step 5, and max_steps is 5",
    ),
    (
        {
            "step": lambda s, key, state, action: (
                state,
                jnp.float32(0),
                jnp.bool_(0),
                ~state.seen[0],
            )
        },
        "truncated in step 1, and max_steps is 5",
    ),
    (
        {"step": step_paying(reward=0.3)},
        "an episode returned 1.5, and return_range is (0.0, 1.0)",
    ),
    ({"step": step_paying(reward=jnp.nan)}, "step 1 gives the reward nan"),
    (
        {"render": lambda s, state, partial: s.layers.draw(state.count)},
        "render gives both twins the same frames in 100 steps at random: where partial is true it "
        "has to hide something that the MDP shows",
    ),
]


@pytest.mark.parametrize(("methods", "message"), PLAYED_WRONG)
def test_playing_finds_what_shapes_and_types_do_not_tell(methods, message):
    game = counter_with(**methods)
    check_game(game)
    with pytest.raises(ValueError, match=f"^{re.escape(f'WrongEasy-v0: {message}')}$"):
        check_game(game, play=True)


def test_a_state_entry_that_is_no_number_is_named():
    class Speed(NamedTuple):
        speed: jax.Array

    def step(self, key, state, action):
        return Speed(state.speed / 0 * 0), jnp.float32(0), jnp.bool_(False), jnp.bool_(True)

    methods = {
        "id": "WrongEasy-v0",
        "max_steps": 1,
        "reset": lambda self, key: Speed(jnp.float32(1)),
        "step": step,
        "render": lambda self, state, partial: jnp.zeros((128, 128, 3), jnp.uint8),
    }
    game = type("Wrong", (Right,), methods)()
    with pytest.raises(ValueError, match=r"^WrongEasy-v0: step 1 gives state entry speed as nan$"):
        check_game(game, play=True)


def draw_once(key):
    return jax.random.bernoulli(key, shape=(3,))


def draw_twice(key):
    return jax.random.bernoulli(key, shape=(3,)) & jax.random.bernoulli(key, shape=(3,))


def split_and_draw(key):
    jax.random.split(key)
    return jax.random.bernoulli(key, shape=(3,))


def fold_in(key):
    first, second = (jax.random.bernoulli(jax.random.fold_in(key, i), shape=(3,)) for i in (0, 1))
    return first & second


def read_bits(key):
    return key[0] > jnp.arange(3)


@pytest.mark.parametrize("draw", [draw_once, draw_twice, split_and_draw, fold_in, read_bits])
@pytest.mark.parametrize("method", ["reset", "step"])
def test_a_random_key_that_is_used_twice_is_refused(draw, method):
    def reset(self, key):
        return State(jnp.int32(0), draw(key))

    def step(self, key, state, action):
        return step_paying(state=lambda s: s._replace(seen=draw(key)))(self, key, state, action)

    game = counter_with(**{method: {"reset": reset, "step": step}[method]})
    check_game(game)
    if draw not in (draw_twice, split_and_draw):
        check_game(game, play=True)
        return
    message = (
        f"WrongEasy-v0: {method} uses a random key twice, so that its draws hang together: "
        "jax.random.split gives a key for each draw"
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_game(game, play=True)


def test_a_picture_beyond_the_end_of_an_episode_is_looked_at_too():
    class Ending(NamedTuple):
        count: jax.Array
        terminated: jax.Array = UNSET
        truncated: jax.Array = UNSET

    def step(self, key, state, action):
        count = state.count + 1
        return Ending(count), jnp.float32(0), jnp.bool_(False), count >= 5

    def render(self, state, partial):
        return self.layers.draw(jnp.where(state.truncated, 77, 0))

    reset = lambda self, key: Ending(jnp.int32(0))  # noqa: E731
    game = counter_with(reset=reset, step=step, render=render)
    with pytest.raises(ValueError, match=r"render after step 5: place 0 .* has no picture 77"):
        check_game(game, play=True)


def test_a_game_that_plays_well_passes():
    check_game(Counter(), play=True)


@pytest.mark.parametrize(
    "id",
    few(
        [id for id in registered_ids() + probe_ids() if "Hard" in id], often=["MineSweeperHard-v0"]
    ),
)
def test_the_games_of_the_package_play_well(id):
    check_game(make(id), play=True)
