"""Tables that people hand over: scores for gap and bias, benchmarks, human scores, delayed recall,
NAME=VALUE.
"""

import functools
import random
from pathlib import Path

import pytest
from hypothesis import given

from arcade_torch.agents.runs.files import read_csv, read_json
from arcade_torch.tools.bench.recall import Recall
from arcade_torch.tools.figures import logs
from arcade_torch.tools.figures.logs import mean_series, series
from arcade_torch.tools.files import read_rows, write_between, write_csv
from arcade_torch.tools.imports import take_imports
from arcade_torch.tools.measures.gap_bias.measure import gap_and_bias
from arcade_torch.tools.options import name_and_value
from arcade_torch.tools.play.scores import (
    COLUMNS,
    append_score,
    next_seed,
    read_scores_file,
    replay,
)
from arcade_torch.tools.scores import METRICS, read_scores
from tests.fuzz.contract import attempt, fuzz
from tests.fuzz.hostile import FLOATS, NAMES, NUMBERS, mutated, names, seeds

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
LONG = "agent,game,observability,seed,score\n" + "".join(
    f"{agent},{game},{twin},{seed},{0.1 * seed + 0.05 * len(agent)}\n"
    for agent in ("mlp", "lru")
    for game in ("MineSweeperEasy", "CartPoleEasy-v0")
    for twin in ("full", "partial")
    for seed in (0, 1)
)
WIDE = "model,env,difficulty,mdp_mean,pomdp_mean\nmlp,CartPole,easy,0.5,0.25\nlru,CartPole,easy,0.5,0.4\n"
BENCH = "".join((ROOT / "results" / "bench_envs_cpu.csv").read_text().splitlines(True)[:13])
RECALL = "".join((ROOT / "results" / "recall_cpu.csv").read_text().splitlines(True)[:4])
HUMAN = (
    ",".join(COLUMNS)
    + "\nhuman,CartPole,easy,partial,0.5,3,terminated,1,0,012,CartPoleEasy-v0,128,default,{},me\n"
    + 'human,CartPole,easy,full,,2,abandoned,1,4,01,CartPoleEasy-v0,128,default,"{""noise"": 1}",me\n'
)


EPISODE = "human,CartPole,easy,partial,0.5,3,terminated,1,0,012,CartPoleEasy-v0,128,default,{},me"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables")


def _cells(text: str, rng: random.Random) -> bytes:
    """A table with hostile cells, or with accidents in its bytes."""
    if rng.random() < 0.4:
        return mutated(text.encode(), rng.randrange(2**32))
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(rng.choice((1, 2, 3))):
        row = rng.choice(rows)
        cell = str(rng.choice((*NAMES, *FLOATS, *NUMBERS[:9], "1e400", "0x10", "1_000", " 1 ")))
        if any(mark in cell for mark in ',"\n\r') and rng.random() < 0.8:
            cell = '"' + cell.replace('"', '""') + '"'
        row[rng.randrange(len(row))] = cell
        if rng.random() < 0.1:
            row.append("more")
        if rng.random() < 0.1:
            row.pop()
        if not row:
            row.append("")
    return "\n".join(",".join(row) for row in rows).encode("utf-8", "surrogatepass")


def _written(file: Path, data: bytes) -> Path:
    file.write_bytes(data)
    return file


@fuzz(9_000)
@given(seed=seeds)
def test_scores_are_read_or_refused(files: Path, seed: int) -> None:
    rng = random.Random(seed)
    data = _cells(rng.choice((LONG, LONG, WIDE)), rng)
    file = _written(files / "scores.csv", data)
    attempt("gap-bias: reading", lambda: read_scores(file, rng.choice(METRICS)))
    assert file.read_bytes() == data


@fuzz(2_500)
@given(seed=seeds)
def test_gap_and_bias_of_any_table_is_computed_or_refused(files: Path, seed: int) -> None:
    rng = random.Random(seed)
    file = _written(files / "scores.csv", _cells(rng.choice((LONG, WIDE)), rng))

    def compute() -> None:
        table = gap_and_bias(file, draws=4)
        rows = table.table()
        write_csv(files / "out.csv", rows, list(rows[0]))
        assert len(read_csv(files / "out.csv")) == len(rows)

    attempt("gap-bias: computing", compute)


@fuzz(5_000)
@given(seed=seeds)
def test_benchmarks_are_drawn_from_a_table_or_it_is_refused(files: Path, seed: int) -> None:
    file = _written(files / "bench.csv", _cells(BENCH, random.Random(seed)))

    def read() -> None:
        rows = read_rows(file, logs.Rate)
        games = list(dict.fromkeys(row.game for row in rows))
        for game in games:
            series(rows, game, "step+draw")
        mean_series(rows, games, "step+draw")

    attempt("figure throughput: reading", read)


@fuzz(4_000)
@given(seed=seeds)
def test_delayed_recall_is_read_or_refused(files: Path, seed: int) -> None:
    file = _written(files / "recall.csv", _cells(RECALL, random.Random(seed)))
    attempt("bench recall: reading", lambda: read_rows(file, Recall))


@functools.cache
def _row() -> dict[str, str]:
    return dict.fromkeys(COLUMNS, "")


@fuzz(5_000)
@given(seed=seeds)
def test_human_scores_are_read_or_refused_and_never_lost(files: Path, seed: int) -> None:
    data = _cells(HUMAN, random.Random(seed))
    file = _written(files / "human.csv", data)
    attempt(
        "play: reading scores", lambda: next_seed(read_scores_file(file), "CartPoleEasy-v0", "me")
    )
    if not attempt("play: adding a score", lambda: append_score(file, _row())):
        assert file.read_bytes() == data
    else:
        assert read_csv(file)[-1] == _row()


@fuzz(600)
@given(seed=seeds)
def test_an_episode_is_replayed_or_refused(seed: int) -> None:
    rng = random.Random(seed)
    row = dict(zip(COLUMNS, EPISODE.split(","), strict=True))
    for _ in range(rng.choice((1, 1, 2))):
        pool = (*NAMES, "5", "-1", "[]", '{"noise": 1}', '{"a": {}}', "null", "٣", "[[[[", "256")
        row[rng.choice(COLUMNS)] = rng.choice(pool)
    if row["obs_size"] != "256":
        attempt("play: replaying", lambda: replay(row))


@fuzz(6_000)
@given(seed=seeds)
def test_any_file_is_json_or_refused_by_name(files: Path, seed: int) -> None:
    file = _written(
        files / "x.json", mutated(b'{"a": [1, 2.5, null, true, "text"], "b": {"c": -1e5}}', seed)
    )
    attempt("read_json", lambda: read_json(file))


@fuzz(5_000)
@given(seed=seeds)
def test_any_file_is_csv_or_refused_by_name(files: Path, seed: int) -> None:
    file = _written(files / "x.csv", _cells(LONG, random.Random(seed)))
    attempt("read_csv", lambda: read_csv(file))


@fuzz(1_000)
@given(seed=seeds)
def test_a_page_gets_its_table_or_stays_as_it_is(files: Path, seed: int) -> None:
    data = mutated("text <!-- a --> old <!-- b --> täxt".encode(), seed)
    file = _written(files / "page.md", data)
    if not attempt("write_between", lambda: write_between(file, "<!-- a -->", "<!-- b -->", "new")):
        assert file.read_bytes() == data


@fuzz(3_000)
@given(names, names)
def test_name_and_value_are_read_or_refused(name: str, value: str) -> None:
    attempt("NAME=VALUE", lambda: name_and_value(f"{name}={value}"))
    attempt("NAME=VALUE", lambda: name_and_value(name))
    attempt("--import", lambda: take_imports(["--import", name, f"--import={value}"]))
