"""Runs that learned by different settings are never pooled as seeds of one agent, also where a
setting is missing.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.runs.files import write_json
from arcade_torch.tools import gap_and_bias
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures import CurveOptions, PaperOptions
from arcade_torch.tools.figures.catalogue import make_figure
from arcade_torch.tools.figures.logs import curves
from arcade_torch.tools.figures.style import drawing
from arcade_torch.tools.names import preset_size
from arcade_torch.tools.reports import report
from arcade_torch.tools.scores import read_scores
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_runs import GAME, write
from tests.tools.test_study import change_config

SETTINGS = TrainConfig(env=GAME, total_frames=350_000).to_dict()
ABSENT = object()
"""Stands for a field that a ``config.json`` does not have."""


def change(config: dict[str, Any], name: str, value: Any) -> None:
    """Set, or take away, a field by its dotted name."""
    *groups, last = name.split(".")
    for group in groups:
        config = config.setdefault(group, {})
    if value is ABSENT:
        config.pop(last, None)
    else:
        config[last] = value


def two_seeds(folder: Path, name: str, first: Any, second: Any) -> Path:
    """Two finished runs of one agent, seeds 0 and 1, that state a setting differently."""
    for seed, value in enumerate((first, second)):
        settings = json.loads(json.dumps(SETTINGS))
        change(settings, name, value)
        own = {
            key: settings[key]
            for key in settings
            if key not in ("env", "memory", "seed", "observability")
        }
        run = write(folder / str(seed), "lru", "full", seed, 0.5, **own)
        if value is ABSENT and "." not in name:
            change_config(run, lambda config: config.pop(name, None))
    return folder


DIFFERENT = [
    ("amp", ABSENT, True),
    ("amp", True, ABSENT),
    ("rules", ABSENT, "reference"),
    ("obs_size", ABSENT, 256),
    ("obs_size", 256, ABSENT),
    ("total_frames", ABSENT, 350_000),
    ("env_options.wind", ABSENT, True),
    ("pqn.bootstrap", ABSENT, "last"),
    ("pqn.average_share", 0.5, ABSENT),
    ("pqn.gamma", 0.9, 0.99),
    ("no_longer", 1, ABSENT),  # a field of another version, whose default nobody knows
]


@pytest.mark.parametrize(("name", "first", "second"), DIFFERENT)
def test_seeds_with_different_settings_are_refused_by_the_name_of_the_setting(
    name: str, first: Any, second: Any, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=name.partition(".")[0]) as refusal:
        find_runs([two_seeds(tmp_path, name, first, second)])
    assert name.rpartition(".")[2] in str(refusal.value) and "\n" not in str(refusal.value)


EQUAL = [
    ("amp", ABSENT, False),
    ("rules", "default", ABSENT),
    ("obs_size", 128, ABSENT),
    ("obs_size", 128, 128.0),
    ("total_frames", 350_000, 350_000.0),
    ("pqn.average_share", ABSENT, 0),
    ("pqn.gamma", ABSENT, 0.99),
    ("pqn.overlap", 4, 4.0),
    ("pqn", ABSENT, {}),
    ("env_options", ABSENT, {}),
    ("network_options", ABSENT, {}),
    ("network_options", {"chunk": 4}, {"chunk": 4.0}),
    ("network_options", {"hidden_size": 512}, {"hidden_size": 512.0}),
    (
        "network_options",
        {"memory_options": {"sizes": [1, 2]}},
        {"memory_options": {"sizes": [1.0, 2.0]}},
    ),
    ("ppo.clip", 0.1, 0.3),  # another learner's
    ("threads", 1, ABSENT),
]


@pytest.mark.parametrize(("name", "first", "second"), EQUAL)
def test_a_missing_setting_is_its_default_and_a_number_is_the_same_in_every_form(
    name: str, first: Any, second: Any, tmp_path: Path
) -> None:
    runs = find_runs([two_seeds(tmp_path, name, first, second)])
    ((_, _, _),) = runs.groups()
    assert len(runs.runs) == 2


def test_one_function_answers_for_resuming_and_for_pooling() -> None:
    old = {"env": GAME, "seed": 0, "pqn": {"gamma": 0.99}}
    changes = {"amp": True, "rules": "reference"}
    new = TrainConfig.from_dict(
        {"env": GAME, "pqn": {"average_share": 0.5, "bootstrap": "last"}} | changes
    )
    named = differing_fields(TrainConfig.from_dict(old), new)
    assert [each.partition(" ")[0] for each in named] == [
        "amp",
        "pqn.average_share",
        "pqn.bootstrap",
        "rules",
    ]
    assert differing_fields(old, new) == named
    assert differing_fields(old, new.to_dict()) == named


def test_all_settings_that_differ_are_named(tmp_path: Path) -> None:
    two_seeds(tmp_path, "amp", ABSENT, True)
    change_config(tmp_path / "0", lambda config: config["pqn"].pop("average_share"))
    change_config(tmp_path / "1", lambda config: config["pqn"].update(average_share=0.5))
    with pytest.raises(
        ValueError,
        match=r"differ in amp: False and True, pqn.average_share: 0.0 and 0.5; give runs",
    ):
        find_runs([tmp_path])


def test_a_setting_with_a_line_break_in_its_name_is_told_in_one_line(tmp_path: Path) -> None:
    two_seeds(tmp_path, "a\nb", ABSENT, "x\x1b")
    with pytest.raises(ValueError, match=r"differ in a\\nb: None and x\\x1b; give runs"):
        find_runs([tmp_path])


@pytest.mark.parametrize("bare", ["CartPoleEasy", "NoisyPoleEasy"])
def test_a_game_with_and_without_its_version_or_by_its_alias_is_one_game(
    bare: str, tmp_path: Path
) -> None:
    full = {"CartPoleEasy": "CartPoleEasy-v0", "NoisyPoleEasy": "NoisyCartPoleEasy-v0"}[bare]
    assert {run.game for run in find_runs([two_seeds(tmp_path, "env_options", {}, {})]).runs} == {
        GAME
    }
    change_config(tmp_path / "0", lambda config: config.update(env=bare))
    change_config(tmp_path / "1", lambda config: config.update(env=full))
    assert list(find_runs([tmp_path]).groups()) == [("lru", full, "full")]


def test_a_game_of_ones_own_that_is_not_imported_is_one_game_too(tmp_path: Path) -> None:
    two_seeds(tmp_path, "env_options", {}, {})
    change_config(tmp_path / "0", lambda config: config.update(env="NeverRegistered"))
    change_config(tmp_path / "1", lambda config: config.update(env="NeverRegistered-v1"))
    assert list(find_runs([tmp_path]).groups()) == [("lru", "NeverRegistered-v1", "full")]


def test_an_alias_in_a_table_is_the_game_of_the_runs(tmp_path: Path) -> None:
    run = write(tmp_path / "run", "lru", "full", 0, 0.5, env="NoisyCartPoleEasy-v0")
    (tmp_path / "scores.csv").write_text(
        "agent,game,observability,seed,score\nlru,NoisyPoleEasy,full,1,0.5\n"
    )
    assert {score.game for score in read_scores([run, tmp_path / "scores.csv"])} == {
        "NoisyCartPoleEasy-v0"
    }


def test_curves_and_report_refuse_what_the_measures_refuse(tmp_path: Path) -> None:
    study = small_study()
    folder = write_study(tmp_path / "s", study)
    change_config(folder.run(study.runs()[0]).path, lambda config: config.pop("total_frames"))
    with pytest.raises(ValueError, match="differ in total_frames"):
        report(folder.root)
    with pytest.raises(ValueError, match="differ in total_frames"), drawing("light"):
        curves(CurveOptions((folder.root,)), None)
    with pytest.raises(ValueError, match="differ in total_frames"):
        gap_and_bias(folder.root, draws=10)


def test_the_twins_of_an_agent_are_not_compared_where_their_settings_differ(
    tmp_path: Path,
) -> None:
    """Else the gap is that of the settings."""
    study = small_study()
    folder = write_study(tmp_path / "s", study)
    for run in study.runs():
        if run.memory == "mingru" and run.observability == "partial":
            change_config(folder.run(run).path, lambda config: config.update(total_frames=4096))
    with pytest.raises(ValueError, match=r"^the twins of mingru on .* differ in total_frames: "):
        gap_and_bias(folder.root, draws=10)
    with pytest.raises(ValueError, match="the twins of mingru"):
        report(folder.root)


def test_agents_that_were_trained_for_other_numbers_of_frames_are_compared_with_a_note(
    tmp_path: Path,
) -> None:
    study = small_study()
    folder = write_study(tmp_path / "s", study)
    assert find_runs([folder.root]).notes == []
    for run in study.runs():
        if run.memory == "mingru":
            change_config(folder.run(run).path, lambda config: config.update(total_frames=4096))
    assert find_runs([folder.root]).notes == [
        "agents were trained for different numbers of frames: 2,048, 4,096 on MineSweeperEasy"
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "holds a run of .*partial.*, not of .*full"),
        (
            {"observability": "full", "sizes": [preset_size("small"), "1x8"]},
            f"holds a run of .*1x8, not of .*{preset_size('small')}",
        ),
        (
            {"observability": "full", "sizes": ["1x8", preset_size("small")]},
            f"holds a run of .*{preset_size('small')}, not of .*1x8",
        ),
    ],
)
def test_a_folder_that_holds_another_run_than_its_name_says_is_refused(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    study = small_study(**changes)
    folder = write_study(tmp_path / "s", study)
    one, other = (folder.run(run).path for run in study.runs()[:2])
    one.rename(tmp_path / "one")
    other.rename(one)
    (tmp_path / "one").rename(other)
    table = (folder.root / "results.csv").read_bytes()
    with pytest.raises(ValueError, match=said) as refusal:
        report(folder.root)
    assert "\n" not in str(refusal.value)
    assert (folder.root / "results.csv").read_bytes() == table


def test_tables_of_two_studies_are_not_pooled_where_their_settings_differ(tmp_path: Path) -> None:
    for name, seeds, gamma in (("a", [0, 1], 0.9), ("b", [2, 3], 0.99)):
        study = small_study(seeds=seeds, settings={"pqn": {"gamma": gamma}})
        folder = write_study(tmp_path / name, study)
        for run in study.runs():
            write_json(folder.job(run).config, study.config(run).to_dict())
    tables = [tmp_path / name / "results.csv" for name in ("a", "b")]
    with pytest.raises(ValueError, match=r"differ in pqn\.gamma: 0\.9 and 0\.99"):
        read_scores(tables)
    with pytest.raises(ValueError, match=r"differ in pqn\.gamma: 0\.9 and 0\.99"):
        read_scores([tmp_path / "a", tables[1]])
    assert len(read_scores(tables[0])) == 8


def test_settings_in_a_table_that_differ_in_a_default_alone_are_one(tmp_path: Path) -> None:
    two_seeds(tmp_path, "pqn.gamma", 0.99, ABSENT)
    made = make_figure("hyperparameters", PaperOptions((tmp_path,), tmp_path / "figures"))
    values = {row["setting"]: row["pqn"] for row in made.pictures[0].rows}
    assert values["gamma"] == "0.99"


def test_settings_nested_without_end_are_refused(tmp_path: Path) -> None:
    two_seeds(tmp_path, "amp", False, False)
    text = (tmp_path / "0" / "config.json").read_text()
    deep = '{"x": ' * 900 + "1" + "}" * 900
    (tmp_path / "0" / "config.json").write_text(
        text.replace('"config": {', f'"config": {{"deep": {deep}, ', 1)
    )
    with pytest.raises(
        ValueError, match=r"config\.json (is damaged|does not hold JSON)|differ in deep"
    ):
        find_runs([tmp_path])


def test_settings_of_the_wrong_kind_are_refused_in_one_line(tmp_path: Path) -> None:
    for name, value in (
        ("algorithm", [1]),
        ("pqn", 5),
        ("total_frames", {"a": 1}),
        ("rules", None),
        ("obs_size", []),
    ):
        two_seeds(tmp_path / name, "amp", False, False)
        change_config(
            tmp_path / name / "0",
            lambda config, name=name, value=value: config.update({name: value}),
        )
        try:
            find_runs([tmp_path / name])
        except ValueError as error:
            assert "\n" not in str(error)
