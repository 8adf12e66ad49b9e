"""Figures of measures of any policy: frames of any kind, any number of actions, one seed or some."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools import (
    contamination,
    contamination_example,
    contamination_example_figure,
    contamination_figure,
    greedy_window,
    recall_density,
    recall_density_figure,
    saliency,
    saliency_figure,
)
from tests.tools.measures.test_any_env import ACTIONS, KINDS, LENGTH, NAMES, Foreign, policy_of

plt = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def backend() -> Iterator[None]:
    before = plt.get_backend()
    plt.switch_backend("agg")
    yield
    plt.close("all")
    plt.switch_backend(before)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_any_kind_are_drawn_under_their_maps(kind: str) -> None:
    policy = policy_of(kind)
    window = greedy_window(policy, Foreign(kind), **NAMES)
    maps = saliency(policy, window.frames, window.last_action, window.is_init, **NAMES)
    figure = saliency_figure([("any", window.frames, maps.maps)], show=3)
    figure.canvas.draw()
    pictures = [axis.get_images()[0].get_array() for axis in figure.axes]
    heat = [axis.get_images()[1].get_array() for axis in figure.axes]
    assert len(figure.axes) == 3
    assert all(
        picture.shape == (*above.shape, 3) for picture, above in zip(pictures, heat, strict=True)
    )
    if kind == "uint8, HWC":
        np.testing.assert_array_equal(pictures[-1], window.frames[-1])
    if kind == "floats, CHW":
        assert pictures[-1].shape == (5, 6, 3)


def test_densities_are_lines_by_name_and_bands_over_seeds() -> None:
    seeds = [recall_density(policy_of(), Foreign(), episodes=3, seed=s, **NAMES) for s in (0, 1)]
    alone = recall_density_figure({"one": seeds[0]}, bins=4)
    (axis,) = alone.axes
    labels = axis.get_legend_handles_labels()[1]
    assert labels == ["one", "uniform memory", "no memory"]
    line = next(patch for patch in axis.patches if patch.get_label() == "one")
    np.testing.assert_allclose(line.get_data().values, seeds[0].mass(4))
    both = recall_density_figure({"both": seeds}, bins=4)
    assert len(both.axes[0].patches) == len(axis.patches) + 1


def test_contamination_has_a_panel_for_each_strength() -> None:
    options: dict[str, Any] = {"sigmas": (0.3, 1.0), "delays": (0, 1, 2), "starts": 8}
    changes = contamination(policy_of(), Foreign(), **options, **NAMES)
    figure = contamination_figure({"gru": changes, "again": [changes, changes]}, name="change")
    assert [axis.get_title() for axis in figure.axes] == ["noise sigma = 0.3", "noise sigma = 1"]
    drawn = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, changes.mean("change")[1])


def test_an_example_has_bars_for_as_many_actions_as_there_are() -> None:
    example = contamination_example(policy_of(), Foreign(), horizon=6, **NAMES)
    assert example.frames.shape[1] == 7 < LENGTH
    figure = contamination_example_figure(example, title="any")
    bars = figure.axes[3]
    assert [label.get_text() for label in bars.get_xticklabels()] == list("0123")
    assert len(bars.patches) == ACTIONS
    named = contamination_example_figure(example, actions=["left", "right", "up", "down"])
    assert named.axes[3].get_xticklabels()[0].get_text() == "left"
