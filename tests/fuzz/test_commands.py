"""The command line: words of any kind end in help, in a parsed command, or in exit code 2 and one
line.
"""

import contextlib
import dataclasses
import io
import os
import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given

from arcade_torch.tools import cli
from tests.fuzz.contract import Refused, attempt, fuzz
from tests.fuzz.hostile import FLOATS, NAMES, NUMBERS, seeds

pytestmark = pytest.mark.slow

# Nobody's arguments can hold a zero byte, and lone surrogates stand for bytes that are no text.
WORDS = tuple(name for name in NAMES if "\x00" not in name)
CHEAP = (
    "list",
    "report",
    "evaluate",
    "analyze gap-bias",
    "figure returns",
    "play",
    "record",
    "study",
)
COSTLY = tuple(name for name in cli.COMMANDS if name not in CHEAP)


@pytest.fixture(scope="module", autouse=True)
def _nothing_runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The real parsers in an empty folder; what they made is not carried out."""
    patch = pytest.MonkeyPatch()
    patch.chdir(tmp_path_factory.mktemp("commands"))
    for name in cli.COMMANDS:
        patch.setattr(cli.command_class(name), "run", lambda self: 0)
    yield
    assert not list(Path().iterdir()), "parsing wrote files"
    patch.undo()


def main(words: list[str]) -> None:
    """Run, and raise `Refused` for a refusal in one line; anything else but success is a defect."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(words)
    said = err.getvalue()
    if code == cli.EXIT_BAD_INPUT and said.startswith("arcade-torch: ") and said.count("\n") == 1:
        raise Refused(said)
    if code != cli.EXIT_OK or said:
        raise AssertionError(f"exit code {code}: {said[:500]!r}")


def _words(rng: random.Random, name: str) -> list[str]:
    flags = [
        f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(cli.command_class(name))
    ]
    flags += [
        "--help",
        "--pqn.gamma",
        "--env",
        "--total-frames",
        "--no-report",
        "-h",
        "--",
        "-x",
        "--debug=1",
        "--im",
    ]
    words = name.split()
    for _ in range(rng.randrange(5)):
        kind = rng.randrange(6)
        if kind < 3:
            words.append(rng.choice(flags))
        if kind < 5:
            words.append(
                str(
                    rng.choice(
                        (
                            rng.choice(WORDS),
                            rng.choice(NUMBERS[:9]),
                            rng.choice(FLOATS),
                            "full",
                            "lru",
                        )
                    )
                )
            )
        else:
            words.append(f"{rng.choice(flags)}={rng.choice(WORDS)}")
    return words


@fuzz(12_000)
@given(seeds)
def test_any_words_are_a_command_or_refused(seed: int) -> None:
    rng = random.Random(seed)
    known = sorted({part for name in cli.COMMANDS for part in name.split()})
    words = [
        str(rng.choice((rng.choice(WORDS), rng.choice(known)))) for _ in range(rng.randrange(4))
    ]
    if " ".join(words[:2]) in cli.COMMANDS or " ".join(words[:1]) in cli.COMMANDS:
        words[0] += "x"
    attempt("command line: which command", lambda: main(words))


@fuzz(4_000)
@given(seeds)
def test_any_options_are_parsed_or_refused(seed: int) -> None:
    rng = random.Random(seed)
    words = _words(rng, rng.choice(CHEAP))
    attempt("command line: options", lambda: main(words))


@fuzz(1_000)
@given(seeds)
def test_any_options_of_long_commands_are_parsed_or_refused(seed: int) -> None:
    rng = random.Random(seed)
    words = _words(rng, rng.choice(COSTLY))
    attempt("command line: options", lambda: main(words))


def test_the_environment_is_as_it_was() -> None:
    assert "ARCADE_TORCH_IMPORT" not in os.environ or os.environ["ARCADE_TORCH_IMPORT"] == ""
