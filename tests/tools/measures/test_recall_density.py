"""Recall density: bins, ends, what is dropped, reference lines, and agents of every algorithm."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.tools import Policy, recall_density, saliency
from arcade_torch.tools.figures import style
from arcade_torch.tools.measures.bootstrap import pooled
from arcade_torch.tools.measures.recall_density import figure as recall_density_figures
from arcade_torch.tools.measures.recall_density.measure import (
    binned,
    density_of_windows,
    no_memory,
    point_sampled,
)
from arcade_torch.tools.measures.windows import _end, greedy_windows
from tests.tools.measures.toys import Net, ToyEnv, linear_policy, window

RHO = linear_policy(0.8, dtype=torch.float32)


@given(shares=st.lists(st.floats(0, 1), min_size=1, max_size=40), bins=st.integers(1, 20))
def test_binning_keeps_the_mass_and_as_many_bins_as_steps_change_nothing(
    shares: list[float], bins: int
) -> None:
    mass = np.array(shares)
    assert binned(mass, bins).sum() == pytest.approx(mass.sum(), abs=1e-9)
    np.testing.assert_allclose(binned(mass, len(mass)), mass, atol=1e-9)
    assert (binned(mass, bins) >= -1e-12).all()
    np.testing.assert_allclose(
        binned(mass[::-1], bins), binned(mass, bins)[::-1], atol=1e-9
    )  # time runs either way


@given(fine=st.integers(1, 6), coarse=st.integers(1, 6), steps=st.integers(1, 30))
def test_fine_bins_add_up_to_coarse_ones(fine: int, coarse: int, steps: int) -> None:
    mass = np.random.default_rng(steps).random(steps)
    summed = binned(mass, fine * coarse).reshape(coarse, fine).sum(1)
    np.testing.assert_allclose(summed, binned(mass, coarse), atol=1e-9)


def test_the_papers_curve_reads_the_step_at_floor_tau_n() -> None:
    shares = np.array([0.1, 0.2, 0.3, 0.4])
    taus = np.array([0.0, 0.32, 1 / 3, 0.5, 0.99, 1.0])
    assert point_sampled(shares, taus).tolist() == [0.1, 0.1, 0.2, 0.2, 0.3, 0.4]
    uneven = [
        np.full(10, 0.1),
        np.full(2, 0.5),
    ]  # does not integrate to one: that is why there are bins
    mean = np.mean([point_sampled(share, np.linspace(0, 1, 1001)) for share in uneven])
    assert mean == pytest.approx(0.3)


def test_reference_lines_are_those_of_uniform_memory_and_of_none() -> None:
    uniform = density_of_windows(linear_policy(1.0, dtype=torch.float32), [window(20), window(7)])
    np.testing.assert_allclose(uniform.mass(16), 1 / 16, rtol=1e-4)
    free = density_of_windows(linear_policy(0.0, dtype=torch.float32), [window(20), window(7)])
    np.testing.assert_allclose(free.mass(16), no_memory([20, 7], 16), rtol=1e-6)
    assert free.last_share() == 1
    assert no_memory([7], 16)[-2:].sum() < 1  # one of 7 frames is longer than two of 16 bins


def test_options_are_those_of_the_windows_that_it_plays() -> None:
    net = Net("mingru", torch.float32)
    policy = Policy(net.encode, net.remember, net.initial_state)
    for options in (
        {"norm": "l2sq", "reduce": "sum"},
        {"norm": "l2", "target": "probs"},
        {"end": "random", "cap": 5},
    ):
        found = recall_density(policy, ToyEnv([9, 12]), episodes=5, seed=2, **options)  # type: ignore[arg-type]
        of_play = {name: options.pop(name) for name in ("end", "cap") if name in options}
        windows = list(greedy_windows(policy, ToyEnv([9, 12]), episodes=5, seed=2, **of_play))  # type: ignore[arg-type]
        wanted = density_of_windows(policy, windows, **options)  # type: ignore[arg-type]
        assert [share.size for share in found.shares] == [window.n + 1 for window in windows]
        np.testing.assert_allclose(found.deltas, wanted.deltas, rtol=1e-6)
        np.testing.assert_allclose(found.sizes, wanted.sizes, rtol=1e-6)
        assert found.target == wanted.target


def test_short_trajectories_are_dropped_and_counted() -> None:
    found = recall_density(RHO, ToyEnv([1, 2, 3, 30]), episodes=8, seed=1)
    assert found.dropped == 4 and sorted(set(found.lengths.tolist())) == [3, 30]
    assert found.ended.all() and found.silent == 0
    none = recall_density(RHO, ToyEnv([2]), episodes=3)
    with pytest.raises(ValueError, match="3 had fewer than 3 frames"):
        none.mass(3)


def test_long_episodes_give_windows_of_the_cap_with_random_ends_and_short_ones_end_with_the_episode() -> (
    None
):
    windows = list(greedy_windows(RHO, ToyEnv([40, 8]), episodes=40, cap=10))
    ends = [int(w.frames[-1, 0, 0, 0]) for w in windows if w.row == 0]
    assert min(ends) >= 9 and len(set(ends)) > 8 and all(w.n == 9 for w in windows if w.row == 0)
    assert all(w.ended and w.n == 7 for w in windows if w.row == 1)


def test_every_frame_that_a_window_may_end_with_is_drawn() -> None:
    rng = np.random.default_rng(0)
    for length, end, wanted in (
        (12, "last", {9, 10, 11}),
        (5, "random", {2, 3, 4}),
        (10, "last", {9}),
    ):
        assert {_end(length, end, 10, rng) for _ in range(200)} == wanted  # type: ignore[arg-type]


def test_random_ends_are_uniform_from_the_third_frame_on() -> None:
    windows = greedy_windows(RHO, ToyEnv([6] * 8), episodes=400, end="random")
    counts = np.bincount([w.n for w in windows], minlength=6)
    assert counts[:2].sum() == 0 and (counts[2:] > 60).all()


def test_the_same_seed_plays_the_same_episodes_and_another_seed_others() -> None:
    first, again, other = (
        torch.cat([w.frames for w in greedy_windows(RHO, ToyEnv([9, 12]), episodes=4, seed=seed)])
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert not torch.equal(first[:21], first[21:])  # nor are the episodes of one seed the same


def test_a_window_gives_the_shares_of_its_saliency() -> None:
    net, w = Net("mingru", torch.float32), window(6)
    for norm, reduce in (("l1", "per_action"), ("l2sq", "sum"), ("l2", "per_action")):
        one = density_of_windows(net, [w], norm=norm, reduce=reduce)  # type: ignore[arg-type]
        two = saliency(net, w.frames, w.last_action, w.is_init, norm=norm, reduce=reduce)  # type: ignore[arg-type]
        np.testing.assert_allclose(one.shares[0], two.shares(), rtol=1e-4, atol=1e-9)
        assert one.sizes[0] == pytest.approx(two.per_frame.sum(), rel=1e-4)
        assert one.certainty[0] == pytest.approx(two.output.max(), rel=1e-4)


@pytest.mark.parametrize(("algorithm", "target"), [("pqn", "q"), ("ppo", "probs"), ("dqn", "q")])
def test_agents_of_every_algorithm_have_a_density(algorithm: str, target: str) -> None:
    config = preset("smoke", env="MineSweeperEasy", memory="gru", algorithm=algorithm)
    agent = Agent(config, build_network(config).eval())
    found = recall_density(agent, episodes=5, cap=8)
    assert found.target == target
    assert len(found.shares) + found.dropped + found.silent == 5 and found.lengths.max() <= 8
    with pytest.raises(ValueError, match="offers"):
        recall_density(agent, episodes=1, target="probs" if target == "q" else "q")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"end": "first"}, "end must be one of last, random"),
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"cap": 2}, "cap must be at least 3"),
        ({"norm": "l0"}, "norm must be one of"),
        ({"observability": "full"}, "leave env out"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recall_density(RHO, ToyEnv([5]), **options)
    with pytest.raises(ValueError, match="hand over env as well"):
        recall_density(RHO)
    with pytest.raises(TypeError, match="got object"):
        recall_density(object(), ToyEnv([5]))
    with pytest.raises(RuntimeError, match="does not exist"):
        recall_density(Path("no/such/run"))


def test_equal_lines_are_all_seen_and_an_agent_looks_alike_in_every_panel() -> None:
    """Before: an agent's broken line lay under another's full one, and was full where one was
    missing.
    """
    agents = ["gru", "lru", "mlp"]
    colours = style.agent_colours(agents)
    equal = pooled([[0.25, 0.75]])
    with style.drawing("light") as plt:
        axes = plt.subplots(1, 2)[1]
        for axis, drawn in zip(axes, (agents, agents[1:]), strict=True):
            series = {agent: (equal, colours[agent]) for agent in drawn}
            recall_density_figures.plot(series, axis, 2, names=agents)
        lines = [{line.get_label(): line for line in axis.patches} for axis in axes]
    upwards = sorted(agents, key=lambda agent: lines[0][agent].get_zorder())
    assert [lines[0][agent].get_linestyle() == "-" for agent in upwards] == [True, False, False]
    for agent in agents[1:]:
        assert lines[0][agent].get_linestyle() == lines[1][agent].get_linestyle()
    assert len({lines[0][agent].get_linestyle() for agent in agents}) == 3
