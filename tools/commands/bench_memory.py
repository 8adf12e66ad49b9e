"""``arcade-torch bench memory``."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import tyro

from arcade_torch.tools.files import write_csv
from arcade_torch.tools.tables import show_table


@dataclass
class BenchMemory:
    """Time and memory of the memory models, each scan beside its own loop and torch.nn.GRU; then of the scans alone.

    Measures take turns; the best turn counts. Peak memory is what torch's allocator had handed out (its profiler's
    events), the same on every machine. Where there is a CUDA device, a third table has the back ends of the scan there,
    each as a share of the speed of a plain copy of the same bytes in the same run.

    Example: arcade-torch bench memory lru gru --steps 132 --layers 1 --out runs/memory
    """

    memories: tyro.conf.Positional[tuple[str, ...]] = ()
    """Memory models; all of them by default."""
    steps: tuple[int, ...] = (132, 1024)
    """Lengths of the sequences."""
    layers: tuple[int, ...] = (1, 2)
    """Cells one above the other."""
    size: int = 512
    """Width of input and output."""
    batch: int = 16
    """Sequences."""
    threads: int = 1
    """Of torch."""
    seconds: float = 0.3
    """For each measure in each repeat, at least one pass."""
    repeats: int = 3
    """Turns."""
    out: Path | None = None
    """Beginning of the names of the files: OUT_models.csv, OUT_scans.csv, with CUDA OUT_back_ends.csv; overwritten."""

    def run(self) -> int:
        """Measure, print, save."""
        if min((1, *self.steps, *self.layers, self.size, self.batch, self.threads)) < 1:
            raise ValueError("steps, layers, size, batch and threads must be at least 1")
        import torch

        from arcade_torch.models import memory_names
        from arcade_torch.tools.bench.back_ends import BackEndRow, bench_back_ends
        from arcade_torch.tools.bench.memory import Row, bench_memory
        from arcade_torch.tools.bench.scans import ScanRow, bench_scans
        from arcade_torch.tools.versions import versions

        how: dict[str, Any] = {"threads": self.threads, "seconds": self.seconds, "repeats": self.repeats}
        names = self.memories or tuple(memory_names())
        scans = self._collect("scans", ScanRow, bench_scans(self.steps, self.batch, self.size, tell=_tell, **how))
        rows = self._collect(
            "models", Row, bench_memory(names, self.steps, self.layers, self.size, self.batch, tell=_tell, **how)
        )
        on_card: list[Any] = []
        if torch.cuda.is_available():
            found = bench_back_ends(torch.device("cuda"), self.steps, self.batch, self.size, tell=_tell)
            on_card = self._collect("back_ends", BackEndRow, found)
        shape = f"B = {self.batch}, H = {self.size}, float32, torch threads: {self.threads}"
        _show_models(rows, shape)
        _show_scans(scans, shape)
        if on_card:
            show_back_ends(on_card, f"{torch.cuda.get_device_name()}, B = {self.batch}, H = {self.size}")
        print(", ".join(f"{name} {value}" for name, value in versions().items() if value))
        return 0

    def _collect(self, name: str, kind: Any, found: Iterable[Any]) -> list[Any]:
        """The rows as a list; the file is written anew after each."""
        rows = []
        for row in found:
            rows.append(row)
            if self.out is not None:
                path = self.out.with_name(f"{self.out.name}_{name}.csv")
                write_csv(path, map(_rounded, rows), [field.name for field in fields(kind)])
        return rows

    def how_to_go_on(self) -> str:
        """What an interruption left."""
        return "what was measured is in the files of --out" if self.out else "nothing was kept; give --out to keep rows"


COMMAND = BenchMemory


def _tell(text: str) -> None:
    print(f"measuring {text}", file=sys.stderr, flush=True)


def _rounded(row: Any) -> dict[str, Any]:
    return {name: float(f"{x:.4g}") if isinstance(x, float) else x for name, x in asdict(row).items()}


def _show_models(rows: Sequence[Any], shape: str) -> None:
    from arcade_torch.tools.bench.memory import TORCH_GRU

    for steps, layers in dict.fromkeys((row.steps, row.layers) for row in rows):
        chosen = [row for row in rows if (row.steps, row.layers) == (steps, layers)]
        loops = {row.model: row.both_ms for row in chosen if row.form == "loop"}
        gru = next(row.both_ms for row in chosen if row.model == TORCH_GRU)
        cells = [
            (
                row.model,
                row.form,
                f"{row.forward_ms:.1f}",
                f"{row.both_ms:.1f}",
                f"{loops[row.model] / row.both_ms:.1f}" if row.form == "scan" else "",
                f"{gru / row.both_ms:.1f}",
                f"{row.peak_mib:.0f}",
            )
            for row in chosen
        ]
        columns = ("model", "form", "forward ms", "both ms", "times the loop", f"times {TORCH_GRU}", "peak MiB")
        show_table(f"T = {steps}, {layers} layer{'s'[: layers > 1]}, {shape}", columns, cells, left=2)


def _show_scans(rows: Sequence[Any], shape: str) -> None:
    from arcade_torch.tools.bench.scans import CHOSEN

    for steps, numbers in dict.fromkeys((row.steps, row.numbers) for row in rows):
        chosen = [row for row in rows if (row.steps, row.numbers) == (steps, numbers)]
        ours = next(row.both_ms for row in chosen if row.form == CHOSEN)
        cells = [
            (row.form, f"{row.forward_ms:.1f}", f"{row.both_ms:.1f}", f"{row.both_ms / ours:.2f}", f"{row.error:.1g}")
            for row in chosen
        ]
        columns = ("form", "forward ms", "both ms", "to ours", "error")
        show_table(f"linear scan, T = {steps}, {numbers}, {shape}", columns, cells)


def show_back_ends(rows: Sequence[Any], where: str) -> None:
    """Print what the back ends of the scan do on a device.

    Args:
        rows: ``BackEndRow``.
        where: the device and the sizes, for the title.
    """
    cells = [
        (
            row.back_end,
            row.numbers,
            str(row.steps),
            f"{1e3 * row.forward_ms:.0f}",
            f"{100 * row.forward_share:.0f} %",
            f"{1e3 * row.backward_ms:.0f}",
            f"{100 * row.backward_share:.0f} %",
            f"{row.error:.1g}",
        )
        for row in rows
    ]
    columns = ("back end", "numbers", "T", "forward us", "of copy", "backward us", "of copy", "error")
    show_table(f"linear scan on {where}", columns, cells, left=2)
