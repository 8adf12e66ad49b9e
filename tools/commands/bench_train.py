"""``arcade-torch bench train``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.tools.bench.table_file import check_table_file, save_table
from arcade_torch.tools.tables import show_table


@dataclass
class BenchTrain:
    """Frames per second of training with PQN: collecting, learning, both, and the share of every part.

    The very trainer of `arcade-torch train` is timed with the numbers of the presets of that name: paper has 16 envs x
    128 steps and 64 gradient steps an update, small 64 x 32 and 32. Beside the encoder's floating-point rate stands
    that of its convolutions alone, on the same shapes in the same run.

    Example: arcade-torch bench train --networks small --memories lru gru --threads 1 --out runs/train.csv
    """

    networks: tuple[str, ...] = ("paper", "small")
    """Presets of network and learner: paper, small."""
    memories: tuple[str, ...] = ("lru", "gru")
    """Memory models, see arcade-torch list."""
    env: str = "MineSweeperEasy"
    """The game; its POMDP twin is played."""
    device: str = "cpu"
    """Torch device of the network."""
    forms: tuple[str, ...] = ("eager",)
    """How networks are run: eager, amp, compiled, graphs (CUDA graphs while acting), or several joined by "+"."""
    threads: int = 0
    """Torch threads; 0 leaves the setting alone."""
    grad_steps: int = 4
    """Gradient steps in each timed pass; those of an update are all alike."""
    repeats: int = 3
    """Passes; the median counts."""
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
        from arcade_torch.tools.bench.train import bench_train
        from arcade_torch.tools.keep_memory import keep_freed_memory

        keep_freed_memory()  # as in training
        if self.threads:
            torch.set_num_threads(self.threads)
        told = bench_train(
            self.networks,
            self.memories,
            self.env,
            self.device,
            self.forms,
            self.grad_steps,
            self.repeats,
            lambda text: _tell(text),
        )
        device = torch.cuda.get_device_name(self.device) if self.device.startswith("cuda") else self.device
        about = {"env": self.env, "device": device, **machine(), "note": self.note}
        rows = [speed.flat() for speed in told]
        _show(rows, self.repeats)
        print(", ".join(f"{name} {value}" for name, value in about.items() if value))
        save_table(self.out, rows, about)
        return 0


COMMAND = BenchTrain


def _tell(text: str) -> None:
    print(f"measuring {text}", file=sys.stderr, flush=True)


def _show(rows: list[dict[str, Any]], repeats: int) -> None:
    """Rates in one table, shares in one table a group; a column for every network, memory and form."""
    names = [", ".join(row[key] for key in ("network", "memory", "form")) for row in rows]
    rates = {
        "parameters": "parameters",
        "envs": "num_envs",
        "steps a window": "num_steps",
        "frames a minibatch": "minibatch_frames",
        "gradient steps a window": "grad_steps",
        "frames/s collecting": "collect_fps",
        "frames/s learning": "learn_fps",
        "frames/s both": "train_fps",
        "GFLOP/s of the encoder": "encoder_gflops",
        "GFLOP/s of its convolutions alone": "plain_gflops",
    }
    table = [(words, *(_number(row[key], _digits(key)) for row in rows)) for words, key in rates.items()]
    shares = [r["encoder_gflops"] and r["encoder_gflops"] / r["plain_gflops"] for r in rows]
    table.append(("of the convolutions alone", *map(_percent, shares)))
    show_table(f"Training with PQN; medians of {repeats} passes", ("", *names), table)
    titles = {"collecting": "Collecting", "learning": "Learning, by part", "kinds": "Learning, by kind of operation"}
    for group, title in titles.items():
        parts = [key for key in rows[0] if key.startswith(f"{group}: ")]
        cells = [(key.partition(": ")[2], *(_percent(row[key]) for row in rows)) for key in parts]
        show_table(f"{title}: share of its time", ("", *names), cells)


def _digits(key: str) -> int:
    return 1 if key.endswith("gflops") else 0


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
