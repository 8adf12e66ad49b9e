"""``arcade-torch bench recall``."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class BenchRecall:
    """Delayed recall: see one of four symbols, wait among distractors, name it when asked.

    Each model is trained alone, on one thread, until 99 % of fresh answers are right or its budget is spent; chance is
    25 %. Where the windows of attention end is measured too. Keeps a CSV file that it goes on with after an
    interruption, and can write the table into a Markdown page.

    Example: arcade-torch bench recall lru attention --delays 8 32 --out recall.csv
    """

    memories: tyro.conf.Positional[tuple[str, ...]] = ()
    """Memory models; all of them, and attention with several windows, by default."""
    delays: tuple[int, ...] = (8, 32, 96)
    """Steps between symbol and question."""
    hidden_size: int = 64
    """Width of the memory block."""
    seconds: float = 60.0
    """Budget of each training, processor time."""
    seed: int = 0
    """Of weights and data."""
    out: Path = Path("recall.csv")
    """Table; rows it holds are not measured again."""
    page: Path | None = None
    """Markdown page that gets the table between its marks."""

    def run(self) -> int:
        """Train, test and write."""
        if self.seconds <= 0 or self.hidden_size < 1 or not self.delays or min(self.delays) < 1:
            raise ValueError(
                "need seconds above 0, a hidden size of at least 1 and delays of at least 1 step, got "
                f"{self.seconds}, {self.hidden_size} and {self.delays}"
            )
        from arcade_torch.tools.bench import recall
        from arcade_torch.tools.bench.timing import torch_threads
        from arcade_torch.tools.files import write_between

        cases = [(entry, delay) for entry in recall.entries(self.memories) for delay in self.delays]
        if not self.memories:
            cases += [case for case in recall.CAPACITY if case[1] in self.delays]
        setting = recall.Setting(hidden_size=self.hidden_size, seconds=self.seconds, seed=self.seed)
        with torch_threads(1):
            table = recall.markdown(list(recall.measure_all(cases, setting, self.out, _tell)))
        print(table)
        if self.page is not None:
            print(f"\nwritten into {write_between(self.page, recall.BEGIN, recall.END, table)}")
        return 0

    def how_to_go_on(self) -> str:
        """What to type after an interruption."""
        return f"finished rows are in {self.out}; the same command goes on with the others"


COMMAND = BenchRecall


def _tell(text: str) -> None:
    print(f"training {text}", file=sys.stderr, flush=True)
