"""``arcade-torch figure``: every figure from runs or from the paper, numbers beside it, and what
cannot be compared.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from tensordict.nn import TensorDictModule

from arcade_torch.agents import Agent, preset, train
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.figures import CurveOptions, PaperOptions, logs
from arcade_torch.tools.figures.catalogue import FIGURES
from arcade_torch.tools.figures.logs import Curve
from arcade_torch.tools.figures.style import (
    AGENT_COLOURS,
    drawing,
    new_figure,
    panels,
    whiskers,
)
from arcade_torch.tools.measures import checkpoints
from arcade_torch.tools.measures.beliefs import figure as beliefs
from arcade_torch.tools.measures.beliefs.measure import Beliefs
from arcade_torch.tools.measures.bootstrap import Interval, pooled, pooled_episodes
from arcade_torch.tools.measures.checkpoints import Label, by_task
from arcade_torch.tools.measures.contamination import ContaminationOptions
from arcade_torch.tools.measures.contamination import figure as contamination
from arcade_torch.tools.measures.contamination.example import CLEAN_BEST, OTHER_BEST, REST
from arcade_torch.tools.measures.contamination.measure import Contamination, Example
from arcade_torch.tools.measures.counterfactual import figure as counterfactual
from arcade_torch.tools.measures.counterfactual.measure import Counterfactual
from arcade_torch.tools.measures.gap_bias import figure as gap_bias
from arcade_torch.tools.measures.gap_bias.measure import gap_and_bias
from arcade_torch.tools.measures.gap_bias.paper import PAPER_RETURNS
from arcade_torch.tools.measures.recall_density import DensityOptions
from arcade_torch.tools.measures.recall_density import figure as recall_density
from arcade_torch.tools.measures.recall_density.measure import RecallDensity
from arcade_torch.tools.measures.saliency import figure as saliency_figures
from arcade_torch.tools.measures.saliency.measure import EpisodeSaliency
from arcade_torch.tools.names import AgentKey
from arcade_torch.tools.runs import Run, Score
from arcade_torch.tools.studies.grid import RunSpec
from tests.tools.fabricated import small_study, write_run, write_study

AGENTS = {"mlp": 0.3, "lru": 0.5, "gru": 0.6}


def fabricate(
    root: Path, seeds: Sequence[int] = (0, 1, 2), games: Sequence[str] = ("CartPoleEasy-v0",)
) -> Path:
    """Finished runs of three agents on both twins."""
    for game in games:
        for agent, score in AGENTS.items():
            for twin in ("full", "partial"):
                for seed in seeds:
                    spec = RunSpec(game, twin, agent, "pqn", seed)
                    write_run(
                        root / spec.name, spec, score + 0.01 * seed - 0.1 * (twin == "partial")
                    )
    return root


def change(run: Path, **values: Any) -> None:
    """Change settings in a run's config.json."""
    file = run / "config.json"
    record = json.loads(file.read_text())
    record["config"] |= values
    file.write_text(json.dumps(record))


def figure(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Make a figure; what was printed."""
    code = cli.main(["figure", *words])
    out, err = capsys.readouterr()
    assert code == cli.EXIT_OK, err
    return out


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line with which a command was refused."""
    assert cli.main([*words]) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    # a slow machine is told how far it is before
    *progress, last = err.splitlines()
    assert not out and not any(line.startswith("arcade-torch: ") for line in progress)
    return last


@pytest.mark.parametrize(
    ("name", "style"),
    [("returns", "light"), ("gap-bias", "print"), ("human", "print"), ("hyperparameters", "light")],
)
def test_the_papers_numbers_make_pictures_and_tables(
    name: str, style: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = figure(capsys, name, "--paper", "--out", str(tmp_path), "--style", style)
    for ending, magic in ((".pdf", b"%PDF"), (".png", b"\x89PNG")):
        assert (tmp_path / f"{name}{ending}").read_bytes().startswith(magic)
    assert len(read_csv(tmp_path / f"{name}.csv")) >= 9
    if name == "returns":
        assert "GDN │ 0.522 │ 0.469 │ +0.054 │ -0.150" in " ".join(text.split())
        assert (tmp_path / "returns-without.png").exists()


def test_one_file_is_asked_for_and_one_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure(capsys, "hyperparameters", "--paper", "--out", str(tmp_path / "numbers.csv"))
    assert [path.name for path in tmp_path.iterdir()] == ["numbers.csv"]


@pytest.mark.parametrize("name", ["returns", "gap-bias", "curves", "hyperparameters"])
def test_run_folders_make_pictures_and_tables(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = fabricate(tmp_path / "runs", games=("CartPoleEasy-v0", "SkittlesEasy-v0"))
    text = figure(capsys, name, "--runs", str(runs), "--out", str(tmp_path / "f"))
    assert "left out" not in text and "no interval" not in text
    rows = read_csv(tmp_path / "f" / f"{name}.csv")
    if name in ("returns", "gap-bias"):
        lru = next(row for row in rows if row["agent"] == "lru" and not row["without"])
        assert float(lru["gap"]) == pytest.approx(0.1) and float(lru["bias"]) == pytest.approx(0.2)
        assert float(lru["gap_low"]) < 0.1 < float(lru["gap_high"]) and lru["seeds"] == "3"
    if name == "curves":
        assert {row["agent"] for row in rows} == set(AGENTS) and {row["seeds"] for row in rows} == {
            "3"
        }


def test_a_curve_goes_over_the_frames_that_all_its_runs_have_reached_in_the_unit_of_its_axis(
    tmp_path: Path,
) -> None:
    spec = RunSpec("CartPoleEasy-v0", "full", "lru", "pqn", 0)
    for name, frames in (("short", 3_000_000), ("long", 6_000_000)):
        write_run(tmp_path / name, spec, 0.5, frames)
    runs = [Run(tmp_path / "short"), Run(tmp_path / "long")]
    for kind, first in (("eval", 1_200_000), ("train", 2048)):
        ((task, curve),) = logs.curves_of_runs(
            {("lru", "CartPoleEasy-v0", "full"): runs}, kind
        ).items()
        assert (curve.frames[0], curve.frames[-1]) == (
            first,
            3_000_000,
        ) and curve.returns.seeds.shape[0] == 2
    rows = [[float(row["mean"]) for row in run.table("eval.csv")] for run in runs]
    curve = logs.curves_of_runs({task: runs}, "eval")[task]
    assert curve.returns.mean[0] == pytest.approx((rows[0][1] + rows[1][0]) / 2)
    assert curve.returns.mean[-1] == pytest.approx((rows[0][4] + (rows[1][1] + rows[1][2]) / 2) / 2)
    for scale, unit in ((1, "million frames"), (0.1, "thousand frames")):
        with drawing("light"):
            axis = panels(1, 1, (3, 3))[1][0, 0]
            logs.plot({"lru": Curve(scale * curve.frames, curve.returns)}, axis, ["lru"])
        assert axis.get_xlabel() == unit and axis.lines[0].get_xdata()[-1] == (
            3 if scale == 1 else 300
        )


def test_curves_are_of_the_returns_behind_the_metric(tmp_path: Path) -> None:
    spec = RunSpec("CartPoleEasy-v0", "full", "lru", "pqn", 0)
    write_run(tmp_path / "run", spec, 0.5, frames=3_000_000)
    columns = {
        "eval_final": ("eval.csv", "mean"),
        "train_max_ewm": ("metrics.csv", "train_return_ewm"),
    }
    for metric, (table, column) in columns.items():
        with drawing("light"):
            (picture,) = logs.curves(CurveOptions((tmp_path,), metric=metric), None).pictures
        last = float(Run(tmp_path / "run").table(table)[-1][column])
        assert picture.rows[-1]["mean"] == pytest.approx(last), metric


def test_an_interval_beside_its_mean_has_one_whisker_and_a_missing_one_none() -> None:
    """An interval of the bootstrap need not hold the mean; matplotlib takes no length below 0."""
    value, low, high = (np.array(row) for row in ([1.0, 1.0], [1.25, np.nan], [1.5, np.nan]))
    np.testing.assert_array_equal(whiskers(value, low, high), [[0, np.nan], [0.5, np.nan]])


def test_bars_are_drawn_where_their_numbers_say(monkeypatch: pytest.MonkeyPatch) -> None:
    three = pooled([[[0.5, 0.0], [0.1, 0.9]], [[0.5, 0.0], [0.1, 0.0]], [[0.5, 0.0], [0.1, 0.0]]])
    runs = [Score(agent, "CartPoleEasy", twin, seed, value + 0.1 * spread * (seed == 2))
            for agent, twin, value, spread in (("mlp", "full", 0.5, 0), ("mlp", "partial", 0.2, 0),
                                               ("lru", "full", 0.4, 1), ("lru", "partial", 0.3, 5))
            for seed in range(3)]  # fmt: skip
    row = gap_and_bias(runs, draws=500).row("lru")
    parts = {
        ("lru", "A", "full"): pooled([[0.2, 0.3, 0.5]]),
        ("mlp", "A", "full"): pooled([[0.0, 0.0, 1.0]]),
    }
    with drawing("light"):
        axis, other = panels(1, 2, (6, 3))[1][0]
        contamination.plot({"lru": {"flip": three}}, axis, "flip", 1, [0, 1])
        gap_bias.plot([row], other)
        stacked, _ = recall_density._stacked_bars(parts, 3)
    assert axis.lines[0].get_ydata().tolist() == pytest.approx([0.1, 0.3])
    ((_, at_one),) = [bars[2][0].get_segments() for bars in axis.containers]
    assert at_one[:, 1].tolist() == pytest.approx([three.low[1, 1], three.high[1, 1]])
    across, up = (bars.get_segments()[0] for bars in other.containers[0][2])
    assert across[:, 0].tolist() == pytest.approx([row.bias.low, row.bias.high])
    assert up[:, 1].tolist() == pytest.approx([row.gap.low, row.gap.high])
    agents = {("lru", "A"): 1, ("lru", "B"): 2, ("gru", "A"): 2}  # of so many twins
    labels = [Label(AgentKey("pqn", agent), game, twin, 0, Path("run"), agent)
              for (agent, game), twins in agents.items() for twin in ("full", "partial")[:twins]]  # fmt: skip
    dense = RecallDensity(
        np.array([0.1, 0.2, 0.7]),
        np.array([3]),
        np.array([True]),
        0,
        0,
        "q",
        np.ones(1),
        np.ones(1),
    )
    monkeypatch.setattr(recall_density, "checkpoints_of", lambda paths: ([], []))
    monkeypatch.setattr(
        recall_density, "measure_runs", lambda *words: [(label, dense) for label in labels]
    )
    (note,) = recall_density._measure(DensityOptions(), None)[1]
    assert note.endswith(": lru on A, gru on B")
    bars = [(bar.get_y(), bar.get_height()) for bar in stacked.axes[0].patches]
    assert np.array(bars) == pytest.approx(
        np.array([[0, 0.2], [0.2, 0.3], [0.5, 0.5]])
    )  # without the memory-free one
    assert [axis.get_title() for axis in stacked.axes] == ["MDP"]  # no empty panel beside it


def test_people_stand_beside_the_memory_free_agent_of_the_same_twin() -> None:
    with drawing("light"):
        (picture,) = gap_bias.human(PaperOptions(), None).pictures
    for axis in picture.figure.axes:
        (line,) = [line for line in axis.lines if line.get_label() == "memory-free agent"]
        rows = [
            row
            for row in read_csv(PAPER_RETURNS)
            if (row["model"], row["env"]) == ("MLP", axis.get_title())
        ]
        assert line.get_ydata().tolist() == [float(row["pomdp_mean"]) for row in rows]


def test_a_size_sweep_names_layers_and_width(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = fabricate(tmp_path / "runs")
    for layers, width in ((1, 512), (2, 128)):
        for twin in ("full", "partial"):
            for seed in (0, 1):
                run = runs / f"big-{layers}-{width}-{twin}-{seed}"
                write_run(
                    run, RunSpec("CartPoleEasy-v0", twin, "lru", "pqn", seed), 0.4 + layers / 10
                )
                change(run, network_options={"layers": layers, "hidden_size": width})
    figure(capsys, "size-sweep", "--runs", str(runs), "--out", str(tmp_path / "f"))
    rows = {row["agent"]: row for row in read_csv(tmp_path / "f" / "size-sweep.csv")}
    assert set(rows) == {"mlp", "gru 2x512", "lru 2x512", "lru 1x512", "lru 2x128"}
    assert float(rows["lru 1x512"]["bias"]) == pytest.approx(0.5 - 0.31)


def test_a_single_seed_is_drawn_without_an_interval_and_said_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = fabricate(tmp_path / "runs", seeds=(0,))
    text = figure(capsys, "returns", "--runs", str(runs), "--out", str(tmp_path / "f"))
    assert "no interval, a single seed: gru on CartPoleEasy-v0 (full)" in text
    assert read_csv(tmp_path / "f" / "returns.csv")[0]["gap_low"] == "nan"


def test_unfinished_runs_and_missing_twins_are_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = fabricate(tmp_path / "runs")
    write_run(
        runs / "slow", RunSpec("CartPoleEasy-v0", "full", "lru", "pqn", 9), 0.5, status="running"
    )
    write_run(runs / "alone", RunSpec("TetrisEasy-v0", "full", "lru", "pqn", 0), 0.5)
    text = figure(capsys, "gap-bias", "--runs", str(runs), "--out", str(tmp_path / "f"))
    assert "left out, not finished: slow" in text
    assert "left out, some agent lacks one of its twins: TetrisEasy-v0" in text


@pytest.mark.parametrize(
    "command", ["figure gap-bias", "figure returns", "figure curves", "analyze gap-bias"]
)
def test_numbers_as_csv_stand_alone_and_what_was_left_out_is_said_on_standard_error(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_study(tmp_path / "s", small_study())
    (folder.run(small_study().runs()[0]).path / "eval.json").unlink()
    (tmp_path / "s" / "runs" / "lost").symlink_to(tmp_path / "nowhere")
    assert (
        cli.main([*command.split(), str(tmp_path / "s"), "--csv", "--out", str(tmp_path / "f")])
        == 0
    )
    said = capsys.readouterr()
    assert "left out, not finished: MineSweeperEasy__full__mingru__pqn__seed0" in said.err
    assert "leads nowhere" in said.err and "left out" not in said.out
    (tmp_path / "printed.csv").write_text(said.out)
    assert read_csv(tmp_path / "printed.csv")


def test_what_cannot_be_compared_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, out = fabricate(tmp_path / "runs"), ["--out", str(tmp_path / "f")]
    ask = ["figure", "returns", *out, "--runs", str(runs)]
    write_run(runs / "new", RunSpec("CartPoleEasy-v1", "full", "lru", "pqn", 0), 0.5)
    assert "CartPoleEasy-v0 and CartPoleEasy-v1 cannot be compared" in refused(capsys, *ask)
    write_run(runs / "new", RunSpec("CartPoleEasy-v0", "full", "lru", "pqn", 7), 0.5)
    change(runs / "new", rules="reference")
    change(runs / "CartPoleEasy-v0__full__lru__pqn__seed0", rules="default")
    assert "runs with rules default and reference" in refused(capsys, *ask)
    shutil.rmtree(runs / "new")
    shutil.copytree(runs / "CartPoleEasy-v0__full__lru__pqn__seed0", runs / "twice")
    assert "are the same cell" in refused(capsys, *ask)
    shutil.rmtree(runs / "twice")
    assert "memory-free agent 'none'" in refused(capsys, *ask, "--baseline", "none")
    assert not (tmp_path / "f").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["figure", "retruns"], "unknown figure 'retruns': did you mean 'returns'?"),
        (["figure", "returns"], "name at least one study folder, run folder or CSV file"),
        (["figure", "returns", "--paper", "--out", "x.png"], "give a folder"),
        (["figure", "curves"], "name the folder with the runs"),
        (["figure", "curves", "--paper"], "Unrecognized options: --paper"),
        (["figure", "curves", "--runs", "nowhere"], "nowhere does not exist"),
        (["figure", "curves", "--runs", "empty"], "empty holds no run"),
        (["figure", "curves", "--runs", "file.csv"], "file.csv is a file"),
        (["figure", "curves", "--runs", "point"], "point is a single checkpoint"),
        (["figure", "curves", "--runs", "slow"], "none of the 1 runs below slow has finished"),
        (["figure", "curves", "--runs", "odd"], "does not describe a run"),
        (["figure", "returns", "--paper", "--confidence", "95"], "between 0 and 1"),
        (["figure", "returns", "--paper", "--confidence", "1"], "between 0 and 1"),
        (["analyze", "gap-bias", "slow", "--paper"], "and these are named: slow; leave"),
        (["figure", "hyperparameters", "slow", "--paper"], "in the place of runs, and these are"),
        (["figure", "returns", "--paper", "--baseline", "gru"], "leave out --baseline"),
        (["figure", "gap-bias", "--paper", "--confidence", ".5"], "leave out --confidence"),
        (["analyze", "recall-density"], "name at least one run folder"),
        (["analyze", "recall-density", "empty"], "holds no run"),
        (["analyze", "recall-density", "empty", "--bins", "0"], "--bins must be at least 1"),
        (["analyze", "contamination"], "name at least one run folder"),
        (["analyze", "contamination", "slow"], "holds no checkpoint"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "point", "odd"):
        (tmp_path / name).mkdir()
    (tmp_path / "file.csv").write_text("a\n")
    (tmp_path / "point" / "meta.json").write_text("{}")
    (tmp_path / "odd" / "config.json").write_text("{}")
    write_run(
        tmp_path / "slow",
        RunSpec("CartPoleEasy-v0", "full", "lru", "pqn", 9),
        0.5,
        status="running",
    )
    assert message in refused(capsys, *words)
    assert not (tmp_path / "figures").exists()


def test_the_usage_names_every_figure() -> None:
    assert all(f"figure {name} " in cli.usage() for name in FIGURES)


def test_analyze_and_figure_are_one_command_and_numbers_come_as_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = fabricate(tmp_path / "runs")
    said = []
    for words in (["analyze", "gap-bias", str(runs)], ["figure", "gap-bias", "--runs", str(runs)]):
        assert cli.main([*words, "--out", str(tmp_path / "t.csv"), "--csv"]) == cli.EXIT_OK
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] == (tmp_path / "t.csv").read_text()
    assert not (tmp_path / "t.png").exists()


def test_a_table_is_readable_at_80_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    runs = fabricate(tmp_path / "runs")
    assert (
        cli.main(["analyze", "gap-bias", str(runs), "--out", str(tmp_path / "t.csv")])
        == cli.EXIT_OK
    )
    lines = capsys.readouterr().out.splitlines()
    table = [line for line in lines if not line.startswith(str(tmp_path))]
    assert max(map(len, table)) <= 80 and not any("…" in line for line in table)
    row = read_csv(tmp_path / "t.csv")[1]
    ends = [
        f"{float(row[name]):+.3f}"
        for name in ("gap", "gap_low", "gap_high", "pomdp_iqm_low", "bias_high")
    ]
    assert all(any(end in line for line in table) for end in ends)
    assert sum("lru" in line for line in table) >= 2  # the name stands in every part


def test_colours_of_agents_stay_apart_for_people_who_see_red_and_green_alike() -> None:
    names = [name for name in AGENT_COLOURS if name not in ("tttl", "feedforward", "fart")]
    rgb = (
        np.array([[int(AGENT_COLOURS[name][i : i + 2], 16) for i in (1, 3, 5)] for name in names])
        / 255
    )
    # deuteranopia and protanopia, Machado et al. (2009), severity 1, applied to linear light
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    deutan = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    protan = np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]])
    for matrix in (np.eye(3), deutan, protan):
        seen = np.clip(linear @ matrix.T, 0, 1) ** (1 / 2.2)
        apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1) + 9 * np.eye(len(names))
        assert apart.min() > 0.12, [names[i] for i in np.unravel_index(apart.argmin(), apart.shape)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of an agent, too short to learn anything."""
    root = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        train(
            preset("smoke", env="MineSweeperEasy", observability="full", memory="gru", seed=seed),
            root / f"gru-{seed}",
        )
    return root


def test_recall_density_of_checkpoints_is_drawn_kept_and_used_again(
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs = [str(run) for run in sorted(trained.iterdir())]
    words = [
        "analyze",
        "recall-density",
        *runs,
        "--episodes",
        "6",
        "--max-frames",
        "12",
        "--out",
        str(tmp_path),
    ]
    assert cli.main(words) == 0
    assert "gradient of the last decision" in capsys.readouterr().out
    rows = read_csv(tmp_path / "recall-density-16.csv")
    assert sum(float(row["mass"]) for row in rows) == pytest.approx(1) and {
        row["seeds"] for row in rows
    } == {"2"}
    assert all(float(row["low"]) <= float(row["mass"]) <= float(row["high"]) for row in rows)
    with np.load(tmp_path / "recall-density-3.npz") as kept:
        assert kept["shares_1"].sum() == pytest.approx(len(kept["lengths_1"])) and kept[
            "points"
        ].shape == (2, 101)
    monkeypatch.setattr("arcade_torch.tools.measures.windows.play", None)
    assert cli.main(words) == 0
    assert read_csv(tmp_path / "recall-density-16.csv") == rows
    monkeypatch.undo()
    file = next((trained / "gru-0" / "analysis").glob("recall_density-*.npz"))
    whole = file.read_bytes()
    first = (
        30 + int.from_bytes(whole[26:28], "little") + int.from_bytes(whole[28:30], "little")
    )  # byte of data
    damaged = (
        whole[:first] + bytes([whole[first] | 0b110]) + whole[first + 1 :]
    )  # no such kind of compressed block
    for junk in (b"junk", whole[:200], damaged):  # no zip file, half of one, a flipped bit
        file.write_bytes(junk)
        assert cli.main(words) == 0
        assert read_csv(tmp_path / "recall-density-16.csv") == rows  # made anew


def test_contamination_of_checkpoints_is_drawn_with_an_example(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "analyze",
        "contamination",
        *map(str, sorted(trained.iterdir())),
        "--starts",
        "6",
        "--delays",
        "0",
        "1",
    ]
    words += ["--sigmas", "0", "1", "--out", str(tmp_path)]
    assert cli.main([*words, "--horizon", "3"]) == 0
    text = capsys.readouterr().out
    assert "changed decisions in %" in text and "6 start points" in text
    rows = read_csv(tmp_path / "contamination-noise-MineSweeperEasy-v0-full.csv")
    assert [(row["sigma"], row["delay"]) for row in rows] == [
        ("0.0", "0"),
        ("0.0", "1"),
        ("1.0", "0"),
        ("1.0", "1"),
    ]
    assert float(rows[0]["change"]) < 1e-5 < float(rows[2]["change"])
    assert (tmp_path / "contamination-noise-MineSweeperEasy-v0-full.png").exists()
    example = tmp_path / "contamination-noise-example-MineSweeperEasy-v0-full"
    assert example.with_suffix(".png").exists() and example.with_suffix(".pdf").exists()
    rows = read_csv(example.with_suffix(".csv"))
    versions = [(row["row"], row["hit"]) for row in rows[::5]]
    assert versions == [("clean", ""), ("noise on frame 1", "1"), ("noise on frame 2", "2")]
    assert [row["action"] for row in rows[:5]] == ["up", "down", "left", "right", "fire"] and len(
        rows
    ) == 15
    assert cli.main([*words, "--horizon", "5000"]) == 0
    assert "no example of" in (text := capsys.readouterr().out) and "5001 frames are needed" in text
    assert "--horizon must be at least 2" in refused(capsys, *words, "--horizon", "1")


def test_the_bars_of_an_example_say_where_the_best_action_changed() -> None:
    values, hits = (
        np.array([[0, 1, 0, 0, -1], [0, 2, 0, 0, -2], [3, 1, 0, 0, -4]], np.float64),
        np.array([-1, 1, 2]),
    )
    pictures, order = np.zeros((3, 4, 8, 8, 3), np.uint8), np.tile(np.arange(4), (3, 1))
    label = Label(AgentKey("pqn", "lru"), "CartPoleEasy-v0", "full", 0, Path("run"), "lru")
    with drawing("light"):
        figure, note, rows = contamination._example(
            label, Example(pictures, order, hits, values, "q", 0.3)
        )
        bars = [axis for axis in figure.axes if axis.patches]
        colours = [[to_hex(bar.get_facecolor()) for bar in axis.patches] for axis in bars]
        assert (
            len({axis.get_ylim() for axis in bars}) == 1
            and bars[0].get_ylim()[0] < -4
            and bars[0].get_ylim()[1] > 3
        )
    grey, blue, red = REST, CLEAN_BEST, OTHER_BEST
    assert colours == [[grey, blue, grey, grey, grey]] * 2 + [[red, blue, grey, grey, grey]]
    assert "sigma = 0.3" in note and [row["value"] for row in rows] == values.ravel().tolist()


def test_counterfactual_recall_of_checkpoints_is_drawn_with_its_numbers(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(run) for run in sorted(trained.iterdir())]
    words = ["analyze", "counterfactual", *runs, "--episodes", "6", "--lags", "5"]
    words += ["--donors", "6", "--max-frames", "8", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "reliance on memory and observation" in text and "gru on" in text
    assert "fewer than 6 donors: a decision has the 5 other episodes at most" in text
    name = tmp_path / "counterfactual-MineSweeperEasy-v0-full"
    assert name.with_suffix(".png").exists() and name.with_suffix(".pdf").exists()
    rows = read_csv(name.with_suffix(".csv"))
    assert [row["lag"] for row in rows[:6]] == ["0", "1", "2", "3", "4", "state"]
    assert {row["donors"] for row in rows} == {"all donors", "donors that differ"}
    first = rows[0]
    assert float(first["flip_low"]) <= float(first["flip"]) <= float(first["flip_high"])
    assert float(first["distance"]) > 0 and first["seeds"] == "2"
    assert "--episodes must be at least 2" in refused(capsys, *words, "--episodes", "1")
    assert "--lags must be at least 1" in refused(capsys, *words, "--lags", "0")


def test_beliefs_of_checkpoints_are_drawn_with_their_numbers(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(run) for run in sorted(trained.iterdir())]
    words = ["analyze", "beliefs", *runs, "--episodes", "16", "--max-steps", "5"]
    words += ["--out", str(tmp_path)]
    assert cli.main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "hidden facts that can be read" in text and "gru on" in text
    assert "whose decision an exchanged state brings" in text
    assert "decisions that follow one fact" in text and "at random" in text
    name = tmp_path / "beliefs-MineSweeperEasy-v0-full"
    assert name.with_suffix(".png").exists() and name.with_suffix(".pdf").exists()
    rows = read_csv(name.with_suffix(".csv"))
    assert [row["step"] for row in rows[:6]] == ["all", "0", "1", "2", "3", "4"]
    assert {(row["fact"], row["source"]) for row in rows} == {
        (fact, source) for fact in ("mine", "swept") for source in ("state", "frame")
    }
    assert rows[0]["seeds"] == "2"
    assert float(rows[0]["low"]) <= float(rows[0]["score"]) <= float(rows[0]["high"])
    assert "--episodes must be at least 8" in refused(capsys, *words, "--episodes", "7")
    assert "--max-steps must be at least 1" in refused(capsys, *words, "--max-steps", "0")


def probes(state: float | None, frame: float, fact: str = "sign") -> Beliefs:
    """Two episodes of two steps in which a guess is always wrong, and probes with such scores."""
    guess = np.ones((1, 2, 2))
    return Beliefs(
        names=np.array([fact]),
        is_class=np.array([True]),
        cells=np.array([1]),
        guess_loss=guess,
        state_loss=guess * (np.nan if state is None else 1 - state),
        frame_loss=guess * (1 - frame),
        constant=np.array(["sky"]),
        state_width=0 if state is None else 3,
        frame_width=4,
        episodes=8,
    )


def test_probes_pool_seeds_and_an_agent_without_memory_has_no_bar_of_a_state() -> None:
    scores = {
        "lru": beliefs.scores_of([probes(0.9, 0.2), probes(0.7, 0.4)]),
        "mlp": beliefs.scores_of([probes(None, 0.3)]),
    }
    overall = scores["lru"]["sign", "state"].overall
    assert overall.value == pytest.approx(0.8) and 0.7 <= overall.low < 0.8 < overall.high
    np.testing.assert_allclose(scores["lru"]["sign", "frame"].by_step, [0.3, 0.3])
    assert list(scores["mlp"]) == [("sign", "frame")]
    with drawing("light"):
        axis = panels(1, 1, (4, 3))[1][0, 0]
        beliefs.plot_bars(scores, axis, {"lru": "#0072b2", "mlp": "#000000"})
        heights = [bar.get_height() for bar in axis.patches]
        axis = panels(1, 1, (4, 3))[1][0, 0]
        beliefs.plot_steps(scores, "sign", axis, {"lru": "#0072b2", "mlp": "#000000"})
    np.testing.assert_allclose(heights, [0.8, 0.3, 0.3])
    assert [line.get_linestyle() for line in axis.lines[:3]] == ["-", "--", "--"]


def test_probes_say_who_has_no_memory_and_what_did_not_vary() -> None:
    label = Label(AgentKey("pqn", "mlp"), "SignpostEasy-v0", "partial", 0, Path("run"), "mlp")
    no_state, left_out = beliefs._notes([(label, probes(None, 0.3))])
    assert "mlp on SignpostEasy-v0 (partial), seed 0 has no recurrent state" in no_state
    assert left_out.endswith("sky did not vary, and can be read off nothing")


def exchanges(flip: Sequence[float], state: float, **other: Any) -> Counterfactual:
    """One decision with two donors, of which the second alone differs, and changes nothing else."""
    lags = np.stack([np.zeros(len(flip)), np.array(flip)], -1)[None]
    states = np.array([[0.0, state]])
    differs = np.zeros_like(lags)
    differs[..., 1] = 1
    values: dict[str, Any] = {
        "certainty": np.array([0.5]),
        "lengths": np.array([len(flip)]),
        "target": "probs",
    }
    return Counterfactual(
        *(lags, lags, lags, differs),
        *(states, states, states, differs[:, 0]),
        dropped=0,
        alone=0,
        clean_error=0.0,
        **(values | other),
    )


def test_profiles_pool_seeds_of_different_lengths_and_a_single_one_over_its_episodes() -> None:
    seeds = [exchanges([0.2, 0.4, 0.6], 0.8), exchanges([0.4, 0.4], 0.4)]
    flip = counterfactual.profiles_of(seeds, False)["flip"]
    np.testing.assert_allclose(flip.mean, [0.15, 0.2, 0.3, 0.3])
    assert np.isnan(flip.low[2]) and flip.low[3] < 0.3 < flip.high[3]
    differing = counterfactual.profiles_of(seeds[:1], True)["flip"]
    np.testing.assert_allclose(differing.mean, [0.2, 0.4, 0.6, 0.8])
    with drawing("light"):
        axis = panels(1, 1, (4, 3))[1][0, 0]
        profiles = {"lru": counterfactual.profiles_of(seeds, True)}
        counterfactual.plot(profiles, axis, "flip", {"lru": "#0072b2"})
        by_lag, of_state = axis.lines[:2]
    assert by_lag.get_ydata().tolist() == pytest.approx([0.3, 0.4, 0.6])
    assert by_lag.get_xdata().tolist() == [0, 1, 2]
    assert of_state.get_xdata().tolist() == [3.5]
    assert of_state.get_ydata().tolist() == pytest.approx([0.6])
    assert axis.get_xticklabels()[-1].get_text() == "state"
    both = {"lru": seeds, "one": seeds[0]}
    figure = counterfactual.counterfactual_figure(both, figure=new_figure())
    everybody, differ = [axis.lines[0].get_ydata().tolist() for axis in figure.axes]
    assert everybody == pytest.approx([0.15, 0.2, 0.3])
    assert differ == pytest.approx([0.3, 0.4, 0.6])


def test_the_row_of_a_report_names_the_frame_that_matters_most_and_saturated_policies() -> None:
    row = counterfactual._section_row([exchanges([0.9, 0.0, 1.0], 1.0)])
    assert (row["observation"].value, row["memory"].value) == (0.45, 0.5)
    assert (row["peak"], row["at_peak"].value, row["at_peak_differing"].value) == (2, 0.5, 1)
    assert not row["saturated"]
    for target, saturated in (("probs", True), ("q", False)):
        seed = exchanges([0.9, 0.0], 1.0, certainty=np.array([0.9999]), target=target)
        assert counterfactual._section_row([seed])["saturated"] == saturated
    density = RecallDensity(
        np.array([0.1, 0.2, 0.7, 0.4, 0.6]), np.array([3, 2]), np.array([True, True]), 0, 0, "q",
        np.ones(2), np.ones(2),
    )  # fmt: skip
    np.testing.assert_allclose(counterfactual.share_by_lag([density], 3), [0.65, 0.3, 0.1])


def test_intervals_resample_seeds_and_their_episodes() -> None:
    rng = np.random.default_rng(0)
    episodes = rng.random((40, 1))
    one = pooled_episodes([episodes])
    over_episodes = pooled(episodes[:, 0].tolist())
    np.testing.assert_allclose(one.mean, over_episodes.mean)
    np.testing.assert_allclose(one.low, over_episodes.low, atol=0.02)
    same = pooled_episodes([episodes, episodes])  # seeds agree: their episodes still vary
    assert 0.5 < (same.high - same.low)[0] / (one.high - one.low)[0] < 0.9
    apart = pooled_episodes([np.zeros((40, 1)), np.ones((40, 1))])
    assert (apart.low[0], apart.mean[0], apart.high[0]) == (0, 0.5, 1)
    sure = pooled_episodes([np.ones((40, 2)), np.ones((30, 2))])
    assert (sure.low == 1).all() and (sure.high == 1).all()
    none = pooled_episodes([np.full((3, 1), np.nan), np.array([[np.nan], [0.25]])])
    assert none.mean[0] == 0.25 and np.isnan(none.low[0]) and np.isnan(none.seeds[0, 0])


def test_sentences_claim_memory_only_where_an_interval_excludes_zero() -> None:
    unsure = Interval(0.3, 0.0, 0.6)
    sure = Interval(0.72, 0.6, 0.8)
    row = {"game": "Signpost", "twin": "POMDP", "agent": "lru", "memory": sure, "peak": 4}
    row |= {"memory_differing": Interval(1, 1, 1), "at_peak": sure}
    rows = [
        row | {"memory": unsure},
        row | {"memory": Interval(0.9, np.nan, np.nan)},
        row | {"twin": "MDP", "at_peak": unsure, "memory": Interval(0.2, 0.1, 0.4)},
        row,
    ]
    assert counterfactual._sentences(rows) == [
        "Signpost POMDP: another episode's memory changes 72 % of lru's decisions, 100 % where it "
        "differs; of single frames the one 4 steps back changes most, 72 %.",
        "Signpost MDP: another episode's memory changes 20 % of lru's decisions, 100 % where it "
        "differs; the MDP shows all there is to know on the last frame.",
    ]


def test_noise_that_cannot_matter_is_named_and_empty_panels_say_why() -> None:
    label = Label(AgentKey("pqn", "lru"), "CartPoleEasy-v0", "full", 0, Path("run"), "lru")
    flip = np.zeros((4, 2, 3))
    flip[:, 1, 0] = 1  # the stronger noise, on the frame that decides
    flip[:, :, 2] = np.nan
    noise = Contamination(
        np.array([0.1, 1.0]), np.array([0, 1, 9]), flip, flip, np.nan * flip,
        np.zeros((4, 2), np.int64), 0.0, 0, "q",
    )  # fmt: skip
    (note,) = contamination._powerless_notes([(label, noise)])
    assert "sigma 0.1 cannot matter" in note and "sigma 1 " not in note
    assert [contamination._section_row([(label, seed)])[1]["powerless"]
            for seed in (noise, replace(noise, flip=flip[:, ::-1]))] == [True, False]  # fmt: skip
    measures = contamination.pool(by_task([(label, noise)]))
    (of_agent,) = measures.values()
    with drawing("light"):
        axes = panels(1, 3, (9, 3))[1][0]
        contamination.plot({"lru": of_agent}, axes[0], "flip", 0, [0, 1])
        contamination.plot({"lru": of_agent}, axes[1], "flip", 1, [0, 1])
        contamination.plot({"lru": of_agent}, axes[2], "kl", 0, [0, 1])
    texts = [[text.get_text() for text in axis.texts if text.get_text()] for axis in axes]
    assert texts[0] == ["no decision changes"] and not texts[1]
    assert texts[2] == ["not measured: no episode is so long, or outputs are all alike"]
    assert contamination._section_row([(label, noise)])[1]["longest"] == 1  # 9 steps: no episode
    late = replace(noise, delays=np.array([1, 2, 9]))  # the ceiling was not measured
    assert not contamination._powerless_notes([(label, late)])


@pytest.mark.parametrize(
    ("output", "gradient", "norm", "words"),
    [
        ([0.999, 0.001], 1e-3, "l2sq", "saturated, its best action has 0.99900"),
        ([0.6, 0.4], 1e-12, "l2sq", "all squared gradients sum to 2e-12"),
        ([0.999, 0.001], 1e-12, "l2sq", "0.99900, and all squared"),
        ([0.6, 0.4], 1e-12, "l2", ""),
        ([0.6, 0.4], 1e-12, "l1", "all gradients sum to 2e-12"),
        ([0.6, 0.4], 1e-2, "l1", ""),
        ([0.6, 0.4], 1e-3, "l2sq", ""),
    ],
)
def test_saliency_says_where_gradients_vanish(
    output: list[float], gradient: float, norm: str, words: str
) -> None:
    episode = EpisodeSaliency(
        np.ones((2, 4, 4), np.float32), np.array([gradient, gradient]), np.array(output, np.float32),
        1, "probs", np.zeros((2, 4, 4, 3), np.uint8), np.zeros(2, np.int64),
    )  # fmt: skip
    warning = saliency_figures.no_gradient(episode, norm)
    assert words in warning if words else warning == ""
    assert "saturated" not in saliency_figures.no_gradient(replace(episode, target="q"), norm)


def test_recall_density_says_in_one_line_where_gradients_vanish() -> None:
    label = Label(AgentKey("ppo", "lru"), "SignpostEasy-v0", "partial", 0, Path("run"), "lru")
    sure = RecallDensity(
        np.array([0.1, 0.2, 0.7, 0.4, 0.6]), np.array([3, 2]), np.array([True, True]), 0, 0,
        "probs", np.array([1e-12, 3e-12]), np.array([0.9999, 0.9997]),
    )  # fmt: skip
    (note,) = recall_density.vanishing_notes([(label, sure)])
    assert "saturated, its best action has 0.99980, and all gradients sum to 2e-12" in note
    assert "counterfactual recall" in note and "\n" not in note
    unsure = replace(sure, sizes=np.array([0.5, 3.0]), certainty=np.array([0.5, 0.7]))
    of_values = replace(sure, target="q", sizes=np.array([0.5, 3.0]))
    assert not recall_density.vanishing_notes([(label, unsure), (label, of_values)])


@dataclass
class Weight:
    weight: float


def weight_of(agent: Any) -> Weight:
    return Weight(agent.network.weight.item())


def test_other_weights_in_the_same_folder_are_measured_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = TensorDictModule(torch.nn.Linear(1, 1), ["pixels"], ["action_value"])
    agent = Agent(preset("smoke", env="MineSweeperEasy"), network)
    monkeypatch.setattr(checkpoints, "load_agent", lambda path: agent)
    (tmp_path / "config.json").write_text("{}")
    for value in (1.0, 2.0, 1.0):
        torch.nn.init.constant_(agent.network.weight, value)
        assert checkpoints.measure_run(tmp_path, weight_of, {})[1] == Weight(value)
    assert len(list((tmp_path / "analysis").iterdir())) == 2


def test_names_of_facts_are_not_written_over_each_other() -> None:
    """Before: angular_velocity of CartPole began in the name before it and ended in the next."""
    interval = Interval(0.5, 0.4, 0.6)
    facts = ("angle", "angular_velocity", "angular_position", "velocity")
    scores = {
        agent: {(fact, "frame"): beliefs.Scores(interval, *np.full((3, 2), 0.5)) for fact in facts}
        for agent in ("lru", "mlp")
    }
    with drawing("light") as plt:
        figure, axis = plt.subplots(figsize=(4.2, 3.6), layout="constrained")
        beliefs.plot_bars(scores, axis, {"lru": "#0072b2", "mlp": "#000000"})
        figure.draw_without_rendering()
        names = axis.get_xticklabels()
        assert [name.get_text() for name in names] == list(facts)
        lines = [name.get_rotation() for name in names]
        ends = [name.get_window_extent().x1 for name in names]
    starts = np.diff(ends) * np.sin(np.radians(lines[1:]))  # between the lines of two names
    assert (starts > 12).all()  # pixels, a small line's height


class Typed(torch.nn.Module):
    """A weight in half precision, as a memory of somebody else may have one, beside a scalar."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1, dtype=torch.bfloat16))
        self.register_buffer("steps", torch.tensor(3))
        self.register_buffer("phases", torch.ones(2, dtype=torch.complex64))


def test_weights_of_any_type_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: NumPy knows no bfloat16, and every measure of such an agent ended in a TypeError."""
    network = TensorDictModule(Typed(), ["pixels"], ["action_value"])
    agent = Agent(preset("smoke", env="MineSweeperEasy"), network)
    monkeypatch.setattr(checkpoints, "load_agent", lambda path: agent)
    (tmp_path / "config.json").write_text("{}")
    for value in (1.0, 1.0078125):  # neighbours
        torch.nn.init.constant_(agent.network.weight, value)
        assert checkpoints.measure_run(tmp_path, weight_of, {})[1] == Weight(value)


def test_the_confidence_that_is_asked_for_is_that_of_bands_and_bars(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three seeds the middle tenth of all draws lies well inside their 95 %."""
    labels = [
        Label(AgentKey("pqn", "lru"), "CartPoleEasy-v0", "full", seed, Path("run"), "lru")
        for seed in range(3)
    ]
    shares = [np.array([0.1 * seed, 0.3, 0.7 - 0.1 * seed]) for seed in range(3)]
    dense = [
        RecallDensity(share, np.array([3]), np.array([True]), 0, 0, "q", np.ones(1), np.ones(1))
        for share in shares
    ]
    flips = [
        np.array([[[1.0, 0.4 * seed if seed else np.nan]]]) for seed in range(3)
    ]  # one episode ended before
    noisy = [Contamination(np.array([0.3]), np.array([0, 1]), flip, flip, np.nan * flip, np.zeros((1, 2), np.int64),
                           0.0, 0, "q") for flip in flips]  # fmt: skip

    def no_example(*words: Any) -> None:
        raise ValueError("too short")

    monkeypatch.setattr(
        recall_density, "_measure", lambda *words: (list(zip(labels, dense, strict=True)), [])
    )
    monkeypatch.setattr(contamination, "checkpoints_of", lambda paths: ([], []))
    monkeypatch.setattr(
        contamination, "measure_runs", lambda *words: list(zip(labels, noisy, strict=True))
    )
    monkeypatch.setattr(contamination, "measure_run", no_example)
    runs = (fabricate(tmp_path),)

    def widths(confidence: float) -> list[float]:
        with drawing("light"):
            density = recall_density.densities(
                DensityOptions(bins=(3,), confidence=confidence), None
            ).pictures[0]
            noise = contamination.by_delay(
                ContaminationOptions(confidence=confidence), None
            ).pictures[0]
            curve = logs.curves(CurveOptions(runs, confidence=confidence), None).pictures[0]
        assert [row["seeds"] for row in noise.rows] == [3, 2] and "n = 2 to 3 seeds" in noise.note
        rows = density.rows[0], curve.rows[0]
        return [
            *(row["high"] - row["low"] for row in rows),
            noise.rows[1]["flip_high"] - noise.rows[1]["flip_low"],
        ]

    assert all(
        wide > 2 * narrow >= 0 for wide, narrow in zip(widths(0.95), widths(0.1), strict=True)
    )


def test_two_checkpoints_of_one_seed_are_not_pooled_as_two_seeds(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(trained / "gru-0")
    words = [
        "analyze",
        "contamination",
        run,
        run,
        "--starts",
        "2",
        "--delays",
        "0",
        "--out",
        str(tmp_path),
    ]
    assert "gru-0 are the same cell: give one of them" in refused(capsys, *words)


def test_runs_named_one_by_one_are_compared_like_those_of_a_folder(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [shutil.copytree(trained / "gru-0", tmp_path / str(seed)) for seed in (0, 1)]
    change(runs[1], seed=1, total_frames=7)
    assert "differ in total_frames: " in refused(
        capsys, "analyze", "recall-density", *map(str, runs)
    )


def test_checkpoints_named_one_by_one_are_compared_like_those_of_a_folder(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [shutil.copytree(trained / "gru-0", tmp_path / str(seed)) for seed in (0, 1)]
    newest = [sorted((run / "checkpoints").glob("frames-*"))[-1] for run in runs]
    record = json.loads((newest[1] / "meta.json").read_text())
    record["config"] |= {"seed": 1, "amp": True}
    (newest[1] / "meta.json").write_text(json.dumps(record))
    assert "differ in amp: False and True" in refused(
        capsys, "analyze", "recall-density", *map(str, newest)
    )
    assert "differ in amp: False and True" in refused(
        capsys, "analyze", "saliency", str(runs[0]), str(newest[1])
    )


def test_seeds_that_learned_different_twins_are_not_pooled_when_one_twin_is_looked_at(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [shutil.copytree(trained / "gru-0", tmp_path / str(seed)) for seed in (0, 1)]
    twin = (
        "full"
        if json.loads((runs[0] / "config.json").read_text())["config"]["observability"] != "full"
        else "partial"
    )
    change(runs[1], seed=1, observability=twin)
    for file in (runs[1] / "checkpoints").glob("*/meta.json"):
        record = json.loads(file.read_text())
        record["config"] |= {"seed": 1, "observability": twin}
        file.write_text(json.dumps(record))
    words = [
        "analyze",
        "recall-density",
        *map(str, runs),
        "--observability",
        "full",
        "--episodes",
        "2",
    ]
    assert "(full) and " in refused(capsys, *words)


def test_saliency_of_runs_has_a_row_for_every_agent(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure(capsys, "saliency", "--runs", str(trained), "--out", str(tmp_path))
    shares = [float(row["share"]) for row in read_csv(tmp_path / "saliency.csv")]
    assert sum(shares) == pytest.approx(1)
    with np.load(tmp_path / "saliency.npz") as kept:
        assert kept["maps_0"].shape == kept["frames_0"].shape[:3] and "maps_1" not in kept
