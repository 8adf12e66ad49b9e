"""Beliefs, patching and steering in an env of somebody else, and of recordings of somebody else."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import Compose, DoubleToFloat, InitTracker, TransformedEnv

from arcade_torch.tools import as_policy, beliefs, patching, steering
from arcade_torch.tools.measures.beliefs.measure import beliefs_of
from arcade_torch.tools.measures.beliefs.recording import Recording
from tests.tools.measures.cues import CUES, STEPS, CueEnv


class FirstCue(CueEnv):
    """Names the cue that an episode began with."""

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        after = super()._reset(tensordict)
        self.first = after["cue"].argmax(-1)
        return after

    def facts(self) -> Mapping[str, Tensor]:
        """The first cue, and a number that is the same for all."""
        return {"first": self.first, "sky": torch.ones(self.batch_size)}


def remembers() -> Any:
    """Says the first cue for ever."""

    def forward(cue: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        is_new = held.sum(-1, keepdim=True) == 0
        held = torch.where(is_new, cue, held)
        return 2 * held, held

    return TensorDictModule(forward, ["cue", "held"], ["action_value", ("next", "held")])


START = {"initial_state": TensorDict({"held": torch.zeros(CUES)}, [])}


def one_hot_actions(policy: Any) -> Any:
    """The same policy for an env with one-hot actions."""
    choose = TensorDictModule(
        lambda values: one_hot(values.argmax(-1), CUES), ["action_value"], ["action"]
    )
    return TensorDictSequential(policy, choose)


ENVS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "a batch": (lambda: FirstCue(16), lambda policy: policy),
    "one-hot": (lambda: FirstCue(16, True), one_hot_actions),
    "one": (lambda: FirstCue(1), lambda policy: policy),
    "no batch": (lambda: FirstCue(None), lambda policy: policy),
    "transforms": (
        lambda: TransformedEnv(FirstCue(16), Compose(InitTracker(), DoubleToFloat())),
        lambda policy: policy,
    ),
}


@pytest.mark.parametrize("name", ENVS)
def test_an_env_of_somebody_else_has_its_names_and_its_batch(name: str) -> None:
    """Before: a KeyError for the last action, an IndexError for an env without a batch."""
    make_env, wrapped = ENVS[name]
    policy = wrapped(remembers())
    probes = beliefs(policy, make_env(), episodes=32, **START)
    assert probes.names.tolist() == ["first"] and probes.constant.tolist() == ["sky"]
    assert probes.is_class.tolist() == [True] and probes.episodes == 32
    assert probes.score("first").value == 1 and probes.score("first", "frame").value < 0.5
    assert probes.guess_loss.shape == (1, 8, STEPS)
    if name in ("one", "no batch"):
        for measure in (patching, steering):
            with pytest.raises(ValueError, match=r"^the batch size of env must be at least 2"):
                measure(policy, make_env(), episodes=32, **START)
        return
    assert patching(policy, make_env(), episodes=32, **START).share().value == 1
    moved = steering(policy, make_env(), episodes=32, **START)
    assert moved.patches("first", "state").share().value == 1
    assert moved.patches("first").share().value > 0.9


def test_the_names_of_a_policy_may_be_its_own() -> None:
    policy = as_policy(remembers(), **START)
    named = beliefs(remembers(), FirstCue(16), episodes=16, pixels_key="cue", **START)
    np.testing.assert_array_equal(
        named.state_loss, beliefs(policy, FirstCue(16), episodes=16).state_loss
    )


class Misshapen(FirstCue):
    """Names facts of no batch."""

    def facts(self) -> Mapping[str, Tensor]:
        """One number for all."""
        return {"first": torch.zeros(3)}


def test_facts_have_a_value_for_each_env() -> None:
    for measure in (beliefs, steering):
        with pytest.raises(ValueError, match=r"^the fact 'first' must be \[16, \.\.\.\], one for"):
            measure(remembers(), Misshapen(16), episodes=16, **START)


RNG = np.random.default_rng(0)
EPISODES = 64
CLASSES = RNG.integers(0, 3, (EPISODES, 1)).repeat(STEPS, 1)
NUMBERS = RNG.standard_normal((EPISODES, STEPS))


def recording(fact: Any, state: Any = None, lengths: Any = None) -> Recording:
    """A recording of one fact; the state holds the classes one-hot."""
    states = np.eye(3)[CLASSES] if state is None else state
    lengths = np.full(EPISODES, STEPS) if lengths is None else lengths
    return Recording(states, RNG.standard_normal((EPISODES, STEPS, 2)), {"fact": fact}, lengths)


@pytest.mark.parametrize("kind", [np.bool_, np.int8, np.int64, np.uint8, np.uint32])
def test_whole_numbers_of_any_kind_are_classes(kind: Any) -> None:
    """Before: unsigned ones were numbers, scored by R2."""
    signed = beliefs_of(recording((CLASSES % 2).astype(np.int64)))
    found = beliefs_of(recording((CLASSES % 2).astype(kind)))
    assert found.is_class.all()
    np.testing.assert_array_equal(found.state_loss, signed.state_loss)


def test_unsigned_facts_have_directions_of_classes() -> None:
    class Unsigned(FirstCue):
        def facts(self) -> Mapping[str, Tensor]:
            return {"first": self.first.to(torch.uint8)}

    signed = steering(remembers(), FirstCue(16), episodes=32, **START)
    moved = steering(remembers(), Unsigned(16), episodes=32, **START)
    np.testing.assert_array_equal(moved.moved, signed.moved)


def spoilt(values: Any, value: float, step: int = 2) -> Any:
    """The same numbers, but for one at a step of one episode."""
    values = values.copy()
    values[3, step] = value
    return values


STATES = np.eye(3)[CLASSES]
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "infinite": (lambda: recording(spoilt(NUMBERS, np.inf)), "the fact 'fact' must be finite"),
    "complex": (lambda: recording(NUMBERS.astype(complex)), "the fact 'fact' must be bool, integ"),
    "words": (lambda: recording(CLASSES.astype(str)), "the fact 'fact' must be bool, integers"),
    "state": (lambda: recording(CLASSES, spoilt(STATES, np.nan)), "states must be finite"),
    "shapes": (lambda: recording(CLASSES[:, 1:]), r"the fact 'fact' must be \[64, 8, ...\]"),
    "lengths": (
        lambda: recording(CLASSES, lengths=np.full(EPISODES, STEPS + 1)),
        "lengths must be from 1 to 8",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_recordings_that_cannot_be_read_are_refused_in_one_line(name: str) -> None:
    """Before: scores that were missing, of infinity and NaN, and half of a complex number."""
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        make()
    assert "\n" not in str(caught.value)


def test_entries_behind_an_end_are_of_no_use() -> None:
    lengths = np.full(EPISODES, STEPS)
    lengths[3] = 5
    clean = beliefs_of(recording(CLASSES, lengths=lengths))
    dirty = beliefs_of(recording(CLASSES, spoilt(STATES, np.nan, 5), lengths))
    np.testing.assert_array_equal(dirty.state_loss, clean.state_loss)
    assert replace(dirty).episodes == EPISODES


class PresentCue(CueEnv):
    """Names the cue in view."""

    def _observe(self, count: Tensor) -> TensorDict:
        after = super()._observe(count)
        self.shown = after["cue"].argmax(-1)
        return after

    def facts(self) -> Mapping[str, Tensor]:
        """The cue of the present step."""
        return {"cue": self.shown}


@pytest.mark.parametrize("has_chooser", [False, True])
def test_features_of_a_policy_without_memory_are_not_its_outputs(has_chooser: bool) -> None:
    """Before: a network without memory was all encoder, so that facts were read off its Q-values:
    of four cues these told one from the others, though its features held all.
    """
    head = TensorDictModule(lambda features: features[..., :2], ["features"], ["action_value"])
    parts = [TensorDictModule(lambda cue: 2 * cue, ["cue"], ["features"]), head]
    if has_chooser:
        choose = lambda values: values.argmax(-1)  # noqa: E731
        parts.append(TensorDictModule(choose, ["action_value"], ["action"]))
    policy = TensorDictSequential(*parts)
    probes = beliefs(policy, PresentCue(), episodes=32)
    assert probes.frame_width == CUES and probes.state_width == 0
    assert probes.score("cue", "frame").value == 1
    frames = torch.eye(CUES)[None]
    wrapped = as_policy(policy)
    assert wrapped.splits
    assert torch.equal(wrapped.unroll(wrapped.features(frames[0])[None])[0], 2 * frames[..., :2])
