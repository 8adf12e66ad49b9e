"""Progress of a single training: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Mapping
from typing import Any

from arcade_torch.tools.optional import need
from arcade_torch.tools.studies.progress import LINE_EVERY_S, Speed, clock

_SHOWN = {
    "return {:.3f}": "train_return_ewm",
    "of last episodes {:.3f}": "train_return_last",
    "greedy {:.3f}": "eval_return",
    "loss {:.3g}": "loss",
    "epsilon {:.2f}": "epsilon",
    "entropy {:.2f}": "entropy",
    "lr {:.1e}": "lr",
}


class TrainBar:
    """Shows the rows of ``metrics.csv`` as they come; use it as a context manager and give `update` to ``train``."""

    def __init__(self, title: str, stream: Any = None) -> None:
        """Make a bar.

        Args:
            title: name of the run.
            stream: where to write, stderr by default.
        """
        self._title, self._stream = title, sys.stderr if stream is None else stream
        self._speed, self._last_s = Speed(), 0.0
        self._bar: Any = None

    def __enter__(self) -> "TrainBar":
        """Start to show."""
        if self._stream.isatty():
            form = (
                "{desc} {percentage:3.0f}% |{bar:24}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
            )
            self._bar = need("tqdm").tqdm(
                desc=self._title, total=0, unit="f", unit_scale=True, file=self._stream, bar_format=form
            )
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        if self._bar is not None:
            self._bar.close()

    def update(self, row: Mapping[str, Any]) -> None:
        """Show one update.

        Args:
            row: of ``metrics.csv``, with ``total_frames``.
        """
        frames, total, reached = int(row["frames"]), int(row["total_frames"]), standing(row)
        if self._bar is not None:
            if not self._bar.total:
                self._bar.total = total
                self._bar.initial = frames  # a resumed run is not counted as instantaneous
            self._bar.n = frames
            self._bar.set_postfix_str(reached)
            return
        now = time.monotonic()
        speed = self._speed.update(now, frames)
        if now - self._last_s >= LINE_EVERY_S or frames >= total:
            self._last_s = now
            left = f", {clock((total - frames) / speed)} left" if speed > 0 and frames < total else ""
            pace = f", {speed:,.0f} frames/s" if speed > 0 else ""
            print(f"{frames:,} of {total:,} frames{pace}{left}; {reached}", file=self._stream, flush=True)


def standing(row: Mapping[str, Any]) -> str:
    """How a run stands, in a few words: returns, loss, exploration, step size; what there is not yet is left out.

    Args:
        row: of ``metrics.csv``, with ``eval_return``.

    Example:
        >>> standing({"train_return_ewm": 0.5, "eval_return": None, "loss": 0.0123, "epsilon": 0.2, "lr": 5e-5})
        'return 0.500, loss 0.0123, epsilon 0.20, lr 5.0e-05'
    """
    found = {words: row.get(key) for words, key in _SHOWN.items()}
    return ", ".join(words.format(float(value)) for words, value in found.items() if value is not None)
