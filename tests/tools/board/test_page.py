"""The page of the leaderboard is what its entries give; ranks never mix."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools.board.check import CheckRecord, write_record
from arcade_torch.tools.board.entry import EntryRefusedError, entry_of
from arcade_torch.tools.board.page import BEGIN, END, board, read_entries, write_page
from arcade_torch.tools.board.protocol import QUICK, Suite, frames_class, suites
from arcade_torch.tools.board.ranking import Listed, has_suite, ranking, suite_iqm
from arcade_torch.tools.measures.gap_bias.measure import generator_of, normalise
from tests.tools.board.boards import GAME, fabricated_entry

ROOT = Path(__file__).resolve().parents[3]
QUICK_SUITE = Suite("quick", QUICK, "")


def listed(**changes: Any) -> Listed:
    return Listed("a.json", entry_of(fabricated_entry(**changes)), None)


def test_the_committed_page_is_what_the_entries_give() -> None:
    """Mend it with `arcade-torch leaderboard page`."""
    page = (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    assert page.partition(BEGIN)[2].partition(END)[0].strip() == board(ROOT / "results").strip()


def test_the_suites_are_ten_easy_games_ten_medium_ones_the_quick_and_a_group_for_each_kind() -> (
    None
):
    by_name = {suite.name: suite.games for suite in suites()}
    assert len(by_name["easy"]) == 10
    assert by_name["medium"] == tuple(game.replace("Easy", "Medium") for game in by_name["easy"])
    kinds = [games for name, games in by_name.items() if name not in ("easy", "medium", "quick")]
    assert sorted(sum(kinds, ())) == sorted(by_name["easy"]), "each game in one group"
    assert by_name["counting"] == ("CountRecallEasy-v0",)


def test_classes_end_where_they_say() -> None:
    edges = [1, 100_000, 100_001, 2_500_000, 2_500_001, 20_000_000, 20_000_001]
    names = ["100k", "100k", "2.5M", "2.5M", "20M", "20M", "open"]
    assert [frames_class(frames) for frames in edges] == names


def test_entries_are_ranked_by_their_pomdp_in_their_class_alone() -> None:
    def pomdp(value: float) -> Any:
        return lambda game, twin, seed: value if twin == "partial" else 1.0 - value

    entries = [
        listed(name="worse", games=QUICK, score=pomdp(0.2)),
        listed(name="better", games=QUICK, score=pomdp(0.3)),
        listed(name="longer", games=QUICK, score=pomdp(0.9), frames=2_500_000),
    ]
    rows = ranking(entries, QUICK_SUITE, "100k")
    assert [(row.rank, row.listed.entry.name) for row in rows] == [(1, "better"), (2, "worse")]
    assert [row.listed.entry.name for row in ranking(entries, QUICK_SUITE, "2.5M")] == ["longer"]
    assert not ranking(entries, QUICK_SUITE, "open")


def test_an_entry_that_lacks_a_game_has_no_rank_and_no_mean() -> None:
    entries = [
        listed(name="part", games=QUICK[:2], score=lambda *cell: 1.0),
        listed(name="whole", games=QUICK, score=lambda *cell: 0.1),
        listed(name="other", games=["TetrisEasy-v0"]),
    ]
    rows = ranking(entries, QUICK_SUITE, "100k")
    assert [(row.listed.entry.name, row.rank, row.games) for row in rows] == [
        ("whole", 1, 3),
        ("part", 0, 2),
    ]
    assert set(rows[0].means) == {"full", "partial"} and not rows[1].means


def test_entries_without_a_rank_are_listed_by_the_games_they_have() -> None:
    entries = [listed(name="a", games=QUICK[:1]), listed(name="b", games=QUICK[:2])]
    rows = ranking(entries, QUICK_SUITE, "100k")
    assert [(row.listed.entry.name, row.games) for row in rows] == [("b", 2), ("a", 1)]


def test_a_single_seed_has_no_interval_and_several_have_one() -> None:
    def score(game: str, twin: str, seed: int) -> float:
        return 0.1 * seed

    one = suite_iqm(listed(games=QUICK, score=score).cells, QUICK_SUITE, "partial")
    assert not one.exists
    three = listed(games=QUICK, seeds=(1, 2, 3), score=score).cells
    interval = suite_iqm(three, QUICK_SUITE, "partial", "a")
    assert interval.low < interval.value < interval.high
    assert suite_iqm(three, QUICK_SUITE, "partial", "a") == interval, "the same draws every time"


def test_mean_and_interval_are_those_of_rliable() -> None:
    """rliable 1.2.0: the same mean of the runs, and on the same resamples the same interval.

    The draws are ours: those of rliable come from a release of arch that numpy 2 does not load.
    """
    metrics = pytest.importorskip("rliable.metrics", reason="rliable is not installed")
    rng = np.random.default_rng(0)
    games = suites()[0].games
    returns = {game: rng.uniform(-1.0, 1.0, size=5) for game in games}
    cells = {(game, "partial"): list(values) for game, values in returns.items()}
    interval = suite_iqm(cells, suites()[0], "partial", "ours")
    matrix = np.stack([normalise(game, returns[game]) for game in games], axis=1)  # runs, tasks
    assert interval.value == pytest.approx(metrics.aggregate_iqm(matrix), abs=1e-12)

    drawn = []  # seeds within each task, as its StratifiedBootstrap draws them
    for game in games:
        picks = generator_of(0, "ours", game, "partial").integers(5, size=(2000, 5))
        drawn.append(normalise(game, returns[game])[picks])
    theirs = [metrics.aggregate_iqm(np.stack(runs, axis=1)) for runs in zip(*drawn, strict=True)]
    ends = np.quantile(theirs, [0.025, 0.975])
    assert (interval.low, interval.high) == pytest.approx(tuple(ends), abs=1e-12)


def write_board(folder: Path, **entries: dict[str, Any]) -> Path:
    """A folder of results with entries, and the tables that a page reads."""
    for part in ("baselines.csv", "small/easy.csv"):
        target = folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text((ROOT / "results" / part).read_text())
    for name, plain in entries.items():
        file = folder / "leaderboard" / f"{name}.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(plain))
    return folder


def test_the_page_says_what_was_checked_and_forgets_it_when_the_file_changes(
    tmp_path: Path,
) -> None:
    plain = fabricated_entry(games=QUICK)
    results = write_board(tmp_path, a=plain)
    assert "| not yet |" in board(results)
    file = results / "leaderboard" / "a.json"
    record = CheckRecord(
        entry_sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        date="2026-11-27",
        runs=4,
        of=6,
        equal=3,
        largest_difference=0.01,
        weights="retrained",
        made_with={},
    )
    write_record(file, record)
    text = "4 of 6 trained and evaluated again 2026-11-27, 3 equal to the bit, others within 0.0100"
    assert text in board(results)
    assert "Checked: 1 entries, 4 runs evaluated again." in board(results)
    file.write_text(json.dumps(plain | {"note": "another"}))
    assert "| not yet |" in board(results)


def test_every_entry_stands_in_the_table_of_its_class(tmp_path: Path) -> None:
    frames = {"100k": 98_304, "2.5M": 2_500_000, "20M": 20_000_000, "open": 40_000_000}
    entries = {}
    for place, name in enumerate(frames):
        entries[f"e{place}"] = fabricated_entry(f"of {name}", QUICK, frames=frames[name])
    text = board(write_board(tmp_path, **entries))
    for name in frames:
        for table in (f"### quick, class {name}\n", f"### {QUICK[0]}, class {name}\n"):
            assert text.count(table) == 1
            rows = text.partition(table)[2].partition("\n#")[0]
            assert [other for other in frames if f"of {other} |" in rows] == [name]


def test_the_page_is_written_between_its_marks(tmp_path: Path) -> None:
    results = write_board(tmp_path / "results", a=fabricated_entry(games=QUICK))
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_page(page, results)
    text = page.read_text()
    assert text.startswith("before") and text.endswith("after\n") and "old" not in text
    assert "## Reported, not checked" in text and "Entries: 1, with 6 runs." in text


def test_a_falsified_file_stops_the_page_and_two_of_one_name_do(tmp_path: Path) -> None:
    results = write_board(tmp_path, a=fabricated_entry(), b=fabricated_entry())
    with pytest.raises(EntryRefusedError, match="are both 'LRU'"):
        read_entries(results / "leaderboard")
    plain = fabricated_entry(name="other")
    del plain["runs"][0]
    (results / "leaderboard" / "b.json").write_text(json.dumps(plain))
    with pytest.raises(EntryRefusedError, match=f"missing cell: {GAME} full, seed 1"):
        board(results)


def test_a_rank_takes_both_twins_and_an_interval_several_seeds_of_every_game() -> None:
    suite = QUICK_SUITE
    cells = {(game, twin): [0.1, 0.9] for game in suite.games for twin in ("full", "partial")}
    assert has_suite(cells, suite) and suite_iqm(cells, suite, "partial").exists
    single = cells | {(suite.games[0], "partial"): [0.5]}
    assert not suite_iqm(single, suite, "partial").exists
    for twin in ("full", "partial"):
        lacking = dict(cells)
        del lacking[suite.games[0], twin]
        assert not has_suite(lacking, suite)
