"""Pages and figures: whatever a study is called and holds, the HTML has no element that a name
brought in.
"""

import json
import random
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given

from arcade_torch.tools.bench.registry import compare, page, read_results
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures import Part
from arcade_torch.tools.figures.catalogue import make_figure
from arcade_torch.tools.measures.gap_bias import ScoreOptions
from arcade_torch.tools.reports import report
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from tests.fuzz.contract import attempt, content, fuzz
from tests.fuzz.hostile import NAMES, json_bytes, mutated, mutated_value, seeds
from tests.fuzz.test_runs import _repair, _rewrite_json
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_bench_registry import RESULTS

pytestmark = pytest.mark.slow

EVIL = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</script><script>alert(1)</script>",
    "</style><b>alert(1)",
    "<!-- alert(1)",
    "]]>alert(1)",
    "javascript:alert(1)",
    "&lt;script&gt;alert(1)",
    "{{ alert(1) }}{% raw %}",
    "<svg onload=alert(1)>",
    "\u2028<iframe srcdoc=alert(1)>",
)


PARTS = get_args(Part)
"""All that a report would compute: made-up runs have no agents."""


class Reader(HTMLParser):
    """Counts elements, and looks for what only an injection would bring."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.raw = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        for name, value in attrs:
            assert not name.startswith("on"), (tag, name, value)
            assert name != "srcdoc" and not (value or "").strip().lower().startswith(
                "javascript:"
            ), (tag, name, value)
        self.raw = tag

    def handle_data(self, data: str) -> None:
        assert self.raw not in ("script", "style") or "alert(1)" not in data, data
        if self.raw in ("script", "style"):
            self.raw = ""

    def handle_comment(self, data: str) -> None:
        assert "alert(1)" not in data


def read(file: Path) -> Counter[str]:
    reader = Reader()
    reader.feed(file.read_text(encoding="utf-8"))
    reader.close()
    return reader.tags


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyFolder:
    return write_study(tmp_path_factory.mktemp("page"), small_study(question="Why?"))


def _poison(study: StudyFolder, rng: random.Random) -> None:
    """Hostile words wherever a study holds words."""
    file = study.root / "study.json"
    values = json.loads(file.read_text())
    values["study"]["question"] = rng.choice(EVIL)
    for key in rng.sample(("command", "versions", "also", "runs"), 2):
        evil = rng.choice(EVIL)
        values[key] = (
            evil
            if key == "command"
            else [{evil: evil}]
            if key == "also"
            else {evil: rng.choice(EVIL)}
        )
    file.write_text(json.dumps(values))
    for run in small_study().runs():
        config = study.run(run).path / "config.json"
        values = json.loads(config.read_text())
        for key in rng.sample(("memory", "env", "device", "network", "note"), 2):
            values["config"][key] = rng.choice(EVIL)
        values["config"][rng.choice(EVIL)] = rng.choice(EVIL)
        values["versions"] = {rng.choice(EVIL): rng.choice(EVIL)}
        config.write_text(json.dumps(values))
    last = small_study().runs()[-1]
    (study.run(last).path / "eval.json").unlink()
    study.note_failure(last, rng.choice(EVIL))


@fuzz(40)
@given(seed=seeds)
def test_no_word_of_a_study_becomes_an_element_of_its_report(study: StudyFolder, seed: int) -> None:
    before = content(study.root)
    try:
        _poison(study, random.Random(seed))
        made: list[Path] = []
        if attempt("report: hostile words", lambda: made.append(report(study.root, skip=PARTS))):
            tags = read(made[0])
            assert tags["img"] == 0 and tags["iframe"] == 0 and tags["script"] <= 1, tags
            assert "alert(1)" in made[0].read_text(encoding="utf-8")
    finally:
        _repair(study.root, before)


@pytest.mark.parametrize(
    "evil", [*EVIL[:4], *(pytest.param(word, marks=pytest.mark.slow) for word in EVIL[4:])]
)
def test_a_hostile_word_in_every_place_stays_a_word(tmp_path: Path, evil: str) -> None:
    """Path, TOML, config, versions, command, reasons for failing and cells of metrics, all at
    once.
    """
    root = tmp_path / evil.replace("/", "\u2215")
    toml = tmp_path / "study.toml"
    toml.write_text(
        "games = ['MineSweeperEasy']\nmemories = ['mingru', 'mlp']\nseeds = 2\nquestion = "
        f"{json.dumps(evil)}"
    )
    grid = Study.load(toml)
    study = write_study(root, small_study(question=grid.question))
    record = json.loads((root / "study.json").read_text())
    record |= {
        "command": evil,
        "versions": {evil: evil},
        "also": [{evil: evil}],
        "runs": {evil: evil},
    }
    record["runs"] |= {run.name: evil for run in small_study().runs()}
    (root / "study.json").write_text(json.dumps(record))
    for run in small_study().runs():
        config = study.run(run).path / "config.json"
        values = json.loads(config.read_text())
        values["config"] |= {evil: evil, "network_options": {evil: evil}, "device": evil}
        values["versions"] = {evil: evil}
        config.write_text(json.dumps(values))
        metrics = config.with_name("metrics.csv")
        head, *lines = metrics.read_text().splitlines()
        quoted = '"' + evil.replace('"', '""') + '"'
        metrics.write_text(
            "\n".join([f"{head},{quoted}", *(f"{line},{quoted}" for line in lines)]) + "\n"
        )
    last = small_study().runs()[-1]
    (study.run(last).path / "eval.json").unlink()
    study.note_failure(last, evil)
    page = report(root, skip=PARTS)
    tags = read(page)
    assert tags["img"] == 0 and tags["iframe"] == 0 and tags["script"] <= 1, tags
    assert page.read_text(encoding="utf-8").count("alert(1)") > 8
    table = (root / "results.csv").read_text()
    assert table.count("\n") == 1 + len(small_study().runs())


def test_a_run_of_a_hostile_memory_is_not_the_one_of_its_folder(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", small_study())
    config = study.run(small_study().runs()[0]).path / "config.json"
    values = json.loads(config.read_text())
    values["config"]["memory"] = EVIL[0]
    config.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="holds a run of MineSweeperEasy, full, <script>alert"):
        report(study.root, skip=PARTS)


@fuzz(60)
@given(seed=seeds)
def test_a_damaged_study_gives_a_page_or_one_line(study: StudyFolder, seed: int) -> None:
    rng = random.Random(seed)
    before = content(study.root)
    try:
        file = rng.choice(sorted(path for path in study.root.rglob("*") if path.is_file()))
        if file.suffix == ".json" and rng.random() < 0.7:
            _rewrite_json(file, rng)
        else:
            file.write_bytes(mutated(file.read_bytes(), rng.randrange(2**32)))
        attempt("report: damaged study", lambda: read(report(study.root, skip=PARTS)))
    finally:
        _repair(study.root, before)


@fuzz(300)
@given(seed=seeds)
def test_runs_for_a_figure_are_found_or_refused(study: StudyFolder, seed: int) -> None:
    rng = random.Random(seed)
    before = content(study.root)
    try:
        run = rng.choice(small_study().runs())
        _rewrite_json(study.run(run).path / rng.choice(("config.json", "eval.json")), rng)

        def look() -> None:
            for found in find_runs([study.root]).runs:
                found.value("eval_final"), found.game, found.twin, found.key, found.seed

        attempt("figure: finding runs", look)
    finally:
        _repair(study.root, before)


@fuzz(6)
@given(seed=seeds)
def test_hostile_names_are_drawn_as_they_are(
    tmp_path_factory: pytest.TempPathFactory, study: StudyFolder, seed: int
) -> None:
    rng = random.Random(seed)
    before = content(study.root)
    try:
        evil = rng.choice(
            (*EVIL, *(name for name in NAMES if len(name) < 50 and "\ud800" not in name))
        )
        for run in small_study().runs():
            config = study.run(run).path / "config.json"
            values = json.loads(config.read_text())
            if run.memory != "mlp":
                values["config"]["memory"] = evil
            config.write_text(json.dumps(values))
        out = tmp_path_factory.mktemp("drawn")
        attempt(
            "figure: hostile names",
            lambda: make_figure("gap-bias", ScoreOptions((study.root,), out)),
        )
    finally:
        _repair(study.root, before)


@fuzz(6_000)
@given(seed=seeds)
def test_benchmark_files_are_compared_or_refused(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = random.Random(seed)
    file = tmp_path_factory.getbasetemp() / "bench.json"
    file.write_bytes(
        json_bytes(mutated_value(RESULTS, seed))
        if rng.random() < 0.8
        else mutated(json_bytes(RESULTS), seed)
    )

    def look() -> None:
        found = read_results(file)
        compare(RESULTS, found, 0.2)
        page(found)

    attempt("bench compare", look)
