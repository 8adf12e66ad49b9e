"""``arcade-torch bench envs``."""

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.tools.bench.table_file import check_table_file, save_table
from arcade_torch.tools.tables import show_table


@dataclass
class BenchEnvs:
    """Frames per second of games at several batch sizes, every frame consumed by a checksum.

    Measures take turns; medians are shown. Beside frames/s stand GB/s and the share of a plain fill and of a plain
    copy of the same bytes in the same run. Memory that is freed is kept, as ``arcade-torch train`` does: else at 256
    pixels the system spends a third of the time on handing out fresh pages.

    Example: arcade-torch bench envs --games MineSweeperEasy --batches 16 128 --out runs/bench.csv
    """

    games: tuple[str, ...] = ()
    """Environment ids; every registered Easy game by default."""
    sizes: tuple[int, ...] = (128,)
    """Sides of the frames, 128 or 256."""
    batches: tuple[int, ...] = (1, 16, 128, 512)
    """Numbers of envs."""
    seconds: float = 0.5
    """For each measure in each repeat."""
    repeats: int = 5
    """Turns."""
    out: Path | None = None
    """File for the numbers, .csv or .json; overwritten."""

    def run(self) -> int:
        """Measure, print, save."""
        check_table_file(self.out)
        from arcade_torch.envs_jax import registered_ids
        from arcade_torch.tools.bench.envs import NAMES, as_dicts, bench_envs, machine
        from arcade_torch.tools.keep_memory import keep_freed_memory

        kept = keep_freed_memory()
        games = self.games or tuple(name for name in registered_ids() if "Easy" in name)
        about = {**machine(), "freed_memory": "kept, as in training" if kept else "handed back"}
        rows = bench_envs(games, self.sizes, self.batches, self.seconds, self.repeats, lambda text: _tell(text))
        for game in games:
            for size in self.sizes:
                chosen = [row for row in rows if row.game == game and row.obs_size == size]
                show_table(
                    f"{game}, {size} px, {about['jax_device']}, {about['cores']} cores",
                    ("envs", "measure", "frames consumed", "frames/s", "with checksum", "GB/s", "of fill", "of copy"),
                    [_cells(row, NAMES) for row in chosen],
                    left=2,
                )
        self._summary(rows, games)
        print("frames/s without the checksum's time, and with it; medians of", self.repeats, "turns")
        print(", ".join(f"{name} {value}" for name, value in about.items() if value))
        save_table(self.out, as_dicts(rows), about)
        return 0

    def _summary(self, rows: Sequence[Any], games: Sequence[str]) -> None:
        """Print one line a game: its rate at the batch size nearest to 128, and what its first call costs."""
        from arcade_torch.tools.bench.first_call import first_call

        count = min(self.batches, key=lambda batch: abs(batch - 128))
        for size in self.sizes:
            _tell(f"first calls at {size} px")
            drawn = [r for r in rows if (r.obs_size, r.num_envs, r.measure) == (size, count, "step+draw")]
            firsts = [first_call(game, size, count) for game in games]
            lines = [
                (row.game, f"{row.frames_per_s:,.0f}", f"{first.compile_s:.1f} s", f"{first.share_of_frames:.2f}")
                for row, first in zip(drawn, firsts, strict=True)
            ]
            mean = statistics.geometric_mean(row.frames_per_s for row in drawn)
            show_table(
                f"step, auto-reset and drawing, {count} envs, {size} px",
                ("game", "frames/s", "trace and compile", "working memory / frames"),
                [*lines, ("geometric mean", f"{mean:,.0f}", "", "")],
            )


COMMAND = BenchEnvs


def _tell(text: str) -> None:
    print(f"measuring {text}", file=sys.stderr, flush=True)


def _cells(row: Any, names: dict[str, str]) -> Sequence[str]:
    drawn = (f"{row.gb_per_s:.2f}", f"{100 * row.share_of_fill:.0f} %", f"{100 * row.share_of_copy:.0f} %")
    return (
        str(row.num_envs),
        names[row.measure],
        f"{row.frames:,}",
        f"{row.frames_per_s:,.0f}",
        f"{row.frames_per_s_with_check:,.0f}",
        *(drawn if row.measure != "step" else ("", "", "")),
    )
