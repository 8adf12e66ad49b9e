"""``arcade-torch list``."""

import inspect
from dataclasses import dataclass
from typing import Literal

import tyro

from arcade_torch.tools.tables import show_table

PAPER_SIZE = 512


@dataclass
class List:
    """Show the registered environments, the memory models and what they cost, or both.

    Example: arcade-torch list memories --measure
    """

    what: tyro.conf.Positional[Literal["all", "envs", "memories"]] = "all"
    """What to show."""
    measure: bool = False
    """Also time the memory models on this machine, on one thread (about a minute)."""

    def run(self) -> int:
        """Print the tables."""
        if self.what in ("all", "envs"):
            _environments()
        if self.what in ("all", "memories"):
            _memories(self.measure)
        return 0


COMMAND = List


def _environments() -> None:
    from arcade_torch.envs_jax import make, registered_ids

    games = [make(env_id) for env_id in registered_ids()]
    rows = [(game.id, game.max_steps, "{:g} to {:g}".format(*game.return_range)) for game in games]
    show_table("environments", ("id", "time limit", "return"), rows)
    print("each as an MDP (full) and a POMDP (partial); frames uint8 [128, 128, 3] or [256, 256, 3]; 5 actions")


def _memories(measure: bool) -> None:
    from arcade_torch.models import make_memory, memory_names
    from arcade_torch.models.networks import PRESETS

    small = PRESETS["small"].hidden_size
    rows = []
    for name in memory_names():
        kind = type(make_memory(name, 1, 1))
        says = getattr(inspect.getmodule(kind), "__doc__", None) or kind.__doc__ or ""
        rows.append((name, says.strip().partition("\n")[0]))
    show_table("memory models", ("name", "what it is"), rows, left=2)
    _costs("one cell of the paper's network", PAPER_SIZE, measure)
    _costs("the cell of the small network", small, measure)
    print("multiply-adds: in matrix products, one step of one env, acting")
    if measure:
        print(
            "us: microseconds for one step of one env; acting with 16 envs, learning (both passes) from 16 x 132 steps"
        )


def _costs(title: str, size: int, measure: bool) -> None:
    """One line a memory model at one width."""
    from arcade_torch.models import make_memory, memory_names
    from arcade_torch.tools.bench.memories import memory_cost, time_memories

    names = memory_names()
    columns = ["name", "parameters", "state", "state in bytes", "multiply-adds"]
    rows = []
    for name in names:
        cost = memory_cost(make_memory(name, size, size), size)
        numbers = (cost.parameters, cost.state_numbers, cost.state_bytes, cost.products)
        rows.append([name, *(f"{number:,}" for number in numbers)])
    if measure:
        times = time_memories(names, size)
        columns += ["acting us", "learning us", "to the LRU's"]
        for row, name in zip(rows, names, strict=True):
            time = times[name]
            ratio = time.learning / times["lru"].learning
            row += [f"{time.acting:.1f}", f"{time.learning:.1f}", f"{ratio:.2f}"]
    show_table(f"{title}, {size} wide", columns, rows)
