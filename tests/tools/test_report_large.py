"""The report of a large study, and what it shows of the inside of agents."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from arcade_torch.agents import preset, train
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, report, reports
from arcade_torch.tools.comparable import Runs
from arcade_torch.tools.figures.style import drawing
from arcade_torch.tools.measures import section
from arcade_torch.tools.measures.checkpoints import Label
from arcade_torch.tools.measures.contamination import figure as contamination
from arcade_torch.tools.measures.contamination.measure import Contamination
from arcade_torch.tools.measures.recall_density import figure as recall_density
from arcade_torch.tools.measures.recall_density.measure import RecallDensity
from arcade_torch.tools.names import AgentKey
from arcade_torch.tools.reports.panels import representatives, select_cells
from arcade_torch.tools.runs import open_run
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from tests.tools.fabricated import write_run
from tests.tools.test_report import LEVELS, Checker

GAMES = (
    "CartPoleEasy-v0",
    "MineSweeperEasy-v0",
    "SkittlesEasy-v0",
    "TetrisEasy-v0",
    "NavigatorEasy-v0",
)
SCORES = {"mlp": 0.2, "lru": 0.5, "gru": 0.4}


def large_study(
    root: Path, games: tuple[str, ...] = GAMES, seeds: int = 2
) -> tuple[StudyFolder, Study]:
    """Finished runs of three agents; the agents with memory are further ahead on later games."""
    study = Study.from_dict(
        {
            "name": "large",
            "games": list(games),
            "memories": list(SCORES),
            "seeds": list(range(seeds)),
        }
    )
    folder = StudyFolder(root)
    folder.claim(study, "arcade-torch study large.toml")
    for run in study.runs():
        ahead = SCORES[run.memory] * (0.5 + 0.1 * games.index(run.game))
        write_run(
            folder.run(run).path,
            run,
            ahead + 0.01 * run.seed - 0.1 * (run.observability == "partial"),
        )
    return folder, study


def check(page: str) -> Checker:
    """The page is well formed, loads nothing, and every link has a place."""
    checker = Checker()
    checker.feed(page)
    assert not checker.open and checker.wanted <= set(checker.ids)
    return checker


def test_many_runs_become_small_multiples_and_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reports, "references", lambda *words, imports: LEVELS)
    folder, _ = large_study(tmp_path / "s")
    skip = ("saliency", "recall", "counterfactual", "beliefs", "contamination")
    page = report(folder.root, skip=skip).read_text()
    assert len(page) < 400_000
    count = check(page).count
    assert count["svg"] == 2 * len(GAMES) + 4  # no training curves, which would double it
    assert "60 runs</summary>" in page and "study.json" in page
    assert page.count("arcade-torch train") == 1
    assert 'class="heat best" style="--v:' in page and 'href="#curve-TetrisEasy-v0-partial"' in page
    mines = page.partition('href="#curve-MineSweeperEasy-v0-full">')[2].partition("</tr>")[0]
    heats = re.findall(r'--v:(\d+)">(-?[\d.]+)<', mines)
    assert len(heats) == 3 and all(
        abs(int(heat) - 50 * (float(value) + 1)) <= 1 for heat, value in heats
    )
    first = page.index("Partial observability costs the memory-free agent")
    assert "and lru 0.07" in page[first : first + 200] and "The same for every other agent" in page


def looked_into(
    folder: StudyFolder, study: Study, subject: str = ""
) -> tuple[Mapping[tuple[str, str, str], Sequence[Path]], str]:
    """The cells that a report looks into, and its note; every run has a checkpoint, but for the
    fourth seed of agents with memory.
    """
    for run in study.runs():
        if run.seed < 3 or run.memory == "mlp":
            (folder.run(run).path / "checkpoints").mkdir()
    runs = Runs(
        tuple(run for spec in study.runs() if (run := open_run(folder.run(spec).path)) is not None)
    )
    finals: dict[tuple[str, str], dict[str, list[float]]] = {}
    for (agent, game, twin), group in runs.groups().items():
        finals.setdefault((game, twin), {})[agent] = [run.value("eval_final") for run in group]
    return select_cells(runs, finals, study.baseline, subject)


@pytest.mark.parametrize("seeds", [3, 4])
def test_of_twelve_cells_none_is_left_out(seeds: int, tmp_path: Path) -> None:
    cells, note = looked_into(*large_study(tmp_path / "s", GAMES[:2], seeds))
    assert len(cells) == 12 and all(len(paths) == 3 for paths in cells.values())
    assert (
        note
        == {
            3: "",
            4: "8 runs without a checkpoint cannot be looked into. "
            "Shown: the first 3 of 4 seeds of each agent.",
        }[seeds]
    )


def test_where_all_agents_and_games_are_looked_into_nothing_is_said(tmp_path: Path) -> None:
    cells, note = looked_into(*large_study(tmp_path / "s", GAMES[:3]), subject="gru")
    assert len(cells) == 18 and not note


def test_a_large_study_is_looked_into_where_memory_is_furthest_ahead(tmp_path: Path) -> None:
    cells, note = looked_into(*large_study(tmp_path / "s", seeds=4))
    assert {agent for agent, _, _ in cells} == {"mlp", "lru"}
    assert {game for _, game, _ in cells} == {
        "SkittlesEasy-v0",
        "CartPoleEasy-v0",
        "NavigatorEasy-v0",
    }
    assert all(len(paths) == 3 for paths in cells.values())
    assert (
        "Shown: mlp and lru on" in note
        and "out of 3 agents and 5 games" in note
        and "first 3 of 4 seeds" in note
    )


def test_representatives_without_a_control_are_the_best_agent() -> None:
    finals = {
        ("A", "full"): {"lru": [0.1], "gru": [0.4]},
        ("B", "full"): {"lru": [0.2], "gru": [0.3]},
    }
    assert representatives(finals, "mlp") == (["gru"], ["A", "B"])
    both = {
        ("A", "partial"): {"pqn-mlp": [0.3], "pqn-lru": [0.1]},
        ("B", "partial"): {"pqn-mlp": [0.3], "pqn-lru": [0.9]},
    }
    assert representatives(both, "mlp") == (["pqn-mlp", "pqn-lru"], ["B", "A"])
    assert representatives(both, "mlp", "pqn-lru") == (["pqn-mlp", "pqn-lru"], ["B", "A"])
    assert representatives(both, "mlp", "pqn-mlp") == (["pqn-lru", "pqn-mlp"], ["A", "B"])


def test_columns_of_the_page_are_those_steps_that_their_headings_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    delays, flip = (
        np.array(contamination.NOISE["delays"]),
        np.tile([1.0, 0.5, 0.25, 0.0, 0.0, np.nan], (4, 1, 1)),
    )
    found = Contamination(
        np.array([0.3]), delays, flip, flip, flip * np.nan, np.zeros((4, 2), np.int64), 0.0, 0, "q"
    )
    label = Label(AgentKey("pqn", "lru"), GAMES[0], "full", 0, Path("run"), "lru")
    monkeypatch.setattr(section, "measure_run", lambda *words: (label, found))
    dense = RecallDensity(
        np.array([0.1, 0.2, 0.3, 0.4]), np.array([4]), np.array([True]), 0, 0, "q",
        np.ones(1), np.ones(1),
    )  # fmt: skip
    with drawing("light"):
        (row,) = contamination.contamination_section({label.task: [label.path]}, ["lru"], None)[
            "rows"
        ]
        monkeypatch.setattr(section, "measure_run", lambda *words: (label, dense))
        (past,) = recall_density.recall_section({label.task: [label.path]}, ["lru"], None)["rows"]
    assert (row["at_once"], row["one"], row["later"]) == (1, 0.5, 0.1875) and (
        row["seeds"],
        row["points"],
    ) == (1, 4)
    assert [past[name] for name in ("older", "first", "last")] == pytest.approx([0.3, 0.1, 0.4])


def test_runs_without_checkpoints_are_left_out_and_counted(tmp_path: Path) -> None:
    folder, _ = large_study(tmp_path / "s", games=GAMES[:1], seeds=1)
    page = report(folder.root, skip=("references",)).read_text()
    assert "6 runs without a checkpoint cannot be looked into" in page
    check(page)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two tiny real runs on the POMDP of SignpostEasy."""
    root = tmp_path_factory.mktemp("real") / "s"
    study = Study.from_dict(
        {
            "name": "real",
            "games": ["SignpostEasy"],
            "observability": ["partial"],
            "memories": ["lru", "mlp"],
            "seeds": [0],
            "preset": "smoke",
        }
    )
    folder = StudyFolder(root)
    folder.claim(study, "arcade-torch study real.toml")
    for run in study.runs():
        config = preset("smoke", env=run.game, observability="partial", memory=run.memory)
        train(config, folder.run(run).path)
    return root


def test_recall_and_contamination_stand_on_the_page_and_are_made_once(
    trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, int, int]] = []
    page = report(
        trained, skip=("saliency", "references"), progress=lambda *step: told.append(step)
    ).read_text()
    check(page)
    assert ("recall density, mlp on SignpostEasy-v0", 16, 16) in told
    assert (
        "contamination, lru on SignpostEasy-v0",
        contamination.NOISE["starts"],
        contamination.NOISE["starts"],
    ) in told
    assert ("counterfactual recall, lru on SignpostEasy-v0", 16, 16) in told
    recall = page[page.index('id="recall"') : page.index('id="counterfactual"')]
    rows = [row.split("<td>")[1:] for row in recall.split("<tr>")[2:]]
    assert rows[1][3].startswith("100.0 %") and rows[1][4].startswith(
        "0.0 %"
    )  # no memory: all on the last frame
    assert not rows[0][3].startswith("100.0 %")
    noise = page[page.index('id="contamination"') : page.index('id="repeat"')]
    free = [row.split("<td>")[1:] for row in noise.split("<tr>")[2:]][1]
    assert free[3].startswith("0.0 %") and free[4].startswith("0.0 %")
    exchanges = page[page.index('id="counterfactual"') : page.index('id="beliefs"')]
    free = [row.split("<td>")[1:] for row in exchanges.split("<tr>")[2:]][1]
    assert free[2].startswith("0.00")  # no memory: no reliance on it
    assert ("beliefs, lru on SignpostEasy-v0", 64, 64) in told
    probes = page[page.index('id="beliefs"') : page.index('id="contamination"')]
    held, nothing = probes.split("<tr>")[2:]
    assert "sign" in held and "no state" not in held
    assert "no state" in nothing  # no memory
    told.clear()
    report(trained, skip=("saliency", "references"), progress=lambda *step: told.append(step))
    assert told == []  # kept in the run folders


def test_each_analysis_can_be_skipped_from_the_command_line(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ask = [
        "report",
        str(trained),
        "--out",
        str(tmp_path / "r.html"),
        "--skip",
        "saliency",
        "references",
    ]
    assert cli.main([*ask, "recall"]) == cli.EXIT_OK
    page = (tmp_path / "r.html").read_text()
    assert (
        'id="contamination"' in page and 'id="recall"' not in page and 'id="saliency"' not in page
    )
    assert 'id="counterfactual"' in page and 'id="beliefs"' in page
    assert cli.main([*ask, "contamination", "counterfactual", "beliefs"]) == cli.EXIT_OK
    page = (tmp_path / "r.html").read_text()
    assert 'id="contamination"' not in page and 'id="recall"' in page
    assert 'id="counterfactual"' not in page and 'id="beliefs"' not in page
    assert not (tmp_path / "analysis").exists() and read_csv(trained / "results.csv")
