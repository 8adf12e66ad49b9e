"""Delayed recall: see one of four symbols, wait among distractors, name it when asked. Plain supervised learning.

Every step shows one token, one-hot: 0 to 3 are the symbols, 4 to 7 distractors, 8 asks. An episode shows a symbol at
its first step, then ``delay`` distractors, then asks. A quarter of the episodes end before, at any step, and the next
one begins: windows hold starts in the middle. Only answers are scored; who remembers nothing gets one in four right.

One setting serves every model at every delay (`Setting`): a memory block of one cell with its default options
(`arcade_torch.models.MemoryBlock`) between the tokens and four logits, Adam. The curriculum: while training, half of
the episodes wait for ``delay`` steps and the others for 1 to ``delay``, drawn evenly. Tests have the full delay alone.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from arcade_torch.models import MemoryBlock, memory_names
from arcade_torch.tools.bench.harness import torch_threads
from arcade_torch.tools.files import read_csv, write_between, write_csv

SYMBOLS, DISTRACTORS = 4, 4
ASK = SYMBOLS + DISTRACTORS
TOKENS = ASK + 1
CHANCE = 1 / SYMBOLS
CUT = 0.25
"""Share of the episodes that end before they ask."""
UNLABELLED = -100  # what cross_entropy leaves out
DELAYS = (8, 32, 96)
SOLVED = 0.99
FIRST_LOOK = 200  # answers in the test that decides whether the final one is worth its time
BEGIN, END = "<!-- recall -->", "<!-- end of recall -->"


@dataclass(frozen=True)
class Setting:
    """How all models are trained.

    Attributes:
        hidden_size: H.
        rows: sequences in a batch.
        learning_rate: of Adam.
        clip: largest norm of the gradient.
        seconds: budget of training, processor time.
        check_every: steps between two looks at whether it is solved.
        answers: number of fresh questions in the final test, at least.
        seed: of weights and data.
    """

    hidden_size: int = 64
    rows: int = 32
    learning_rate: float = 3e-3
    clip: float = 1.0
    seconds: float = 60.0
    check_every: int = 25
    answers: int = 2000
    seed: int = 0


@dataclass
class Options:
    """Delayed recall: see one of four symbols, wait among distractors, name it when asked.

    Each model is trained alone, on one thread, until 99 % of fresh answers are right or its budget is spent; chance is
    25 %. Where the windows of attention end is measured too. Keeps a CSV file that it goes on with after an
    interruption, and can write the table into a Markdown page.

    Example: arcade-torch bench recall lru attention --delays 8 32 --out recall.csv
    """

    memories: tuple[str, ...] = ()
    """Memory models; all of them, and attention with several windows, by default."""
    delays: tuple[int, ...] = (8, 32, 96)
    """Steps between symbol and question."""
    hidden_size: int = 64
    """Width of the memory block."""
    seconds: float = 60.0
    """Budget of each training, processor time."""
    seed: int = 0
    """Of weights and data."""
    out: Path | None = Path("recall.csv")
    """Table; rows it holds are not measured again."""
    page: Path | None = None
    """Markdown page that gets the table between its marks."""


SIZES: dict[str, dict[str, Any]] = {
    "tiny": {"memories": ("gru",), "delays": (2,), "seconds": 0.5},
    "quick": {"memories": ("lru", "mingru", "gru"), "delays": (8,), "seconds": 10.0},
    "full": {},
}
KEEPS_ITS_FILE = True


def run(options: Options, tell: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``recall``."""
    if options.seconds <= 0 or options.hidden_size < 1 or not options.delays or min(options.delays) < 1:
        raise ValueError(
            "need seconds above 0, a hidden size of at least 1 and delays of at least 1 step, got "
            f"{options.seconds}, {options.hidden_size} and {options.delays}"
        )
    cases = [(entry, delay) for entry in entries(options.memories) for delay in options.delays]
    cases += [] if options.memories else [case for case in CAPACITY if case[1] in options.delays]
    setting = Setting(hidden_size=options.hidden_size, seconds=options.seconds, seed=options.seed)
    rows = []
    with torch_threads(1):
        for row in measure_all(cases, setting, options.out, tell):
            rows.append(row)
            yield "recall", asdict(row)
    if options.page is not None:
        write_between(options.page, BEGIN, END, markdown(rows))


@dataclass(frozen=True)
class Entry:
    """A model in the table: its name, number of cells one above the other, and options."""

    memory: str
    layers: int = 1
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name, options and layers in one line."""
        options = "".join(f", {key}={value}" for key, value in self.options.items())
        return f"{self.memory}{options}" + (f", {self.layers} layers" if self.layers > 1 else "")


@dataclass(frozen=True)
class Recall:
    """What one model reached at one delay.

    Attributes:
        model: label of the entry.
        delay: steps between the symbol and the question.
        hidden_size: width of the memory block.
        seed: of weights and data.
        accuracy: share of right answers on fresh data at the end, to four places.
        answers: how many those were.
        steps: of training, until 99 % of the answers were right or the budget was spent.
        seconds: processor time of these steps, tests left out, to two places.
        parameters: of the network.
        state_numbers: numbers in its recurrent state.
    """

    model: str
    delay: int
    hidden_size: int
    seed: int
    accuracy: float
    answers: int
    steps: int
    seconds: float
    parameters: int
    state_numbers: int

    @property
    def solved(self) -> bool:
        """Whether 99 % of the final answers were right."""
        return self.accuracy >= SOLVED


def entries(names: Sequence[str] = ()) -> list[Entry]:
    """One entry a model, with its default options; every registered one by default."""
    return [Entry(name) for name in names or memory_names()]


CAPACITY: tuple[tuple[Entry, int], ...] = (
    (Entry("attention", 1, {"window": 32}), 32),
    (Entry("attention", 1, {"window": 34}), 32),
    (Entry("attention", 2, {"window": 17}), 32),
    (Entry("attention", 2, {"window": 24}), 32),
)
"""Where theory puts a border. The question comes delay + 1 = 33 steps after the symbol; L layers of attention over
windows of W steps reach L (W - 1) steps back: 31, 33, 32 and 46."""


@dataclass(frozen=True)
class Windows:
    """A batch of sequences."""

    tokens: Tensor
    is_init: Tensor
    answers: Tensor


def windows(rng: np.random.Generator, rows: int, delay: int, *, mixed: bool = False) -> Windows:
    """Draw sequences of 2 (delay + 2) steps, episode after episode."""
    if delay < 1:
        raise ValueError(f"a delay is at least 1 step, got {delay}")
    length = 2 * (delay + 2)
    tokens = SYMBOLS + rng.integers(DISTRACTORS, size=(rows, length))
    starts, answers = np.zeros((rows, length), bool), np.full((rows, length), UNLABELLED)
    begin, row = np.zeros(rows, int), np.arange(rows)
    while (begin < length).any():
        symbol, wait = rng.integers(SYMBOLS, size=rows), np.full(rows, delay)
        if mixed:
            wait = np.where(rng.random(rows) < 0.5, wait, rng.integers(1, delay + 1, size=rows))
        cut = rng.random(rows) < CUT
        asked = begin + wait + 1
        inside, asks = begin < length, ~cut & (asked < length)
        tokens[row[inside], begin[inside]] = symbol[inside]
        starts[row[inside], begin[inside]] = True
        tokens[row[asks], asked[asks]] = ASK
        answers[row[asks], asked[asks]] = symbol[asks]
        begin = np.where(cut, begin + rng.integers(1, wait + 2), asked + 1)
    return Windows(*(torch.from_numpy(x) for x in (tokens, starts, answers)))


class Reader(nn.Module):
    """Tokens to logits: one-hot, memory block, linear."""

    def __init__(self, entry: Entry, hidden_size: int) -> None:
        super().__init__()
        options = dict(entry.options)
        self.block = MemoryBlock(TOKENS, hidden_size, entry.memory, layers=entry.layers, memory_options=options)
        self.head = nn.Linear(hidden_size, SYMBOLS)

    def forward(self, batch: Windows) -> Tensor:
        """Logits of the four symbols wherever one is asked for, float [answers, 4]."""
        x = nn.functional.one_hot(batch.tokens, TOKENS).to(self.head.weight.dtype)
        y, _ = self.block(x, self.block.initial_state(len(x)), batch.is_init)
        logits: Tensor = self.head(y[batch.answers != UNLABELLED])
        return logits


def train(entry: Entry, delay: int, setting: Setting | None = None) -> Recall:
    """Train one model until it is right or the budget is spent, then test it on fresh data."""
    setting = setting or Setting()
    torch.manual_seed(setting.seed)
    data, tests = (np.random.default_rng([setting.seed, delay, part]) for part in range(2))
    reader = Reader(entry, setting.hidden_size)
    optimizer = torch.optim.Adam(reader.parameters(), setting.learning_rate)
    steps, spent = 0, 0.0
    while spent < setting.seconds:
        began = time.process_time()
        for _ in range(setting.check_every):
            batch = windows(data, setting.rows, delay, mixed=True)
            loss = nn.functional.cross_entropy(reader(batch), batch.answers[batch.answers != UNLABELLED])
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(reader.parameters(), setting.clip)
            optimizer.step()
            steps += 1
        spent += time.process_time() - began
        if accuracy(reader, tests, delay, FIRST_LOOK)[0] >= SOLVED:
            right, answers = accuracy(reader, tests, delay, setting.answers)
            if right >= SOLVED:
                break
    else:
        right, answers = accuracy(reader, tests, delay, setting.answers)
    state = reader.block.initial_state(1)
    return Recall(
        entry.label,
        delay,
        setting.hidden_size,
        setting.seed,
        round(right, 4),
        answers,
        steps,
        round(spent, 2),
        sum(p.numel() for p in reader.parameters()),
        sum(leaf.numel() for leaf in state.values(True, True)),
    )


@torch.no_grad()
def accuracy(reader: Reader, rng: np.random.Generator, delay: int, answers: int) -> tuple[float, int]:
    """Share of right answers to ``answers`` fresh questions or a few more, and how many they were."""
    right = asked = 0
    while asked < answers:
        batch = windows(rng, 128, delay)
        wanted = batch.answers[batch.answers != UNLABELLED]
        right += int((reader(batch).argmax(-1) == wanted).sum())
        asked += len(wanted)
    return right / asked, asked


def measure_all(
    cases: Sequence[tuple[Entry, int]],
    setting: Setting,
    out: Path | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Iterator[Recall]:
    """One case after another; rows that the file holds already are not measured again."""
    rows = read_recall(out) if out is not None and out.exists() else []
    known = {(row.model, row.delay, row.hidden_size, row.seed): row for row in rows}
    for entry, delay in cases:
        key = entry.label, delay, setting.hidden_size, setting.seed
        if key not in known:
            tell(f"{entry.label}, delay {delay}")
            known[key] = train(entry, delay, setting)
            if out is not None:
                write_csv(out, map(asdict, known.values()), [field.name for field in fields(Recall)])
        yield known[key]


def read_recall(path: Path) -> list[Recall]:
    """The rows of a file that `measure_all` has written."""
    kinds = {item.name: item.type for item in fields(Recall)}
    try:
        return [Recall(**{name: kinds[name](row[name]) for name in kinds}) for row in read_csv(path)]  # type: ignore[operator]
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is no table of delayed recall ({error}); choose another --out") from None


def markdown(rows: Sequence[Recall]) -> str:
    """The rows as a Markdown table: a line a model, a column a delay."""
    delays = sorted({row.delay for row in rows})
    models = list(dict.fromkeys(row.model for row in rows))
    found = {(row.model, row.delay): row for row in rows}
    lines = [
        "| model | " + " | ".join(f"delay {delay}" for delay in delays) + " | parameters | state |",
        "|---" * (len(delays) + 3) + "|",
    ]
    for model in models:
        cells = [_cell(found.get((model, delay))) for delay in delays]
        any_row = next(row for row in rows if row.model == model)
        lines.append(f"| `{model}` | {' | '.join(cells)} | {any_row.parameters:,} | {any_row.state_numbers:,} |")
    return "\n".join(lines)


def _cell(row: Recall | None) -> str:
    if row is None:
        return ""
    effort = f"{row.steps} steps, {row.seconds:.{0 if row.seconds >= 10 else 1}f} s"
    return f"{100 * row.accuracy:.1f} %" + (f" ({effort})" if row.solved else f" (not solved: {effort})")
