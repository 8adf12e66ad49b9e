"""The tables of ``docs/leaderboard.md``, from the entries and nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean

from arcade_torch.tools.board.check import CheckRecord, read_record
from arcade_torch.tools.board.entry import EntryRefusedError, check_protocol, read_entry
from arcade_torch.tools.board.protocol import (
    CLASSES,
    OPEN_CLASS,
    PROTOCOL,
    TWINS,
    Protocol,
    Suite,
    suites,
)
from arcade_torch.tools.board.ranking import (
    Cells,
    Listed,
    Ranked,
    has_suite,
    ranking,
    suite_iqm,
)
from arcade_torch.tools.board.reported import Reported, paper, players, unkept
from arcade_torch.tools.files import markdown_table, write_between
from arcade_torch.tools.measures.gap_bias.measure import game_of

BEGIN = "<!-- board -->"
END = "<!-- end of board -->"
PLAYERS = {
    "random": "random play",
    "state": "scripted, sees the state",
    "frames": "scripted, remembers the frames",
}
MEMORIES = {"lru": "PPO with LRU", "mlp": "PPO without memory"}
Players = Mapping[str, Cells]
"""Player -> returns."""
_COLUMNS = ("rank", "entry", "memory", "POMDP", "MDP", "games", "seeds", "parameters")
_MORE = ("state, bytes", "frames", "seconds a run", "environments", "checked")


def read_entries(folder: Path, protocol: Protocol = PROTOCOL) -> list[Listed]:
    """The entries of a folder by their files' names, each with its last check.

    Raises:
        EntryRefusedError: one does not keep the protocol, or two have one name.
    """
    entries = list[Listed]()
    names = dict[str, str]()
    for file in sorted(folder.glob("*.json")):
        entry = read_entry(file)
        try:
            check_protocol(entry, protocol)
        except EntryRefusedError as error:
            raise EntryRefusedError(f"{file}: {error}") from error
        if entry.name in names:
            raise EntryRefusedError(f"{file} and {names[entry.name]} are both {entry.name!r}")
        names[entry.name] = str(file)
        entries.append(Listed(file.name, entry, read_record(file)))
    return entries


def board(results: Path, protocol: Protocol = PROTOCOL) -> str:
    """The generated part of the page.

    Args:
        results: the folder ``results`` of the repository: ``leaderboard/*.json``, the players'
            tables and ``small/easy.csv``.
        protocol: that of the entries.

    Returns:
        Markdown; the same for the same files.
    """
    entries = read_entries(results / "leaderboard", protocol)
    tables = [results / "baselines.csv", results / "leaderboard" / "players.csv"]
    baselines = players([table for table in tables if table.exists()])
    parts = [_summary(entries)]
    for suite in suites():
        parts += _suite(entries, suite, baselines)
    parts += _game_by_game(entries, baselines)
    parts += _reported(results)
    return "\n\n".join(parts)


def write_page(page: Path, results: Path) -> Path:
    """Put the tables between the marks of the page."""
    return write_between(page, BEGIN, END, board(results))


def _summary(entries: Sequence[Listed]) -> str:
    """How many entries and runs there are, and how many were evaluated again."""
    runs = sum(len(listed.entry.runs) for listed in entries)
    records = [listed.record for listed in entries if listed.record is not None]
    again = sum(record.runs for record in records)
    return (
        f"Entries: {len(entries)}, with {runs} runs. Checked: {len(records)} entries, {again} runs "
        "evaluated again."
    )


def _suite(
    entries: Sequence[Listed],
    suite: Suite,
    baselines: Players,
) -> list[str]:
    """One suite: a table for each class of frames that has entries."""
    games = ", ".join(game_of(game) for game in suite.games)
    parts = [f"## {suite.title}", f"{games}."]
    empty = True
    for frames in (*CLASSES, OPEN_CLASS):
        rows = ranking(entries, suite, frames)
        if not rows:
            continue
        empty = False
        cells = [_line(row, suite) for row in rows]
        for player, name in PLAYERS.items():
            line = _player_line(name, baselines.get(player, {}), suite)
            if line:
                cells.append(line)
        parts.append(f"### {suite.name}, class {frames}")
        parts.append(markdown_table((*_COLUMNS, *_MORE), cells, left=3))
    if empty:
        parts.append("No entry yet.")
    return parts


def _line(row: Ranked, suite: Suite) -> list[str]:
    """One entry."""
    entry = row.listed.entry
    means = []
    for twin in reversed(TWINS):
        means.append(_interval(row, twin))
    return [
        str(row.rank) if row.rank else "none",
        entry.name,
        entry.memory,
        *means,
        f"{row.games} of {len(suite.games)}",
        str(row.listed.seeds),
        f"{entry.parameters:,}",
        f"{entry.state_bytes:,}",
        f"{entry.frames:,}",
        f"{row.listed.seconds:.0f}",
        ", ".join(sorted({run.game.rpartition("-")[2] for run in entry.runs})),
        _checked(row.listed.record),
    ]


def _interval(row: Ranked, twin: str) -> str:
    """An interquartile mean with its interval, if there is one."""
    interval = row.means.get(twin)
    if interval is None:
        return "-"
    if not interval.exists:
        return f"{interval.value:.3f}"
    return f"{interval.value:.3f} [{interval.low:.3f}, {interval.high:.3f}]"


def _checked(record: CheckRecord | None) -> str:
    """What was checked, and when."""
    if record is None:
        return "not yet"
    before = {"kept": "", "pulled": "pulled and ", "retrained": "trained and "}[record.weights]
    again = f"{before}evaluated again"
    text = f"{record.runs} of {record.of} {again} {record.date}, {record.equal} equal to the bit"
    if record.equal < record.runs:
        text += f", others within {record.largest_difference:.4f}"
    return text


def _player_line(name: str, cells: Cells, suite: Suite) -> list[str]:
    """A player beside the entries, where it played every game of the suite on a twin."""
    means = []
    for twin in reversed(TWINS):
        complete = all((game, twin) in cells for game in suite.games)
        means.append(f"{suite_iqm(cells, suite, twin).value:.3f}" if complete else "-")
    if set(means) == {"-"}:
        return []
    rest = [""] * (len(_COLUMNS) + len(_MORE) - 6)
    return ["", name, "", *means, f"{len(suite.games)} of {len(suite.games)}", *rest]


def _game_by_game(entries: Sequence[Listed], baselines: Players) -> list[str]:
    """A small table for each game and class: mean greedy returns, not normalised, best POMDP
    first.
    """
    easy = suites()[0].games
    others = sorted({game for row in entries for game, _ in row.cells} - set(easy))
    parts = ["## Game by game", "Mean greedy returns over the seeds, not normalised."]
    for game in [*easy, *others]:
        suite = Suite(game_of(game), (game,), "")
        for frames in (*CLASSES, OPEN_CLASS):
            rows = ranking(entries, suite, frames)
            if not rows:
                continue
            lines = list[list[str]]()
            best_first = sorted(rows, key=lambda row: (-_mean(row, game), row.listed.entry.name))
            for rank, row in enumerate(best_first, 1):
                means = _means(row.listed.cells, game)
                lines.append([str(rank), row.listed.entry.name, *means, str(row.listed.seeds)])
            for player, name in PLAYERS.items():
                means = _means(baselines.get(player, {}), game)
                if set(means) != {"-"}:
                    lines.append(["", name, *means, ""])
            parts.append(f"### {game}, class {frames}")
            columns = ("rank", "entry", "POMDP", "MDP", "seeds")
            parts.append(markdown_table(columns, lines, left=2))
    return parts


def _mean(row: Ranked, game: str) -> float:
    """The mean return on a POMDP."""
    return mean(row.listed.cells[game, "partial"])


def _means(cells: Cells, game: str) -> list[str]:
    """The mean return on the POMDP and on the MDP; a dash where there is none."""
    texts = []
    for twin in reversed(TWINS):
        values = cells.get((game, twin))
        texts.append(f"{mean(values):.3f}" if values else "-")
    return texts


def _reported(results: Path) -> list[str]:
    """Numbers of others and of runs that are gone: another table, no ranks."""
    suite = suites()[0]
    rows = unkept(results / "small" / "easy.csv", MEMORIES)
    rows += paper(Path(__file__).parents[1] / "data" / "paper_returns.csv", suite)
    lines = []
    for row in sorted(rows, key=lambda row: -_value(row, suite, "partial")):
        lines.append(
            [row.name, *(_value_text(row, suite, twin) for twin in reversed(TWINS)), row.note]
        )
    return [
        "## Reported, not checked",
        "Other protocols, so other tables: nothing above is compared with these. The paper's rows "
        "are means of its five seeds by its training score, under the published rules, and its "
        "people; a row is the interquartile mean of the ten means. The two rows of this repository "
        "are greedy returns of 1,024 episodes of another evaluation seed, AutoEncode and Navigator "
        "under the published rules, of runs in [small/easy.csv](../results/small/easy.csv): "
        "reported, checkpoints not kept.",
        markdown_table(("agent", "POMDP", "MDP", "of"), lines, left=1),
    ]


def _value(row: Reported, suite: Suite, twin: str) -> float:
    """Interquartile mean of the means of a row; below all others where a game is missing."""
    if not has_suite(row.cells, suite):
        return -1.0
    means = {}
    for cell, values in row.cells.items():
        means[cell] = [mean(values)]
    return suite_iqm(means, suite, twin).value


def _value_text(row: Reported, suite: Suite, twin: str) -> str:
    value = _value(row, suite, twin)
    return f"{value:.3f}" if value >= 0 else "-, no return of a game"
