"""The games give the same bits whatever the settings of JAX are, and refuse keys of another kind in
one line.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import BatchedGame, env_keys, gymnax, make
from arcade_torch.envs_jax.settings import compiled, fixed, raw_key

from ..arcade_torch.stub import StubGame
from ..few import few
from . import digests
from .conftest import ALL_IDS

IDS = ("SkittlesEasy-v0", "NoisyCartPoleEasy-v0")


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return str(tmp_path_factory.mktemp("compiled"))


@pytest.fixture(scope="session", params=few(IDS, often=["NoisyCartPoleEasy-v0"]))
def id(request):
    return request.param


@pytest.fixture(scope="session")
def expected(id, cache):
    return digests.in_process({}, [id], cache, sizes=[128])


# x64 makes other programs, which nothing has compiled: slow. Below steps and own games have it.
@pytest.mark.parametrize("name", few(digests.SETTINGS, often=set(digests.SETTINGS) - {"x64"}))
def test_a_game_has_the_same_bits_in_a_shell_with_other_settings(name, id, cache, expected):
    assert digests.in_process(digests.SETTINGS[name], [id], cache, sizes=[128]) == expected


@pytest.mark.slow
def test_all_configurations_have_the_same_bits_in_a_shell_with_other_settings():
    assert digests.compare(ALL_IDS) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags", ["--xla_cpu_experimental_ynn_fusion_type=", "--xla_cpu_enable_fast_math=false"]
)
def test_a_game_has_the_same_bits_with_other_flags_of_xla(flags, id, cache, expected):
    assert digests.in_process({"XLA_FLAGS": flags}, [id], cache, sizes=[128]) == expected


OTHERS = {
    "jax_enable_x64": True,
    "jax_threefry_partitionable": False,
    "jax_default_prng_impl": "rbg",
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_legacy_prng_key": "error",
    "jax_enable_custom_prng": True,
    "jax_random_seed_offset": 7,
    "jax_disable_jit": True,
}


@pytest.fixture(params=OTHERS)
def other_setting(request):
    """Change one setting of this process for a test; gives what takes the settings that all others
    have.
    """
    before = getattr(jax.config, request.param)

    def change(to_other=True):
        jax.config.update(request.param, OTHERS[request.param] if to_other else before)

    yield change
    change(to_other=False)


def pure_steps(game, seed=5, steps=4):
    """A few steps of one env, not compiled as a whole, as numpy arrays."""
    keys = np.arange(2 * (steps + 1), dtype=np.uint32).reshape(-1, 2) + np.uint32(seed)
    state = game.reset(keys[0])
    out = []
    for key in keys[1:]:
        state, *outcome = game.step(key, state, jnp.asarray(2))
        out += [state, outcome, game.render(state, True)]
    return jax.tree.map(np.asarray, out)


def batch_steps(game):
    """A few steps of a batch, its functions compiled anew."""
    batched = BatchedGame(game)
    batch = batched.init(env_keys(3, 4), jnp.zeros(4, bool))
    out = [batch]
    for action in range(3):
        batch, stepped, outcome, frames = batched.step_autoreset(batch, jnp.full(4, action))
        out += [batch, stepped, outcome, frames]
    return jax.tree.map(np.asarray, out)


def assert_equal(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert left.dtype == right.dtype and np.array_equal(left, right)


@pytest.mark.parametrize("play", [pure_steps, batch_steps])
def test_a_game_of_ones_own_has_the_same_bits_in_a_process_with_other_settings(play, other_setting):
    """Its code says nothing of types or kinds of keys."""
    before = play(StubGame())
    other_setting()
    during = play(StubGame())
    other_setting(to_other=False)
    assert_equal(during, before)


def test_steps_of_a_caller_with_x64_stay_in_32_bits():
    game = make("NavigatorEasy")
    keys = env_keys(0, 4)

    def walk(actions):
        def advance(state, action):
            state, *outcome = jax.vmap(game.step)(keys, state, action)
            return state, outcome

        return jax.lax.scan(advance, jax.vmap(game.reset)(keys), actions)

    actions = np.arange(20).reshape(5, 4) % 5
    before = jax.tree.map(np.asarray, jax.jit(walk)(jnp.asarray(actions)))
    with jax.enable_x64(True):
        assert jnp.asarray(actions).dtype == jnp.int64
        assert_equal(jax.tree.map(np.asarray, jax.jit(walk)(jnp.asarray(actions))), before)


def test_the_adapter_gives_the_same_under_x64():
    env, params = gymnax.make("NavigatorEasy")

    def play():
        obs, state = env.reset(env_keys(0, 1)[0], params)
        stepped = env.step(env_keys(1, 1)[0], state, jnp.asarray(3), params)
        return jax.tree.map(
            np.asarray, (obs, state, stepped, env.action_space().sample(env_keys(2, 1)[0]))
        )

    before = play()
    with jax.enable_x64(True):
        assert_equal(play(), before)


def test_keys_of_both_styles_give_the_same_episode():
    game = make("MineSweeperEasy")
    env, params = gymnax.make("MineSweeperEasy")
    old, new = jax.random.PRNGKey(4), jax.random.key(4)
    assert_equal(
        jax.tree.map(np.asarray, game.reset(old)), jax.tree.map(np.asarray, game.reset(new))
    )
    one, two = (jax.tree.map(np.asarray, env.reset(key, params)) for key in (old, new))
    assert_equal(one, two)
    batched = BatchedGame(game)
    old, new = env_keys(0, 3), jax.random.wrap_key_data(env_keys(0, 3), impl="threefry2x32")
    one, two = (
        jax.tree.map(np.asarray, batched.init(keys, jnp.zeros(3, bool))) for keys in (old, new)
    )
    assert_equal(one, two)
    states = jax.jit(jax.vmap(game.reset))(new)
    assert_equal(
        jax.tree.map(np.asarray, states),
        jax.tree.map(np.asarray, jax.jit(jax.vmap(game.reset))(old)),
    )


@pytest.mark.parametrize(
    ("key", "words"),
    [
        (jax.random.key(0, impl="rbg"), "kind 'rbg'"),
        (jax.random.PRNGKey(0, impl="rbg"), r"uint32 \[4\]"),
        (np.zeros(2, np.int32), r"int32 \[2\]"),
        (np.zeros((3, 2), np.uint32), r"uint32 \[3, 2\]"),
        (0, "is 0"),
    ],
)
def test_other_keys_are_refused_in_one_line(key, words):
    game = make("MineSweeperEasy")
    state = game.reset(jax.random.PRNGKey(0))
    for call in (lambda: game.reset(key), lambda: game.step(key, state, 0), lambda: raw_key(key)):
        with pytest.raises((TypeError, ValueError), match=words) as refused:
            call()
        assert "\n" not in str(refused.value) and "threefry2x32" in str(refused.value)


def test_what_is_compiled_is_compiled_where_nothing_else_is():
    traced = []

    def double(x):
        traced.append(isinstance(x, jax.core.Tracer))
        return 2 * x

    with jax.disable_jit():
        assert compiled(double)(3) == 6
    assert traced == [True]


def test_settings_are_as_before_after_an_error():
    with jax.enable_x64(True):
        with pytest.raises(ZeroDivisionError):
            fixed(lambda: 1 / 0)()
        assert jnp.arange(1).dtype == jnp.int64
