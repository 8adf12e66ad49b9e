"""A forged state of a trainer is refused in one line, or the training goes on with it; nothing
fails in between.
"""

import contextlib
import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from arcade_torch.agents import preset, train
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.runs.checkpoint import Checkpoint, list_checkpoints, load_checkpoint
from arcade_torch.agents.runs.files import CheckpointError
from arcade_torch.agents.runs.states import check_optimizer, check_state
from arcade_torch.agents.trainer import Trainer

OVERLAP = {"overlap": 4, "time_limit": "bootstrap"}
CONFIGS: dict[str, dict[str, Any]] = {
    "pqn": {"algorithm": "pqn"},
    "ppo": {"algorithm": "ppo"},
    "dqn": {"algorithm": "dqn"},
    "overlap": {"algorithm": "pqn", "pqn": OVERLAP},
}
WRONG = (
    None,
    "5",
    5,
    -1,
    10**30,
    0.5,
    float("nan"),
    [],
    {},
    b"x",
    torch.zeros(3),
    {"a": torch.zeros(2)},
)


@pytest.fixture(scope="module", params=CONFIGS)
def run(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Trainer, Checkpoint]]:
    """A trainer, and a checkpoint that it made."""
    changes = CONFIGS[request.param]
    config = preset(
        "smoke",
        env="CartPoleEasy-v0",
        memory="mingru",
        total_frames=256,
        checkpoint_every=128,
        **changes,
    )
    folder = tmp_path_factory.mktemp("states") / "run"
    train(config, folder)
    trainer = Trainer(config, folder / "replay")
    yield trainer, load_checkpoint(list_checkpoints(folder / "checkpoints")[0])
    trainer.close()


def places(state: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of everything in a nested state."""
    yield path
    keys = (
        state
        if isinstance(state, dict)
        else range(len(state))
        if isinstance(state, list | tuple)
        else ()
    )
    for key in keys:
        yield from places(state[key], (*path, key))


def changed(state: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with something else in one place."""
    if not path:
        return value
    copy = dict(state) if isinstance(state, dict) else list(state)
    copy[path[0]] = changed(state[path[0]], path[1:], value)
    return copy


def others(value: Any) -> list[Any]:
    """What may stand in the place of a value."""
    if not isinstance(value, torch.Tensor):
        return list(WRONG)
    return [
        *WRONG,
        value.double(),
        value.unsqueeze(0),
        value.flatten()[:0],
        value.bool(),
        torch.full_like(value, -1),
    ]


def test_the_state_that_was_saved_is_taken(run: tuple[Trainer, Checkpoint]) -> None:
    trainer, checkpoint = run
    trainer.load(checkpoint)
    trainer.update()


def test_a_forged_state_is_refused_or_trains(run: tuple[Trainer, Checkpoint]) -> None:
    """Before: a sixth of them was taken, and failed in the next update with the errors of torch and
    Python.
    """
    trainer, checkpoint = run
    rng = random.Random(0)
    every = [path for path in places(checkpoint.trainer) if path]
    outcomes = {"refused": 0, "trained": 0}
    for path in rng.sample(every, min(60, len(every))):
        value: Any = checkpoint.trainer
        for key in path:
            value = value[key]
        forged = changed(checkpoint.trainer, path, rng.choice(others(value)))
        try:
            trainer.load(replace(checkpoint, trainer=forged))
        except CheckpointError as error:
            assert len(str(error).splitlines()) == 1
            outcomes["refused"] += 1
            continue
        with contextlib.suppress(CheckpointError, NonFiniteError):
            trainer.update()
        outcomes["trained"] += 1
    assert outcomes["refused"] > 10, outcomes


@pytest.mark.parametrize(
    "name", ["frames", "updates", "seconds", "grad_steps", "stats", "collector", "optimizer"]
)
def test_a_part_of_another_type_is_named(run: tuple[Trainer, Checkpoint], name: str) -> None:
    trainer, checkpoint = run
    assert checkpoint.trainer is not None
    for wrong in ("5", [torch.zeros(2)], float("nan")):
        with pytest.raises(CheckpointError, match="does not fit this run"):
            trainer.load(replace(checkpoint, trainer=checkpoint.trainer | {name: wrong}))
    missing = {key: value for key, value in checkpoint.trainer.items() if key != name}
    with pytest.raises(CheckpointError, match="does not fit this run"):
        trainer.load(replace(checkpoint, trainer=missing))


def test_types_and_sizes_are_compared() -> None:
    expected = {"a": 1, "b": [0.5, torch.zeros(2)], "c": None, "d": True, "e": []}
    fine = {"a": 7, "b": (3, torch.ones(2)), "c": 0.5, "d": False, "e": [1], "more": "text"}
    check_state(fine, expected)
    check_state({}, expected)  # what is missing is missed by who reads it
    wrong = (
        {"a": True},
        {"a": "1"},
        {"b": [0.5]},
        {"b": [0.5, torch.zeros(3)]},
        {"b": [0.5, torch.zeros(2, dtype=torch.float64)]},
        {"b": 3},
        {"c": "x"},
        {"d": 1},
        [],
    )
    for saved in wrong:
        with pytest.raises(ValueError, match="expected "):
            check_state(saved, expected)


@pytest.mark.parametrize(
    "forged",
    [
        {"exp_avg": torch.zeros(3)},
        {"exp_avg_sq": torch.zeros(3)},
        {"exp_avg_sq": torch.zeros(2, dtype=torch.float64)},
        {"step": torch.tensor(-1.0)},
        {"more": torch.zeros(2)},
    ],
)
def test_averages_of_the_optimiser_are_those_of_its_weights(forged: dict[str, Any]) -> None:
    weights = [torch.nn.Parameter(torch.zeros(2))]
    averages = {"step": torch.tensor(3.0), "exp_avg": torch.ones(2), "exp_avg_sq": torch.ones(2)}
    check_optimizer({"state": {0: averages}}, weights)
    for state in ({0: averages | forged}, {1: averages}):
        with pytest.raises(ValueError, match="expected "):
            check_optimizer({"state": state}, weights)


def test_options_of_the_optimiser_are_those_of_the_config(run: tuple[Trainer, Checkpoint]) -> None:
    """Before: betas and weight decay of the file were used, whatever the config said."""
    trainer, checkpoint = run
    assert checkpoint.trainer is not None
    optimizer = checkpoint.trainer["optimizer"]
    group = optimizer["param_groups"][0] | {"betas": (0.0, 0.0), "weight_decay": 5.0, "eps": -1.0}
    forged = checkpoint.trainer | {"optimizer": optimizer | {"param_groups": [group]}}
    trainer.load(replace(checkpoint, trainer=forged))
    now = trainer.learner.optimizer.param_groups[0]
    assert now["betas"] == (0.9, 0.999) and now["weight_decay"] == 0 and now["eps"] > 0


def test_windows_of_a_replay_hold_the_same_frames(tmp_path: Path) -> None:
    from arcade_torch.agents.replay import SequenceReplay
    from tests.agents.fakes import stream

    replay = SequenceReplay(100, tmp_path)
    replay.add(stream(2, 5, seed=1).sequences())
    with pytest.raises(CheckpointError, match="holds other frames than the windows before it"):
        replay.add(stream(2, 6, seed=1).sequences())
