"""Sentences of a report at the edges: equal returns, gaps below zero, differences next to zero."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import pytest

from arcade_torch.tools import gap_and_bias, report
from arcade_torch.tools.measures.bootstrap import Interval
from arcade_torch.tools.measures.gap_bias.measure import GapBias
from arcade_torch.tools.measures.gap_bias.pairs import pairs
from arcade_torch.tools.reports import Part, findings
from arcade_torch.tools.reports.subject import subject_sentence
from arcade_torch.tools.runs import Score
from tests.tools.fabricated import FINAL, small_study, write_study


def two_agents(**returns: Sequence[float]) -> list[Score]:
    """Scores with ``agent_twin=`` of one game, a seed each."""
    made = []
    for name, values in returns.items():
        agent, twin = name.split("_")
        for seed, value in enumerate(values):
            made.append(Score(agent, "CartPoleEasy", twin, seed, value))
    return made


def test_the_same_returns_are_no_difference_whatever_the_number_of_seeds() -> None:
    """Before: the mean of three times .7 is not .7, so an agent with one seed more was behind, by
    -0.00 [-0.00, -0.00].
    """
    scores = two_agents(
        gru_full=[0.7] * 3, gru_partial=[0.7] * 3, mlp_full=[0.7] * 2, mlp_partial=[0.7] * 2
    )
    both = pairs(scores, "gru", draws=50)
    assert [pair.difference for pair in both] == [Interval(0.0, 0.0, 0.0)] * len(both)
    made = gap_and_bias(scores, draws=50)
    assert not made.difference("gap", "mlp", "gru").excludes_zero
    said = {name: findings.score_sentence(made, name, "gru") for name in findings.SENTENCES}
    assert "the gap is the same in every seed" in said["gap"]
    assert said["pomdp"].endswith("the memory-free agent 0.70, with no difference in any seed.")
    assert said["bias"].endswith("gru earns what the memory-free agent does, in every seed.")


def test_a_gap_below_zero_becomes_lower_or_higher() -> None:
    """Before: memory "widened" a gap of -0.40 to one of 0.00."""
    six = [0.0, 0.01, 0.02, 0.03, 0.04, 0.05]

    def said(mlp: float, lru: float, spread: Sequence[float] = six) -> str:
        returns = {
            "lru_full": [0.5] * 6,
            "lru_partial": [0.5 - lru - 0.025 + more for more in spread],
            "mlp_full": [0.5] * 6,
            "mlp_partial": [0.5 - mlp - 0.025 + more for more in spread],
        }
        return findings.score_sentence(gap_and_bias(two_agents(**returns)), "gap", "lru")

    assert "memory raises the observability gap by 0.40" in said(-0.4, 0.0)
    assert "memory lowers the observability gap by 0.40" in said(-0.1, -0.5)
    closed = said(0.2, -0.001)
    assert "lru 0.00" in closed and "memory narrows the observability gap by 0.20" in closed
    assert "memory narrows the observability gap by 0.40" in said(0.5, 0.1)
    widened = said(0.1, 0.5)
    assert "memory widens the observability gap by 0.40" in widened
    near, far = re.findall(r"\[(0\.\d\d), (0\.\d\d)\]", widened)[0]
    assert float(near) < 0.4 < float(far)
    wide = [10 * more for more in six]
    assert "with memory the gap is 0.10 lower, but" in said(-0.4, -0.5, wide)
    assert "with memory the gap is 0.10 higher, but" in said(-0.5, -0.4, wide)
    assert "with memory the gap is 0.10 smaller, but" in said(0.5, 0.4, wide)


def test_an_interval_that_excludes_zero_is_seen_to() -> None:
    """Before: an agent was ahead by +0.00 [+0.00, +0.00]."""
    near = [0.5, 0.501, 0.502, 0.503, 0.504, 0.505]
    far = [value + 0.003 for value in near]
    scores = two_agents(gru_full=far, gru_partial=far, mlp_full=near, mlp_partial=near)
    made = gap_and_bias(scores)
    pomdp = findings.score_sentence(made, "pomdp", "gru")
    bias = findings.score_sentence(made, "bias", "gru")
    headline = subject_sentence(pairs(scores, "gru"), "gru", "mlp", [("CartPoleEasy", "full")])
    for sentence in (pomdp, bias, headline):
        assert "+0.003" in sentence or "adds 0.003" in sentence
        assert re.search(r"\[\+0\.00[1-9], \+0\.00[1-9]\]", sentence), sentence


def test_of_few_seeds_every_finding_is_of_these_seeds() -> None:
    """Before: only the gap was; two seeds were enough for what memory adds."""
    few = two_agents(
        gru_full=[0.8, 0.82],
        gru_partial=[0.8, 0.81],
        mlp_full=[0.5, 0.51],
        mlp_partial=[0.2, 0.21],
    )
    many = two_agents(
        gru_full=[0.8, 0.82] * 4,
        gru_partial=[0.8, 0.81] * 4,
        mlp_full=[0.5, 0.51] * 4,
        mlp_partial=[0.2, 0.21] * 4,
    )
    for name in findings.SENTENCES:
        assert "over these 2 seeds" in findings.score_sentence(gap_and_bias(few), name, "gru")
        assert "over these" not in findings.score_sentence(gap_and_bias(many), name, "gru")


def test_a_finding_of_a_single_seed_has_no_interval() -> None:
    scores = two_agents(gru_full=[0.8], gru_partial=[0.7], mlp_full=[0.5], mlp_partial=[0.2])
    made = gap_and_bias(scores, draws=50)
    assert findings.score_sentence(made, "pomdp", "gru").endswith("the memory-free agent 0.20.")
    assert findings.score_sentence(made, "bias", "gru").endswith("against the memory-free agent.")


@pytest.mark.parametrize("fewer", ["gru", "mlp"])
def test_the_agent_with_fewer_seeds_says_how_sure_a_finding_is(fewer: str) -> None:
    def made(gru: Sequence[float], mlp: Sequence[float]) -> GapBias:
        partial = {"gru": gru, "mlp": mlp}
        partial[fewer] = partial[fewer][:2]
        returns: dict[str, Sequence[float]] = {}
        for agent, values in partial.items():
            returns |= {f"{agent}_full": [0.9] * len(values), f"{agent}_partial": values}
        return gap_and_bias(two_agents(**returns))

    clear = made([0.8, 0.82] * 4, [0.2, 0.21] * 4)
    assert "over these 2 seeds memory narrows" in findings.score_sentence(clear, "gap", "gru")
    assert findings.coverage_sentence(clear).partition(". ")[2].startswith("With 2 seeds")
    vague = made([0.1, 0.9] * 4, [0.2, 0.8] * 4)
    assert "so 2 seeds do not settle it" in findings.score_sentence(vague, "gap", "gru")


def test_findings_hold_every_memory_against_the_memory_free_agent_of_its_algorithm() -> None:
    level = {"pqn-mlp": 0.1, "ppo-mlp": 0.2, "pqn-gru": 0.4, "ppo-gru": 0.6}
    level["dqn-gru"] = 0.9  # there is none of its algorithm: nothing is said
    made = gap_and_bias(
        [
            Score(agent, "CartPoleEasy", twin, seed, value + 0.02 * seed)
            for agent, value in level.items()
            for twin in ("full", "partial")
            for seed in range(2)
        ],
        draws=50,
    )
    found = findings.score_sentences(made, "")
    reached = [sentence for sentence in found if sentence.startswith("On the POMDP")]
    assert len(found) == 6 and len(reached) == 2
    assert "ppo-gru reaches a normalised return of 0.61, the memory-free agent 0.21" in reached[0]
    assert "pqn-gru reaches a normalised return of 0.41, the memory-free agent 0.11" in reached[1]
    about = findings.score_sentences(made, "pqn-gru")
    assert about == found[3:] + found[:3]


def test_the_highest_of_a_row_is_bold_beside_one_that_is_no_number(tmp_path: Path) -> None:
    """Before: a NaN that came first was the largest, and nothing was bold."""
    games = ["MineSweeperEasy", "CartPoleEasy", "CountRecallEasy"]
    study = small_study(games=games)
    folder = write_study(tmp_path, study)
    for run in study.runs():
        if (run.game, run.memory) == ("CartPoleEasy", "mingru"):
            file = folder.run(run).path / "eval.json"
            changes = {"mean": math.nan, "returns": [math.nan, 0.5]}
            file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    page = report(tmp_path, skip=get_args(Part)).read_text()
    rows = re.findall(r"CartPoleEasy</a>(.*?)</tr>", page)
    assert len(rows) == 2
    for row in rows:
        assert re.search(r'heat".*nan</td><td class="heat best"', row), row


def test_a_study_of_one_twin_says_what_its_intervals_are_worth(tmp_path: Path) -> None:
    """Before: that stood beside gap and bias alone, which it has not."""
    write_study(tmp_path / "two", small_study(observability=["partial"]))
    page = report(tmp_path / "two", skip=get_args(Part)).read_text()
    assert re.search(r"With 2 seeds such an interval held the true mean in \d\d % of", page)
    write_study(tmp_path / "one", small_study(observability=["partial"], seeds=[0]))
    page = report(tmp_path / "one", skip=get_args(Part)).read_text()
    assert "With a single seed there are no intervals" in page


def test_a_report_says_which_returns_lie_out_of_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: `figure gap-bias` alone did."""
    monkeypatch.setitem(FINAL, ("partial", "mingru"), 7.0)
    write_study(tmp_path, small_study())
    page = report(tmp_path, skip=get_args(Part)).read_text()
    assert "Returns of MineSweeperEasy lie outside of [-1, 1], so normalised returns" in page


def test_the_subject_of_a_study_of_one_twin_names_the_score(tmp_path: Path) -> None:
    """Before: the score stood below the table of gap and bias alone."""
    write_study(tmp_path / "s", small_study(observability=["partial"], subject="mingru"))
    page = report(tmp_path / "s", skip=get_args(Part), metric="train_max_ewm").read_text()
    assert "Normalised returns by the best smoothed training return, as in the paper" in page
    page = report(tmp_path / "s", skip=get_args(Part)).read_text()
    assert "Normalised returns by the mean return of the final greedy evaluation" in page
