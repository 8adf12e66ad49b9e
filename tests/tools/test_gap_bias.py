"""Gap and Bias against the paper's aggregates, and the bootstrap against what is known about it."""

import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.tools import gap_and_bias
from arcade_torch.tools.figures import style
from arcade_torch.tools.figures.style import drawing
from arcade_torch.tools.measures.bootstrap import (
    Interval,
    mean_over_tasks,
    measured_coverage,
    percentile_interval,
    resampled,
)
from arcade_torch.tools.measures.gap_bias import ScoreOptions, figure
from arcade_torch.tools.measures.gap_bias.measure import NUMBERS, GapBias, game_of, normalise
from arcade_torch.tools.names import memory_free
from arcade_torch.tools.runs import Score
from arcade_torch.tools.scores import read_scores

PAPER = Path(__file__).resolve().parents[2] / "tools" / "data" / "paper_returns.csv"

# agent: MDP, POMDP, Gap, Bias; then POMDP, Gap, Bias without Tetris (spec of the analyses, section
# 1.3)
AGGREGATES = {
    "MLP": (0.672, 0.439, 0.233, 0.0, 0.451, 0.259, 0.0),
    "LRU": (0.659, 0.594, 0.065, -0.013, 0.659, 0.073, 0.022),
    "GRU": (0.652, 0.565, 0.088, -0.020, 0.626, 0.098, 0.014),
    "MinGRU": (0.613, 0.471, 0.142, -0.059, 0.522, 0.158, -0.029),
    "FART": (0.476, 0.421, 0.055, -0.196, 0.467, 0.061, -0.182),
    "attention": (0.510, 0.403, 0.107, -0.161, 0.447, 0.119, -0.143),
    "TTTL": (0.415, 0.408, 0.008, -0.257, 0.452, 0.009, -0.249),
    "GDN": (0.522, 0.469, 0.054, -0.150, 0.520, 0.060, -0.130),
}


@pytest.fixture(scope="module")
def paper() -> GapBias:
    return gap_and_bias(PAPER, draws=10)


@pytest.mark.parametrize("agent", AGGREGATES)
def test_published_tables_give_the_published_aggregates(paper: GapBias, agent: str) -> None:
    row = paper.row(agent)
    rest = next(row for row in paper.without["Tetris"] if row.agent == agent)
    found = (row.mdp, row.pomdp, row.gap, row.bias, rest.pomdp, rest.gap, rest.bias)
    assert [interval.value for interval in found] == pytest.approx(AGGREGATES[agent], abs=6e-4)


def test_the_texts_quoted_differences_come_out(paper: GapBias) -> None:
    assert paper.row("GDN").pomdp.value == pytest.approx(0.469, abs=5e-4)
    assert paper.row("MinGRU").pomdp.value == pytest.approx(0.471, abs=5e-4)
    assert paper.row("GDN").bias.value - paper.row("MinGRU").bias.value == pytest.approx(
        -0.091, abs=5e-4
    )
    assert paper.difference("gap", "MinGRU", "GDN").value == pytest.approx(0.089, abs=5e-4)
    assert len(paper.tasks) == 30 and len(paper.without) == 10


def test_means_without_seeds_have_no_interval(paper: GapBias) -> None:
    assert np.isnan(paper.row("LRU").gap.low)
    assert not paper.row("LRU").gap.excludes_zero


@given(value=st.floats(-1, 1))
def test_five_games_and_the_probe_are_mapped_and_five_are_not(value: float) -> None:
    signed = (
        "SignpostEasy-v0",
        "BattleShipHard-v0",
        "MineSweeperEasy",
        "BreakoutMedium",
        "TetrisEasy-v3",
        "NavigatorHard",
    )
    plain = (
        "CartPoleEasy",
        "NoisyCartPoleEasy",
        "AutoEncodeHard",
        "CountRecallMedium-v0",
        "SkittlesEasy",
    )
    assert all(normalise(game, value) == (value + 1) / 2 for game in signed)
    assert all(normalise(game, value) == value for game in plain)


def test_an_alias_is_the_same_game() -> None:
    assert game_of("NoisyPoleEasy-v0") == "NoisyCartPole" == game_of("NoisyCartPoleEasy")


def scores(values: dict[tuple[str, str], list[float]], game: str = "CartPoleEasy") -> list[Score]:
    """Scores of one game: (agent, twin) -> values of its seeds."""
    return [
        Score(agent, game, twin, seed, value)
        for (agent, twin), vs in values.items()
        for seed, value in enumerate(vs)
    ]


def test_identical_seeds_give_an_interval_without_width() -> None:
    table = gap_and_bias(
        scores(
            {
                ("mlp", "full"): [0.5] * 5,
                ("mlp", "partial"): [0.2] * 5,
                ("lru", "full"): [0.6] * 5,
                ("lru", "partial"): [0.5] * 5,
            }
        ),
        draws=200,
    )
    gap, bias = table.row("lru").gap, table.row("lru").bias
    assert (gap.low, gap.value, gap.high) == pytest.approx((0.1, 0.1, 0.1))
    assert (bias.low, bias.value, bias.high) == pytest.approx((0.1, 0.1, 0.1))


def test_a_table_for_a_file_has_every_number_with_its_ends_and_the_game_left_out() -> None:
    runs = [
        Score(agent, game, twin, seed, 0.1 * seed + 0.2 * (agent == "lru"))
        for agent, game, twin, seed in product(
            ("mlp", "lru"), ("CartPoleEasy", "TetrisEasy"), ("full", "partial"), range(3)
        )
    ]
    table = gap_and_bias(runs, draws=50)
    of_rows = [(row, "") for row in table.rows]
    of_rows += [(row, game) for game, rows in table.without.items() for row in rows]
    for plain, (row, without) in zip(table.table(), of_rows, strict=True):
        assert (plain["agent"], plain["without"], plain["seeds"]) == (row.agent, without, 3)
        for name in NUMBERS:
            found = [plain[name], plain[f"{name}_low"], plain[f"{name}_high"]]
            np.testing.assert_equal(found, list(getattr(row, name)))
        np.testing.assert_equal(plain["coverage"], row.coverage)


@pytest.mark.parametrize("name", ["confidence", "draws"])
def test_a_number_of_the_bootstrap_out_of_range_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} must be .*; got 0"):
        gap_and_bias([], **{name: 0})


def test_gap_and_bias_share_the_resample_of_the_mdp_runs() -> None:
    rng = np.random.default_rng(0)
    noisy = list(rng.normal(size=5))
    table = gap_and_bias(
        scores(
            {
                ("mlp", "full"): [0.0] * 5,
                ("mlp", "partial"): [0.0] * 5,
                ("lru", "full"): noisy,
                ("lru", "partial"): [0.0] * 5,
            }
        ),
        draws=500,
    )
    row = table.row("lru")  # only the MDP runs vary, so Gap and Bias must be equal draw by draw
    assert (row.gap.low, row.gap.high) == (row.bias.low, row.bias.high)
    assert row.gap.high > row.gap.low


def test_twins_and_agents_are_resampled_apart_even_where_their_scores_are_equal() -> None:
    same = [0.0, 0.2, 0.5, 0.6, 1.0]
    table = gap_and_bias(
        scores({(agent, twin): same for agent in ("mlp", "lru") for twin in ("full", "partial")}),
        draws=300,
    )
    for interval in (
        table.row("lru").gap,
        table.row("lru").bias,
        table.difference("pomdp", "lru", "mlp"),
    ):
        assert interval.value == 0 and interval.low < -0.2 and interval.high > 0.2


def test_confidence_decides_intervals_differences_and_their_measured_coverage() -> None:
    rng = np.random.default_rng(4)
    runs = scores(
        {
            (a, twin): list(rng.normal(size=4))
            for a in ("mlp", "lru")
            for twin in ("full", "partial")
        }
    )
    wide, narrow = (
        gap_and_bias(runs, draws=400, confidence=confidence) for confidence in (0.95, 0.5)
    )
    of = [(table.row("lru").gap, table.difference("gap", "lru", "mlp")) for table in (wide, narrow)]
    assert all(a.low < b.low and b.high < a.high for a, b in zip(*of, strict=True))
    assert (
        narrow.row("lru").coverage
        == measured_coverage((4,), (4,), 0.5)
        < wide.row("lru").coverage - 0.2
    )
    assert measured_coverage((5,), (), 0.5) < measured_coverage((5,), ()) - 0.2


def test_the_least_coverage_stands_under_figure_and_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both agents have a cell of two seeds; in the other cells one of them has two and the other
    five.
    """
    lines, rng = ["agent,game,observability,seed,score"], np.random.default_rng(0)
    cells = product(("mlp", "lru"), range(6), ("full", "partial"), range(5))
    for agent, game, twin, seed in cells:
        if seed < 2 or (agent == "mlp" and (game, twin) != (0, "full")):
            lines.append(f"{agent},Game{game},{twin},{seed},{rng.normal()}")
    (tmp_path / "scores.csv").write_text("\n".join(lines))
    table = gap_and_bias(tmp_path / "scores.csv", draws=10)
    shares = [row.coverage for row in table.rows]
    assert shares[0] > shares[1] + 0.03 and table.coverage == {2: shares[1]}
    with drawing("light"):
        made = figure.gap_bias(ScoreOptions(runs=(tmp_path / "scores.csv",), draws=10), None)
    share = f"{100 * shares[1]:.0f} %"
    assert made.pictures[0].note.endswith(f"measured coverage with 2 seeds {share}")
    assert made.tables[0].caption.endswith(f"measured coverage of the gap's: {share} with 2 seeds")


def test_a_single_seed_of_one_side_leaves_no_interval_of_the_difference() -> None:
    many, one = [0.1, 0.2, 0.4], [0.3]
    values = {
        ("mlp", "full"): one,
        ("mlp", "partial"): one,
        ("lru", "full"): many,
        ("lru", "partial"): many,
    }
    table = gap_and_bias(scores(values), draws=50)
    assert table.row("lru").gap.low < table.row("lru").gap.high
    assert np.isnan(table.row("lru").bias.low) and np.isnan(
        table.difference("gap", "lru", "mlp").low
    )


def test_a_difference_of_bias_has_an_interval_where_the_memory_free_agents_have() -> None:
    """Before: those of two algorithms with one seed each counted as if they were known exactly."""
    many, one = [0.1, 0.2, 0.4], [0.3]
    seeds = {"pqn-mlp": one, "ppo-mlp": one, "pqn-lru": many, "ppo-lru": many, "pqn-gru": many}
    values = {(agent, twin): seeds[agent] for agent in seeds for twin in ("full", "partial")}
    table = gap_and_bias(scores(values), draws=50)
    assert np.isnan(table.difference("bias", "pqn-lru", "ppo-lru").low)
    # the same one cancels
    alike = table.difference("bias", "pqn-lru", "pqn-gru")
    assert alike == table.difference("mdp", "pqn-lru", "pqn-gru") and alike.low < alike.high


def test_raw_returns_stay_as_they_are_and_only_the_normalised_ones_are_mapped() -> None:
    values = {
        (agent, twin): [-0.5, 0.5, 0.6] for agent in ("mlp", "lru") for twin in ("full", "partial")
    }
    row = gap_and_bias(scores(values, "TetrisEasy"), draws=10).row("lru")
    assert [row.mdp_raw.value, row.mdp.value, row.mdp_iqm.value] == pytest.approx([0.2, 0.6, 0.6])
    assert [row.pomdp_raw.value, row.pomdp.value, row.pomdp_iqm.value] == pytest.approx(
        [0.2, 0.6, 0.6]
    )


def test_the_bias_of_the_memory_free_agent_is_exactly_zero() -> None:
    rng = np.random.default_rng(1)
    values = {
        (agent, twin): list(rng.normal(size=4))
        for agent in ("gru", "MLP")
        for twin in ("full", "partial")
    }
    table = gap_and_bias(scores(values), draws=100)
    assert table.baseline == "MLP" and table.rows[0].agent == "MLP"
    assert (table.rows[0].bias.low, table.rows[0].bias.value, table.rows[0].bias.high) == (
        0.0,
        0.0,
        0.0,
    )


def test_bias_is_measured_against_the_memory_free_agent_of_the_same_algorithm() -> None:
    mdp = {"pqn-lru": 0.3, "pqn-mlp": 0.3, "dqn-lru": 0.5, "ppo-lru 2x64": 0.7, "ppo-mlp": 0.9}
    values = {
        (agent, twin): [value] * 2 for agent, value in mdp.items() for twin in ("full", "partial")
    }
    table = gap_and_bias(scores(values), draws=10)
    assert [row.agent for row in table.rows] == [
        "pqn-mlp",
        "ppo-mlp",
        "pqn-lru",
        "dqn-lru",
        "ppo-lru 2x64",
    ]
    assert table.baseline == "pqn-mlp" and table.baselines["dqn-lru"] is None
    found = {row.agent: row.bias.value for row in table.rows}
    assert np.isnan(found.pop("dqn-lru"))  # that algorithm has none without memory
    assert found == pytest.approx({"pqn-mlp": 0, "ppo-mlp": 0, "pqn-lru": 0, "ppo-lru 2x64": -0.2})
    table = gap_and_bias(
        scores(values), baseline="ppo-mlp", draws=10
    )  # who names one agent measures all against it
    assert {row.agent: row.bias.value + 0.9 for row in table.rows} == pytest.approx(mdp)


def test_without_a_memory_free_agent_there_are_gaps_and_no_bias(tmp_path: Path) -> None:
    """It was refused, though a gap is of one agent; whoever names one that is missing still is."""
    values = {("mine", "full"): [0.9, 0.8], ("mine", "partial"): [0.3, 0.4]}
    table = gap_and_bias(scores(values), draws=10)
    row = table.row("mine")
    assert row.gap.value == pytest.approx(0.5) and row.gap.low <= 0.5 <= row.gap.high
    assert math.isnan(row.bias.value)
    assert table.baseline == "" and table.baselines == {"mine": None}
    for baseline in ("none", "MINE-2"):
        with pytest.raises(ValueError, match=f"memory-free agent '{baseline}', only for mine"):
            gap_and_bias(scores(values), baseline=baseline, draws=10)

    lines = ["agent,game,observability,seed,score"]
    for score in scores(values):
        lines.append(f"mine,{score.game},{score.observability},{score.seed},{score.value}")
    file = tmp_path / "mine.csv"
    file.write_text("\n".join(lines))
    with drawing("light"):
        drawn = figure.gap_bias(ScoreOptions(runs=[file], draws=10), None)
        (axis,) = drawn.pictures[0].figure.axes
        assert axis.get_title() == "Observability Gap" and len(axis.patches) == 1
        assert any("only for mine; memory bias is against one" in note for note in drawn.notes)
        with pytest.raises(ValueError, match="memory-free agent 'mlp', only for mine"):
            figure.returns(ScoreOptions(runs=[file], draws=10), None)


@pytest.mark.parametrize("name", ["gated-mlp", "mlp-mixer", "my mlp", "GATED-MLP"])
def test_a_memory_whose_name_ends_like_the_memory_free_agent_is_none(name: str) -> None:
    """Before: it was the memory-free agent of an algorithm of its own, with a Bias of 0."""
    values = {
        (agent, twin): [value] * 2
        for agent, value in {"mlp": 0.9, name: 0.5}.items()
        for twin in ("full", "partial")
    }
    table = gap_and_bias(scores(values), draws=10)
    assert table.baselines == {"mlp": "mlp", name: "mlp"}
    assert table.row(name).bias.value == pytest.approx(-0.4)
    assert memory_free("mlp 2x64", "mlp") and memory_free("PPO-mlp", "mlp")
    assert not memory_free(name, "mlp")


def test_an_algorithm_that_nobody_here_knows_is_one_where_two_agents_have_it() -> None:
    values = {
        (agent, twin): [0.5] * 2
        for agent in ("mlp", "lru", "sac-mlp", "sac-lru", "own-mlp")
        for twin in ("full", "partial")
    }
    table = gap_and_bias(scores(values), draws=10)
    wanted = {"mlp": "mlp", "lru": "mlp", "sac-mlp": "sac-mlp", "sac-lru": "sac-mlp"}
    assert table.baselines == wanted | {"own-mlp": "mlp"}
    alone = [score for score in scores(values) if score.agent == "own-mlp"]
    with pytest.raises(
        ValueError, match=r"no scores for .* 'mlp', only for own-mlp; .*: name it, --"
    ):
        gap_and_bias(alone, draws=10)
    assert gap_and_bias(alone, baseline="own-mlp", draws=10).baselines == {"own-mlp": "own-mlp"}


def test_the_order_of_the_runs_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    values = {
        (agent, twin): list(rng.normal(size=4))
        for agent in ("mlp", "lru")
        for twin in ("full", "partial")
    }
    runs = scores(values)
    shuffled = [runs[index] for index in rng.permutation(len(runs))]
    assert gap_and_bias(runs, draws=300).row("lru") == gap_and_bias(shuffled, draws=300).row("lru")


def test_bootstrap_spread_is_that_of_the_mean_of_resampled_seeds() -> None:
    cells = [np.array([0.0, 1.0, 4.0]), np.array([2.0, 2.0, 5.0, 7.0])]
    draws = mean_over_tasks(resampled(cells, 40_000, np.random.default_rng(0)))
    variance = sum(cell.var() / len(cell) for cell in cells) / len(cells) ** 2
    assert draws.mean() == pytest.approx(np.mean([cell.mean() for cell in cells]), abs=0.02)
    assert draws.var() == pytest.approx(variance, rel=0.03)


def test_measured_coverage_is_below_nominal_and_grows_with_seeds() -> None:
    few, some, many = (
        measured_coverage((n,), (n,), simulations=600, draws=300) for n in (2, 5, 20)
    )
    assert 0.5 < few < some < many < 0.98
    assert 0.82 < some < 0.94


def test_coverage_of_a_single_cell_of_five_is_the_known_84_percent() -> None:
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(1500):
        seeds = rng.standard_normal(5)
        interval = percentile_interval(
            float(seeds.mean()), mean_over_tasks(resampled([seeds], 400, rng)), 0.95
        )
        inside.append(interval.low <= 0 <= interval.high)
    assert np.mean(inside) == pytest.approx(0.84, abs=0.03)


def test_tasks_that_an_agent_lacks_are_left_out_and_named() -> None:
    both = {(agent, twin): [0.1, 0.2] for agent in ("mlp", "lru") for twin in ("full", "partial")}
    alone = {("mlp", "full"): [0.9, 0.9], ("mlp", "partial"): [0.9, 0.9]}
    table = gap_and_bias(scores(both) + scores(alone, "SkittlesEasy"), draws=10)
    assert table.tasks == ("CartPoleEasy",) and table.dropped == ("SkittlesEasy",)
    assert table.row("mlp").mdp.value == pytest.approx(0.15)


def test_a_csv_file_with_one_run_a_line_is_read(tmp_path: Path) -> None:
    file = tmp_path / "runs.csv"
    lines = ["agent,game,observability,seed,score"]
    lines += [
        f"{a},CartPoleEasy,{o},{s},{0.1 * s}"
        for a in ("mlp", "lru")
        for o in ("full", "partial")
        for s in (0, 1)
    ]
    file.write_text("\n".join(lines) + "\n")
    assert len(read_scores(file)) == 8
    both = ["agent,game,observability,seed,eval_mean,train_max_ewm", "mlp,X,full,0,0.25,0.75"]
    (tmp_path / "results.csv").write_text("\n".join(both) + "\n")
    for metric, value in (("eval_final", 0.25), ("train_max_ewm", 0.75)):
        assert [score.value for score in read_scores(tmp_path / "results.csv", metric)] == [value]
    assert gap_and_bias(file, draws=10).row("lru").seeds == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("agent,game\nmlp,x\n", "no column for observability, seed, score"),
        ("agent,game,observability,seed,score\nmlp,X,full,0,abc\n", "not a number"),
        (
            "agent,game,observability,seed,score\nmlp,X,full,0,1\nmlp,X,full,0,2\n",
            "two scores for mlp",
        ),
        (
            "agent,game,observability,seed,score\nmlp,X,full,0,1\n",
            "on both twins, and gap and bias compare",
        ),
        ("agent,game,observability,seed,score\nmlp,X,half,0,1\n", "full or partial"),
        ("agent,game,observability,seed,score\nmlp,X,full,0,nan\n", "is nan"),
    ],
)
def test_bad_tables_are_refused_with_a_reason(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "runs.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        gap_and_bias(file, draws=10)


def test_scores_of_several_rules_are_not_pooled_and_lost_runs_are_told(tmp_path: Path) -> None:
    head, rows = (
        "agent,game,observability,seed,status,rules,eval_mean",
        ["mlp,X,full,0,finished,default,.9"],
    )
    rows += ["mlp,X,partial,0,finished,default,.1", "mlp,X,partial,1,failed,default,"]
    (tmp_path / "s.csv").write_text("\n".join([head, *rows]))
    made, table, _ = figure._table(ScoreOptions(runs=(tmp_path / "s.csv",), draws=10))
    assert table.row("mlp").gap.value == pytest.approx(0.8) and made.notes == [
        "left out, not finished: 1 run"
    ]
    (tmp_path / "s.csv").write_text("\n".join([head, *rows, "mlp,X,full,1,finished,reference,.1"]))
    with pytest.raises(ValueError, match=r"X has scores of rules, .*'default'.* and .*'reference'"):
        read_scores(tmp_path / "s.csv")


def test_returns_out_of_range_are_noted_with_the_range_of_their_game(tmp_path: Path) -> None:
    """Before: those of Tetris "lie outside of [0, 1] and count as they are"; they are rescaled."""
    head = "memory,game,observability,seed,status,rules,eval_final"
    rows = [
        f"{memory},{game},{twin},0,finished,default,{value}"
        for memory, twin in product(("lru", "mlp"), ("full", "partial"))
        for game, value in (
            ("LampEasy-v0", -0.5),
            ("BulbEasy-v0", 1.5),
            ("TetrisEasy-v0", -1.0),
            ("BreakoutEasy-v0", 12.0),
            ("OwnEasy-v0", 1.0),
        )
    ]
    (tmp_path / "s.csv").write_text("\n".join([head, *rows]))
    made, *_ = figure._table(ScoreOptions(runs=(tmp_path / "s.csv",), draws=10))
    notes = [note for note in made.notes if "outside of" in note]
    assert len(notes) == 2
    assert notes[0].startswith("returns of LampEasy-v0, BulbEasy-v0 lie outside of [0, 1], so")
    assert notes[1].startswith("returns of BreakoutEasy-v0 lie outside of [-1, 1], so")


def test_a_bare_name_and_its_version_are_one_game() -> None:
    twins = [("mlp", "full"), ("mlp", "partial"), ("lru", "full"), ("lru", "partial")]
    bare = [Score(agent, "TetrisEasy", twin, 0, 0.5) for agent, twin in twins]
    full = [Score(agent, "TetrisEasy-v1", twin, 1, 0.7) for agent, twin in twins]
    table = gap_and_bias(bare + full, draws=10)
    assert table.tasks == ("TetrisEasy-v1",) and table.row("lru").seeds == 2
    names = ("TetrisEasy", "TetrisEasy-v9", "TetrisEasy-v10")
    newest = read_scores([Score("mlp", game, "full", seed, 0.5) for seed, game in enumerate(names)])
    assert newest[0].game == "TetrisEasy-v10"


def test_agents_without_a_gap_lie_on_one_line() -> None:
    """The axis of returns that are equal on both twins showed rounding errors, 1e-17."""
    scores = []
    for place, agent in enumerate(("mlp", "gru", "lru")):
        for game, twin in product(("SignpostEasy", "CartPoleEasy"), ("full", "partial")):
            scores.append(Score(agent, game, twin, 0, 0.2 + 0.01 * place))
    rows = []
    for place, row in enumerate(gap_and_bias(scores).rows):
        rows.append(replace(row, gap=Interval(1e-17 * place, math.nan, math.nan)))
    with drawing("light"):
        axis = style.panels(1, 1, (4, 3))[1][0, 0]
        figure.plot(rows, axis)
        low, high = axis.get_ylim()
    assert high - low >= 0.02 and low < 0 < high


def test_an_unknown_metric_is_refused() -> None:
    with pytest.raises(ValueError, match="metric must be one of eval_final, train_max_ewm"):
        read_scores([], "best")


@pytest.mark.parametrize("count", [3, 12, 13, 50])
def test_the_names_of_many_agents_do_not_cover_each_other_in_a_report(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fifty stood in a row below a picture of ten centimetres."""
    values = {
        (agent, twin): [value / count, 0.5]
        for value, agent in enumerate(["mlp", *(f"mingru 4x{width}" for width in range(1, count))])
        for twin in ("full", "partial")
    }
    table = gap_and_bias(scores(values), draws=10)
    drawn = list[Any]()
    monkeypatch.setattr(style, "svg", lambda figure, name: drawn.append(figure))
    with drawing("light"):
        figure.score_panels(table)
        for picture in drawn:
            picture.draw_without_rendering()
            axis = picture.axes[0]
            labels = [*axis.get_xticklabels(), *axis.get_yticklabels()]
            names = [label for label in labels if label.get_text().startswith("mingru")]
            lines = sorted(label.get_position() for label in names)
            assert len(names) == count - 1
            places = axis.transData.transform(lines)
            # along the axis, or of names that are turned across them
            steps = np.abs(np.diff(places, axis=0)).max(axis=1)
            assert steps.min() > names[0].get_fontsize() * picture.dpi / 72
