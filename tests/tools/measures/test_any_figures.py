"""Figures of measures of any policy: frames of any kind, any number of actions, one seed or some."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from arcade_torch import make
from arcade_torch.models import make_network
from arcade_torch.tools import (
    beliefs,
    beliefs_figure,
    contamination,
    contamination_example,
    contamination_example_figure,
    contamination_figure,
    counterfactual,
    counterfactual_figure,
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


def test_effects_of_exchanges_stand_inside_their_panels() -> None:
    """Before: the panel of all donors set the scale, and what differing donors do was cut off."""
    exchanges = counterfactual(policy_of(), Foreign(), episodes=6, donors=2, **NAMES)
    differs = np.zeros_like(exchanges.differs)
    differs[..., 0] = 1
    memory_differs = np.zeros_like(exchanges.memory_differs)
    memory_differs[..., 0] = 1
    of_one_donor = replace(
        exchanges,
        change=3 * differs,
        differs=differs,
        memory_change=3 * memory_differs,
        memory_differs=memory_differs,
    )
    figure = counterfactual_figure({"gru": of_one_donor}, effect="change")
    figure.canvas.draw()
    for axis, level in zip(figure.axes, (1.5, 3), strict=True):
        low, high = axis.get_ylim()
        assert low == 0
        assert axis.lines[0].get_ydata().max() == level < high


def test_beliefs_have_bars_of_all_facts_and_a_panel_for_each() -> None:
    env = make("MineSweeperEasy", num_envs=8, observability="partial", seed=0)
    seeds = []
    for memory in ("gru", "mlp"):
        seeds.append(beliefs(make_network("small", memory), env, episodes=16, max_steps=4))
    figure = beliefs_figure({"GRU": seeds[0], "both": [seeds[0], seeds[0]], "none": seeds[1]})
    figure.canvas.draw()
    facts = seeds[0].names.tolist()
    assert [axis.get_title() for axis in figure.axes] == ["all steps", *facts]
    heights = [bar.get_height() for bar in figure.axes[0].patches[:2]]
    sources = ("state", "frame")
    scores = [max(seeds[0].score(facts[0], source).value, -0.15) for source in sources]
    assert heights == pytest.approx(scores)
    drawn = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, seeds[0].by_step(facts[0], "state")[0])
    assert len(beliefs_figure({"none": seeds[1]}).axes[1].lines) == 2  # the frame, and zero


def test_an_example_has_bars_for_as_many_actions_as_there_are() -> None:
    example = contamination_example(policy_of(), Foreign(), horizon=6, **NAMES)
    assert example.frames.shape[1] == 7 < LENGTH
    figure = contamination_example_figure(example, title="any")
    bars = figure.axes[3]
    assert [label.get_text() for label in bars.get_xticklabels()] == list("0123")
    assert len(bars.patches) == ACTIONS
    named = contamination_example_figure(example, actions=["left", "right", "up", "down"])
    assert named.axes[3].get_xticklabels()[0].get_text() == "left"


DOLLARS = ["$x^$", "lr $0.1$ wd $0$", r"\frac", "_under", "50 %"]


def test_names_with_dollars_are_text_in_figures_of_ones_own() -> None:
    """Before: a parse error of matplotlib, or letters in italics without their dollars."""
    options: dict[str, Any] = {"sigmas": (1.0,), "delays": (0, 1), "starts": 4}
    changes = contamination(policy_of(), Foreign(), **options, **NAMES)
    exchanges = counterfactual(policy_of(), Foreign(), episodes=4, donors=1, **NAMES)
    density = recall_density(policy_of(), Foreign(), episodes=2, **NAMES)
    for figure in (
        contamination_figure(dict.fromkeys(DOLLARS, changes)),
        counterfactual_figure(dict.fromkeys(DOLLARS, exchanges)),
        recall_density_figure(dict.fromkeys(DOLLARS, density)),
    ):
        figure.canvas.draw()
        texts = figure.legends[0].get_texts()
        assert [text.get_text().lstrip("\u200b") for text in texts][: len(DOLLARS)] == DOLLARS
        assert not any(text.get_parse_math() for text in texts)
    example = contamination_example(policy_of(), Foreign(), horizon=6, **NAMES)
    figure = contamination_example_figure(example, title="$x^$", actions=DOLLARS[:ACTIONS])
    figure.canvas.draw()
    ticks = figure.axes[-1].get_xticklabels()
    assert [tick.get_text() for tick in ticks] == DOLLARS[:ACTIONS]


def assert_inside(figure: Any, texts: Iterable[Any]) -> None:
    """Nothing is cut, and nothing is written over another text."""
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    for box in boxes:
        assert box.x0 >= 0 and box.x1 <= figure.bbox.x1 and box.y0 >= 0 and box.y1 <= figure.bbox.y1
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


LONG = "a_memory_whose_name_has_all_forty_letter"


def test_legends_stand_beside_what_is_drawn() -> None:
    """Before: names lay over the lines, and long ones over the numbers of the axis."""
    changes = contamination(policy_of(), Foreign(), sigmas=(1.0,), delays=(0, 1), starts=4, **NAMES)
    exchanges = counterfactual(policy_of(), Foreign(), episodes=4, donors=1, **NAMES)
    density = recall_density(policy_of(), Foreign(), episodes=2, **NAMES)
    names = [LONG, "gru", "mlp"]
    for figure in (
        contamination_figure(dict.fromkeys(names, changes)),
        counterfactual_figure(dict.fromkeys(names, exchanges)),
        recall_density_figure(dict.fromkeys(names, density)),
    ):
        (legend,) = figure.legends
        assert_inside(figure, legend.get_texts())
        for axis in figure.axes:
            assert axis.get_legend() is None
            assert not legend.get_window_extent().overlaps(axis.get_window_extent())


@pytest.mark.parametrize(
    "names",
    [
        [f"move the arm forward and {place}" for place in range(ACTIONS)],
        [str(place) for place in range(18)],
        ["NOOP", "DOWNRIGHTFIRE", "UPLEFTFIRE"] * 6,
        [LONG] * 4,
    ],
)
def test_many_actions_and_long_names_of_them_can_be_read(names: list[str]) -> None:
    """Before: they were written over each other."""
    example = contamination_example(policy_of(), Foreign(), horizon=6, **NAMES)
    values = np.linspace(-1, 1, len(names) * len(example.values), dtype=np.float32)
    example = replace(example, values=values.reshape(-1, len(names)))
    figure = contamination_example_figure(example, actions=names)
    bars = figure.axes[3::4]
    figure.canvas.draw()
    assert_inside(figure, bars[-1].get_xticklabels())
    heights = [axis.get_window_extent().height for axis in bars]
    assert min(heights) > 0.9 * max(heights) > 60


def test_the_title_of_a_strip_is_not_cut() -> None:
    frames = np.zeros((5, 4, 4, 3), np.uint8)
    maps = np.ones((5, 4, 4), np.float32)
    for title in (LONG, f"{LONG} on a game, seed 0", "x"):
        for show in (1, 2, 5):
            figure = saliency_figure([(title, frames, maps), ("b", frames, maps)], show=show)
            assert_inside(figure, [part._suptitle for part in figure.subfigs])
            assert title.replace(" ", "") in figure.subfigs[0]._suptitle.get_text().translate(BLANK)


BLANK = str.maketrans("", "", " \n")


def test_steps_of_an_episode_are_whole_numbers() -> None:
    """Before: the axis of beliefs had steps 0.5 and 1.5."""
    env = make("MineSweeperEasy", num_envs=8, observability="partial", seed=0)
    probes = beliefs(make_network("small", "gru"), env, episodes=16, max_steps=4)
    figure = beliefs_figure({"gru": probes, **dict.fromkeys(DOLLARS, probes)})
    figure.canvas.draw()
    assert all(float(tick).is_integer() for tick in figure.axes[1].get_xticks())


def test_actions_of_one_name_have_a_bar_each_and_all_have_a_name() -> None:
    """Before: bars of one name stood behind each other, and one name was that of all."""
    example = contamination_example(policy_of(), Foreign(), horizon=6, **NAMES)
    figure = contamination_example_figure(example, actions=["a", "a", "b", "b"])
    places = [bar.get_x() for bar in figure.axes[-1].patches]
    assert len(set(places)) == ACTIONS
    with pytest.raises(ValueError, match=r"^actions must be 4 names; got \['a'\]"):
        contamination_example_figure(example, actions=["a"])


def test_contaminations_of_other_delays_or_strengths_are_not_drawn_as_one() -> None:
    """Before: numbers of delays 0, 2, 3 stood at 0, 1, 2, and were pooled with those."""
    options: dict[str, Any] = {"starts": 8, **NAMES}
    changes = contamination(policy_of(), Foreign(), sigmas=(1.0,), delays=(0, 1, 2), **options)
    later = contamination(policy_of(), Foreign(), sigmas=(1.0,), delays=(0, 2, 3), **options)
    weaker = contamination(policy_of(), Foreign(), sigmas=(0.1,), delays=(0, 1, 2), **options)
    shuffled = replace(changes, sigmas=np.array([np.nan]))
    for other in (later, weaker, shuffled):
        for together in ({"a": changes, "b": other}, {"a": [changes, other]}):
            with pytest.raises(ValueError, match="must have the same sigmas and delays"):
                contamination_figure(together)
    contamination_figure({"a": shuffled, "b": [shuffled, shuffled]})


def test_what_cannot_be_drawn_is_refused_in_one_line() -> None:
    changes = contamination(policy_of(), Foreign(), sigmas=(1.0,), delays=(0, 1), starts=4, **NAMES)
    exchanges = counterfactual(policy_of(), Foreign(), episodes=4, donors=1, **NAMES)
    frames = np.zeros((5, 4, 4, 3), np.uint8)
    maps = np.ones((5, 4, 4), np.float32)
    wrong: list[tuple[Any, str]] = [
        (lambda: contamination_figure({}), "changes must be of one policy at least"),
        (lambda: contamination_figure({"a": []}), "changes must be of one policy at least"),
        (
            lambda: contamination_figure({"a": changes}, name="x"),
            "name must be one of flip, change",
        ),
        (lambda: counterfactual_figure({}), "effects must be of one policy at least"),
        (lambda: counterfactual_figure({"a": exchanges}, effect="x"), "effect must be one of flip"),
        (lambda: beliefs_figure({}), "probes must be of one policy at least"),
        (lambda: recall_density_figure({}), "densities must be of one policy at least"),
        (lambda: saliency_figure([]), "rows must be one at least"),
        (lambda: saliency_figure([("a", frames, maps)], show=0), "show must be at least 1"),
        (
            lambda: saliency_figure([("a", frames, maps[1:])]),
            r"the maps of 'a' must be \[5, 4, 4\]",
        ),
        (lambda: saliency_figure([("a", frames, maps.reshape(5, 2, 8))]), "the maps of 'a' must"),
        (lambda: saliency_figure([("a", frames, maps * np.nan)]), "the maps of 'a' must be finite"),
    ]
    for draw, message in wrong:
        with pytest.raises(ValueError, match=f"^{message}") as caught:
            draw()
        assert "\n" not in str(caught.value)
