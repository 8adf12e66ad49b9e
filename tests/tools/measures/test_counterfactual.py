"""Counterfactual recall against agents of which it is known what their decisions rest on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.modules import LSTMModule, QValueModule

import arcade_torch
from arcade_torch.agents import Agent, preset
from arcade_torch.agents.evaluation import make_eval_env
from arcade_torch.agents.policy import build_network
from arcade_torch.envs_jax import make as make_game
from arcade_torch.envs_jax.oracles import make_oracle
from arcade_torch.tools import Policy, as_policy, counterfactual
from arcade_torch.tools.measures.counterfactual.measure import (
    Counterfactual,
    counterfactual_of_windows,
)
from arcade_torch.tools.measures.windows import Window, greedy_windows
from tests.tools.measures.test_any_env import LENGTH, NAMES, Foreign, policy_of
from tests.tools.measures.toys import Net, ToyEnv, linear_policy, window

LENGTHS = (5, 6, 6, 7, 8, 8)


class CueEnv(ToyEnv):
    """Episodes whose first frames hold a cue, one of ``cues`` by row, and others nothing."""

    def __init__(self, lengths: Sequence[int], cues: int, steps: int = 1) -> None:
        super().__init__(lengths)
        self.cues = cues
        self.cue_steps = steps

    def frame(self, row: int, step: int) -> Tensor:
        picture = torch.zeros(4, 4, 3, dtype=torch.uint8)
        picture[0, 0, 0] = step
        if step < self.cue_steps:
            picture[0, 0, 1] = row % self.cues
        return picture


def cue_policy(actions: int, remembered: int = 1) -> Policy:
    """Repeats the cue that most of the first ``remembered`` frames hold."""

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for t in range(features.shape[1]):
            state = torch.where(is_init[:, t, None], 0, state)
            counting = state[:, -1:] < remembered
            votes = torch.where(counting, state[:, :-1] + features[:, t], state[:, :-1])
            state = torch.cat([votes, state[:, -1:] + 1], 1)
            outputs.append(votes)
        return torch.stack(outputs, 1), state

    def encode(frames: Tensor) -> Tensor:
        return torch.nn.functional.one_hot(frames[:, 0, 0, 1].long(), actions).float()

    return Policy(encode, remember, lambda size: torch.zeros(size, actions + 1))


def at_last(found: Counterfactual) -> np.ndarray:
    """bool [D, L], where the lag is that of the first frame."""
    return np.arange(found.flip.shape[1]) == found.lengths[:, None] - 1


def test_without_memory_nothing_but_the_last_frame_changes_anything() -> None:
    net = Net("mlp", torch.float32)
    for player in (
        Policy(net.encode, net.remember, net.initial_state),
        linear_policy(0.0, dtype=torch.float32),
    ):
        found = counterfactual(player, ToyEnv(LENGTHS), episodes=12)
        for effect in ("flip", "distance", "change"):
            assert np.nanmax(found.by_lag(effect)[:, 1:]) == 0  # type: ignore[arg-type]
            assert np.nanmax(found.by_state(effect)) == 0  # type: ignore[arg-type]
        assert found.profile("distance")[0] > 0 < found.profile("change")[0]
        assert found.memory_reliance() == (0, 0, 0)
        assert found.observation_reliance().value == pytest.approx(found.profile()[0])
    assert found.profile()[0] > 0.1  # of the linear one


def test_a_copy_of_the_first_cue_rests_on_the_first_frame_and_on_nothing_else() -> None:
    players = len(LENGTHS)
    found = counterfactual(cue_policy(players), CueEnv(LENGTHS, players), episodes=players)
    first = at_last(found)
    there = np.isfinite(found.by_lag())
    assert (found.by_lag()[first] == 1).all() and first.sum() == players
    assert (found.by_lag()[there & ~first] == 0).all()
    assert found.observation_reliance() == (0, 0, 0)
    assert found.memory_reliance() == (1, 1, 1)
    assert found.clean_error == 0 and found.dropped == 0


def test_donors_that_hold_the_same_cue_change_nothing_and_are_told_apart() -> None:
    found = counterfactual(cue_policy(2), CueEnv([6, 6, 6, 6, 6, 6], 2), episodes=12, donors=5)
    differs = found.differs[:, -1]
    assert 0 < differs.mean() < 1
    np.testing.assert_array_equal(found.flip[:, -1], differs)
    assert found.profile()[-1] == differs.mean() == found.memory_reliance().value
    assert found.profile(differing=True)[-1] == 1 == found.memory_reliance(differing=True).value
    assert np.isnan(found.profile(differing=True)[:-1]).all()  # later frames are all alike
    assert found.memory_reliance().low < differs.mean() < found.memory_reliance().high


def test_donors_whose_states_alone_differ_are_told_apart_too() -> None:
    """Before: of episodes longer than the cap the last frames are kept; where these were alike, the
    donors whose states had seen another cue were left out.
    """
    nothing = replace(window(3, starts=()), frames=torch.zeros(3, 4, 4, 3, dtype=torch.uint8))
    windows = []
    for cue in ([9.0, 0.0], [9.0, 0.0], [0.0, 9.0]):
        windows.append(replace(nothing, state=torch.tensor([[*cue, 5.0]]), first=5))
    found = counterfactual_of_windows(cue_policy(2), windows, donors=2)
    assert np.sort(found.memory_flip).tolist() == [[0, 1], [0, 1], [1, 1]]
    np.testing.assert_array_equal(found.memory_differs, found.memory_flip)
    assert found.memory_reliance().value == pytest.approx(2 / 3)
    assert found.memory_reliance(differing=True).value == 1


def test_two_of_three_frames_that_hold_one_fact_hide_each_other_and_a_block_shows_them() -> None:
    players = len(LENGTHS)
    policy, env = cue_policy(players, remembered=3), CueEnv(LENGTHS, players, steps=3)
    assert np.nanmax(counterfactual(policy, env, episodes=players).flip) == 0
    blocks = counterfactual(policy, env, episodes=players, block=2)
    steps = (blocks.lengths - 1)[:, None] - np.arange(blocks.flip.shape[1])  # newest of a block
    there = np.isfinite(blocks.by_lag())
    # frames 0 and 1, or 1 and 2: two votes of three
    np.testing.assert_array_equal(blocks.by_lag()[there], np.isin(steps, (1, 2))[there])


@pytest.mark.parametrize("change", [torch.exp, lambda x: x**3, lambda x: 1e-3 * x - 7])
def test_a_strictly_increasing_change_of_the_outputs_leaves_all_flips(
    change: Callable[[Tensor], Tensor],
) -> None:
    base = linear_policy(0.8, dtype=torch.float64, gain=1e-4)

    def remember(*words: Any) -> tuple[Tensor, Any]:
        out, state = base.remember(*words)
        return change(out), state

    def encode(frames: Tensor) -> Tensor:
        return base.encode(frames)

    changed = Policy(encode, remember, base.initial_state)
    wanted = counterfactual(base, ToyEnv(LENGTHS), episodes=12, target="logits")
    found = counterfactual(changed, ToyEnv(LENGTHS), episodes=12, target="logits")
    np.testing.assert_array_equal(found.flip, wanted.flip)
    np.testing.assert_array_equal(found.memory_flip, wanted.memory_flip)
    assert 0 < np.nanmean(wanted.by_lag()[:, 1:]) < 1


def test_values_are_measured_in_action_gaps_and_scale_and_offset_do_not_matter() -> None:
    windows = [window(6, seed=seed) for seed in range(4)]
    plain, scaled = (
        counterfactual_of_windows(linear_policy(0.9, dtype=torch.float32, gain=gain), windows)
        for gain in (1.0, 1e-3)
    )
    for effect in ("flip", "distance", "change"):
        np.testing.assert_allclose(getattr(scaled, effect), getattr(plain, effect), rtol=1e-3)
    assert plain.target == "q" and (plain.certainty > 1 / 3).all()


def test_a_frame_exchanged_for_itself_changes_nothing() -> None:
    net = Net("gru", torch.float32)
    same = [window(6, seed=3) for _ in range(5)]
    found = counterfactual_of_windows(net, same)
    assert not found.differs.any() and not found.memory_differs.any()
    assert not found.flip.any() and not found.memory_flip.any()
    assert found.change.max() < 1e-4 and found.memory_change.max() < 1e-4
    assert found.clean_error < 1e-6
    assert np.isnan(found.profile(differing=True)).all()
    assert np.isnan(found.memory_reliance(differing=True)).all()


def oracle_policy(player: Callable[[], Any], actions: int = 5) -> Policy:
    """A frames oracle as a policy, whose state is all that it has seen since its episode began."""

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        seen = torch.cat([features, is_init[..., None]], -1)
        seen = torch.cat([state, seen], 1)
        oracle = player()
        steps = []
        for t in range(seen.shape[1]):
            pictures = seen[:, t, :-1].byte().reshape(-1, *SCREEN).numpy()
            steps.append(torch.as_tensor(oracle.act(pictures, seen[:, t, -1].bool().numpy())))
        played = torch.stack(steps[state.shape[1] :], 1).long()
        return torch.nn.functional.one_hot(played, actions).float(), seen

    size = int(np.prod(SCREEN)) + 1
    return Policy(
        lambda frames: frames.flatten(1).float(), remember, lambda n: torch.zeros(n, 0, size)
    )


SCREEN = (128, 128, 3)


@pytest.mark.parametrize(
    ("name", "most"),
    [("SignpostEasy", 9), pytest.param("CountRecallEasy", 5, marks=pytest.mark.slow)],
)
def test_a_frames_oracle_depends_on_what_it_depends_on(name: str, most: int) -> None:
    game = make_game(name)
    policy = oracle_policy(lambda: make_oracle(game, "frames"))
    env = arcade_torch.make(name, num_envs=6, observability="partial", seed=0)
    windows = []
    for played in greedy_windows(policy, env, episodes=6, seed=2):
        windows.append(played.up_to(min(played.n, most - 1)))
    found = counterfactual_of_windows(policy, windows, donors=5)

    def decide(frames: Tensor, is_init: Tensor) -> int:
        oracle = make_oracle(game, "frames")
        for frame, start in zip(frames.numpy(), is_init.numpy(), strict=True):
            action = oracle.act(frame[None], start[None])
        return int(action[0])

    for index, w in enumerate(windows):
        others = [other for place, other in enumerate(windows) if place != index]
        for lag in range(w.n + 1):
            there = [other for other in others if other.n >= w.n - lag]
            changed = []
            for donor in there:
                frames = w.frames.clone()
                frames[w.n - lag] = donor.frames[w.n - lag]
                changed.append(decide(frames, w.is_init) != decide(w.frames, w.is_init))
            assert np.nansum(found.flip[index, lag]) == sum(changed)
            assert np.isfinite(found.flip[index, lag]).sum() == len(there)
    assert np.nansum(found.flip) > 0
    if name == "SignpostEasy":  # the sign, which the first frame shows, and the place of the walker
        assert found.profile(differing=True)[-1] == 1
        assert found.memory_reliance(differing=True).value == 1
        assert np.nansum(found.by_lag()[:, :-1]) == 0


@pytest.mark.parametrize(
    ("algorithm", "memory"),
    [("pqn", "lru"), ("dqn", "gru"), ("ppo", "attention"), ("ppo", "mingru")],
)
def test_it_equals_the_slow_path_from_raw_frames(algorithm: str, memory: str) -> None:
    config = preset("smoke", env="MineSweeperEasy", memory=memory, algorithm=algorithm)
    agent = Agent(config, build_network(config).eval())
    with torch.no_grad():
        for name, weight in agent.network.named_parameters():
            if name.endswith("head.weight"):
                weight *= 100  # the outputs of a fresh network are nearly alike
    windows = []
    for played in greedy_windows(agent, make_eval_env(config, 5), episodes=5, seed=1):
        if played.n > 1:
            windows.append(played.up_to(min(played.n, 3 + len(windows))))
    found = counterfactual_of_windows(agent, windows, donors=4)
    assert found.target == ("probs" if algorithm == "ppo" else "q")

    @torch.no_grad()
    def replay(frames: Tensor, w: Window, other: Window | None = None) -> np.ndarray:
        """Values of actions on the last frame; ``other`` is whose actions led up to it."""
        actions = w.last_action.clone()
        if other is not None:
            actions[:-1] = other.last_action[: w.n]
        features = agent.network.encode(frames[None].float())
        before = agent.initial_state(1)
        out, _ = agent.network.remember(features, actions[None], w.is_init[None], before)
        name = "logits" if algorithm == "ppo" else "q"
        return np.asarray(agent.outputs(out[0, -1], name).double().numpy())

    def effects(clean: np.ndarray, after: np.ndarray) -> tuple[float, float, float]:
        gap = np.sort(clean)[-1] - np.sort(clean)[-2]
        scale = 1.0 if algorithm == "ppo" else gap
        p, q = (np.exp(y / scale) / np.exp(y / scale).sum() for y in (clean, after))
        best = clean.argmax()
        moved = abs(np.log(p) - np.log(q)) if algorithm == "ppo" else abs(after - clean)
        return float(after.argmax() != best), abs(p - q).sum() / 2, moved[best] / gap

    for index, w in enumerate(windows):
        clean = replay(w.frames, w)
        others = [other for place, other in enumerate(windows) if place != index]
        for lag in range(w.n + 1):
            t = w.n - lag
            slow = set()
            for donor in others:
                if donor.n >= t:
                    frames = w.frames.clone()
                    frames[t] = donor.frames[t]
                    slow.add(effects(clean, replay(frames, w)))
            check(slow, found, index, lag)
        slow = set()
        for donor in others:
            if donor.n >= w.n:
                frames = torch.cat([donor.frames[: w.n], w.frames[-1:]])
                slow.add(effects(clean, replay(frames, w, donor)))
        check(slow, found, index, None)


def check(
    slow: set[tuple[float, float, float]], found: Counterfactual, index: int, lag: int | None
) -> None:
    """The effects of all donors, in whatever order they were drawn."""
    if lag is None:
        arrays = (found.memory_flip, found.memory_distance, found.memory_change)
        fast = np.stack([array[index] for array in arrays], -1)
    else:
        fast = np.stack(
            [array[index, lag] for array in (found.flip, found.distance, found.change)], -1
        )
    fast = np.array(sorted(fast[np.isfinite(fast[:, 0])].tolist()))
    wanted = np.array(sorted(slow))
    assert len({tuple(row.round(4)) for row in fast}) <= max(1, len(wanted))
    for row in wanted:
        assert np.abs(fast - row).max(1).min() < 1e-3 * max(1.0, row[2])


def test_last_actions_stay_as_recorded_and_an_exchanged_state_is_that_of_the_donors_actions() -> (
    None
):
    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for t in range(features.shape[1]):
            state = torch.where(is_init[:, t], 0, state)
            # the action two steps ago decides
            outputs.append(torch.nn.functional.one_hot(state, 3).float())
            state = last_action[:, t]
        return torch.stack(outputs, 1), state

    policy = Policy(
        lambda frames: frames.flatten(1).float(),
        remember,
        lambda size: torch.zeros(size, dtype=torch.int64),
    )
    windows = []
    for seed in range(3):
        actions = torch.full((5,), seed)
        w = window(5, seed=seed)
        windows.append(Window(w.frames, actions, w.is_init, actions, w.reward, None, True, seed))
    found = counterfactual_of_windows(policy, windows)
    assert np.nanmax(found.flip) == 0  # frames say nothing
    assert np.nanmin(found.memory_flip) == 1  # the donors chose other actions


def test_a_block_as_long_as_the_episode_exchanges_the_state() -> None:
    net = Net("lru", torch.float32)  # does not see last actions
    windows = [window(7, seed=seed) for seed in range(5)]
    found = counterfactual_of_windows(net, windows, block=7)
    np.testing.assert_array_equal(found.flip[:, 1], found.memory_flip)
    np.testing.assert_allclose(found.distance[:, 1], found.memory_distance, atol=1e-6)
    np.testing.assert_array_equal(found.differs[:, 1], found.memory_differs)
    assert found.memory_distance.min() > 0


def test_nothing_reaches_over_a_start_flag() -> None:
    net = Net("gru", torch.float32)
    windows = [window(7, starts=(0, 4), seed=seed) for seed in range(5)]
    found = counterfactual_of_windows(net, windows)
    assert found.distance[:, 3:].max() == 0 < found.distance[:, :3].min()


def test_frames_come_from_the_same_step_of_the_episode_and_short_donors_are_missing() -> None:
    policy = linear_policy(0.9, dtype=torch.float32)
    found = counterfactual(policy, ToyEnv([2, 4, 4, 9]), episodes=4, donors=2)
    assert found.dropped == 1 and found.lengths.tolist() == [4, 4, 9]
    shortest = counterfactual(policy, ToyEnv([2, 3, 3]), episodes=3, donors=1)
    assert shortest.dropped == 1 and shortest.lengths.tolist() == [3, 3]
    counts = np.isfinite(found.flip).sum(-1)
    assert counts[0, :4].tolist() == [2, 2, 2, 2] and not counts[0, 4:].any()
    assert counts[2].tolist() == [0, 0, 0, 0, 0, 2, 2, 2, 2]
    assert found.alone == 1 and np.isnan(found.memory_flip[2]).all()
    late = list(greedy_windows(policy, ToyEnv([30, 31]), episodes=2, cap=8))
    assert [w.first for w in late] == [int(w.frames[0, 0, 0, 0]) for w in late]
    assert max(w.first for w in late) > 0


def test_lags_and_the_size_of_a_batch_only_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    net = Net("lru", torch.float32)
    windows = [window(7, seed=seed) for seed in range(5)]
    whole = counterfactual_of_windows(net, windows)
    few = counterfactual_of_windows(net, windows, most_lags=3)
    np.testing.assert_allclose(few.distance, whole.distance[:, :3], atol=1e-6)
    monkeypatch.setattr("arcade_torch.tools.measures.counterfactual.measure.MOST_STEPS", 1)
    single = counterfactual_of_windows(net, windows)
    np.testing.assert_allclose(single.distance, whole.distance, atol=1e-6)
    np.testing.assert_array_equal(single.flip, whole.flip)


class Scaled(torch.nn.Module):
    """Features of small frames."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(48, 8)

    def forward(self, frames: Tensor) -> Tensor:
        return torch.tanh(self.linear(frames.float().flatten(-3) / 255 - 0.5))


def test_a_policy_of_torchrls_parts_is_measured_as_it_acts() -> None:
    torch.manual_seed(0)
    head = torch.nn.Linear(8, 3)
    network = TensorDictSequential(
        TensorDictModule(Scaled(), ["pixels"], ["features"]),
        LSTMModule(input_size=8, hidden_size=8, in_key="features", out_key="remembered"),
        TensorDictModule(head, ["remembered"], ["action_value"]),
        QValueModule(action_space="categorical"),
    )
    with torch.no_grad():
        for weight in network.parameters():  # so that frames count, and not what all share
            weight *= 4 if weight.ndim == 2 else 0
    found = counterfactual(network, ToyEnv(LENGTHS), episodes=6, donors=5)
    player = as_policy(network)
    windows = list(greedy_windows(player, ToyEnv(LENGTHS), episodes=6))

    def act(frames: Tensor) -> int:
        """The action on the last frame, played step by step."""
        state = player.initial_state(1)
        for t, frame in enumerate(frames):
            obs = {"pixels": frame[None], "last_action": torch.zeros(1, dtype=torch.int64)}
            action, _, state = player.act(obs | {"is_init": torch.tensor([[t == 0]])}, state)
        return int(action)

    for index, w in enumerate(windows):
        clean = act(w.frames)
        others = [other for place, other in enumerate(windows) if place != index]
        for lag in range(w.n + 1):
            changed = 0
            for donor in others:
                if donor.n >= w.n - lag:
                    frames = w.frames.clone()
                    frames[w.n - lag] = donor.frames[w.n - lag]
                    changed += act(frames) != clean
            assert np.nansum(found.flip[index, lag]) == changed
        changed = 0
        for donor in others:
            if donor.n >= w.n:
                changed += act(torch.cat([donor.frames[: w.n], w.frames[-1:]])) != clean
        assert np.nansum(found.memory_flip[index]) == changed
    assert found.profile()[1] > 0 and found.memory_reliance().value > 0


@pytest.mark.parametrize("kind", ["uint8, HWC", "floats, CHW"])
@pytest.mark.parametrize("memory", [False, True])
def test_other_envs_have_other_names_and_one_hot_actions(kind: str, memory: bool) -> None:
    policy = policy_of(kind, True, memory)
    found = counterfactual(policy, Foreign(kind, (4,), True), episodes=4, **NAMES)
    assert found.clean_error < 1e-5 and found.lengths.tolist() == [LENGTH] * 4
    later = found.by_lag("distance")[:, 1:]
    assert found.profile("distance")[0] > 0 and (later.min() > 0) == memory
    # without a memory the action before, which stays as it was, is all that is left of the past
    assert memory or (later.max() == 0 and not found.by_state("distance").any())


def test_bad_input_is_refused() -> None:
    policy = linear_policy(0.5, dtype=torch.float32)
    windows = [window(4), window(4, seed=1)]
    for option, message in (
        ({"donors": 0}, "donors must be at least 1; got 0"),
        ({"block": 0}, "block must be at least 1; got 0"),
        ({"most_lags": 0}, "most_lags must be at least 1; got 0"),
        ({"target": "value"}, "target must be q, logits or probs, not value"),
    ):
        with pytest.raises(ValueError, match=message):
            counterfactual_of_windows(policy, windows, **option)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="nothing can be exchanged: 1 episode of 3 frames"):
        counterfactual_of_windows(policy, windows[:1])
