"""``arcade-torch bench compare``."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class BenchCompare:
    """What became better or worse between two files of bench all, number by number; exit code 1 if something is worse.

    Example: arcade-torch bench compare results/bench.json runs/bench.json --tolerance 0.2
    """

    old: tyro.conf.Positional[Path]
    """The file to compare with."""
    new: tyro.conf.Positional[Path]
    """The file to judge."""
    tolerance: float = 0.2
    """Share by which a number may be worse; machines that are not quiet need more."""

    def run(self) -> int:
        """Compare and print."""
        if not 0 < self.tolerance < 1:
            raise ValueError(f"--tolerance must lie between 0 and 1, got {self.tolerance}")
        from arcade_torch.tools.bench.results import compare, read_results

        old, new = read_results(self.old), read_results(self.new)
        differs = [
            f"{name} {old['machine'].get(name)} and {new['machine'].get(name)}"
            for name in ("processor", "cores", "jax_device", "torch_threads")
            if old["machine"].get(name) != new["machine"].get(name)
        ]
        if differs:
            print(f"not the same machine: {', '.join(differs)}")
        changes = compare(old, new)
        count = Counter(change.verdict(self.tolerance) for change in changes)
        for verdict in ("worse", "missing", "better", "new"):
            for change in changes:
                if change.verdict(self.tolerance) == verdict:
                    print(f"{verdict}: {change.line()}")
        print(", ".join(f"{count[name]} {name}" for name in ("same", "worse", "better", "missing", "new")))
        return 1 if count["worse"] else 0


COMMAND = BenchCompare
