"""``arcade-torch list``."""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from arcade_torch.agents.runs.files import check_writable
from arcade_torch.envs_jax import make, registered_ids, resolve_id
from arcade_torch.envs_jax.game import MEMORY_KINDS
from arcade_torch.tools import players
from arcade_torch.tools.files import Table, write_between
from arcade_torch.tools.options import Command, at_least
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.text import say

PAPER_SIZE = 512
BASELINES = Path("baselines.csv")


@dataclass
class List(Command):
    """Show the games, the memory models and what they cost, what players earn in the games, or a
    picture of the games.

    list baselines lets the random player and both scripted players play; it keeps a CSV file that
    it goes on with after an interruption. list sheet draws both twins of every game, or, with
    --steps, some moments of one episode.

    Example: arcade-torch list memories --measure
    """

    topic: tyro.conf.Positional[Literal["all", "envs", "memories", "baselines", "sheet"]] = "all"
    """What to show; all: envs and memories."""
    games: tyro.conf.Positional[tuple[str, ...]] = ()
    """For baselines and sheet: ids; all, or the ten games of one level, by default."""
    # Also time the memory models on this machine, on one thread (about a minute).
    measure: bool = False
    episodes: int = 1000  # For baselines: of each player in each game, at most.
    seconds: float = 60.0  # For baselines: for each player in each game; what is begun is finished.
    page: Path | None = None  # For baselines: Markdown page that gets the table between its marks.
    level: Literal["Easy", "Medium", "Hard"] = "Easy"  # For sheet, when no games are named.
    steps: tuple[int, ...] = ()  # For sheet: after these steps of the scripted player in one game.
    out: Path | None = None  # File for baselines (baselines.csv by default) or sheet (games.png).

    def run(self) -> int:
        """Print the tables, or draw."""
        if self.topic in ("envs", "all"):
            self._envs()
        if self.topic in ("memories", "all"):
            self._memories()
        if self.topic == "baselines":
            self._baselines()
        if self.topic == "sheet":
            self._sheet()
        return 0

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        if self.topic != "baselines":
            return super().resume_hint()
        return (
            f"finished rows are in {self.out or BASELINES}; the same command goes on with the "
            "others"
        )

    def _baselines(self) -> None:
        at_least(self, episodes=1, seconds=0)
        ids = [resolve_id(name) for name in self.games] or registered_ids()
        rows = []
        total = len(ids) * len(players.PLAYERS)
        out = check_writable(self.out or BASELINES)
        if self.page is not None:
            check_writable(self.page)
        with Bars() as bars:
            for row in players.measure_all(ids, self.episodes, self.seconds, out):
                rows.append(row)
                bars.update("players", len(rows), total, f"{row.id} {row.player} {row.mean:.3f}")
        table = players.markdown(rows)
        print(table)
        if self.page is not None:
            print()
            say(f"written into {write_between(self.page, players.BEGIN, players.END, table)}")

    def _sheet(self) -> None:
        from arcade_torch.tools.play.recording import sheet, strip, write_png

        ids = [resolve_id(name) for name in self.games]
        if self.steps and len(ids) != 1:
            raise ValueError(f"--steps draws a strip of one game: name one, got {len(ids)}")
        ids = ids or [id for id in registered_ids() if f"{self.level}-v" in id]
        out = check_writable(self.out or Path("games.png"))
        with Bars(first_line_s=0.0) as bars:

            def show(id: str, done: int) -> None:
                bars.update("sheet", done, len(ids), id)

            picture = strip(ids[0], self.steps) if self.steps else sheet(ids, progress=show)
        say(write_png(out, picture).resolve())

    def _envs(self) -> None:
        games = [make(env_id) for env_id in registered_ids()]
        rows = []
        for game in games:
            returns = " to ".join(f"{round(end, 3):g}" for end in game.return_range)
            rows.append((game.id, game.max_steps, returns, game.memory_kind or "not said"))
        Table("environments", ("id", "time limit", "return", "the POMDP asks for"), rows).show()
        print(
            "each as an MDP (full) and a POMDP (partial); frames uint8 [128, 128, 3] or [256, 256, "
            "3]; 5 actions"
        )
        for kind, meaning in MEMORY_KINDS.items():
            print(f"{kind}: {meaning}")

    def _memories(self) -> None:
        from arcade_torch.models import make_memory, memory_names
        from arcade_torch.models.presets import PRESETS

        names = memory_names()
        rows = []
        for name in names:
            kind = type(make_memory(name, 1, 1))
            says = getattr(inspect.getmodule(kind), "__doc__", None) or kind.__doc__ or ""
            rows.append((name, " ".join(says.strip().partition("\n\n")[0].split())))
        Table("memory models", ("name", "what it is"), rows, left=2).show()
        self._costs("the paper's network", names, PAPER_SIZE)
        self._costs("the small network", names, PRESETS["small"].hidden_size)
        print("multiply-adds: in matrix products, one step of one env, acting")
        if self.measure:
            print(
                "us: microseconds for one step of one env; acting: 16 envs; learning: both passes, "
                "16 x 132 steps"
            )

    def _costs(self, network: str, names: Sequence[str], size: int) -> None:
        """Print what one cell of every memory model costs in a network."""
        from arcade_torch.models import make_memory
        from arcade_torch.tools.bench.memory import memory_cost, time_memories

        columns = ["name", "parameters", "state", "state in bytes", "multiply-adds"]
        if self.measure:
            columns += ["acting us", "learning us", "to the LRU's"]
            times = time_memories(names, size)
        rows = []
        for name in names:
            cost = memory_cost(make_memory(name, size, size), size)
            row = [name, *map("{:,}".format, cost)]
            if self.measure:
                acting, learning = times[name]
                ratio = learning / times["lru"][1]
                row += [f"{acting:.1f}", f"{learning:.1f}", f"{ratio:.2f}"]
            rows.append(row)
        Table(f"one cell of {network}, {size} wide", columns, rows).show()
