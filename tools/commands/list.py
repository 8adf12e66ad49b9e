"""``arcade-torch list``."""

from dataclasses import dataclass
from typing import Literal

import tyro

from arcade_torch.tools.tables import show_table


@dataclass
class List:
    """Show the registered environments, the memory models, or both.

    Example: arcade-torch list memories
    """

    what: tyro.conf.Positional[Literal["all", "envs", "memories"]] = "all"
    """What to show."""

    def run(self) -> int:
        """Print the tables."""
        if self.what in ("all", "envs"):
            _environments()
        if self.what in ("all", "memories"):
            _memories()
        return 0


COMMAND = List


def _environments() -> None:
    from arcade_torch.envs_jax import make, registered_ids

    games = [make(env_id) for env_id in registered_ids()]
    rows = [(game.id, game.max_steps, "{:g} to {:g}".format(*game.return_range)) for game in games]
    show_table("environments", ("id", "time limit", "return"), rows)
    print("each as an MDP (full) and a POMDP (partial); frames uint8 [128, 128, 3] or [256, 256, 3]; 5 actions")


def _memories() -> None:
    from arcade_torch.models import make_memory, memory_names

    rows = []
    for name in memory_names():
        memory = make_memory(name, 128, 128)
        words = (type(memory).__doc__ or "").strip().partition("\n")[0]
        rows.append((name, words, f"{sum(p.numel() for p in memory.parameters()):,}"))
    show_table("memory models", ("name", "what it is", "parameters at 128"), rows, left=2)
