"""Arguments of measures that their docstrings forbid: one line before anything is measured, and
never another measure in silence.
"""

import math

import pytest
import torch

from arcade_torch.agents import from_pretrained
from arcade_torch.tools import (
    as_policy,
    beliefs,
    beliefs_figure,
    contamination,
    contamination_example,
    contamination_example_figure,
    contamination_figure,
    counterfactual,
    counterfactual_figure,
    gap_and_bias,
    greedy_window,
    patching,
    recall_density,
    recall_density_figure,
    saliency,
    saliency_figure,
    steering,
)
from tests.tools.measures.toys import linear_policy, window

NO_COUNTS = (0, -1, 1.5, True, None, "2", math.nan)
NO_SEEDS = (-1, 1.5, True, None, "1")
COUNTS = [
    (recall_density, "episodes"),
    (recall_density, "cap"),
    (contamination, "starts"),
    (contamination, "cap"),
    (contamination_example, "horizon"),
    (counterfactual, "episodes"),
    (counterfactual, "donors"),
    (counterfactual, "block"),
    (counterfactual, "most_lags"),
    (beliefs, "episodes"),
    (beliefs, "max_steps"),
    (patching, "episodes"),
    (patching, "max_steps"),
    (steering, "episodes"),
    (steering, "max_steps"),
    (greedy_window, "max_steps"),
]
MEASURES = list(dict.fromkeys(function for function, _ in COUNTS))


def one_line(message, call, *args, kind=ValueError, **options):
    """A call is refused by one line that matches."""
    with pytest.raises(kind, match=message) as refused:
        call(*args, **options)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def agent():
    """A trained agent."""
    return from_pretrained("signpost-partial-mlp")


@pytest.fixture(autouse=True)
def nothing_is_played(monkeypatch):
    """What is refused is refused before an episode is played."""

    def played(*args, **options):
        raise AssertionError("an episode was played")

    monkeypatch.setattr("arcade_torch.agents.evaluation.make_env", played)


@pytest.mark.parametrize(("measure", "name"), COUNTS)
def test_what_a_measure_counts_is_a_whole_number(measure, name, agent):
    for wrong in NO_COUNTS:
        one_line(f"^{name} must be", measure, agent, **{name: wrong})


@pytest.mark.parametrize("measure", MEASURES)
def test_the_seed_of_a_measure_is_a_whole_number(measure, agent):
    for wrong in NO_SEEDS:
        one_line("^seed must be", measure, agent, seed=wrong)


@pytest.mark.parametrize("measure", MEASURES)
def test_a_measure_knows_two_twins(measure, agent):
    for wrong in ("x", True, 1):
        one_line("^observability must be 'full' or 'partial'", measure, agent, observability=wrong)


def test_the_grid_of_contamination_is_of_numbers(agent):
    for wrong in ((), (-1.0,), (0.5, math.nan), (math.inf,), ("a",), (True,), 3, None):
        one_line("^sigmas must be", contamination, agent, sigmas=wrong)
    for wrong in ((), (-1,), (1.5,), (math.nan,), ("a",), (True,), 3, None):
        one_line("^delays must be", contamination, agent, delays=wrong)
    for name in ("clip", "feedback", "shuffle"):
        for measure in (contamination, contamination_example):
            for wrong in ("no", 1, None):
                one_line(f"^{name} must be true or false", measure, agent, **{name: wrong})
    for wrong in (-1.0, math.nan, math.inf, "a", True, None):
        one_line("^sigma must be", contamination_example, agent, sigma=wrong)


def test_the_options_of_recall_density_are_looked_at_before_it_plays(agent):
    one_line("^norm must be", recall_density, agent, norm="l3")
    one_line("^reduce must be", recall_density, agent, reduce="mean")
    one_line("^end must be", recall_density, agent, end="first")
    one_line("^end must be", counterfactual, agent, end="first")


def test_the_numbers_of_saliency_are_whole(agent):
    frames = torch.zeros(3, 128, 128, 3, dtype=torch.uint8)
    for wrong in (1.5, True, None, "a", math.nan, 3, -4):
        one_line("^n must be", saliency, agent, frames, n=wrong)
    for wrong in NO_COUNTS:
        one_line("^chunk must be", saliency, agent, frames, chunk=wrong)
    for wrong in (torch.int64, torch.complex64, "float32"):
        one_line("^dtype must be", saliency, agent, frames, dtype=wrong)


def test_a_window_without_frames_is_refused(agent):
    frames = torch.zeros(0, 128, 128, 3, dtype=torch.uint8)
    one_line("^n must be inside a window of 0 frames", saliency, agent, frames)


def test_white_is_a_number_above_0(agent):
    for wrong in (0, -1.0, math.nan, math.inf, "white", True):
        one_line("^white must be a number above 0", as_policy, agent, white=wrong)
    assert as_policy(agent, white=1).white == 1


def test_the_numbers_of_the_bootstrap_are_checked():
    for wrong in NO_COUNTS:
        one_line("^draws must be", gap_and_bias, [], draws=wrong)
    for wrong in (0, 1, 1.5, math.nan, "a", None, True):
        one_line("^confidence must be", gap_and_bias, [], confidence=wrong)
    for wrong in NO_SEEDS:
        one_line("^seed must be", gap_and_bias, [], seed=wrong)


def test_saliency_takes_lists_and_arrays_and_names_what_is_neither():
    """A list was an AttributeError about ndim."""
    policy = linear_policy(0.5, dtype=torch.float32)
    seen = window(4)
    actions = [0, 1, 2, 0]
    flags = [True, False, False, False]
    given = saliency(policy, seen.frames.numpy(), actions, flags)
    tensors = saliency(policy, seen.frames, torch.tensor(actions), torch.tensor(flags))
    assert (given.per_frame == tensors.per_frame).all()
    one_line("the length of last_action must be that of frames", saliency, policy, seen.frames, [0])
    for wrong in ("x", object(), [None] * 4):
        message = "must be a tensor or an array; got an?"
        one_line(f"^last_action {message}", saliency, policy, seen.frames, wrong, kind=TypeError)
        one_line(f"^frames {message}", saliency, policy, wrong, kind=TypeError)
        one_line(
            f"^is_init {message}", saliency, policy, seen.frames, is_init=wrong, kind=TypeError
        )


def test_gap_and_bias_is_of_paths_or_scores():
    for wrong in (None, 3, object(), [1], [None]):
        one_line("^runs must be paths of runs, studies or tables, or scores; got an?",
                 gap_and_bias, wrong, kind=TypeError)  # fmt: skip


@pytest.mark.parametrize(
    "draw", [recall_density_figure, contamination_figure, beliefs_figure, counterfactual_figure]
)
def test_a_figure_is_of_results_by_name(draw):
    for wrong in (None, 3, "x", [1, 2], object()):
        one_line("must be a dictionary of results by name; got an?", draw, wrong, kind=TypeError)


def test_a_figure_of_one_episode_is_of_what_the_measure_gave():
    for wrong in (None, 3, "x", [1, 2], object(), [("a", "b")]):
        one_line("^rows must be a list of", saliency_figure, wrong, kind=TypeError)
        one_line("^example must be what contamination_example gave; got an?",
                 contamination_example_figure, wrong, kind=TypeError)  # fmt: skip
