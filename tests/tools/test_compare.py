"""``arcade-torch compare``: a study that fits into some minutes, and a report about its subject."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from arcade_torch.models import register_memory
from arcade_torch.models.lru import LRU
from arcade_torch.tools import cli, gap_and_bias, report, reports
from arcade_torch.tools.commands import compare
from arcade_torch.tools.figures.style import AGENT_COLOURS, agent_colours
from arcade_torch.tools.measures.gap_bias.pairs import pairs
from arcade_torch.tools.runs import Score
from arcade_torch.tools.studies.budget import (
    REPORT_S,
    START_S,
    Budget,
    Size,
    Speed,
    measure_speed,
)
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from tests.tools.fabricated import write_study
from tests.tools.test_cli import one_error
from tests.tools.test_report import LEVELS

SPEED = Speed(frames_per_s=2500, start_s=8, report_s=3.5)
GAMES = compare.GAMES


class Yours(LRU):
    """A model of somebody's."""


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Study]:
    """The studies that ``compare`` would train, at a speed that is not measured."""
    studies = list[Study]()

    def carry_out(self: Any, definition: Study, out: Path, *rest: Any, **options: Any) -> int:
        StudyFolder(out).claim(definition)
        studies.append(definition)
        return 0

    register_memory("yours", Yours)
    monkeypatch.setattr(compare.Compare, "carry_out", carry_out)
    monkeypatch.setattr(compare, "measure_speed", lambda study: SPEED)
    monkeypatch.setattr(compare, "available_cores", lambda: [0, 1])
    return studies


def test_what_fits_into_the_minutes_takes_no_longer_and_is_not_much_shorter() -> None:
    budget = Budget(agents=3, workers=2, speed=SPEED)
    for minutes in (5, 10, 20, 60, 240):
        size = budget.fit(GAMES, minutes)
        longest = budget.minutes(len(size.games), size.seeds, size.frames + 1000)
        assert budget.minutes(len(size.games), size.seeds, size.frames) <= minutes < longest
    assert budget.fit(GAMES, 20).games == GAMES
    assert budget.fit(GAMES, 240).seeds == 5


def test_games_and_seeds_are_left_out_before_runs_become_too_short() -> None:
    budget = Budget(agents=3, workers=2, speed=SPEED)
    assert budget.fit(GAMES, 10) == Size(GAMES[:2], 2, 78_000)
    assert budget.fit(GAMES, 5).games == GAMES[:1]
    assert budget.fit(GAMES, 1) == Size(GAMES[:1], 2, 20_000)  # the least, which takes longer
    assert budget.minutes(1, 2, 20_000) > 1
    assert budget.fit(GAMES, 1, all_games=True).games == GAMES
    assert budget.fit(GAMES, 10, seeds=4).seeds == 4
    assert budget.fit(GAMES, 10, frames=100_000).frames == 100_000
    assert Budget(3, 64, SPEED).fit(GAMES, 10).frames >= 250_000


def test_a_study_lasts_until_the_worker_with_the_most_runs_is_done() -> None:
    one_round = Budget(3, 6, SPEED).minutes(games=1, seeds=1, frames=60_000)
    for workers, rounds in ((64, 1), (5, 2), (4, 2), (2, 3), (1, 6)):
        minutes = Budget(3, workers, SPEED).minutes(games=1, seeds=1, frames=60_000)
        assert minutes == pytest.approx(rounds * one_round)


def test_a_study_is_as_large_as_what_just_fits_and_never_longer_than_the_preset() -> None:
    budget = Budget(agents=3, workers=2, speed=SPEED)
    assert budget.fit(GAMES, 10, frames=78_000) == Size(GAMES[:2], 2, 78_000)
    assert budget.fit(GAMES[:1], 240).seeds == 5  # one game is no reason for fewest seeds
    assert budget.fit(GAMES, 100_000) == Size(GAMES, 5, 2_500_000)


def test_the_speed_is_that_of_all_memories_and_a_busy_machine_starts_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a clock that the trainer moves; the process has a core half of the time."""
    clock_s = [0.0]
    frames_per_s = {"gru": 1_000, "mlp": 4_000}

    class Timed:
        def __init__(self, config: Any) -> None:
            self.config = config
            clock_s[0] += 1.0

        def update(self) -> None:
            frames = self.config.learner.frames_per_update
            clock_s[0] += frames / frames_per_s[self.config.memory]

        def warm_up(self) -> None:
            pass

        def close(self) -> None:
            pass

    clocks = SimpleNamespace(perf_counter=lambda: clock_s[0], process_time=lambda: clock_s[0] / 2)
    monkeypatch.setattr("arcade_torch.agents.trainer.Trainer", Timed)
    monkeypatch.setattr("arcade_torch.tools.studies.budget.time", clocks)
    study = Study("speed", GAMES, ("gru", "mlp"), (0,), preset="smoke")
    frames = study.config(study.runs()[0]).learner.frames_per_update
    speed = measure_speed(study)
    assert speed.frames_per_s == pytest.approx(2 / (1 / 1_000 + 1 / 4_000))
    assert speed.start_s == pytest.approx(2 * START_S + 1.0 + frames / 4_000)
    assert speed.report_s == pytest.approx(2 * REPORT_S)


def test_the_study_is_about_the_memory_and_says_what_is_left_out(
    started: list[Study], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", "--against", "lru", "none", "--out", str(tmp_path / "c")]
    assert cli.main(words) == cli.EXIT_OK
    (study,) = started
    assert study.memories == ("yours", "lru", "mlp")  # the only one that is registered
    assert study.subject == "yours"
    assert study.games == GAMES[:2]
    assert "yours" in study.question and "mlp" in study.question
    out = capsys.readouterr().out
    assert "left out for want of time: CountRecallEasy" in out
    assert "yours against lru, mlp on SignpostEasy, MineSweeperEasy" in out


def test_the_same_command_goes_on_with_the_same_study(
    started: list[Study], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A speed that is measured again is another one, and would be another study."""
    words = ["compare", "--memory", "yours", "--out", str(tmp_path / "c")]
    assert cli.main(words) == cli.EXIT_OK
    monkeypatch.setattr(compare, "measure_speed", lambda study: pytest.fail("measured again"))
    assert cli.main(words) == cli.EXIT_OK
    assert started[0] == started[1]


def test_a_folder_with_another_comparison_is_refused(
    started: list[Study], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", "--memory", "yours", "--out", str(tmp_path / "c")]
    assert cli.main(words) == cli.EXIT_OK
    assert cli.main([*words, "--frames", "5000"]) == cli.EXIT_BAD_INPUT
    assert "choose another --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--memory", "nobody"], "unknown memory 'nobody'"),
        (["--memory", "yours", "--against", "yours"], "memories names something twice"),
        (["--memory", "yours", "--minutes", "0"], "--minutes must be at least 1"),
        (["--memory", "yours", "--seeds", "0"], "--seeds must be at least 1"),
        (["--memory", "yours", "--frames", "0"], "--frames must be at least 1"),
        (["--memory", "yours", "--games", "NoGame"], "unknown env id 'NoGame'"),
    ],
)
def test_what_cannot_be_compared_is_one_line(
    started: list[Study],
    tmp_path: Path,
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert message in one_error(capsys, ["compare", *words, "--out", str(tmp_path / "c")])
    assert not started


def test_without_a_memory_of_the_user_one_has_to_be_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = one_error(capsys, ["compare"])
    assert "--memory must be named unless --import registers just one; got 'none'" in said


def scores(**returns: list[float]) -> list[Score]:
    """Scores of agents on both twins of one game, a tenth lower on the MDP."""
    table = []
    for agent, values in returns.items():
        for seed, value in enumerate(values):
            table.append(Score(agent, "CartPoleEasy", "partial", seed, value))
            table.append(Score(agent, "CartPoleEasy", "full", seed, value - 0.1))
    return table


def test_a_difference_is_that_of_gap_and_bias_with_the_same_draws() -> None:
    returns = scores(yours=[0.8, 0.7, 0.9], lru=[0.5, 0.6, 0.4], mlp=[0.8, 0.6, 0.9])
    table = gap_and_bias(returns)
    rows = pairs(returns, "yours")
    for other in ("lru", "mlp"):
        means = {row.twin: row for row in rows if not row.game and row.other == other}
        assert means["partial"].difference == pytest.approx(
            table.difference("pomdp", "yours", other)
        )
        assert means["full"].difference == pytest.approx(table.difference("mdp", "yours", other))
        assert means[""].subject_return == pytest.approx(0.75)
    (task,) = [row for row in rows if row[:3] == ("CartPoleEasy", "partial", "lru")]
    assert task.difference.value == pytest.approx(0.3) and task.difference.excludes_zero


def test_a_single_seed_gives_a_difference_without_an_interval() -> None:
    row = pairs(scores(yours=[0.8], lru=[0.5]), "yours")[0]
    assert row.difference.value == pytest.approx(0.3) and not row.difference.exists


def test_games_that_are_signed_are_normalised() -> None:
    table = [Score("yours", "TetrisEasy", "full", 0, 1.0), Score("lru", "TetrisEasy", "full", 0, 0)]
    assert pairs(table, "yours")[0].difference.value == 0.5


def not_folded(page: str) -> str:
    """What a page shows before anything is opened."""
    for _ in range(3):
        page = re.sub(r"<details>(?:(?!<details>).)*?</details>", "", page, flags=re.DOTALL)
    return page


SUBJECT = {
    "name": "toy",
    "games": ["MineSweeperEasy"],
    "memories": ["gru", "mingru", "mlp"],
    "seeds": 3,
    "preset": "smoke",
    "total_frames": 2048,
    "subject": "gru",
}
FINAL = {"gru": 0.2, "mingru": 0.6, "mlp": 0.5}


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A study whose subject is the weakest of three agents."""
    monkeypatch.setattr(reports, "references", lambda *words, imports: LEVELS)
    finals = {(twin, name): value for name, value in FINAL.items() for twin in ("full", "partial")}
    monkeypatch.setattr("tests.tools.fabricated.FINAL", finals)
    write_study(tmp_path / "s", Study.from_dict(SUBJECT))
    return tmp_path / "s"


def test_the_subject_is_the_headline_and_in_no_closed_fold(root: Path) -> None:
    """Before: the headline was of the best memory, and that of the user's was folded away."""
    page = not_folded(report(root, skip=("saliency",)).read_text())
    headline = page[page.index('class="found"') : page.index("</section>")]
    assert re.search(r"On the POMDP gru reaches .* and mingru 0.\d\d: behind by -0", headline)
    assert "On the POMDP gru reaches a normalised return of 0.60, the memory-free" in headline
    assert "costs the memory-free agent 0.00 of normalised return and gru" in headline
    assert "and mingru 0.00" not in headline
    assert "and mlp 0." not in headline  # gap and bias are held against it already
    assert "gru against the others" in page and "minus mingru" in page


def test_costs_and_differences_stand_on_the_page(root: Path) -> None:
    page = report(root, skip=("saliency",)).read_text()
    section = page[page.index('id="subject"') : page.index('id="learning"')]
    assert section.count("<tr") == 1 + 3 + 1 + 3  # heads, tasks and mean, heads, agents
    assert "in the memory" in section and ">512<" in section  # bytes: 128 numbers of GRU
    rows = np.genfromtxt(
        root / "analysis/differences_eval_final.csv", delimiter=",", names=True, dtype=None
    )
    assert len(rows) == 2 * 5


def test_the_option_takes_the_place_of_the_studys(root: Path) -> None:
    page = report(root, skip=("saliency",), subject="mingru").read_text()
    assert "mingru against the others" in page and "gru against the others</h2>" in page
    assert "<h2>gru against" not in page
    with pytest.raises(ValueError, match=r"subject 'lru' is none of the agents .* gru, mingru"):
        report(root, skip=("saliency",), subject="lru")


def test_a_subject_that_is_not_trained_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(
        'games = ["SignpostEasy"]\nmemories = ["lru"]\nseeds = 1\nsubject = "gru"\npreset = "smoke"'
    )
    with pytest.raises(ValueError, match=r"subject = 'gru' is none of the agents .* lru"):
        Study.load(file)


def test_a_study_whose_subject_has_not_finished_has_a_report(root: Path) -> None:
    for file in root.glob("runs/*__gru__*/eval.json"):
        file.unlink()
    assert "against the others" not in report(root, skip=("saliency",)).read_text()


def test_known_memories_keep_their_colours_whoever_stands_before_them() -> None:
    """Before: a memory of the user's took the blue of LRU."""
    colours = agent_colours(["yours", "theirs", "lru", "mlp"])
    assert colours["lru"] == AGENT_COLOURS["lru"] and colours["mlp"] == AGENT_COLOURS["mlp"]
    assert len(set(colours.values())) == 4


def test_many_others_have_one_column_each(root: Path) -> None:
    """Before: the table was cut off at 1,280 pixels."""
    study = Study.from_dict(SUBJECT | {"algorithms": ["pqn", "ppo"], "subject": "pqn-gru"})
    write_study(root.with_name("wide"), study)
    page = report(root.with_name("wide"), skip=("saliency",)).read_text()
    section = page[page.index('id="subject"') : page.index("What it costs")]
    assert len(re.findall("<th[ >]", section)) == 2 + 5
