"""Keeps easy.csv, and makes of it the tables of small.md and easy-curves.png.

    python results/small/easy.py [COMMIT STUDY_FOLDER ...]

Finished runs of the study folders, trained by COMMIT, are added to easy.csv where they are not there yet. Their greedy
return is that of ``arcade-torch evaluate RUN --episodes 1024 --json RUN/greedy.json``.
"""

import csv
import json
import sys
from pathlib import Path
from statistics import mean, pstdev

import matplotlib.pyplot as plt
from scipy.stats import ttest_ind

from arcade_torch.tools.measures.bootstrap import Interval
from arcade_torch.tools.measures.gap_bias.measure import GapBias, game_of, gap_and_bias, normalise
from arcade_torch.tools.runs import Score

HERE = Path(__file__).parent
PAPER = HERE.parents[1] / "tools" / "data" / "paper_returns.csv"
TABLE = HERE / "easy.csv"
TWINS = {"full": "MDP", "partial": "POMDP"}
MEMORIES = {"lru": "LRU", "mlp": "none"}
RETURNS = ("eval_mean", "train_max_ewm")


def number(value: float, digits: int = 3) -> str:
    """A return without the zero in front."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def add(rows: list[dict[str, str]], commit: str, folder: Path) -> None:
    """Append the finished and evaluated runs of a study that are not there yet."""
    known = {(row["study"], row["game"], row["twin"], row["memory"], row["seed"]) for row in rows}
    for run in sorted((folder / "runs").iterdir()):
        if not (run / "greedy.json").exists():
            continue
        result = json.loads((run / "eval.json").read_text())
        returns = json.loads((run / "greedy.json").read_text())["returns"]
        config = json.loads((run / "config.json").read_text())["config"]
        twin = TWINS[config["observability"]]
        key = (folder.name, config["env"].removesuffix("-v0"), twin, config["memory"], str(config["seed"]))
        if result["status"] != "finished" or key in known:
            continue
        with open(run / "eval.csv") as file:
            curve = [float(row["mean"]) for row in csv.DictReader(file)]
        rules = "published" if config["rules"] == "reference" else "ours"
        values = [*key[:3], rules, *key[3:], commit, result["frames"], f"{mean(returns):.3f}", f"{pstdev(returns):.3f}"]
        values += [len(returns), f"{result['train_max_ewm']:.3f}", round(result["seconds"])]
        values.append(" ".join(f"{value:.2f}" for value in curve))
        rows.append(dict(zip(rows[0], map(str, values), strict=True)))


def paper() -> dict[tuple[str, str], dict[str, tuple[float, float]]]:
    """The paper's returns of Easy games: game and twin -> model -> mean and deviation."""
    found: dict[tuple[str, str], dict[str, tuple[float, float]]] = {}
    with open(PAPER) as file:
        for row in csv.DictReader(file):
            zeros = (row["env"], row["model"]) == ("Tetris", "MLP")  # results/differences.md, "The training score"
            if row["difficulty"] == "easy" and row["model"] != "human" and not zeros:
                for twin in ("MDP", "POMDP"):
                    value = float(row[f"{twin.lower()}_mean"]), float(row[f"{twin.lower()}_std"])
                    found.setdefault((game_of(row["env"]) + "Easy", twin), {})[row["model"]] = value
    return found


def table(rows: list[dict[str, str]]) -> None:
    """Print the cells, one a line, seeds in order."""
    print("| game | twin | rules | memory | seeds | greedy | training | paper: best | LRU / none | reached |")
    print("|" + "---|" * 10)
    cells: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in sorted(rows, key=lambda row: (row["game"], row["twin"], row["memory"], row["seed"])):
        cells.setdefault((row["game"], row["twin"], row["rules"], row["memory"]), []).append(row)
    for (game, twin, rules, memory), runs in cells.items():
        models = paper()[game, twin]
        best = max(models, key=lambda model: models[model])
        means = [mean(float(run[key]) for run in runs) for key in RETURNS]
        enough = [round(value, 2) >= models[best][0] for value in means]
        near = [value >= models[best][0] - models[best][1] / 5**0.5 for value in means]  # they have five seeds
        reached = {(True, True): "yes", (True, False): "greedy only", (False, True): "training only"}
        verdict = reached.get((enough[0], enough[1]), "no")
        if verdict != "yes" and all(map(max, enough, near)):
            verdict = "within s.e."
        columns = [game.removesuffix("Easy"), twin, rules, MEMORIES[memory], ", ".join(run["seed"] for run in runs)]
        columns += [" ".join(number(float(run[key])) for run in runs) for key in RETURNS]
        columns.append(f"{number(models[best][0], 2)} ± {number(models[best][1], 2)} ({best})")
        columns.append(" / ".join(number(models[name][0], 2) if name in models else "-" for name in ("LRU", "MLP")))
        print("| " + " | ".join([*columns, verdict]) + " |")


def difference(one: list[dict[str, str]], other: list[dict[str, str]], key: str) -> list[str]:
    """The means of two cells, and their difference with Welch's 95 % interval where both have several seeds."""
    values = [[float(run[key]) for run in runs] for runs in (one, other)]
    means = [mean(cell) for cell in values]
    found = number(means[0] - means[1])
    if min(map(len, values)) > 1:
        welch = ttest_ind(*values, equal_var=False).confidence_interval()
        found += f" [{number(welch.low, 2)}, {number(welch.high, 2)}]"
    return [", ".join(map(number, means)), found]


def wholes(rows: list[dict[str, str]]) -> list[GapBias]:
    """Gap and bias over all games that every agent has on both twins, greedily and in training."""
    back = {twin: name for name, twin in TWINS.items()}
    found = []
    for key in RETURNS:
        scores = [Score(r["memory"], r["game"], back[r["twin"]], int(r["seed"]), float(r[key])) for r in rows]
        found.append(gap_and_bias(scores))
    return found


def interval(found: Interval) -> str:
    """A number of the suite with its interval."""
    return f"{number(found.value)} [{number(found.low)}, {number(found.high)}]"


def gaps(rows: list[dict[str, str]]) -> None:
    """Print the observability gap, MDP minus POMDP: LRU's game by game, both agents' over all games."""
    print("\n| game | seeds | greedy: MDP, POMDP | gap | training: MDP, POMDP | gap | paper: gap |")
    print("|" + "---|" * 7)
    lru, models, suites = [row for row in rows if row["memory"] == "lru"], paper(), wholes(rows)
    for game in sorted({row["game"] for row in lru}):
        twins = [[row for row in lru if (row["game"], row["twin"]) == (game, twin)] for twin in TWINS.values()]
        columns = [game.removesuffix("Easy"), " and ".join(str(len(runs)) for runs in twins)]
        columns += [column for key in RETURNS for column in difference(*twins, key)]
        theirs = [models[game, twin]["LRU"][0] for twin in TWINS.values()]
        print("| " + " | ".join([*columns, number(theirs[0] - theirs[1], 2)]) + " |")
    for memory, name in (("lru", "LRU"), ("mlp", "MLP")):  # the paper's MLP has the same zeros on both twins of Tetris
        columns = [f"all, {MEMORIES[memory]}", f"{len(suites[0].tasks)} games"]
        for suite in suites:
            row = suite.row(memory)
            columns += [f"{number(row.mdp.value)}, {number(row.pomdp.value)}", interval(row.gap)]
        means = [
            sum(normalise(g, m[name][0]) for (g, t), m in models.items() if t == twin and name in m)
            for twin in TWINS.values()
        ]
        print("| " + " | ".join([*columns, number((means[0] - means[1]) / len(suites[0].tasks), 2)]) + " |")


def compare(rows: list[dict[str, str]], twin: str) -> None:
    """Print what LRU adds where both agents were trained: means over seeds, with Welch's 95 % intervals."""
    print(f"\n| {twin} | seeds | greedy: LRU, none | added | training: LRU, none | added | paper: LRU, none |")
    print("|" + "---|" * 7)
    cells = {m: [row for row in rows if (row["twin"], row["memory"]) == (twin, m)] for m in MEMORIES}
    for game in sorted({row["game"] for row in cells["lru"]} & {row["game"] for row in cells["mlp"]}):
        runs = [[row for row in cell if row["game"] == game] for cell in cells.values()]
        columns = [game.removesuffix("Easy"), " and ".join(str(len(cell)) for cell in runs)]
        columns += [column for key in RETURNS for column in difference(*runs, key)]
        models = paper()[game, twin]
        columns.append(", ".join(number(models[name][0], 2) if name in models else "-" for name in ("LRU", "MLP")))
        print("| " + " | ".join(columns) + " |")


def bias(rows: list[dict[str, str]]) -> None:
    """Print the memory bias of LRU, the last lines of the table above, with and without Tetris."""
    suites = wholes(rows)
    for title, without in (("all, in [0, 1]", ""), ("all but Tetris", "Tetris")):
        tasks, columns = [task for task in suites[0].tasks if game_of(task) != without], []
        for suite in suites:
            agents = {row.agent: row for row in (suite.without[without] if without else suite.rows)}
            columns += [", ".join(number(agents[m].mdp.value) for m in MEMORIES), interval(agents["lru"].bias)]
        ends = "-"  # the paper's Tetris without memory is not a return
        if without:
            theirs = [[normalise(task, paper()[task, "MDP"][name][0]) for task in tasks] for name in ("LRU", "MLP")]
            ends = ", ".join(number(mean(values)) for values in theirs)
        print("| " + " | ".join([title, f"{len(tasks)} games", *columns, ends]) + " |")


def draw(rows: list[dict[str, str]]) -> None:
    """Greedy returns over frames, a panel a cell and a line a run; dashed, the paper's best."""
    plt.style.use(PAPER.parent / "light.mplstyle")
    games = sorted({game for game, _ in paper()})
    figure, axes = plt.subplots(4, 5, figsize=(11, 8), sharex=True)
    colours = dict(zip(MEMORIES, plt.rcParams["axes.prop_cycle"].by_key()["color"], strict=False))
    for place, game in enumerate(games):
        for line, twin in enumerate(TWINS.values()):
            axis = axes[2 * (place // 5) + line][place % 5]
            axis.axhline(max(paper()[game, twin].values())[0], color="grey", linestyle="--", linewidth=1)
            for row in rows:
                if (row["game"], row["twin"]) == (game, twin):
                    curve = [float(value) for value in row["curve"].split()]
                    axis.plot([0.25 * (n + 1) for n in range(len(curve))], curve, color=colours[row["memory"]], lw=1.2)
            axis.set_title(f"{game.removesuffix('Easy')} {twin}", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("million frames")
    for axis in axes[:, 0]:
        axis.set_ylabel("greedy return")
    handles = [plt.Line2D([], [], color=colour, label=MEMORIES[name]) for name, colour in colours.items()]
    handles.append(plt.Line2D([], [], color="grey", linestyle="--", label="paper's best"))
    figure.legend(handles=handles, loc="upper center", ncols=3, bbox_to_anchor=(0.5, 1.03))
    figure.tight_layout()
    figure.savefig(HERE / "easy-curves.png", dpi=110, bbox_inches="tight")


def main() -> None:
    """Add, print and draw."""
    with open(TABLE, newline="") as file:
        rows = list(csv.DictReader(file))
    for folder in sys.argv[2:]:
        add(rows, sys.argv[1], Path(folder))
    rows.sort(key=lambda row: (row["study"], row["game"], row["twin"], row["memory"], int(row["seed"])))
    with open(TABLE, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    apart = ("before", "eight-minibatches", "two-passes")  # studies of settings that are not the preset
    others = {name: [row for row in rows if row["study"].startswith(name)] for name in apart}
    rows = [row for row in rows if not row["study"].startswith(tuple(others))]
    for part in (rows, *others.values()):
        table(part)
    for twin in reversed(TWINS.values()):
        compare(rows, twin)
    bias(rows)
    gaps(rows)
    draw(rows)


if __name__ == "__main__":
    main()
