"""Policies of which is known what each decision rests on, in an env of somebody else: every measure
says just that.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.modules import GRUModule

from arcade_torch.tools import (
    as_policy,
    beliefs,
    contamination,
    contamination_example,
    counterfactual,
    patching,
    recall_density,
    saliency,
    steering,
)
from arcade_torch.tools.measures.saliency.measure import episode_saliency
from tests.fake_cards import fake_cards
from tests.tools.measures.cues import CUES, STEPS, CueEnv


class Known(NamedTuple):
    """A policy, the start of its state, and the lags that its last decision rests on."""

    module: Any
    start: dict[str, Tensor]
    lags: list[int]
    has_gradient: bool = True


def module(forward: Callable[..., Any], *state: str, also: tuple[str, ...] = ()) -> Any:
    """A policy of a function of the cue, its state, and other entries."""
    writes = ["action_value", *(("next", name) for name in state)]
    return TensorDictModule(forward, ["cue", *state, *also], writes)


def copy_late(lag: int, dtype: torch.dtype = torch.float32) -> Known:
    """Says the cue of ``lag`` steps ago: a ring of cues, and a whole number that goes round."""
    size = lag + 1

    def forward(cue: Tensor, ring: Tensor, place: Tensor) -> tuple[Tensor, ...]:
        now = one_hot(place % size, size).unsqueeze(-1)
        ring = torch.where(now.bool(), cue.unsqueeze(-2).to(dtype), ring)
        oldest = one_hot((place + 1) % size, size).unsqueeze(-1)
        return 2 * (ring.float() * oldest).sum(-2), ring, place + 1

    start = {"ring": torch.zeros(size, CUES, dtype=dtype), "place": torch.tensor(0)}
    return Known(module(forward, "ring", "place"), start, [lag], dtype.is_floating_point)


def first_cue() -> Known:
    """Says the first cue for ever: a truth value holds whether it was seen."""

    def forward(cue: Tensor, held: Tensor, seen: Tensor) -> tuple[Tensor, ...]:
        held = torch.where(seen.unsqueeze(-1), held, cue)
        return 2 * held, held, torch.ones_like(seen)

    start = {"held": torch.zeros(CUES), "seen": torch.tensor(False)}
    return Known(module(forward, "held", "seen"), start, [STEPS - 1])


def clock() -> Known:
    """Looks at the time alone."""

    def forward(cue: Tensor, time: Tensor) -> tuple[Tensor, ...]:
        return one_hot(time % CUES, CUES) + 0 * cue, time + 1

    return Known(module(forward, "time"), {"time": torch.tensor(0)}, [], False)


def parity() -> Known:
    """Whether the number of small cues so far is odd."""

    def forward(cue: Tensor, odd: Tensor) -> tuple[Tensor, ...]:
        odd = odd ^ (cue.argmax(-1) < 2)
        values = torch.stack([odd, ~odd], -1).to(cue.dtype)
        return torch.cat([values, torch.full_like(values, -1)], -1), odd

    known = module(forward, "odd")
    return Known(known, {"odd": torch.tensor(False)}, list(range(STEPS)), False)


def last_action() -> Known:
    """Goes round by its own last action."""

    def forward(cue: Tensor, action: Tensor) -> Tensor:
        if action.ndim == cue.ndim:
            action = action.argmax(-1)
        return one_hot((action + 1) % CUES, CUES) + 0 * cue

    return Known(module(forward, also=("last_action",)), {}, [], False)


POLICIES: dict[str, Callable[[], Known]] = {
    "the cue": lambda: copy_late(0),
    "one step late": lambda: copy_late(1),
    "three steps late": lambda: copy_late(3),
    "in half precision": lambda: copy_late(2, torch.bfloat16),
    "in truth values": lambda: copy_late(2, torch.bool),
    "the first": first_cue,
    "a clock": clock,
    "parity": parity,
    "its last action": last_action,
}


@pytest.mark.parametrize("name", POLICIES)
def test_an_exchange_changes_just_what_a_decision_rests_on(name: str) -> None:
    known = POLICIES[name]()
    start = TensorDict(known.start, [])
    exchanges = counterfactual(known.module, CueEnv(), episodes=24, donors=3, initial_state=start)
    profile = exchanges.profile(differing=True)
    lags = known.lags
    assert np.flatnonzero(profile).tolist() == lags and len(profile) == STEPS
    if name != "parity":  # two of three other cues change it
        assert (profile[lags] == 1).all()
    assert (exchanges.memory_reliance().value > 0) == any(lag > 0 for lag in lags)
    assert (exchanges.observation_reliance().value > 0) == (0 in lags)


@pytest.mark.parametrize("name", POLICIES)
def test_noise_is_seen_just_when_the_noisy_frame_counts(name: str) -> None:
    known = POLICIES[name]()
    start = TensorDict(known.start, [])
    changes = contamination(
        known.module,
        CueEnv(),
        sigmas=(5.0,),
        delays=range(STEPS - 1),
        starts=60,
        initial_state=start,
    )
    flips = np.flatnonzero(changes.mean("flip")[0]).tolist()
    if name == "the first":  # noise on a later frame is nothing to it
        later = changes.points[:, 1] > 0
        assert not np.nansum(changes.flip[later]) and np.nansum(changes.flip[~later]) > 0
    else:
        assert flips == [lag for lag in known.lags if lag < STEPS - 1]
    assert changes.clean_error == 0


@pytest.mark.parametrize("name", POLICIES)
def test_gradients_are_just_where_a_decision_rests(name: str) -> None:
    """Before: without any gradient the measure broke off where it cut no frames."""
    known = POLICIES[name]()
    names = {"initial_state": TensorDict(known.start, [])}
    if name == "in truth values":
        with pytest.raises(ValueError, match="by which they have no gradient"):
            recall_density(known.module, CueEnv(), episodes=4, **names)
        return
    density = recall_density(known.module, CueEnv(), episodes=4, **names)
    cues = one_hot(torch.arange(STEPS) % CUES, CUES).float()
    actions = torch.zeros(STEPS, dtype=torch.int64)
    shares = saliency(known.module, cues, actions, **names).shares()
    if not known.has_gradient:
        assert density.silent == 4 and not density.lengths.size and not shares.any()
        return
    (lag,) = known.lags
    for row in (shares, *density.shares):
        assert row.tolist() == [float(step == STEPS - 1 - lag) for step in range(STEPS)]


@pytest.mark.parametrize("size", [None, 1])
@pytest.mark.parametrize("is_one_hot", [False, True])
def test_one_env_and_one_hot_actions_say_the_same(size: int | None, is_one_hot: bool) -> None:
    known = copy_late(3)
    choose = TensorDictModule(
        lambda values: one_hot(values.argmax(-1), CUES), ["action_value"], ["action"]
    )
    policy = TensorDictSequential(known.module, choose) if is_one_hot else known.module
    exchanges = counterfactual(
        policy,
        CueEnv(size, is_one_hot),
        episodes=12,
        donors=3,
        initial_state=TensorDict(known.start, []),
    )
    assert exchanges.profile(differing=True).tolist() == [0, 0, 0, 1, 0, 0, 0, 0]


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_floats_of_any_precision_are_read_as_the_env_gives_them(dtype: torch.dtype) -> None:
    """Before: they were single precision, which a policy of another does not take."""
    torch.manual_seed(0)
    policy = TensorDictSequential(
        TensorDictModule(nn.Linear(CUES, 6, dtype=dtype), ["cue"], ["features"]),
        GRUModule(6, 6, in_key="features", out_key="remembered").to(dtype),
        TensorDictModule(nn.Linear(6, CUES, dtype=dtype), ["remembered"], ["action_value"]),
    )
    nn.init.normal_(policy[2].module.weight)
    env = CueEnv(dtype=dtype)
    assert counterfactual(policy, env, episodes=8, donors=2).profile("change")[0] > 0
    assert contamination(policy, env, delays=(0, 1), starts=8).mean("change")[:, 0].min() > 0
    density = recall_density(policy, env, episodes=2)
    assert density.last_share() > 0 and density.sizes.shape == (2,)
    cues = one_hot(torch.arange(5) % CUES, CUES)
    shares = saliency(policy, cues.to(dtype)).shares()
    exact = saliency(policy.double(), cues.double()).shares()
    np.testing.assert_allclose(shares, exact, rtol=0.1, atol=1e-3)
    assert episode_saliency(policy.to(dtype), CueEnv(1, dtype=dtype)).frames.shape[1:] == (CUES,)
    assert contamination_example(policy.to(dtype), env, horizon=4).values.shape[1] == CUES


def test_whole_numbers_that_a_policy_takes_as_such_alone_are_refused_in_one_line() -> None:
    """Before: what torch says of an embedding, with its traceback."""
    grids = nn.Sequential(nn.Embedding(2, 3), nn.Flatten(-2), nn.Linear(3 * CUES, CUES))
    policy = TensorDictModule(grids, ["cue"], ["action_value"])
    env = CueEnv(dtype=torch.int64)
    for measure in (counterfactual, contamination, recall_density):
        with pytest.raises(ValueError, match=r"^the policy must take floats .*int64.*long") as told:
            measure(policy, env)
        assert "\n" not in str(told.value)

    class Converts(nn.Sequential):
        def forward(self, cue: Tensor) -> Tensor:
            return super().forward(cue.long())

    converts = TensorDictModule(Converts(*grids), ["cue"], ["action_value"])
    assert np.flatnonzero(counterfactual(converts, env, episodes=8).profile()).tolist() in ([], [0])


def test_arrays_of_an_episode_can_be_explained_again() -> None:
    known = first_cue()
    start = TensorDict(known.start, [])
    episode = episode_saliency(known.module, CueEnv(1), initial_state=start)
    again = saliency(known.module, episode.frames, initial_state=start)
    np.testing.assert_array_equal(again.maps, episode.maps)


def test_what_noise_is_of_no_strength_is_refused() -> None:
    known = copy_late(0)
    names = {"initial_state": TensorDict(known.start, [])}
    with pytest.raises(ValueError, match=r"^delays must be whole numbers of at least 0"):
        contamination(known.module, CueEnv(), delays=(0, 1.5), **names)
    with pytest.raises(ValueError, match=r"^white must be a number above 0; got 0"):
        contamination(known.module, CueEnv(), white=0.0, **names)


WORDS: dict[str, Callable[[Any, Any], Any]] = {
    "episode": lambda policy, env: counterfactual(policy, env, episode=4),
    "delay": lambda policy, env: contamination(policy, env, delay=(0, 1)),
    "tagret": lambda policy, env: recall_density(policy, env, tagret="q"),
    "pixel_key": lambda policy, env: saliency(policy, torch.zeros(3, CUES), pixel_key="cue"),
    "max_step": lambda policy, env: episode_saliency(policy, env, max_step=3),
    "horizons": lambda policy, env: contamination_example(policy, env, horizons=4),
    "stat_keys": lambda policy, env: as_policy(policy, stat_keys=["ring"]),
}


@pytest.mark.parametrize("word", WORDS)
def test_a_misspelt_keyword_is_refused_and_not_passed_over(word: str) -> None:
    """Before: a measure of a TensorDict policy took any keyword, and went by its defaults."""
    policy = TensorDictModule(nn.Linear(CUES, CUES), ["cue"], ["action_value"])
    for model in (policy, as_policy(policy)):
        with pytest.raises(TypeError, match=f"^unknown keyword '{word}': .*pixels_key") as caught:
            WORDS[word](model, CueEnv(1))
        assert "\n" not in str(caught.value)


def test_states_may_be_dictionaries_and_are_of_one_episode() -> None:
    """Before: errors of TensorDicts."""
    known = copy_late(1)
    cues = one_hot(torch.arange(3), CUES).float()
    start = TensorDict(known.start, [])
    wanted = saliency(known.module, cues, initial_state=start)
    given = [known.start, start.expand(1), start]
    for initial_state in given:
        same = saliency(known.module, cues, initial_state=initial_state)
        np.testing.assert_array_equal(same.maps, wanted.maps)
    state = {name: value[None] for name, value in known.start.items()}
    for before in (state, TensorDict(state, [1])):
        same = saliency(known.module, cues, state=before, initial_state=start)
        np.testing.assert_array_equal(same.output, wanted.output)
    with pytest.raises(ValueError, match=r"^initial_state must be of batch size \[\]; got \[3\]"):
        saliency(known.module, cues, initial_state=start.expand(3))
    for wrong in (start, start.expand(2)):
        with pytest.raises(ValueError, match=r"^state must be of batch size \[1\]"):
            saliency(known.module, cues, state=wrong, initial_state=start)


class Tutorial(CueEnv):
    """Draws from torch's own generator, as the env of TorchRL's tutorial does."""

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.manual_seed(seed or 0)

    def facts(self) -> dict[str, Tensor]:
        """A number for each env."""
        return {"chance": torch.rand(self.batch_size)}


PLAYS: dict[str, Callable[[Any, Any], Any]] = {
    "counterfactual": lambda policy, env: counterfactual(policy, env, episodes=8),
    "contamination": lambda policy, env: contamination(policy, env, starts=4, delays=(0,)),
    "recall density": lambda policy, env: recall_density(policy, env, episodes=2),
    "beliefs": lambda policy, env: beliefs(policy, env, episodes=16),
    "patching": lambda policy, env: patching(policy, env, episodes=8),
    "steering": lambda policy, env: steering(policy, env, episodes=16),
}


@pytest.mark.parametrize("measure", PLAYS)
def test_an_env_that_draws_from_torch_leaves_its_generator_as_it_was(measure: str) -> None:
    """Before: whoever measured while training went on with the same random numbers each time."""
    policy = TensorDictModule(nn.Linear(CUES, CUES), ["cue"], ["action_value"])
    env = Tutorial(4)
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    PLAYS[measure](policy, env)
    assert torch.equal(torch.rand(3), wanted)


@pytest.mark.parametrize("measure", PLAYS)
def test_the_generators_of_cards_are_left_as_they_were(
    measure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``torch.manual_seed`` in an env seeds those too."""
    policy = TensorDictModule(nn.Linear(CUES, CUES), ["cue"], ["action_value"])
    cards = fake_cards(monkeypatch)
    PLAYS[measure](policy, Tutorial(4))
    assert all(bool((state == 7).all()) for state in cards.states)


class Unseeded(CueEnv):
    """Plays other episodes each time, of other lengths."""

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _observe(self, count: Tensor) -> TensorDict:
        after = super()._observe(count)
        ends = torch.rand(count.shape, generator=self.generator) < 0.1
        return after.set("done", ends & (count > 0)).set("terminated", ends & (count > 0))


def test_an_env_that_does_not_play_an_episode_again_is_refused_where_that_is_needed() -> None:
    """Before: the window ended somewhere in another episode."""
    policy = TensorDictModule(nn.Linear(CUES, CUES), ["cue"], ["action_value"])
    with pytest.raises(ValueError, match=r"^env must play the same episodes after set_seed\(\d+\)"):
        recall_density(policy, Unseeded(8), episodes=8, cap=4)
    assert recall_density(policy, Unseeded(8), episodes=8).lengths.max() > 4
