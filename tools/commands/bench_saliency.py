"""``arcade-torch bench saliency``."""

import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from arcade_torch.tools.files import write_csv
from arcade_torch.tools.tables import show_table


@dataclass
class BenchSaliency:
    """Saliency maps of one episode: two stages against differentiating the whole network action by action.

    All ways are measured in turns in the same run and have to give the same maps; the fastest turn counts.

    Example: arcade-torch bench saliency --steps 128 --out saliency.csv
    """

    networks: tuple[str, ...] = ("small", "paper")
    """Presets whose networks are measured."""
    memory: str = "lru"
    """Memory model."""
    steps: int = 128
    """Frames of the episode."""
    chunk: int = 8
    """Frames pushed through the encoder at once by the two stages."""
    repeats: int = 3
    """Turns."""
    threads: int = 1
    """Of torch."""
    keep_memory: bool = True
    """Keep freed memory, as this program does whenever it trains; a Python process of its own hands it back."""
    out: Path | None = None
    """CSV file of the table; overwritten."""

    def run(self) -> int:
        """Measure, print, save."""
        if not self.networks or min(self.steps, self.chunk, self.repeats, self.threads) < 1:
            raise ValueError("name a network; steps, chunk, repeats and threads must be at least 1")
        from arcade_torch.tools.bench.saliency import bench_saliency
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.versions import versions

        if self.keep_memory:
            keep_freed_memory()
        found = bench_saliency(
            self.networks, self.memory, self.steps, self.chunk, self.repeats, self.threads, tell=_tell
        )
        rows = list(found)
        if self.out is not None:
            write_csv(self.out, map(asdict, rows), [item.name for item in fields(rows[0])])
        show_table(
            f"{self.steps} frames of 128 x 128, 5 actions, memory {self.memory}, torch threads: {self.threads}, "
            f"freed memory {'kept' if self.keep_memory else 'handed back'}",
            ["network", "way", "seconds", "ratio", "peak MiB", "difference"],
            [
                (r.network, r.way, f"{r.seconds:.2f}", f"{r.ratio:.2f}", f"{r.peak_mib:.0f}", f"{r.difference:.1e}")
                for r in rows
            ],
            left=2,
        )
        print(", ".join(f"{name} {value}" for name, value in versions().items() if value))
        return 0


COMMAND = BenchSaliency


def _tell(text: str) -> None:
    print(f"measuring {text}", file=sys.stderr, flush=True)
