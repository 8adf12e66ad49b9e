"""Which scores are read from runs and tables, and which are refused."""

import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools.scores import read_scores
from arcade_torch.tools.studies.grid import RunSpec
from tests.tools.fabricated import small_study, write_run, write_study
from tests.tools.test_runs import write

GAME = "CartPoleEasy"
TWINS = ("full", "partial")


def table(path: Path, agent: str = "lru", **settings: Any) -> Path:
    """A table of one agent on both twins, with columns of one's own."""
    lines = [",".join(["agent", "game", "observability", "seed", "score", *settings])]
    for twin in TWINS:
        values = [json.dumps(str(value)).replace('\\"', '""') for value in settings.values()]
        lines.append(",".join([agent, GAME, twin, "0", "0.5", *values]))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_metric_of_runs_is_the_one_that_is_asked_for(tmp_path: Path) -> None:
    write(tmp_path / "run", "lru", "full", 0, 0.5)
    final, best = (read_scores(tmp_path, metric) for metric in ("eval_final", "train_max_ewm"))
    assert [score.value for score in final] == [0.5]
    assert [score.value for score in best] == pytest.approx([0.45])  # as `write_run` has it


@pytest.mark.parametrize(
    ("metric", "columns", "wanted"),
    [
        ("eval_final", "score,train_max_ewm,eval_mean", 3),
        ("train_max_ewm", "score,eval_mean,train_max_ewm", 3),
        ("eval_final", "score,train_max_ewm,eval_final", 3),
        ("train_max_ewm", "eval_mean,score,other", 2),
        ("eval_final", "other,value,train_max_ewm", 2),
    ],
)
def test_the_column_of_a_metric_comes_before_a_plain_score(
    tmp_path: Path, metric: str, columns: str, wanted: float
) -> None:
    file = tmp_path / "scores.csv"
    file.write_text(f"agent,game,observability,seed,{columns}\nlru,{GAME},full,0,1,2,3\n")
    assert [score.value for score in read_scores(file, metric)] == [wanted]


def test_a_line_without_a_score_has_not_finished(tmp_path: Path) -> None:
    file = tmp_path / "scores.csv"
    head = "memory,algorithm,game,observability,seed,player,eval_mean"
    rows = [f"lru,pqn,{GAME},full,0,,0.5", f"lru,pqn,{GAME},full,1,,", f"lru,ppo,{GAME},full,2,a,1"]
    file.write_text("\ufeff" + "\n".join([head, *rows]) + "\n")
    first, other = read_scores(file)
    assert (first.agent, first.seed, first.value, first.player) == ("pqn-lru", 0, 0.5, "")
    assert (other.agent, other.seed, other.value, other.player) == ("ppo-lru", 2, 1.0, "a")


@pytest.mark.parametrize(
    ("name", "one", "other"),
    [("rules", "default", "reference"), ("options", "{}", '{"mine_reward": -1}')],
)
def test_tables_and_runs_that_were_played_otherwise_are_not_pooled(
    tmp_path: Path, name: str, one: str, other: str
) -> None:
    """Before: only within one table; people's scores by the published rules stood beside agents'
    by ours.
    """
    ours = table(tmp_path / "a.csv", "lru", **{name: one})
    theirs = table(tmp_path / "b.csv", "human", **{name: other})
    silent = table(tmp_path / "c.csv", "gru")
    message = rf"{GAME}.* was played with {name} .* in .*, and with|{GAME}.* was played with {name}"
    with pytest.raises(ValueError, match=message):
        read_scores([ours, theirs])
    assert len(read_scores([ours, silent])) == 4  # it does not say
    runs = [write(tmp_path / twin, "ttt", twin, 0, 0.5) for twin in TWINS]
    assert len(read_scores([*runs, ours])) == 4
    with pytest.raises(ValueError, match=message):
        read_scores([*runs, theirs])


def test_people_may_see_larger_frames_than_agents(tmp_path: Path) -> None:
    people = table(tmp_path / "human.csv", "human", obs_size=256, rules="default")
    agents = table(tmp_path / "runs.csv", "lru", obs_size=128, rules="default")
    assert len(read_scores([people, agents])) == 4


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rules", ("default", "reference")),
        ("obs_size", ("128", "256")),
        ("options", ("{}", "{'a': 1}")),
    ],
)
def test_a_game_in_one_table_has_one_of_each_setting(
    tmp_path: Path, name: str, values: tuple[str, str]
) -> None:
    file = tmp_path / "scores.csv"
    lines = [f"agent,game,observability,seed,score,{name}"]
    lines += [f'lru,{GAME},full,{seed},0.5,"{value}"' for seed, value in enumerate(values)]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="has scores of rules, obs_size and options"):
        read_scores(file)


def test_of_a_study_without_its_runs_the_settings_of_the_finished_ones_are_compared(
    tmp_path: Path,
) -> None:
    study = small_study()
    folder = write_study(tmp_path / "study", study)
    lost = tmp_path / "lost"
    (lost / "configs").mkdir(parents=True)
    for run in study.runs():
        settings = study.config(run).to_dict()
        (lost / "configs" / f"{run.name}.json").write_text(json.dumps(settings))
    table = (folder.root / "results.csv").read_text()
    (lost / "results.csv").write_text(table)
    assert len(read_scores(lost)) == 8
    first = study.runs()[0]
    file = lost / "configs" / f"{first.name}.json"
    file.write_text(json.dumps(study.config(first).to_dict() | {"rules": "reference"}))
    with pytest.raises(ValueError, match="runs with rules default and reference"):
        read_scores(lost)
    # one whose settings are lost, or lie outside of the study, is not compared
    file.rename(lost / file.name)
    assert len(read_scores(lost)) == 8
    table = (lost / "results.csv").read_text()
    (lost / "results.csv").write_text(table.replace(first.name, f"../{first.name}"))
    assert len(read_scores(lost)) == 8
    (lost / "results.csv").write_text(table)
    (lost / file.name).rename(file)
    # one that has not finished has no score, and says nothing
    rows = read_csv(lost / "results.csv")
    place = next(line for line, row in enumerate(rows) if row["run"] == first.name)
    rows[place] |= {"status": "failed", "eval_mean": "", "train_max_ewm": ""}
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    (lost / "results.csv").write_text("\n".join(lines) + "\n")
    assert len(read_scores(lost)) == 7


def test_a_study_that_has_its_runs_is_read_from_them(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "study", small_study())
    file = folder.root / "results.csv"
    file.write_text(file.read_text().replace("0.", "7."))
    assert max(score.value for score in read_scores(folder.root)) < 1


def test_a_run_in_a_folder_and_in_a_table_is_one_too_many(tmp_path: Path) -> None:
    spec = RunSpec(f"{GAME}-v0", "full", "lru", "pqn", 0)
    write_run(tmp_path / "run", spec, 0.5)
    with pytest.raises(ValueError, match="two scores for lru on CartPoleEasy-v0"):
        read_scores([tmp_path / "run", table(tmp_path / "a.csv", "lru")])
