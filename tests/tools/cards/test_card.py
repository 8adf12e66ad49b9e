"""``arcade-torch card``: what it says is measured, and a model that fails has a card too."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import (
    RecurrentMemory,
    check_memory,
    law_results,
    make_memory,
    memory_names,
    register_memory,
    registry,
)
from arcade_torch.models.gru import GRU
from arcade_torch.tools import cli
from arcade_torch.tools.bench.memory_tests import TESTS
from arcade_torch.tools.cards import measure, reach
from arcade_torch.tools.cards.page import findings, page, ratios, reach_text
from arcade_torch.tools.cards.study import GAMES, card_study, study_part
from arcade_torch.tools.studies.folder import StudyFolder
from tests.tools.fabricated import write_study
from tests.tools.test_cli import one_error

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "own_memory.py"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short looks back, short timings, and a registry that forgets."""
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    monkeypatch.setattr(reach.gradient_reach, "__defaults__", (12, 0))
    monkeypatch.setattr(reach.context_length, "__defaults__", (12, 1e-6, 0))
    timing = measure.time_memories
    monkeypatch.setattr(
        measure,
        "time_memories",
        lambda names, size, seconds: timing(names, 8, seconds=0.001, repeats=1),
    )


class Leaky(GRU):
    """Forgets nothing at starts."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        return super().forward(x, state, torch.zeros_like(is_init))


class Broken(nn.Module):
    """Fails whenever it is called."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.input_size = input_size
        self.weight = nn.Parameter(torch.zeros(hidden_size))

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> Any:
        raise RuntimeError("no such luck")

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({}, batch_size=[batch_size])


def test_the_laws_of_a_card_are_those_of_check_memory_and_go_on_behind_a_broken_one() -> None:
    kept = law_results(make_memory("mingru", 4, 8))
    assert [row.law for row in kept] == list(check_memory(make_memory("mingru", 4, 8)))
    assert all(row.passed and not row.message for row in kept)
    broken = {row.law: row for row in law_results(Leaky(4, 8))}
    assert not broken["packed equals apart"].passed
    assert not broken["nothing leaks over a start"].passed
    assert broken["nothing leaks over a start"].discrepancy > 0
    assert "Likely cause" in broken["packed equals apart"].message
    assert broken["batch rows are independent"].passed and broken["gradients are right"].passed


def test_a_card_of_a_built_in_memory_trains_nothing_and_shows_what_is_on_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a training")

    monkeypatch.setattr(measure.recall, "train", refuse)
    monkeypatch.setattr(measure.table, "measured", refuse)
    assert cli.main(["card", "lru", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert f"card: {tmp_path / 'lru.json'}" in out and f"page: {tmp_path / 'lru.html'}" in out
    card = json.loads((tmp_path / "lru.json").read_text())
    assert card["name"] == "lru" and card["built_in"] and card["study"] is None
    assert card["cost"]["small"]["width"] == 128
    assert card["cost"]["paper"]["parameters"] == sum(
        p.numel() for p in make_memory("lru", 512, 512).parameters()
    )
    assert [row["delay"] for row in card["recall"]] == [8, 32, 96]
    assert {row["test"] for row in card["tests"]} == set(TESTS)
    assert set(card["speed"]["us_a_step"]) == {"lru", "gru"}
    text = (tmp_path / "lru.html").read_text()
    assert "It keeps all" in text and "http" not in re.sub(
        r'xmlns[^"]*"[^"]*"|www.w3.org\S*', "", text
    )
    for test in TESTS:
        assert f"<code>{test}</code>" in text


def test_torch_lstm_from_outside_has_a_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "yours.py"
    file.write_text(EXAMPLE.read_text())
    words = ["card", "--import", str(file), "--no-tests", "--out", str(tmp_path)]
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("ARCADE_TORCH_IMPORT", "")
    assert cli.main(words) == 0
    card = json.loads((tmp_path / "torch_lstm.json").read_text())
    assert not card["built_in"] and not card["tests"] and not card["recall"]
    assert all(row["passed"] for row in card["laws"])
    lstm = nn.LSTM(128, 128)
    assert card["cost"]["small"]["parameters"] == sum(p.numel() for p in lstm.parameters())
    assert card["cost"]["small"]["state_bytes"] == 2 * 128 * 4
    assert set(card["speed"]["us_a_step"]) == {"torch_lstm", "gru", "lru"}
    assert "Tests that separate" not in (tmp_path / "torch_lstm.html").read_text()


def test_a_memory_that_fails_has_a_card_that_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    register_memory("broken", Broken)
    assert cli.main(["card", "broken", "--no-tests", "--out", str(tmp_path)]) == 0
    assert "broken: It breaks " in capsys.readouterr().out
    card = json.loads((tmp_path / "broken.json").read_text())
    assert not any(row["passed"] for row in card["laws"])
    assert card["reach"]["error"] == "RuntimeError: no such luck"
    assert findings(card)[0].startswith(f"It breaks {len(card['laws'])} of {len(card['laws'])}")
    assert ratios(card) == {}
    text = page(json.loads(json.dumps(card)))
    assert text.count("no such luck") >= 4


def test_a_ratio_is_its_time_over_that_of_the_rival() -> None:
    rows = {
        "a": {"acting_us": 3.0, "learning_us": 1.0},
        "gru": {"acting_us": 2.0, "learning_us": 4.0},
    }
    card = {"name": "a", "speed": {"us_a_step": rows}}
    assert ratios(card) == {"gru": {"acting_us": 1.5, "learning_us": 0.25}}


def lru_card() -> dict[str, Any]:
    """The card of a built-in memory that is on file."""
    found = Path(__file__).parents[3] / "results/cards/lru.json"
    values: dict[str, Any] = json.loads(found.read_text())
    return values


@pytest.mark.parametrize(
    ("gap", "seeds", "end"),
    [
        ([0.2, 0.1, 0.3], 3, "0.20 [0.10, 0.30] of normalised return."),
        (
            [0.02, -0.1, 0.1],
            3,
            "0.02 of normalised return, but the interval [-0.10, 0.10] contains zero, so 3 seeds "
            "do not settle it.",
        ),
        ([0.2, None, None], 1, "0.20, with a single seed, which says nothing about others."),
        ([0.002, 0.001, 0.003], 3, "0.002 [0.001, 0.003] of normalised return."),
    ],
)
def test_the_gap_of_a_card_is_claimed_only_where_its_interval_allows(
    gap: list[float | None], seeds: int, end: str
) -> None:
    """Before: it was, of one seed and of an interval around zero."""
    said = findings(lru_card() | {"study": {"gap": gap, "seeds": seeds}})[-1]
    assert said == f"Partial observability costs agents with it {end}"


def test_the_reach_of_a_card_is_said_as_it_was_measured() -> None:
    """Before: SHM's gradient was "at least a tenth up to 119 steps back", which it is at a few of
    them, and where it was one at the last step that was looked at, the page said up to that.
    """
    norms = [1.0, 0.05, 0.2, 0.02, 0.02]
    card = lru_card() | {"reach": {"norms": norms, "tenth": 2, "hundredth": 4}}
    assert "a tenth for the last time 2 steps back, a hundredth 4 steps or more back" in page(card)
    assert reach_text(card, "hundredth") == "4 steps or more"
    assert reach_text(card, "tenth") == "2 steps"
    card["reach"]["tenth"] = 1
    assert reach_text(card, "tenth") == "1 step"


def test_without_results_on_file_the_tests_are_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a test with one size, for two steps."""
    monkeypatch.setattr(measure, "ON_FILE", Path("/nowhere"))
    monkeypatch.setattr(measure, "TESTS", {"parity": TESTS["parity"]})
    monkeypatch.setattr(measure, "SETTING", measure.Setting(steps=2, rows=2, answers=2))
    monkeypatch.setattr(measure, "DELAYS", (2,))
    monkeypatch.setattr(measure, "RECALL_S", 0.01)
    said = list[str]()
    card = measure.measure_card("mlp", tell=said.append)
    assert [row["level"] for row in card["tests"]] == list(TESTS["parity"].tested)
    assert len(card["recall"]) == 1 and not card["recall"][0]["solved"]
    assert any("parity" in line for line in said)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nope"], "unknown memory 'nope'"),
        ([], "name a memory model, or --all: none is named"),
        (["lru", "--all"], "give names or --all, not both"),
        (["lru", "--frames", "0"], "--frames must be at least 1"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in one_error(capsys, ["card", *words, "--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())


def test_the_study_of_a_card_is_three_games_both_twins_three_seeds() -> None:
    study = card_study("gru")
    assert study.memories == ("gru", "mlp") and study.games == GAMES and len(study.runs()) == 36
    assert card_study("mlp").memories == ("mlp", "lru")


def test_the_study_part_holds_the_gap_of_the_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a study whose returns are known, .51 and .47; its decisions are left out."""
    from arcade_torch.tools.cards import study as module

    definition = card_study("mingru", games=("SignpostEasy",))
    write_study(tmp_path, definition)
    nothing = {"pictures": [], "rows": [], "notes": ["left out"]}
    monkeypatch.setattr(module, "counterfactual_section", lambda *_, **__: nothing)
    part, pictures = study_part(tmp_path, "mingru", StudyFolder(tmp_path).load())
    assert part["gap"][0] == pytest.approx((0.51 - 0.47) / 2, abs=1e-3) and not pictures
    assert part["bias"][0] == pytest.approx((0.51 - 0.45) / 2, abs=1e-3)
    assert len(part["returns"]) == 4 and part["notes"] == ["left out"]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_card_with_a_study_says_what_was_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["card", "mingru", "--no-tests", "--study", "--games", "SignpostEasy"]
    words += ["--seeds", "1", "--frames", "4096", "--workers", "1", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    assert "4 runs of 4,096 frames" in capsys.readouterr().out
    study = json.loads((tmp_path / "mingru.json").read_text())["study"]
    assert (study["subject"], study["frames"], study["seeds"]) == ("mingru", 4096, 1)
    tasks = {(row["agent"], row["game"], row["twin"]) for row in study["returns"]}
    game = "SignpostEasy-v0"
    assert tasks == {(a, game, t) for a in ("mingru", "mlp") for t in ("MDP", "POMDP")}
    assert [row["twin"] for row in study["counterfactual"]] == ["MDP", "POMDP"]
    text = (tmp_path / "mingru.html").read_text()
    assert "What agents with it learn" in text and "SignpostEasy" in text
    assert cli.main(words) == 0  # nothing is trained again
    assert json.loads((tmp_path / "mingru.json").read_text())["study"] == study


def test_every_built_in_memory_has_an_about_line() -> None:
    for name in memory_names():
        assert len(measure._about(make_memory(name, 8, 16))) > 10


class TwoTraces(nn.GRU):
    """A fast and a slow trace.

    More about it.
    """


def test_a_recurrent_module_is_told_of_in_its_own_words() -> None:
    """The page said of it what ``RecurrentMemory`` says of itself."""
    assert measure._about(RecurrentMemory(TwoTraces(8, 16), 8, 16)) == "A fast and a slow trace."
