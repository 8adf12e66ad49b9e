"""A memory model of a user is checked before it is trained."""

from pathlib import Path

import pytest

from arcade_torch.models import registry
from arcade_torch.tools import cli
from arcade_torch.tools.imports import VARIABLE

LAWLESS = '''
import torch
from tensordict import TensorDict
from torch import nn
from arcade_torch.models import register_memory


class Lawless(nn.Module):
    """Forgets no episode: is_init is not looked at."""

    def __init__(self, input_size, hidden_size, fails=False):
        super().__init__()
        self.linear = nn.Linear(input_size, hidden_size)
        self.hidden_size = hidden_size
        self.fails = fails

    def forward(self, x, state, is_init):
        if self.fails:
            raise RuntimeError("no kernel for Double")
        h = state["h"][:, None] + self.linear(x).cumsum(1)
        return h, TensorDict({"h": h[:, -1]}, batch_size=[len(x)])

    def initial_state(self, batch_size):
        batch = [batch_size] if isinstance(batch_size, int) else list(batch_size)
        zeros = self.linear.weight.new_zeros(*batch, self.hidden_size)
        return TensorDict({"h": zeros}, batch_size=batch)


register_memory("lawless", Lawless)
'''

WIDER = """
import torch
from tensordict import TensorDict
from torch import nn
from arcade_torch.models import register_memory


class Wider(nn.Module):
    def __init__(self, input_size, hidden_size):
        super().__init__()
        self.linear = nn.Linear(input_size, hidden_size + 1)

    def forward(self, x, state, is_init):
        return self.linear(x), state

    def initial_state(self, batch_size):
        return TensorDict({}, batch_size=[batch_size])


register_memory("lawless", Wider)
"""


@pytest.fixture
def lawless(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Words that train a model which forgets no episode."""
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    file = tmp_path / "lawless.py"
    file.write_text(LAWLESS)
    words = ["--import", str(file), "--memory", "lawless", "--preset", "smoke"]
    return ["train", *words, "--env", "SignpostEasy", "--out", str(tmp_path / "run")]


def test_train_refuses_a_memory_that_breaks_a_law_and_names_it(
    lawless: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: it was trained without a word."""
    assert cli.main(lawless) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "memory 'lawless': law 'packed equals apart' is broken" in err
    assert "--no-check-memory" in err
    assert not (tmp_path / "run").exists()


def test_a_flag_trains_it_all_the_same(lawless: list[str], tmp_path: Path) -> None:
    assert cli.main([*lawless, "--no-check-memory"]) == cli.EXIT_OK
    assert (tmp_path / "run/eval.json").exists()


def test_a_memory_that_fails_in_float64_is_one_line(
    lawless: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--network-option", 'memory_options={"fails": true}']
    assert cli.main([*lawless, *options]) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    line = LAWLESS[: LAWLESS.index("raise RuntimeError")].count("\n") + 1
    said = f"failed when it was checked in float64, RuntimeError (lawless.py:{line}): no kernel"
    assert said in err


def test_a_width_of_its_own_is_refused_before_the_training(
    lawless: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: a traceback out of the first update, as a fault of arcade-torch."""
    (tmp_path / "lawless.py").write_text(WIDER)
    assert cli.main(lawless) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "was made with hidden_size=128, and its y is 129 wide" in err


def test_a_study_checks_its_memories_first(
    lawless: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('games = ["SignpostEasy"]\nmemories = ["mlp", "lawless"]\nseeds = 1\n')
    words = ["study", str(plan), *lawless[1:3], "--out", str(tmp_path / "study")]
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "law 'packed equals apart' is broken" in capsys.readouterr().err
    assert not (tmp_path / "study").exists()
