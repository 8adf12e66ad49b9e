"""The report: sentences that say no more than the numbers, charts, and one page that loads nothing."""

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.tools import gap_and_bias, report
from arcade_torch.tools.analysis.curves import learning_curves
from arcade_torch.tools.analysis.images import afmhot, overlay, png, scaled, smooth
from arcade_torch.tools.analysis.scores import Score
from arcade_torch.tools.reports import build, words
from arcade_torch.tools.reports.charts import Level, Line, Whisker, line_chart, spread, ticks, whisker_chart
from tests.tools.fabricated import small_study, write_run, write_study

LEVELS = {"random": {"mean": -0.02, "std": 0.2, "n": 256}, "state": {"mean": 1.0, "std": 0.0, "n": 256}}


@pytest.fixture
def no_oracles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "cached_references", lambda game, folder, rules: LEVELS)


@pytest.fixture
def page(tmp_path: Path, no_oracles: None) -> str:
    write_study(tmp_path / "s", small_study(question="Is 1 < 2 & true?"))
    return report(tmp_path / "s", saliency=False).read_text()


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
            assert name not in ("src", "href") or str(value).startswith(("data:", "#")), f"{tag} loads {value}"
            if name == "id":
                assert value not in self.ids
                self.ids.append(str(value))
            if name == "href" and str(value).startswith("#"):
                self.wanted.add(str(value)[1:])
        if tag not in ("meta", "br", "img", "path", "circle"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("path", "circle"):
            assert self.open.pop() == tag


def test_the_page_is_well_formed_and_loads_nothing(page: str) -> None:
    checker = Checker()
    checker.feed(page)
    assert not checker.open
    assert checker.wanted <= set(checker.ids)
    assert checker.count["svg"] == 8  # greedy and training curves of two twins, four panels of gap and bias
    assert not re.search(r"https?://|@import|url\(", page)


def test_the_page_says_what_was_asked_and_how_to_repeat_it(page: str) -> None:
    assert "Is 1 &lt; 2 &amp; true?" in page
    for run in small_study().runs():
        assert f"--memory {run.memory} --algorithm pqn --seed {run.seed}" in page
    assert "arcade-torch demo" in page and "arcade-torch report" in page
    assert "torchrl" in page and "pqn.gamma" in page


def test_reference_lines_and_intervals_are_on_the_page(page: str) -> None:
    assert ">random</text>" in page and ">oracle</text>" in page
    assert 'class="band c0"' in page and 'class="whisker c1"' in page
    assert "memory narrows the observability gap by 0.05" in page


def test_an_unfinished_study_is_reported_as_such(tmp_path: Path, no_oracles: None) -> None:
    what = small_study()
    folder = write_study(tmp_path / "s", what)
    run = what.runs()[0]
    (folder.run(run).path / "eval.json").unlink()
    write_run(folder.run(run).path, run, 0.5, status="interrupted")
    assert "1 of 8 runs have not finished" in report(tmp_path / "s", saliency=False).read_text()


def test_a_study_without_the_control_still_has_a_page(tmp_path: Path, no_oracles: None) -> None:
    write_study(tmp_path / "s", small_study(memories=["mingru"]))
    assert "no scores for the memory-free agent" in report(tmp_path / "s", saliency=False).read_text()


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
            made += [Score(agent, "CartPoleEasy", twin, seed, v) for twin, v in (("full", 0.9), ("partial", value))]
    return gap_and_bias(made, draws=500)


def test_the_headline_claims_only_what_the_interval_allows() -> None:
    clear = words.gap_sentence(table([0.1, 0.12, 0.11], [0.8, 0.82, 0.81]), "lru")
    assert ": over these three seeds memory narrows the observability gap by 0.70" in clear
    many = words.gap_sentence(table([0.1, 0.12, 0.11] * 2, [0.8, 0.82, 0.81] * 2), "lru")
    assert ": memory narrows the observability gap by 0.70" in many
    worse = words.gap_sentence(table([0.8, 0.82, 0.81], [0.1, 0.12, 0.11]), "lru")
    assert "memory widens the observability gap by 0.70" in worse
    vague = words.gap_sentence(table([0.1, 0.9, 0.5], [0.2, 0.9, 0.6]), "lru")
    assert "contains zero, so three seeds do not settle it" in vague
    single = words.gap_sentence(table([0.1], [0.9]), "lru")
    assert "single seed" in single and "narrows" not in single


def test_few_seeds_come_with_a_caution() -> None:
    assert "With two seeds" in words.coverage_sentence(table([0.1, 0.2], [0.3, 0.4]))
    assert "no intervals" in words.coverage_sentence(table([0.1], [0.3]))


def test_the_way_from_random_to_oracle_is_a_share() -> None:
    said = words.learning_sentence("X", "partial", {"mlp": [0.0, 0.5]}, {"random": 0.0, "state": 1.0})
    assert "mlp 25 %" in said and "a seed of mlp did not get above random" in said
    assert words.learning_sentence("X", "full", {"mlp": [0.1]}, {}) == ""


def test_curves_are_means_over_seeds_with_their_interval(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study())
    for curve in learning_curves(folder, small_study()):
        assert curve.seeds.shape == (2, 5)
        np.testing.assert_allclose(curve.mean, curve.seeds.mean(0))
        assert (curve.low <= curve.mean).all() and (curve.mean <= curve.high).all()


@given(st.lists(st.floats(0, 300), min_size=1, max_size=8))
def test_labels_never_overlap_and_stay_inside(wanted: list[float]) -> None:
    placed = spread(wanted, 14.0, 0.0, 300.0)
    assert all(b - a >= 14 - 1e-6 for a, b in zip(sorted(placed), sorted(placed)[1:], strict=False))
    assert min(placed) >= -1e-6 and max(placed) <= 300 + 1e-6


@given(low=st.floats(-100, 100), width=st.floats(1e-3, 1e3))
def test_ticks_are_round_inside_the_range_and_neither_few_nor_many(low: float, width: float) -> None:
    found = ticks(low, low + width)
    assert 2 <= len(found) <= 12
    assert all(low - 1e-6 * width <= value <= low + width * (1 + 1e-6) for value in found)


def test_charts_are_valid_xml_even_with_awkward_names() -> None:
    x, nan = np.array([0.0, 1e6]), np.full(2, np.nan)
    line = Line("<a&b>", "c1", x, x / 1e6, nan, nan, np.array([x / 1e6]))
    ElementTree.fromstring(line_chart("a < b", [line], [Level("random", 0.1)], (0.0, 1.0)))
    ElementTree.fromstring(whisker_chart("t", [Whisker("<x>", "c0", 0.1, np.nan, np.nan)], (-1.0, 1.0), True))


@given(sigma=st.floats(0, 4))
def test_smoothing_keeps_the_sum_and_the_place(sigma: float) -> None:
    point = np.zeros((2, 21, 21))
    point[0, 10, 10], point[1, 0, 0] = 1.0, 2.0
    soft = smooth(point, sigma)
    np.testing.assert_allclose(soft.sum((1, 2)), [1.0, 2.0])
    assert np.unravel_index(soft[0].argmax(), (21, 21)) == (10, 10)


def test_the_heat_colours_run_from_black_over_red_and_yellow_to_white() -> None:
    np.testing.assert_allclose(afmhot(np.array([0.0, 0.5, 1.0])), [[0, 0, 0], [1, 0.5, 0], [1, 1, 1]])


def test_one_scale_serves_a_whole_row() -> None:
    heat, peak = scaled(np.stack([np.full((4, 4), 2.0), np.full((4, 4), 1.0)]), 0.0)
    assert peak == 2.0 and heat[0].max() == 1.0 and heat[1].max() == np.sqrt(0.5)
    dark = overlay(np.full((1, 2, 2, 3), 200, np.uint8), np.zeros((1, 2, 2)))
    assert (dark == 100).all()


def test_pictures_are_readable_png_files(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    (tmp_path / "x.png").write_bytes(png(image))
    np.testing.assert_array_equal(np.rint(255 * imread(tmp_path / "x.png")[..., :3]).astype(np.uint8), image)
    with pytest.raises(ValueError, match="uint8"):
        png(image.astype(np.float32))
