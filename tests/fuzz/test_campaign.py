"""The short form of the campaign: some cases of each kind that need no process of their own, in
this one.

The long one is ``python -m tests.fuzz.campaign``; a few of its cases run here too, to see that its
script works.
"""

import contextlib
import io
import os
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from arcade_torch.tools import cli
from tests.fuzz import campaign
from tests.fuzz.attacks import COMMANDS, Case, cases
from tests.fuzz.contract import Hang, time_limit

QUICK = ("gap-bias", "figure", "report", "dry-run", "compare", "hyperparameters")
LIMIT_S = 15.0
MORE_BYTES = 3 * 2**30
KINDS = ("file/", "name/", "folder/file/")


def quick_cases() -> list[Case]:
    """Cases that only need files, of commands that take less than a second."""
    words = {COMMANDS[name] for name in QUICK}
    return [
        case
        for case in cases(0, 0)
        if case.words in words and case.name.startswith(KINDS) and not case.happens
    ]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign.make_base(tmp_path_factory.mktemp("base"))


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """At most three gigabytes more than this process has."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + MORE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def outcome_here(case: Case, base: Path, folder: Path) -> tuple[str, str]:
    """What becomes of a case in this process, and what is said about it."""
    shutil.copytree(base, folder, dirs_exist_ok=True, symlinks=True)
    work = folder / "work"
    assert case.prepare is not None
    case.prepare(work)
    before = campaign.snapshot(folder / "outside")
    out, err = io.StringIO(), io.StringIO()
    here = Path.cwd()
    os.chdir(work)
    words = case.words.split() if isinstance(case.words, str) else case.words
    code: int | None = None
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.redirect_stdout(out))
            stack.enter_context(contextlib.redirect_stderr(err))
            stack.enter_context(little_memory())
            stack.enter_context(contextlib.suppress(Hang))
            stack.enter_context(time_limit(LIMIT_S))
            code = cli.main(words)
    finally:
        os.chdir(here)
    if campaign.snapshot(folder / "outside") != before:
        return "outside", err.getvalue()
    return campaign.judge(case, code, out.getvalue(), err.getvalue()), err.getvalue()


@pytest.mark.parametrize("case", quick_cases()[::4], ids=lambda case: ascii(case.name))
def test_a_case_works_or_is_refused_in_one_line(case: Case, base: Path, tmp_path: Path) -> None:
    outcome, said = outcome_here(case, base, tmp_path)
    assert outcome in campaign.FINE, f"{outcome}: {said[-1500:]}"


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "name",
    ["stream/no-out/gap-bias", "name/report", "folder/read-only/gap-bias", "signal/SIGINT/figure"],
)
def test_cases_in_processes_of_their_own(name: str, base: Path) -> None:
    case = next(case for case in cases(0, 10) if case.name.startswith(name))
    result = campaign.carry_out(case, base, 2.0)
    assert result.outcome in campaign.FINE, result


def test_the_judge_knows_what_is_fine() -> None:
    case = Case("x", "list")
    line = "arcade-torch: no\n"
    assert campaign.judge(case, 0, "", "") == "worked"
    assert campaign.judge(case, 2, "", f"run: 3 of 4\n{line}") == "refused"
    assert campaign.judge(case, 2, "", line * 2) == "wordy"
    assert campaign.judge(case, 1, "", "") == "silent"
    assert campaign.judge(case, 130, "", "arcade-torch: stopped; x\n") == "stopped"
    assert campaign.judge(case, 130, "", "") == "silent"
    assert campaign.judge(case, -11, "", "") == campaign.judge(case, 139, "", "") == "crash"
    assert campaign.judge(case, None, "", "") == "hang"
    assert campaign.judge(case, 1, "", "Traceback (most recent call last):\n") == "traceback"
