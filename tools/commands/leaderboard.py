"""``arcade-torch leaderboard``: make an entry, check one, write the page."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from arcade_torch.agents.runs.files import check_writable
from arcade_torch.tools.options import Command, at_least
from arcade_torch.tools.text import counted, say


@dataclass
class Submit(Command):
    """Evaluate the runs of one agent by the protocol of the leaderboard and write its entry.

    The runs are seeds x games x both twins of one memory, trained with one number of frames.
    docs/guides/leaderboard.md says what is compulsory and what disqualifies.

    Example: arcade-torch leaderboard submit runs/mine --memory gru --name "GRU, small"
    """

    # Run folders, or folders with runs below them.
    runs: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[tuple[Path, ...]]]
    name: str  # Of the entry: at most 60 letters, digits, spaces or .,()+=/-
    memory: str = ""  # Only the runs with this memory.
    seeds: tuple[int, ...] = ()  # Only the runs with these seeds of training.
    url: str = ""  # Where the code is that trained them.
    commit: str = ""  # The commit of that code.
    note: str = ""  # At most 300 letters.
    hub: str = ""
    """OWNER/NAME@REVISION of the repository on the Hugging Face hub that has the checkpoints, the
    revision as 40 digits. Without it they count as not kept: the entry can be trained again.
    """
    checkpoints_url: str = ""  # An address where the checkpoints are, in the place of a hub.
    out: Path = Path("results/leaderboard")  # Folder for the file.
    replace: bool = False  # Whether a file of that name may be replaced.

    def run(self) -> int:
        """Evaluate, write, say where."""
        from arcade_torch.tools.board.entry import write_entry
        from arcade_torch.tools.board.submit import Words, file_name, submit

        file = self.out / file_name(self.name)
        if file.exists() and not self.replace:
            raise FileExistsError(f"{file} exists: give another --name, or --replace")
        check_writable(file)
        words = Words(self.name, self.url, self.commit, self.note, self._checkpoints())
        entry = submit(self.runs, words, self.memory, self.seeds, progress=say_progress)
        write_entry(file, entry)
        say(f"{counted(len(entry.runs), 'run')}, {entry.frames:,} frames each: {file}")
        return 0

    def _checkpoints(self) -> dict[str, str]:
        """Where the checkpoints are."""
        if self.hub and self.checkpoints_url:
            raise ValueError("give --hub or --checkpoints-url, not both")
        if self.hub:
            repository, _, revision = self.hub.partition("@")
            return {"kind": "hub", "repo": repository, "revision": revision}
        if self.checkpoints_url:
            return {"kind": "url", "url": self.checkpoints_url}
        return {"kind": "retrain"}


@dataclass
class Check(Command):
    """Evaluate an entry again from its checkpoints; refuse in one line what does not agree.

    Looked at are the protocol, evaluation seeds, cells, observations, and of every run the SHA-256
    of its weights and its score: equal to the bit where commit, versions and processor are those of
    the entry, within half the 95 percent interval of the score elsewhere. Exit code 2 if refused.

    Example: arcade-torch leaderboard check results/leaderboard/lru.json --runs runs/board --cells 4
    """

    file: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[Path]]  # The entry.
    runs: Path | None = None  # Folder with its run folders somewhere below.
    cells: int = 0  # Evaluate so many runs, drawn at random; 0 for all.
    retrain: bool = False
    """Train the runs that are not below --runs first, from the settings in the entry. A run gives
    the same weights again at the same commit, on the same processor and versions; elsewhere its
    score is compared, which decides nothing (exit code 2).
    """
    pull: bool = False
    """Fetch the runs that are not below --runs first, from the hub that the entry names (extra
    hub): only weights whose SHA-256 is in the entry.
    """
    record: bool = False  # Keep beside the entry what was checked, for the page.

    def run(self) -> int:
        """Check, and say what was checked."""
        from arcade_torch.tools.board.check import Origin, check, record_file, write_record

        at_least(self, cells=0)
        if self.runs is None:
            raise ValueError(
                "give the folder with the runs of the entry, --runs DIR; with --pull they are "
                "fetched there, with --retrain trained"
            )
        if self.retrain and self.pull:
            raise ValueError("give --pull or --retrain, not both: --pull fetches checkpoints")
        if self.record:
            check_writable(record_file(self.file))
        weights: Origin = "kept"
        if self.pull or self.retrain:
            weights = "pulled" if self.pull else "retrained"
        checked = check(
            self.file,
            self.runs,
            self.cells,
            progress=say_progress,
            weights=weights,
        )
        say(
            f"agrees: {checked.runs} of {checked.of} runs evaluated again, {checked.equal} equal "
            f"to the bit, largest difference {checked.largest_difference:.4g}"
        )
        if self.record:
            write_record(self.file, checked)
            say(f"recorded: {record_file(self.file)}")
        return 0


@dataclass
class Page(Command):
    """Write the tables of the leaderboard between the marks of its page.

    Example: arcade-torch leaderboard page
    """

    page: Path = Path("docs/leaderboard.md")  # With the two marks.
    results: Path = Path("results")  # Its leaderboard/*.json are the entries.

    def run(self) -> int:
        """Write."""
        for path in (self.page, self.results):
            if not path.exists():
                raise FileNotFoundError(
                    f"{path} does not exist: run it in a checkout, or give --page and --results"
                )
        from arcade_torch.tools.board.page import write_page

        say(write_page(self.page, self.results))
        return 0


def say_progress(name: str, done: int, total: int) -> None:
    """One line a run."""
    say(f"{done}/{total} {name}")
