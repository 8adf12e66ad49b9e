"""Which agent a run is, and what may be pooled as seeds of one."""

import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, gap_and_bias
from arcade_torch.tools.play.scores import COLUMNS
from arcade_torch.tools.runs import AgentKey, agent_names, find_runs, read_scores
from arcade_torch.tools.studies.grid import RunSpec
from tests.tools.fabricated import write_run

GAME = "CartPoleEasy-v0"


def write(path: Path, memory: str, twin: str, seed: int, score: float, algorithm: str = "pqn", **config: Any) -> Path:
    """A finished run with some settings changed."""
    write_run(path, RunSpec(GAME, twin, memory, algorithm, seed), score)
    record = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(record | {"config": record["config"] | config}))
    return path


def test_seeds_of_ppo_and_of_pqn_are_not_pooled_as_one_agent(tmp_path: Path) -> None:
    runs = []
    for twin in ("full", "partial"):
        runs += [write(tmp_path / f"a-{twin}", "lru", twin, 1, 0.9, "ppo")]
        runs += [write(tmp_path / f"b-{twin}", "lru", twin, 0, 0.1, "pqn")]
        runs += [write(tmp_path / f"c-{twin}", "mlp", twin, 0, 0.5, "pqn")]
    table = gap_and_bias(runs, draws=10)
    assert {row.agent for row in table.rows} == {"pqn-mlp", "pqn-lru", "ppo-lru"}
    assert table.row("ppo-lru").mdp.value == pytest.approx(0.9) and table.row("ppo-lru").seeds == 1


def test_two_sizes_of_a_memory_are_two_lines_of_the_curves(tmp_path: Path) -> None:
    for seed, width in ((0, 512), (1, 128)):
        options = {"network": "paper", "network_options": {"hidden_size": width}}
        write(tmp_path / "runs" / str(width), "lru", "full", seed, 0.5, **options)
    assert cli.main(["figure", "curves", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path)]) == 0
    rows = read_csv(tmp_path / "curves.csv")
    assert {(row["agent"], row["seeds"]) for row in rows} == {("lru 2x512", "1"), ("lru 2x128", "1")}


def test_seeds_trained_with_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    for seed, gamma in ((0, 0.9), (1, 0.99)):
        write(tmp_path / str(seed), "lru", "full", seed, 0.5, pqn={"gamma": gamma})
    with pytest.raises(ValueError, match=r"seeds of lru on CartPoleEasy-v0 \(full\) differ in pqn.gamma: 0.9 and 0.99"):
        find_runs([tmp_path])


def test_names_say_no_more_than_is_needed_to_tell_agents_apart() -> None:
    plain, ppo = AgentKey("pqn", "lru"), AgentKey("ppo", "lru")
    big, skip = AgentKey("pqn", "lru", size="2x128"), AgentKey("pqn", "lru", options=(("skip", "none"),))
    assert agent_names([plain]) == {plain: "lru"}
    assert agent_names([plain, ppo]) == {plain: "pqn-lru", ppo: "ppo-lru"}
    assert agent_names([plain, big])[big] == "lru 2x128"
    assert agent_names([plain, skip]) == {plain: "lru", skip: "lru skip=none"}


def test_two_players_share_one_file_of_human_scores(tmp_path: Path) -> None:
    lines = [",".join(COLUMNS)]
    for player, score in (("ann", 0.5), ("bob", 0.7)):
        for twin in ("full", "partial"):
            lines.append(f"human,CartPole,easy,{twin},{score},3,terminated,1,0,012,{GAME},128,default,{{}},{player}")
    (tmp_path / "human.csv").write_text("\n".join(lines) + "\n")
    assert [score.value for score in read_scores(tmp_path / "human.csv")] == [0.5, 0.5, 0.7, 0.7]
    table = gap_and_bias(tmp_path / "human.csv", baseline="human", draws=10)
    assert table.row("human").seeds == 2 and table.row("human").mdp.value == pytest.approx(0.6)
