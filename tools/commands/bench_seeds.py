"""``arcade-torch bench seeds``."""

import sys
from dataclasses import dataclass
from pathlib import Path

from arcade_torch.tools.bench.table_file import check_table_file, save_table
from arcade_torch.tools.tables import show_table


@dataclass
class BenchSeeds:
    """Frames per second of several seeds of PQN trained together, against the same runs one after the other.

    Whole updates are timed, collecting and learning, of the very trainers of `arcade-torch train`, in turns.

    Example: arcade-torch bench seeds --seeds 1 2 5 --networks small --memories gru --threads 1
    """

    seeds: tuple[int, ...] = (1, 2, 5)
    """Numbers of seeds."""
    networks: tuple[str, ...] = ("small",)
    """Presets of network and learner: paper, small."""
    memories: tuple[str, ...] = ("mingru", "gru")
    """Memory models, see arcade-torch list."""
    env: str = "MineSweeperEasy"
    """The game; its POMDP twin is played."""
    device: str = "cpu"
    """Torch device of the networks."""
    threads: int = 1
    """Torch threads; 0 leaves the setting alone."""
    seconds: float = 5.0
    """Time for each measure in each turn."""
    repeats: int = 3
    """Turns; the median counts."""
    note: str = ""
    """Said about the machine in the result, for example that it was not idle."""
    out: Path | None = None
    """File for the numbers, .csv or .json; overwritten."""

    def run(self) -> int:
        """Measure, print, save."""
        check_table_file(self.out)
        if self.threads < 0:
            raise ValueError(f"--threads must be 0 or more, got {self.threads}")
        import torch

        from arcade_torch.tools.bench.envs import machine
        from arcade_torch.tools.bench.seeds import as_rows, bench_seeds
        from arcade_torch.tools.keep_memory import keep_freed_memory

        keep_freed_memory()  # as in training
        if self.threads:
            torch.set_num_threads(self.threads)
        speeds = bench_seeds(
            self.seeds, self.networks, self.memories, self.env, self.device, self.seconds, self.repeats, _tell
        )
        about = {"env": self.env, "device": self.device, **machine(), "note": self.note}
        cells = [
            (s.network, s.memory, s.seeds, f"{s.together_fps:,.0f}", f"{s.alone_fps:,.0f}", f"{s.gain:.2f}")
            for s in speeds
        ]
        titles = ("network", "memory", "seeds", "frames/s together", "frames/s one by one", "gain")
        show_table(f"Seeds together; medians of {self.repeats} turns", titles, cells)
        print(", ".join(f"{name} {value}" for name, value in about.items() if value))
        save_table(self.out, as_rows(speeds), about)
        return 0


COMMAND = BenchSeeds


def _tell(text: str) -> None:
    print(f"measuring {text}", file=sys.stderr, flush=True)
