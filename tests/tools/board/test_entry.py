"""The file of an entry is a stranger's: bounded, checked by type, and nothing in it is run."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.presets import preset
from arcade_torch.tools.board.entry import (
    MOST_BYTES,
    EntryRefusedError,
    entry_of,
    nested,
    read_entry,
    settings_of,
    write_entry,
)
from arcade_torch.tools.board.submit import file_name
from tests.tools.board.boards import fabricated_entry

PLAIN = fabricated_entry()
RUN = PLAIN["runs"][0]


def refusal(path: Path, plain: Any) -> str:
    path.write_text(plain if isinstance(plain, str) else json.dumps(plain))
    with pytest.raises(EntryRefusedError) as caught:
        read_entry(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 1000 and str(path) in message
    return message


def test_an_entry_is_written_and_read_back(tmp_path: Path) -> None:
    entry = entry_of(copy.deepcopy(PLAIN))
    assert read_entry(write_entry(tmp_path / "a.json", entry)) == entry


HOSTILE: list[tuple[dict[str, Any], str]] = [
    ({"name": "<script>alert(1)</script>"}, "name must be"),
    ({"name": "[a](https://example.org)"}, "name must be"),
    ({"name": "a\nb"}, "name must be"),
    ({"name": ["a"]}, "name must be a string"),
    ({"memory": "../../etc/passwd|"}, "memory must be"),
    ({"url": "javascript:alert(1)"}, "url must be"),
    ({"url": "http://example.org"}, "url must be"),
    ({"note": "x" * 301}, "note must be"),
    ({"date": "yesterday"}, "date must be"),
    ({"frames": 10**30}, "frames must be"),
    ({"frames": "many"}, "frames must be a whole number"),
    ({"parameters": -1}, "parameters must be"),
    ({"protocol": "1"}, "protocol must be a whole number"),
    ({"runs": {}}, "runs must be a list"),
    ({"runs": []}, "the number of runs must be"),
    ({"runs": [RUN] * 3001}, "the number of runs must be"),
    ({"runs": [7]}, r"runs[0]: a run must be a table"),
    ({"runs": [RUN | {"score": float("nan")}]}, "runs[0]: score must be"),
    ({"runs": [RUN | {"score": 1e300}]}, "runs[0]: score must be"),
    ({"runs": [RUN | {"game": "CartPoleEasy"}]}, "runs[0]: game must be a versioned game"),
    ({"runs": [RUN | {"twin": "both"}]}, "runs[0]: twin must be 'full' or 'partial'"),
    ({"runs": [RUN | {"seed": -1}]}, "runs[0]: seed must be"),
    ({"runs": [RUN | {"weights_sha256": "no"}]}, "runs[0]: weights_sha256 must be a SHA-256"),
    ({"runs": [RUN | {"extra": 1}]}, "runs[0]: a field of a run must be one of"),
    ({"runs": [RUN | {"settings": {"a": {"b": {}}}}]}, "runs[0]: the setting 'a' must be short"),
    ({"settings": {"a": "x" * 1000}}, "the setting 'a' must be short"),
    ({"settings": {str(n): n for n in range(301)}}, "settings must be at most 300 names"),
    ({"checkpoints": {"kind": "path", "path": "/etc"}}, "checkpoints.kind must be one of"),
    ({"checkpoints": {"kind": "hub", "repo": "a/b", "revision": "main"}}, "checkpoints.revision"),
    ({"checkpoints": {"kind": "url", "url": "file:///etc/passwd"}}, "checkpoints.url must be"),
    ({"checkpoints": {"kind": "retrain", "run": "rm"}}, "checkpoints of kind retrain must be"),
    ({"unknown": 1}, "a field of an entry must be one of"),
]


@pytest.mark.parametrize(("changes", "message"), HOSTILE, ids=lambda part: str(part)[:40])
def test_a_hostile_value_is_refused_in_one_line_that_names_it(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    assert message in refusal(tmp_path / "a.json", PLAIN | changes)


def test_what_is_no_entry_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    assert "does not hold the JSON" in refusal(file, "{")
    assert "does not hold the JSON" in refusal(file, "[" * 100_000)
    assert "no table of names" in refusal(file, "[]")
    assert "at most" in refusal(file, " " * (MOST_BYTES + 1))
    assert "none with 'runs'" in refusal(file, {k: PLAIN[k] for k in PLAIN if k != "runs"})
    with pytest.raises(FileNotFoundError):
        read_entry(tmp_path / "none.json")


def test_settings_that_are_no_config_are_refused_by_the_name_of_the_run() -> None:
    for name, value in {"ppo.gamma": 7, "nonsense": 1, "ppo": 3, "ppo.a.b": 1}.items():
        entry = entry_of(PLAIN | {"settings": PLAIN["settings"] | {name: value}})
        with pytest.raises(EntryRefusedError, match=r"settings of MineSweeperEasy-v0 full, seed 1"):
            entry.config(entry.runs[0])


def test_the_settings_of_runs_are_kept_once_and_come_back() -> None:
    configs = [
        preset("small", env=f"{game}-v0", seed=seed, memory="gru", network_options={"layers": 2})
        for game in ("CartPoleEasy", "TetrisEasy")
        for seed in (1, 2)
    ]
    shared, rest = settings_of(configs)
    assert shared["memory"] == "gru" and rest[0] == {
        "env": "CartPoleEasy-v0",
        "seed": 1,
        "ppo.gamma": 0.995,
    }
    for config, own in zip(configs, rest, strict=True):
        assert not differing_fields(TrainConfig.from_dict(nested(shared | own)), config)


def test_names_of_files_are_plain() -> None:
    assert file_name("A/b ../c=1") == "a-b-c-1.json"
