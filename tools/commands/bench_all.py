"""``arcade-torch bench all``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from arcade_torch.tools.files import write_json, write_text


@dataclass
class BenchAll:
    """Every benchmark into one file with machine, versions and commit, and a page of its tables.

    Tables: envs, train, models, scans, recall. arcade-torch bench compare says what became of an older file.

    Example: arcade-torch bench all --size quick --out results/bench.json --page results/bench.md
    """

    size: Literal["tiny", "quick", "full"] = "quick"
    """How much: tiny takes half a minute and proves nothing, quick about ten minutes, full an hour or more."""
    tables: tuple[str, ...] = ()
    """Which tables; all by default."""
    out: Path = Path("results/bench.json")
    """The file; overwritten."""
    page: Path | None = None
    """Markdown page of the tables; beside the file by default."""

    def run(self) -> int:
        """Measure and save."""
        if self.out.suffix != ".json":
            raise ValueError(f"--out must end in .json, got {self.out}")
        from arcade_torch.tools.bench.results import page
        from arcade_torch.tools.bench.suite import bench_all

        results = bench_all(
            self.size, self.tables, lambda text: print(f"measuring {text}", file=sys.stderr, flush=True)
        )
        print(write_json(self.out, results))
        print(write_text(self.page or self.out.with_suffix(".md"), page(results)))
        return 0


COMMAND = BenchAll
