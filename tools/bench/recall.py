"""Tests of memory. Of this file, *symbol*: see one of four symbols, wait among distractors, name it
when asked. Plain supervised learning. The tests that tell memories apart stand in `memory_tests`.

Every step shows one token, one-hot: 0 to 3 are the symbols, 4 to 7 distractors, 8 asks. An episode
shows a symbol at its first step, then ``delay`` distractors, then asks. A quarter of the episodes
end before, at any step, and the next one begins: windows hold starts in the middle. Only answers
are scored; who remembers nothing gets one in four right.

One setting serves every model at every delay: a memory block of one cell with its default options
(`arcade_torch.models.MemoryBlock`) between the tokens and four logits, Adam. The curriculum: while
training, half of the episodes wait for ``delay`` steps and the others for 1 to ``delay``, drawn
evenly. Tests have the full delay alone.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from arcade_torch.models import MemoryBlock, make_memory, memory_names
from arcade_torch.tools.bench.memory_tests import TESTS, table
from arcade_torch.tools.bench.memory_tests.training import MOST_SEED, MOST_STEPS, Setting
from arcade_torch.tools.bench.registry import BenchOptions
from arcade_torch.tools.files import Row, markdown_table, measured_rows, read_rows, write_between
from arcade_torch.tools.machine import torch_threads
from arcade_torch.tools.options import at_least, at_most

SYMBOLS = 4
DISTRACTORS = 4
ASK = SYMBOLS + DISTRACTORS
TOKENS = ASK + 1
CUT = 0.25
"""Share of the episodes that end before they ask."""
UNLABELLED = -100  # what cross_entropy leaves out
SEQUENCES = 32  # of a batch
LEARNING_RATE = 3e-3
MAX_NORM = 1.0  # of the gradient
CHECK_EVERY = 25  # gradient steps
SOLVED = 0.99
FIRST_LOOK = 200  # answers, at least: few, to see whether the final test is worth its time
ANSWERS = 2000  # of the final test, at least
BEGIN = "<!-- recall -->"
END = "<!-- end of recall -->"
SYMBOL = "symbol"
OUT = Path("recall.csv")
OUT_OF_TESTS = Path("memory_tests.csv")
TestName = Literal[
    "symbol",
    "delay",
    "noise",
    "capacity",
    "association",
    "rewriting",
    "forgetting",
    "copy",
    "counting",
    "parity",
    "s3",
    "s5",
]


@dataclass
class Options(BenchOptions):
    """Tests of memory: what a model holds, for how long, and what it can do with it.

    symbol, the default: see one of four symbols, wait among distractors, name it when asked. Each
    model is trained alone, on one thread, until 99 % of fresh answers are right or its budget is
    spent; chance is 25 %. The other tests tell memories apart: all models learn each of them with
    one setting, and are asked at sizes that they have learned and at new ones. Keeps a CSV file
    that it goes on with after an interruption, and can write the table into a Markdown page.

    Example: arcade-torch bench recall --tests delay parity s5 --memory lru gru
    """

    resumable: ClassVar[bool] = True
    memories: tuple[str, ...] = ()
    """Memory models, which may stand first without this word; all of them by default."""
    tests: tuple[TestName, ...] = ("symbol",)  # What they are asked; symbol stands alone.
    delays: tuple[int, ...] = (8, 32, 96)  # Of symbol: steps between symbol and question.
    hidden_size: int = 64  # Width of the memory block.
    seconds: float = 60.0  # Of symbol: budget of each training, processor time.
    steps: int = 800  # Of the other tests: gradient steps of each training, at most.
    seed: int = 0  # Of weights and data; the first of them.
    seeds: int = 3  # Of the other tests: number of seeds.
    out: Path | None = OUT
    """Table; rows it holds are not measured again. Of the other tests memory_tests.csv by
    default.
    """
    page: Path | None = None
    """Markdown page that gets the table between its marks, and beside it, of the other tests, a
    picture of its name. It shows all models that the file has rows of, not the named alone.
    """

    def __post_init__(self) -> None:
        """The file of the other tests has other columns."""
        if self.tests != (SYMBOL,) and self.out == OUT:
            self.out = OUT_OF_TESTS


class Recall(NamedTuple):
    """What one model reached at one delay: a row of the table."""

    model: str
    delay: int
    hidden_size: int
    seed: int
    accuracy: float  # share of right answers on fresh data at the end, to four places
    answers: int
    steps: int  # of training, until 99 % of the answers were right or the budget was spent
    seconds: float  # processor time of these steps, tests left out, to two places
    parameters: int
    state_numbers: int


def run(options: Options, log: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``recall``, or of ``memory_tests``; those that the file holds already are
    not measured again.
    """
    at_least(options, seconds=0.01, hidden_size=1, delays=1, seed=0, seeds=1, steps=1)
    at_most(options, steps=MOST_STEPS, seed=MOST_SEED, seeds=MOST_SEED)
    for memory in options.memories:
        make_memory(memory, 1, 1)  # refuses a name that is none, before anything is trained
    if options.tests == (SYMBOL,):
        yield from _run_symbol(options, log)
    elif SYMBOL in options.tests or not options.tests:
        raise ValueError(
            f"--tests must be {SYMBOL} alone, whose table has other columns, or some of "
            f"{', '.join(TESTS)}, got {' '.join(options.tests) or 'none'}"
        )
    else:
        yield from _run_tests(options, log)


def _run_tests(
    options: Options, log: Callable[[str], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``memory_tests``, then its page and picture."""
    from arcade_torch.tools.bench.memory_tests import figure

    setting = Setting(hidden_size=options.hidden_size, steps=options.steps)
    seeds = range(options.seed, options.seed + options.seeds)
    tests = [TESTS[name] for name in dict.fromkeys(options.tests)]
    memories = list(dict.fromkeys(options.memories)) or memory_names()
    rows = []
    with torch_threads(1):
        for row in table.measured(options.out, memories, tests, seeds, setting, log):
            rows.append(row)
            yield "memory_tests", row._asdict()
    if options.page is not None:
        if options.out is not None:
            rows = []
            for row in rows_of_all(options.out, table.Row):
                setting_of_row = (row.hidden_size, row.most_steps)
                if setting_of_row == (options.hidden_size, options.steps) and row.seed in seeds:
                    rows.append(row)
        models = list(dict.fromkeys(row.model for row in rows))
        write_between(options.page, table.BEGIN, table.END, table.markdown(rows, models))
        figure.write(options.page.with_suffix(".png"), rows, models)


def _run_symbol(
    options: Options, log: Callable[[str], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``recall``, then its page."""
    sizes = (options.hidden_size, options.seed)
    asked = []

    def measure(memory: str, delay: int, hidden_size: int, seed: int) -> Recall:
        log(f"{memory}, delay {delay}")
        return train(memory, delay, hidden_size, options.seconds, seed)

    keys = ((*key, *sizes) for key in product(options.memories or memory_names(), options.delays))
    with torch_threads(1):
        for row in measured_rows(options.out, Recall, keys, measure):
            asked.append(row)
            yield "recall", row._asdict()
    if options.page is not None:
        if options.out is not None:
            rows = rows_of_all(options.out, Recall)
            asked = [row for row in rows if (row.hidden_size, row.seed) == sizes]
        write_between(options.page, BEGIN, END, markdown(asked))


def rows_of_all(file: Path, kind: type[Row]) -> list[Row]:
    """The rows that a file has of registered models, in the order of the registry."""
    names = memory_names()
    rows = [row for row in read_rows(file, kind) if row[0] in names]
    return sorted(rows, key=lambda row: names.index(row[0]))


class Windows(NamedTuple):
    """A batch of sequences: tokens and answers int64 [B, T], is_init bool [B, T]."""

    tokens: Tensor
    is_init: Tensor
    answers: Tensor


def windows(rng: np.random.Generator, rows: int, delay: int, *, mixed: bool = False) -> Windows:
    """Draw sequences of 2 (delay + 2) steps, episode after episode."""
    length = 2 * (delay + 2)
    tokens = SYMBOLS + rng.integers(DISTRACTORS, size=(rows, length))
    starts = np.zeros((rows, length), bool)
    answers = np.full((rows, length), UNLABELLED)
    begin = np.zeros(rows, int)
    row = np.arange(rows)
    while (begin < length).any():
        symbol = rng.integers(SYMBOLS, size=rows)
        wait = np.full(rows, delay)
        if mixed:
            wait = np.where(rng.random(rows) < 0.5, wait, rng.integers(1, delay + 1, size=rows))
        cut = rng.random(rows) < CUT
        asked = begin + wait + 1
        inside = begin < length
        asks = ~cut & (asked < length)
        tokens[row[inside], begin[inside]] = symbol[inside]
        starts[row[inside], begin[inside]] = True
        tokens[row[asks], asked[asks]] = ASK
        answers[row[asks], asked[asks]] = symbol[asks]
        begin = np.where(cut, begin + rng.integers(1, wait + 2), asked + 1)
    return Windows(*(torch.from_numpy(x) for x in (tokens, starts, answers)))


class Reader(nn.Module):
    """Tokens to logits: one-hot, memory block, linear."""

    def __init__(self, memory: str, hidden_size: int) -> None:
        super().__init__()
        self.block = MemoryBlock(TOKENS, hidden_size, memory, layers=1)
        self.head = nn.Linear(hidden_size, SYMBOLS)

    def forward(self, batch: Windows) -> tuple[Tensor, Tensor]:
        """Where a symbol is asked for: logits of the four, float [answers, 4], and the right one,
        int64 [answers].
        """
        x = nn.functional.one_hot(batch.tokens, TOKENS).to(self.head.weight.dtype)
        y, _ = self.block(x, self.block.initial_state(len(x)), batch.is_init)
        asked = batch.answers != UNLABELLED
        return self.head(y[asked]), batch.answers[asked]


def train(
    memory: str,
    delay: int,
    hidden_size: int = 64,
    seconds: float = 60.0,
    seed: int = 0,
    answers: int = ANSWERS,
) -> Recall:
    """Train one model until it is right or the budget is spent, then test it on fresh data."""
    torch.manual_seed(seed)
    data, tests = (np.random.default_rng([seed, delay, part]) for part in range(2))
    reader = Reader(memory, hidden_size)
    optimizer = torch.optim.Adam(reader.parameters(), LEARNING_RATE)
    steps = 0
    spent = 0.0
    right = 0.0
    answered = 0
    while right < SOLVED and spent < seconds:
        began = time.process_time()
        for _ in range(CHECK_EVERY):
            loss = nn.functional.cross_entropy(*reader(windows(data, SEQUENCES, delay, mixed=True)))
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(reader.parameters(), MAX_NORM)
            optimizer.step()
        steps += CHECK_EVERY
        spent += time.process_time() - began
        if accuracy(reader, tests, delay, FIRST_LOOK)[0] >= SOLVED or spent >= seconds:
            right, answered = accuracy(reader, tests, delay, answers)
    parameters = sum(p.numel() for p in reader.parameters())
    state = sum(leaf.numel() for leaf in reader.block.initial_state(1).values(True, True))
    result = (round(right, 4), answered, steps, round(spent, 2), parameters, state)
    return Recall(memory, delay, hidden_size, seed, *result)


@torch.no_grad()
def accuracy(
    reader: Reader, rng: np.random.Generator, delay: int, answers: int
) -> tuple[float, int]:
    """Share of right answers to ``answers`` fresh questions or a few more, and how many they
    were.
    """
    right = asked = 0
    while asked < answers:
        logits, wanted = reader(windows(rng, 128, delay))
        right += int((logits.argmax(-1) == wanted).sum())
        asked += len(wanted)
    return right / asked, asked


def markdown(rows: Sequence[Recall]) -> str:
    """The rows as a Markdown table: a line a model, a column a delay."""
    delays = sorted({row.delay for row in rows})
    heads = ["model", *(f"delay {delay}" for delay in delays), "parameters", "state"]
    lines = dict[str, list[str]]()
    for row in rows:
        sizes = [f"{row.parameters:,}", f"{row.state_numbers:,}"]
        line = lines.setdefault(row.model, [f"`{row.model}`", *[""] * len(delays), *sizes])
        line[1 + delays.index(row.delay)] = _in_words(row)
    return markdown_table(heads, list(lines.values()))


def _in_words(row: Recall) -> str:
    """Per cent of right answers, and what they took."""
    digits = 0 if row.seconds >= 10 else 1
    solved = "" if row.accuracy >= SOLVED else "not solved: "
    effort = f"{row.steps} steps, {row.seconds:.{digits}f} s"
    return f"{100 * row.accuracy:.1f} % ({solved}{effort})"
