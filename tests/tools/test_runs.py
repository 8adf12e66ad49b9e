"""Which agent a run is, and what may be pooled as seeds of one."""

import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, gap_and_bias
from arcade_torch.tools.commands.figure import Figure
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.names import AgentKey, agent_names
from arcade_torch.tools.play.scores import COLUMNS
from arcade_torch.tools.scores import read_scores
from arcade_torch.tools.studies.grid import RunSpec
from tests.tools.fabricated import write_run

GAME = "CartPoleEasy-v0"


def write(
    path: Path,
    memory: str,
    twin: str,
    seed: int,
    score: float,
    algorithm: str = "pqn",
    **config: Any,
) -> Path:
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
    assert (
        cli.main(["figure", "curves", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path)])
        == 0
    )
    rows = read_csv(tmp_path / "curves.csv")
    assert {(row["agent"], row["seeds"]) for row in rows} == {
        ("lru 2x512", "1"),
        ("lru 2x128", "1"),
    }


def test_seeds_trained_with_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    for seed, gamma in ((0, 0.9), (1, 0.99)):
        write(tmp_path / str(seed), "lru", "full", seed, 0.5, pqn={"gamma": gamma})
    with pytest.raises(
        ValueError,
        match=r"seeds of lru on CartPoleEasy-v0 \(full\) differ in pqn.gamma: 0.9 and 0.99",
    ):
        find_runs([tmp_path])
    write(tmp_path / "1", "lru", "full", 1, 0.5, total_frames=7, pqn={"gamma": 0.9})
    with pytest.raises(ValueError, match="differ in total_frames: 350000 and 7"):
        find_runs([tmp_path])
    for seed, size in ((0, 128), (1, 256)):
        write(tmp_path / str(seed), "lru", "full", seed, 0.5, obs_size=size)
    with pytest.raises(ValueError, match="runs with obs_size 128 and 256 cannot be compared"):
        find_runs([tmp_path])


def test_two_versions_of_a_game_by_its_options_are_refused_also_between_agents(
    tmp_path: Path,
) -> None:
    write(tmp_path / "0", "lru", "full", 0, 0.5, env_options={"mine_reward": -1})
    write(tmp_path / "1", "mlp", "full", 0, 0.5)
    with pytest.raises(
        ValueError,
        match=r"CartPoleEasy-v0 was played with env_options \{'mine_reward': -1\} and \{\}",
    ):
        find_runs([tmp_path])


def test_names_say_no_more_than_is_needed_to_tell_agents_apart() -> None:
    plain, ppo = AgentKey("pqn", "lru"), AgentKey("ppo", "lru")
    big, skip = (
        AgentKey("pqn", "lru", size="2x128"),
        AgentKey("pqn", "lru", options=(("skip", "none"),)),
    )
    assert agent_names([plain]) == {plain: "lru"}
    assert agent_names([plain, ppo]) == {plain: "pqn-lru", ppo: "ppo-lru"}
    assert agent_names([plain, big])[big] == "lru 2x128"
    assert agent_names([plain, skip]) == {plain: "lru", skip: "lru skip=none"}


def test_two_players_share_one_file_of_human_scores(tmp_path: Path) -> None:
    lines = [",".join(COLUMNS)]
    for player, score in (("ann", 0.5), ("bob", 0.7)):
        for twin in ("full", "partial"):
            lines.append(
                f"human,CartPole,easy,{twin},{score},3,terminated,1,0,012,{GAME},128,default,{{}},{player}"
            )
    (tmp_path / "human.csv").write_text("\n".join(lines) + "\n")
    assert [score.value for score in read_scores(tmp_path / "human.csv")] == [0.5, 0.5, 0.7, 0.7]
    table = gap_and_bias(tmp_path / "human.csv", baseline="human", draws=10)
    assert table.row("human").seeds == 2 and table.row("human").mdp.value == pytest.approx(0.6)
    words = [
        "figure",
        "returns",
        str(tmp_path / "human.csv"),
        "--baseline",
        "human",
        "--out",
        str(tmp_path / "f"),
    ]
    assert cli.main(words) == 0 and (tmp_path / "f" / "returns.png").exists()  # nobody has a bias


def test_episodes_that_people_played_on_both_twins_are_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [",".join(COLUMNS)]
    for seed, twin in enumerate(("full", "partial", "mixed", "both")):
        lines.append(
            f"human,CartPole,easy,{twin},0.{seed + 1},3,terminated,1,{seed},012,{GAME},128,default,{{}},ann"
        )
    (tmp_path / "human.csv").write_text("\n".join(lines) + "\n")
    words = [
        "analyze",
        "gap-bias",
        str(tmp_path / "human.csv"),
        "--baseline",
        "human",
        "--out",
        str(tmp_path / "g.csv"),
    ]
    assert cli.main(words) == 0
    assert "left out, of no single twin: 2 scores (mixed or both)" in capsys.readouterr().out
    (row,) = read_csv(tmp_path / "g.csv")
    assert (row["mdp"], row["pomdp"], row["seeds"]) == ("0.1", "0.2", "1")


def test_runs_may_be_named_behind_another_option() -> None:
    def parsed(*words: str) -> Any:
        return Figure.parse(words, "arcade-torch figure recall-density").options

    one = (Path("runs/one"), Path("runs/two"))
    for words in (
        ["--runs", *map(str, one), "--bins", "3", "16"],
        ["--bins", "3", "16", "--runs", *map(str, one)],
    ):
        assert (parsed(*words).runs, parsed(*words).bins) == (one, (3, 16))
    assert parsed("--bins", "3", "--runs=runs/one", "--csv").runs == one[:1]
    assert parsed("runs/one", "--runs", "runs/two", "--csv").runs == one[::-1]


def test_a_run_without_settings_is_refused_for_their_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write(tmp_path / "bare", "lru", "full", 0, 0.5)
    (run / "config.json").write_text(json.dumps({"env": GAME, "memory": "lru"}))
    assert cli.main(["figure", "hyperparameters", "--runs", str(run), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "say nothing of their settings" in said and said.count("\n") == 1


def test_an_agent_without_a_memory_free_one_of_its_algorithm_has_no_bias_anywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)  # or the table would be cut to that width
    lines = ["algorithm,memory,game,observability,seed,score"]
    for algorithm, memory, value in (("pqn", "mlp", 0.3), ("ppo", "lru", 0.9), ("pqn", "lru", 0.4)):
        for game in ("CartPoleEasy", "SkittlesEasy"):
            lines += [
                f"{algorithm},{memory},{game},{twin},0,{value}" for twin in ("full", "partial")
            ]
    (tmp_path / "scores.csv").write_text("\n".join(lines) + "\n")
    for name in ("returns", "gap-bias"):
        assert (
            cli.main(
                ["figure", name, "--runs", str(tmp_path / "scores.csv"), "--out", str(tmp_path)]
            )
            == 0
        )
        (row,) = [line for line in capsys.readouterr().out.splitlines() if "ppo-lru" in line]
        assert "none" in row and "nan" not in row
    rows = {
        row["agent"]: row["bias"]
        for row in read_csv(tmp_path / "gap-bias.csv")
        if not row["without"]
    }
    assert rows["ppo-lru"] == "nan" and float(rows["pqn-lru"]) == pytest.approx(0.1)
