"""Arguments of ``ArcadeCollector`` that its docstring forbids: one line, where it is made."""

import math

import pytest

import arcade_torch
from arcade_torch import ArcadeCollector
from arcade_torch.envs_jax import env_keys


@pytest.fixture(scope="module")
def env():
    """Two envs."""
    return arcade_torch.make("CartPoleEasy", num_envs=2)


def one_line(message, call, *args, kind=TypeError, **options):
    """A call is refused by one line that matches."""
    with pytest.raises(kind, match=message) as refused:
        call(*args, **options)
    assert "\n" not in str(refused.value)


def test_what_a_collector_could_not_use_is_refused_where_it_is_made(env):
    def made(**options):
        ArcadeCollector(env, None, frames_per_batch=8, **options)

    for wrong in (1.5, True, "8", None, math.nan):
        one_line("^init_random_frames is", made, init_random_frames=wrong)
    one_line("^init_random_frames is -1", made, init_random_frames=-1, kind=ValueError)
    for name in ("compress", "post_collect_hook"):
        one_line(f"^{name} is a int, expected a function", made, **{name: 3})
    one_line("^exploration_type is 'x'", made, exploration_type="x")
    for wrong in ("pixels", 3, [3]):
        one_line("^store is", made, store=wrong)
    made(store=["pixels", ("a", "b")], init_random_frames=8)


def test_the_number_of_keys_is_a_whole_number():
    for wrong in (1.5, True, None, "2"):
        one_line("^num_envs is", env_keys, 0, wrong)
