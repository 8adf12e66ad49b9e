"""Rows that nobody can check: players, the paper's returns, and runs without checkpoints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.envs_jax.registry import resolve_id
from arcade_torch.tools.board.protocol import Suite
from arcade_torch.tools.board.ranking import Cells
from arcade_torch.tools.files import read_rows
from arcade_torch.tools.measures.gap_bias.measure import game_of
from arcade_torch.tools.players import Baseline

PLAYER_TWINS = {"random": ("full", "partial"), "state": ("full",), "frames": ("partial",)}
"""The twins on which a player stands: the scripted one with the state knows what the MDP shows."""
TWIN_NAMES = {"MDP": "full", "POMDP": "partial"}


@dataclass(frozen=True)
class Reported:
    """A row of returns without files behind them."""

    name: str
    cells: Cells
    note: str


def players(tables: Sequence[Path]) -> dict[str, dict[tuple[str, str], list[float]]]:
    """The returns of random and scripted players, of tables as ``results/baselines.csv``."""
    cells: dict[str, dict[tuple[str, str], list[float]]] = {}
    for table in tables:
        for row in read_rows(table, Baseline):
            for twin in PLAYER_TWINS[row.player]:
                cells.setdefault(row.player, {})[row.id, twin] = [row.mean]
    return cells


def paper(table: Path, suite: Suite) -> list[Reported]:
    """The paper's agents and its people on the games of a suite; a row each.

    Source: POPGym Arcade (ICML 2026), its tables of returns: means of five seeds, best smoothed
    returns while training for 10 to 20 million frames; people: as printed there.
    """
    rows: dict[str, dict[tuple[str, str], list[float]]] = {}
    for line in read_csv(table):
        level = line["difficulty"].capitalize()
        game = resolve_id(f"{game_of(line['env'])}{level}")
        # these two zeros are no returns: results/differences.md, "The training score"
        is_return = (line["env"], line["model"]) != ("Tetris", "MLP")
        if game in suite.games and is_return:
            cells = rows.setdefault(line["model"], {})
            cells[game, "full"] = [float(line["mdp_mean"])]
            cells[game, "partial"] = [float(line["pomdp_mean"])]
    reported = []
    for name, cells in rows.items():
        note = "people" if name == "human" else "five seeds, 10 to 20 million frames"
        reported.append(Reported(name, cells, note))
    return reported


def unkept(table: Path, names: Mapping[str, str]) -> list[Reported]:
    """The runs of ``results/small/easy.csv``: greedy returns of 1,024 episodes of evaluation seed
    0, checkpoints not kept.

    Args:
        table: the file.
        names: memory -> the name of its row.
    """
    rows: dict[str, dict[tuple[str, str], list[float]]] = {}
    for line in read_csv(table):
        # other studies had other settings
        if line["study"] not in ("easy", "easy-reference") or line["episodes"] != "1024":
            continue
        game = resolve_id(line["game"])
        # of the two games whose rules were corrected the published rules are the complete ones
        published = game_of(game) in ("AutoEncode", "Navigator")
        if published == (line["rules"] == "published") and line["memory"] in names:
            cells = rows.setdefault(line["memory"], {})
            cell = (game, TWIN_NAMES[line["twin"]])
            cells.setdefault(cell, []).append(float(line["eval_mean"]))
    reported = []
    for memory, cells in rows.items():
        seeds = sorted({len(values) for values in cells.values()})
        count = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
        note = f"{count} seeds, 2.5 million frames; checkpoints not kept"
        reported.append(Reported(names[memory], cells, note))
    return reported
