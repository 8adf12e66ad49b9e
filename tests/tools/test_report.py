"""The report: sentences that say no more than the numbers, charts, and one page that loads
nothing.
"""

import json
import math
import os
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.tools import cli, gap_and_bias, players, report, reports
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures.logs import curves_of_runs
from arcade_torch.tools.figures.style import agent_colours, agent_markers, drawing, svg
from arcade_torch.tools.measures.saliency import figure as saliency
from arcade_torch.tools.players import Baseline, references
from arcade_torch.tools.reports import findings
from arcade_torch.tools.runs import Score
from arcade_torch.tools.studies.grid import Study
from tests.tools.fabricated import FINAL, small_study, write_run, write_study

LEVELS = {
    player: Baseline("MineSweeperEasy-v0", player, 256, mean, 0.02, 20.0, 1.0)
    for player, mean in (("random", -0.02), ("state", 1.0))
}


@pytest.fixture
def no_oracles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reports, "references", lambda *words, imports: LEVELS)


@pytest.fixture
def page(tmp_path: Path, no_oracles: None) -> str:
    write_study(tmp_path / "s", small_study(question="Is 1 < 2 & true?"))
    return report(tmp_path / "s", skip=("saliency",)).read_text()


class Checker(HTMLParser):
    """Collects tags, and complains about addresses outside the page."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.ids: list[str] = []
        self.wanted: set[str] = set()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        for name, value in attributes:
            assert name not in ("src", "href", "xlink:href") or str(value).startswith(
                ("data:", "#")
            ), f"{tag} loads {value}"
            if name == "id":
                assert value not in self.ids
                self.ids.append(str(value))
            if name == "href" and str(value).startswith("#"):
                self.wanted.add(str(value)[1:])
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in ("meta", "br", "img"):
            self.open.pop()


def test_the_page_is_well_formed_and_loads_nothing(page: str) -> None:
    checker = Checker()
    checker.feed(page)
    assert not checker.open
    assert checker.wanted <= set(checker.ids)
    assert (
        checker.count["svg"] == 8
    )  # greedy and training curves of two twins, four panels of gap and bias
    assert not re.search(r"https?://|@import|url\((?!#)", page)


def test_the_page_says_what_was_asked_and_how_to_repeat_it(page: str) -> None:
    assert "Is 1 &lt; 2 &amp; true?" in page
    for run in small_study().runs():
        assert f"configs/{run.name}.json --out" in page
    assert "arcade-torch demo" in page and "arcade-torch report" in page
    assert "torchrl" in page and "pqn.gamma" in page


def test_reference_lines_and_intervals_are_on_the_page(page: str) -> None:
    assert ">random</text>" in page and ">oracle</text>" in page
    assert "FillBetweenPolyCollection" in page and "POMDP IQM" in page
    assert "memory narrows the observability gap by 0.05" in page


def test_returns_out_of_the_common_scale_are_named_above_all_numbers(
    page: str, tmp_path: Path, no_oracles: None
) -> None:
    words = "returns of MineSweeperEasy lie outside of [0, 1] and count as they are"
    assert words not in page
    what = small_study()
    folder = write_study(tmp_path / "wide", what)
    for run in what.runs():
        write_run(folder.run(run).path, run, 7.0, settings=what.config(run).to_dict())
    wide = report(tmp_path / "wide", skip=("saliency",)).read_text()
    assert words in wide.partition('id="learning"')[0]


def test_an_unfinished_study_is_reported_as_such(tmp_path: Path, no_oracles: None) -> None:
    what = small_study()
    folder = write_study(tmp_path / "s", what)
    run = what.runs()[0]
    (folder.run(run).path / "eval.json").unlink()
    write_run(folder.run(run).path, run, 0.5, status="interrupted")
    assert "1 of 8 runs have not finished" in report(tmp_path / "s", skip=("saliency",)).read_text()


def test_a_study_without_the_control_has_gaps_and_no_bias(tmp_path: Path, no_oracles: None) -> None:
    folder = write_study(tmp_path / "s", small_study(memories=["mingru"], subject="mingru"))
    # too short for a training score: the table of the other metric has no reason of its own here
    file = next(folder.root.glob("runs/*/eval.json"))
    file.write_text(json.dumps(json.loads(file.read_text()) | {"train_max_ewm": None}))
    (file.parent / "metrics.csv").write_text("frames,train_return_ewm\n2048,\n")
    page = report(tmp_path / "s", skip=("saliency",)).read_text()
    assert "no scores for the memory-free agent" in page and "not known yet" not in page
    assert "has no train_max_ewm" not in page
    assert ">Observability Gap<" in page and ">Memory Bias<" not in page
    assert (tmp_path / "s" / "analysis" / "gap_bias_eval_final.csv").is_file()


def test_agents_are_told_about_beside_the_memory_free_one_of_their_algorithm(
    tmp_path: Path, no_oracles: None
) -> None:
    what = small_study(algorithms=["pqn", "ppo"])
    folder = write_study(tmp_path / "s", what)
    for run in [
        run
        for run in what.runs()
        if (run.algorithm, run.memory, run.observability) == ("ppo", "mlp", "full")
    ]:
        write_run(
            folder.run(run).path, run, 0.9 + 0.02 * run.seed, settings=what.config(run).to_dict()
        )
    page = report(tmp_path / "s", skip=("saliency",)).read_text()
    assert "On the MDP, where memory is not needed, pqn-mingru adds 0.0" in page
    assert (
        "ppo-mingru costs 0.2" in page
        and "and ppo-mlp 0." not in page
        and "needed, ppo-mlp" not in page
    )


def test_runs_that_cannot_be_compared_are_not_pooled(tmp_path: Path, no_oracles: None) -> None:
    folder = write_study(tmp_path / "s", small_study())
    file = folder.run(small_study().runs()[0]).path / "config.json"
    file.write_text(file.read_text().replace('"gamma": 0.99', '"gamma": 0.5'))
    with pytest.raises(
        ValueError, match=r"seeds of mingru on MineSweeperEasy \(full\) differ in pqn.gamma"
    ):
        report(tmp_path / "s", skip=("saliency",))


def page_without_an_mdp(study: Study, memory: str, root: Path) -> str:
    """The report of a study in which one memory has no run on CartPoleEasy's MDP."""
    folder = write_study(root / "s", study)
    for run in study.runs():
        if (run.game, run.memory, run.observability) == ("CartPoleEasy", memory, "full"):
            shutil.rmtree(folder.run(run).path)
    parts = ("saliency", "recall", "counterfactual", "beliefs", "contamination")
    return report(folder.root, skip=parts).read_text()


def test_a_mean_over_fewer_tasks_is_said_to_be_one(
    tmp_path: Path, no_oracles: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for twin in ("full", "partial"):
        monkeypatch.setitem(FINAL, (twin, "gru"), 0.4)
    games = ["MineSweeperEasy", "CartPoleEasy"]
    study = small_study(subject="mingru", memories=["gru", "mlp", "mingru"], games=games)
    page = page_without_an_mdp(study, "gru", tmp_path)
    assert "gru has no finished run on CartPoleEasy MDP: its means are of the other tasks." in page
    assert "on the MDP, 1 of 2 tasks, mingru reaches a normalised return of 0.76 and gru" in page
    assert page.count("over the 1 of 2 games that all agents have.") == 6  # gap, POMDP, bias
    # (0.51 + (1 + 0.51) / 2) / 2
    assert re.search(r"mean of the MDPs</td><td>0\.63[23]</td>", page)


def test_a_mean_of_the_subject_over_fewer_tasks_is_said_to_be_one(
    tmp_path: Path, no_oracles: None
) -> None:
    """Before: its POMDPs were all games, its MDPs one less, and nothing said so."""
    games = ["MineSweeperEasy", "CartPoleEasy"]
    study = small_study(subject="mingru", baseline="gru", games=games)
    page = page_without_an_mdp(study, "mingru", tmp_path)
    assert "on the MDP, 1 of 2 tasks, mingru reaches" in page
    assert "On the POMDP mingru reaches" in page
    assert "mingru has no finished run on CartPoleEasy MDP: all means are of the other" in page


@pytest.mark.parametrize("score", [math.nan, math.inf, -math.inf])
def test_a_run_without_a_score_is_not_averaged_away(
    score: float, tmp_path: Path, no_oracles: None
) -> None:
    study = small_study(subject="mingru")
    folder = write_study(tmp_path / "s", study)
    path = folder.run(study.runs()[0]).path
    file = path / "eval.json"
    changes = {"mean": score, "returns": [score, 0.5]}
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    lines = (path / "eval.csv").read_text().splitlines()
    for place in (1, -1):  # the first evaluation and the last
        lines[place] = f"{lines[place].partition(',')[0]},{score},nan,128"
    (path / "eval.csv").write_text("\n".join([*lines, ""]))
    parts = ("saliency", "recall", "counterfactual", "beliefs", "contamination")
    page = report(folder.root, skip=parts).read_text()
    assert f"is {score}" in page  # in the place of gap and bias
    assert "since the score of a run is no number" in page
    assert re.search(rf"<td>nan</td><td></td><td class=.many.>{score}  0\.520</td>", page)
    curves = curves_of_runs(find_runs([folder.root]).groups())
    with_it = curves["mingru", "MineSweeperEasy", "full"].returns.mean
    without = curves["mingru", "MineSweeperEasy", "partial"].returns.mean
    assert np.isfinite(with_it).tolist() == [False, True, True, True, False]
    assert np.isfinite(without).all()


def test_a_part_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no part 'strips' to skip; parts: saliency, recall"):
        report(tmp_path / "s", skip=("strips",))  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="metric must be one of eval_final, train_max_ewm; got 'return'"
    ):
        report(tmp_path / "s", metric="return")


def test_nothing_finished_is_an_error(tmp_path: Path) -> None:
    from arcade_torch.tools.studies.folder import StudyFolder

    StudyFolder(tmp_path / "s").claim(small_study())
    with pytest.raises(ValueError, match="nothing to report"):
        report(tmp_path / "s")
    with pytest.raises(FileNotFoundError, match=r"no study\.json"):
        report(tmp_path)


def table(mlp: list[float], lru: list[float]) -> Any:
    """POMDP scores of two agents whose MDP scores are all 0.9."""
    made = []
    for agent, values in (("mlp", mlp), ("lru", lru)):
        for seed, value in enumerate(values):
            made += [
                Score(agent, "CartPoleEasy", twin, seed, v)
                for twin, v in (("full", 0.9), ("partial", value))
            ]
    return gap_and_bias(made, draws=500)


def test_the_headline_claims_only_what_the_interval_allows() -> None:
    clear = findings.score_sentence(table([0.1, 0.12, 0.11], [0.8, 0.82, 0.81]), "gap", "lru")
    assert ": over these 3 seeds memory narrows the observability gap by 0.70" in clear
    many = findings.score_sentence(
        table([0.1, 0.12, 0.11] * 2, [0.8, 0.82, 0.81] * 2), "gap", "lru"
    )
    assert ": memory narrows the observability gap by 0.70" in many
    worse = findings.score_sentence(table([0.8, 0.82, 0.81], [0.1, 0.12, 0.11]), "gap", "lru")
    assert "memory widens the observability gap by 0.70" in worse
    vague = findings.score_sentence(table([0.1, 0.9, 0.5], [0.2, 0.9, 0.6]), "gap", "lru")
    assert "contains zero, so 3 seeds do not settle it" in vague
    ahead = findings.score_sentence(
        table([0.1, 0.12, 0.11] * 2, [0.8, 0.82, 0.81] * 2), "pomdp", "lru"
    )
    assert ahead.startswith(
        "On the POMDP lru reaches a normalised return of 0.81, the memory-free agent 0.11, a diff"
    )
    assert "a difference of +0.70 [+0." in ahead
    single = findings.score_sentence(table([0.1], [0.9]), "gap", "lru")
    assert "single seed" in single and "narrows" not in single


def test_few_seeds_come_with_a_caution() -> None:
    assert "With 2 seeds" in findings.coverage_sentence(table([0.1, 0.2], [0.3, 0.4]))
    assert "no intervals" in findings.coverage_sentence(table([0.1], [0.3]))


def test_an_interval_that_keeps_its_word_is_not_called_narrow() -> None:
    """Before: it was, whatever the simulated studies said."""
    few = table([0.1, 0.2], [0.3, 0.4])
    rows = tuple(replace(row, seeds=100, coverage=0.95) for row in few.rows)
    assert "than it claims" in findings.coverage_sentence(few)
    kept = findings.coverage_sentence(replace(few, rows=rows))
    assert "in 95 % of simulated studies." in kept and "than it claims" not in kept


def test_the_way_from_random_to_oracle_is_a_share() -> None:
    said = findings.learning_sentence(
        "X", "partial", {"mlp": [0.0, 0.5]}, {"random": 0.0, "state": 1.0}
    )
    assert "mlp 25 %" in said and "a seed of mlp did not get above random" in said
    assert findings.learning_sentence("X", "full", {"mlp": [0.1]}, {}) == ""
    for nothing in (math.nan, math.inf, -math.inf):
        assert findings.way(nothing, {"random": 0.0, "state": 1.0}) is None


def test_equal_returns_of_oracle_and_random_player_divide_by_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (
        findings.learning_sentence("X", "full", {"mlp": [0.1]}, {"random": 0.5, "state": 0.5}) == ""
    )
    same = {
        player: Baseline("X", player, 256, 0.5, 0.0, 20.0, 1.0) for player in ("random", "state")
    }
    monkeypatch.setattr(reports, "references", lambda *words, imports: same)
    write_study(tmp_path / "s", small_study())
    assert "random policy" in report(tmp_path / "s", skip=("saliency",)).read_text()


def test_reference_lines_follow_the_options_of_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(
        reports, "references", lambda *words, imports: asked.append(words) or LEVELS
    )
    folder = write_study(tmp_path / "s", small_study())
    for run in small_study().runs():
        file = folder.run(run).path / "config.json"
        record = json.loads(file.read_text())
        record["config"] |= {"env_options": {"mine_reward": -1.0}, "rules": "reference"}
        file.write_text(json.dumps(record))
    report(tmp_path / "s", skip=("saliency",))
    assert asked == [("MineSweeperEasy", folder.analysis, "reference", {"mine_reward": -1.0})]


def test_a_mine_costs_what_the_options_say_and_a_damaged_file_is_made_anew(tmp_path: Path) -> None:
    mild = references("MineSweeperEasy", tmp_path, episodes=64)
    harsh = references("MineSweeperEasy", tmp_path, options={"mine_reward": -1}, episodes=64)
    assert harsh["random"].mean < mild["random"].mean - 0.2
    (file,) = tmp_path.iterdir()
    file.write_text(file.read_text()[:50])
    assert references("MineSweeperEasy", tmp_path, options={"mine_reward": -1}, episodes=64)[
        "random"
    ].mean == (harsh["random"].mean)


def test_references_of_a_game_that_was_changed_are_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def measure(game: str, player: str, episodes: int, **_: Any) -> Baseline:
        asked.append(player)
        return Baseline(game, player, episodes, 0.0, 0.0, 1.0, 0.0)

    monkeypatch.setattr(players, "measure", measure)
    for sha256 in ("a" * 64, "a" * 64, "b" * 64):
        references("SkittlesEasy", tmp_path, imports={"/home/me/mine.py": sha256})
    assert len(asked) == 2 * len(set(asked))


@given(
    st.lists(st.sampled_from(["pqn-lru", "ppo-lru", "mlp", "gru", "lstm", "dqn-lru"]), unique=True)
)
def test_no_two_agents_share_a_colour(names: list[str]) -> None:
    assert len(set(agent_colours(names).values())) == len(names)


@given(st.permutations(["pqn-gru", "pqn-mlp", "ppo-gru", "ppo-mlp", "dqn-gru", "dqn-mlp"]))
def test_an_agent_looks_the_same_in_every_figure(names: list[str]) -> None:
    """Before: curves, in the order of the grid, and Gap and Bias, memory-free agents first,
    exchanged the colours of two agents.
    """
    colours = agent_colours(names)
    assert list(colours) == names and colours == agent_colours(sorted(names))
    markers = agent_markers(names, colours)
    assert list(markers) == names and markers == agent_markers(sorted(names), colours)


def test_an_agent_whose_name_is_blank_has_a_colour_too() -> None:
    assert list(agent_colours([" ", "lru 2x512"])) == [" ", "lru 2x512"]
    assert agent_colours(["pqn-lru 2x512"])["pqn-lru 2x512"] == agent_colours(["lru"])["lru"]


def test_a_picture_in_a_page_has_ids_of_its_own_and_escapes_names() -> None:
    with drawing("light") as plt:
        figure, axis = plt.subplots()
        axis.plot([0, 1], [0, 1], label="<a&b>")
        axis.legend()
        text = svg(figure, 'a < "b"')
    checker = Checker()
    checker.feed(text)
    assert not checker.open and all(name.startswith("a-b-") for name in checker.ids)
    assert checker.wanted <= set(checker.ids) and "&lt;a&amp;b&gt;" in text
    assert not re.search(r"\d\.\d{5}", text)


def test_one_scale_serves_a_whole_row_and_few_frames_leave_places_empty() -> None:
    frames, maps = (
        np.zeros((2, 4, 4, 3), np.uint8),
        np.stack([np.full((4, 4), 2.0), np.full((4, 4), 1.0)]),
    )
    with drawing("light") as plt:
        _, axes = plt.subplots(1, 3)
        assert saliency.plot(frames, maps, axes, sigma_px=0.0) == 2.0
        heats = [axis.images[1].get_array() for axis in axes[1:]]
    assert [axis.get_title() for axis in axes] == ["", "$o_{n-1}$", "$o_{n}$"]
    assert not axes[0].images and heats[0].max() == 1.0 and heats[1].max() == np.sqrt(0.5)


def test_ticks_are_readable_on_a_telephone(page: str) -> None:
    """Of its 390 pixels a picture has 326. Before: letters of 9 pixels."""
    widths = [float(width) for width in re.findall(r'viewBox="0 0 ([\d.]+)', page)]
    assert widths and all(10 * 326 / width >= 11 for width in widths)


def test_a_panel_with_nothing_in_it_is_left_out(tmp_path: Path, no_oracles: None) -> None:
    """Before: Memory Bias of the memory-free agent alone was an empty picture."""
    write_study(tmp_path / "s", small_study(memories=["mlp"]))
    page = report(tmp_path / "s", skip=("saliency",)).read_text()
    assert "Observability Gap" in page and ">Memory Bias<" not in page


def test_the_study_of_somebody_else_has_its_page_elsewhere_and_is_left_as_it_is(
    tmp_path: Path, no_oracles: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_study(tmp_path / "s", small_study(subject="mingru"))
    before = {path: path.stat().st_mtime_ns for path in folder.root.rglob("*")}
    access = os.access
    monkeypatch.setattr(
        os,
        "access",
        lambda path, mode: not Path(path).is_relative_to(folder.root) and access(path, mode),
    )
    parts = ("saliency", "recall", "counterfactual", "beliefs", "contamination")
    page = report(folder.root, tmp_path / "page.html", skip=parts)
    assert "mingru" in page.read_text()
    assert {path: path.stat().st_mtime_ns for path in folder.root.rglob("*")} == before
    assert cli.main(["report", str(folder.root)]) == 2  # its own page cannot be written
