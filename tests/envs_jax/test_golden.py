"""Every game does what it did when ``golden.json`` was written."""

import jax
import pytest

from . import golden
from .conftest import ALL_IDS

STORED = golden.load()


def is_quick(name):
    """The walks of one level under one rule set are run by default, the others take minutes."""
    return "Easy-" in name and name.endswith(" default")


CASES = [
    pytest.param(name, marks=() if is_quick(name) else pytest.mark.slow) for name in STORED["walks"]
]


@pytest.mark.parametrize("name", CASES)
def test_a_walk_is_the_golden_one(name):
    if golden.random_numbers() != STORED["jax.random"]:
        pytest.skip(
            f"golden.json was written with JAX {STORED['jax']}, and jax.random of JAX "
            f"{jax.__version__} gives other "
            f"numbers: check the games in another way, then run `{golden.COMMAND}`"
        )
    wrong = golden.differences(STORED["walks"][name], golden.record(*name.split()))
    assert not wrong, (
        f"{name} no longer does what it did, in {', '.join(wrong)} (golden.json was written with "
        f"JAX {STORED['jax']}, "
        f"this is JAX {jax.__version__}). If that was meant, raise the version of the id and run "
        f"`{golden.COMMAND}`"
    )


def test_all_ids_have_golden_walks_under_both_rules():
    assert set(STORED["walks"]) == {f"{id} {rules}" for id in ALL_IDS for rules in golden.RULES}


def test_a_changed_walk_is_noticed():
    kept = next(iter(STORED["walks"].values()))
    assert golden.differences(kept, kept) == []
    assert golden.differences(kept, {**kept, "integers": "0"}) == ["integers"]
    assert golden.differences(kept, {**kept, "frames 128": "0"}) == ["frames 128"]
    moved = {name: value + 0.1 for name, value in kept["floats"].items()}
    assert golden.differences(kept, {**kept, "floats": moved}) == [
        f"floats{name}" for name in sorted(moved)
    ]
    assert golden.differences(
        kept, {key: value for key, value in kept.items() if key != "floats"}
    ) == ["floats"]


def test_a_hash_tells_order_shape_and_type_apart():
    actions = golden.actions()
    assert len(set(actions.ravel().tolist())) == 5
    others = [actions[::-1], actions.T, actions.ravel(), actions.astype("uint32")]
    assert len({golden.digest([array]) for array in [actions, *others]}) == 5
