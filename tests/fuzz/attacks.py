"""The table of the campaign: commands, and what is done to their files, folders, streams and
processes.
"""

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from arcade_torch.agents.runs.files import checksum
from tests.fuzz.hostile import json_bytes, mutated, mutated_value

Prepare = Callable[[Path], None]
"""Does something to the working folder of a case."""

COMMANDS = {
    "train": "train --config run/config.json --out run --resume",
    "train-replay": "train --config replay/config.json --out replay --resume",
    "evaluate": "evaluate run --episodes 2 --json out/eval.json",
    "record": "record CartPoleEasy --player run --max-steps 3 --out out/film.gif",
    "analyze": "analyze saliency run --out out/figures --max-steps 20",
    "gap-bias": "analyze gap-bias study --draws 20 --out out/table.csv",
    "figure": "figure returns study --draws 20 --out out/figures",
    "curves": "figure curves study --out out/figures",
    "hyperparameters": "figure hyperparameters study --out out/table.csv",
    "list": "list sheet CartPoleEasy --steps 0 --out out/sheet.png",
    "report": "report study --out out/report.html "
    "--skip saliency recall counterfactual contamination references",
    "study": "study study.toml --out out/study --engine inline --no-report",
    "dry-run": "study study.toml --dry-run",
    "compare": "bench compare bench.json bench.json",
}
"""Name -> words; every one works in the working folder as it is prepared."""

READERS = {
    "run/config.json": ("train", "evaluate", "record", "analyze"),
    "run/metrics.csv": ("train",),
    "run/eval.csv": ("train",),
    "run/progress.json": ("train", "evaluate"),
    "run/lock": ("train",),
    "run/checkpoints/latest": ("train", "evaluate"),
    "run/checkpoints/frames-000000000192/meta.json": ("train", "evaluate", "record"),
    "run/checkpoints/frames-000000000192/weights.safetensors": (
        "train",
        "evaluate",
        "record",
        "analyze",
    ),
    "run/checkpoints/frames-000000000192/trainer.pt": ("train",),
    "replay/replay/window-000000001.safetensors": ("train-replay",),
    "study/study.json": ("report",),
    "study/results.csv": ("report",),
    "study/runs/MineSweeperEasy__full__mlp__pqn__seed0/config.json": (
        "report",
        "gap-bias",
        "figure",
        "hyperparameters",
    ),
    "study/runs/MineSweeperEasy__full__mlp__pqn__seed0/eval.json": ("report", "gap-bias", "figure"),
    "study/runs/MineSweeperEasy__full__mlp__pqn__seed0/eval.csv": ("report", "curves"),
    "study/runs/MineSweeperEasy__full__mlp__pqn__seed0/metrics.csv": ("report", "curves"),
    "study.toml": ("dry-run",),
    "bench.json": ("compare",),
}
"""File -> the commands that read it."""

NAMES = (
    "-rf",
    "=1+1",
    "a b\n[red]c[/red]",
    "\x1b[2J\x1b[31m",
    "\u202etxt",
    "$\\frac{",
    "μνήμη",
    os.fsdecode(b"\xff\xfe"),
    "<script>alert(1)</script>".replace("/", "\u2215"),
    "x" * 200,
    "..",
    "{0}%s",
)


class Case(NamedTuple):
    """One input of the campaign."""

    name: str  # unique; what --only takes
    words: str | tuple[str, ...]  # of the command
    prepare: Prepare | None = None
    redirect: str = ""  # a piece of shell behind the command
    flags: tuple[str, ...] = ()  # of Python
    environment: Mapping[str, str] = {}
    moment: float | None = None  # share of the command's usual time after which `happens` happens
    happens: Callable[["subprocess.Popen[bytes]", Path], None] | None = None


def cases(seed: int, moments: int) -> Iterator[Case]:
    """Every case, in an order that does not depend on anything but the arguments."""
    yield from of_files(seed)
    yield from of_forgeries()
    yield from of_folders()
    yield from of_names()
    yield from of_streams()
    yield from of_moments(seed, moments)


def of_files(seed: int) -> Iterator[Case]:
    """A fault in the place of a file, met by one of the commands that read it; another seed takes
    other pairs.
    """
    rng = random.Random(seed)
    for file, readers in READERS.items():
        for fault, spoil in FAULTS.items():
            command = rng.choice(readers)
            if rng.random() < 0.5:
                continue
            do = partial(_spoil, file=file, spoil=spoil, seed=rng.randrange(2**32))
            yield Case(f"file/{fault}/{file}/{command}", COMMANDS[command], do)


def _spoil(work: Path, file: str, spoil: Callable[[Path, random.Random], None], seed: int) -> None:
    path = work / file
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.touch()
    spoil(path, random.Random(seed))


def _replaced(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


def _socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's address is short
    try:
        socket.socket(socket.AF_UNIX).bind(path.name)
    finally:
        os.chdir(here)


def _sparse(path: Path, rng: random.Random) -> None:
    with path.open("r+b") as stream:
        stream.truncate(3 * 2**30)


def _bomb(path: Path, rng: random.Random) -> None:
    """A zip file of many zeros, which is what an npz and a trainer's state are."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("data.pkl", "w") as stream,
    ):
        for _ in range(256):
            stream.write(bytes(2**20))


def _values(path: Path, rng: random.Random) -> None:
    """Other values in JSON, accidents in what is none."""
    try:
        value = json.loads(path.read_bytes())
    except ValueError:
        path.write_bytes(mutated(path.read_bytes(), rng.randrange(2**32)))
        return
    path.write_bytes(json_bytes(mutated_value(value, rng.randrange(2**32))))


def _flipped(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes()) or bytearray(1)
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


FAULTS: dict[str, Callable[[Path, random.Random], None]] = {
    "fifo": lambda path, rng: _replaced(path, os.mkfifo),
    "socket": lambda path, rng: _replaced(path, _socket),
    "zero": lambda path, rng: _replaced(path, lambda at: at.symlink_to("/dev/zero")),
    "folder": lambda path, rng: _replaced(path, Path.mkdir),
    "dangling": lambda path, rng: _replaced(path, lambda at: at.symlink_to("nowhere")),
    "loop": lambda path, rng: _replaced(path, lambda at: at.symlink_to(at.name)),
    "outside": lambda path, rng: _replaced(
        path, lambda at: at.symlink_to(_outside(at) / "victim.txt")
    ),
    "empty": lambda path, rng: path.write_bytes(b"") and None,
    "half": lambda path, rng: (
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]) and None
    ),
    "flip": _flipped,
    "values": _values,
    "values-2": _values,
    "nested": lambda path, rng: path.write_bytes(b"[" * 200_000) and None,
    "digits": lambda path, rng: path.write_bytes(b"9" * 20_000) and None,
    "sparse": _sparse,
    "bomb": _bomb,
    "bom": lambda path, rng: path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes()) and None,
}


def _outside(path: Path) -> Path:
    """The folder that nobody may touch, beside the working folder of a case."""
    return next(parent for parent in path.parents if parent.name == "work").with_name("outside")


def of_forgeries() -> Iterator[Case]:
    """Names in files, sizes in files, and files of the user beside ours."""
    for name in (
        "{outside}/victim.txt",
        "../../outside/victim.txt",
        "../config.json",
        "window-1.safetensors\n",
        "lock",
    ):
        yield Case(
            f"forged/replay/{name!r}", COMMANDS["train-replay"], partial(_forge_window, name=name)
        )
    for value in (
        "../../../outside",
        "{outside}",
        "frames-000000000192/../frames-000000000192",
        "",
        "\n",
        "/etc",
    ):
        yield Case(
            f"forged/latest/{value!r}",
            COMMANDS["train"],
            partial(_write, file="run/checkpoints/latest", text=value),
        )
    for field, size in (
        ("hidden_size", 10**9),
        ("layers", 10**6),
        ("hidden_size", -1),
        ("layers", 1.5),
    ):
        do = partial(_resize, field=field, size=size)
        yield Case(f"forged/size/{field}={size}", COMMANDS["evaluate"], do)
    for file in (
        "run/.notes.123",
        "run/.metrics.csv.123",
        "run/.config.json.99-abcdef01",
        "run/thesis.tex",
    ):
        yield Case(
            f"users-file/{file}", COMMANDS["train"], partial(_write, file=file, text="precious")
        )
        yield Case(f"users-folder/{file}", COMMANDS["train"], partial(_make_folder, file=file))


def _forge_window(work: Path, name: str) -> None:
    """Another name for a replay window, in every checkpoint, with all checksums right."""
    name = name.format(outside=work.with_name("outside"))
    target = work / "replay" / "replay" / name
    for file in (work / "replay" / "checkpoints").glob("*/trainer.pt"):
        state = torch.load(file, weights_only=True)
        files = state["replay"]["files"]
        _, *others = files.items()
        known = checksum(target) if target.is_file() else "0" * 64
        state["replay"]["files"] = {name: known, **dict(others)}
        torch.save(state, file)
        meta = json.loads((file.parent / "meta.json").read_text())
        meta["sha256"]["trainer.pt"] = checksum(file)
        (file.parent / "meta.json").write_text(json.dumps(meta))


def _write(work: Path, file: str, text: str) -> None:
    (work / file).write_text(
        text.format(outside=work.with_name("outside")) if "{outside}" in text else text
    )


def _make_folder(work: Path, file: str) -> None:
    (work / file).mkdir()
    (work / file / "precious").write_text("precious")


def _resize(work: Path, field: str, size: Any) -> None:
    for file in (work / "run" / "config.json", *(work / "run" / "checkpoints").glob("*/meta.json")):
        values = json.loads(file.read_text())
        values["config"]["network_options"][field] = size
        file.write_text(json.dumps(values))


WRITERS = (
    "train",
    "evaluate",
    "record",
    "analyze",
    "gap-bias",
    "figure",
    "list",
    "report",
    "study",
)


def of_folders() -> Iterator[Case]:
    """Folders that are full, read-only, no folders, or gone in the middle."""
    disks = {"full": "size=64k", "inodes": "size=64m,nr_inodes=2", "read-only": "size=64m,ro"}
    for command in WRITERS:
        for disk, options in disks.items():
            yield Case(
                f"folder/{disk}/{command}",
                COMMANDS[command],
                partial(_mount, options=options, name=_target(command)),
            )
        if command != "train":
            yield Case(
                f"folder/file/{command}", COMMANDS[command], partial(_write, file="out", text="")
            )
        yield Case(
            f"folder/gone/{command}",
            COMMANDS[command],
            moment=0.8,
            happens=partial(_remove, name=_target(command)),
        )


def _target(command: str) -> str:
    return "run" if command == "train" else "out"


def _mount(work: Path, options: str, name: str) -> None:
    """A small disk in the place of a folder, with what the folder holds as far as there is room."""
    folder = work / name
    kept = work / "kept"
    if folder.exists():
        folder.rename(kept)
    folder.mkdir()
    fits = options.replace(",ro", "") if kept.exists() else options
    size = sum(path.stat().st_size for path in kept.rglob("*")) if kept.exists() else 0
    if "size=64k" in fits:
        fits = f"size={size + 131_072}"
    if "nr_inodes" in fits:
        inodes = 3 + sum(1 for _ in kept.rglob("*")) if kept.exists() else 2
        fits = f"size={size + 2**26},nr_inodes={inodes}"
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", fits, "tmpfs", str(folder)], check=True, capture_output=True
    )
    if kept.exists():
        shutil.copytree(kept, folder, dirs_exist_ok=True)
        shutil.rmtree(kept)
        if options.endswith(",ro"):
            subprocess.run(
                ["mount", "-o", "remount,ro", str(folder)], check=True, capture_output=True
            )


def _remove(process: "subprocess.Popen[bytes]", work: Path, name: str) -> None:
    shutil.rmtree(work / name, ignore_errors=True)


def of_names() -> Iterator[Case]:
    """Hostile names of folders, and of agents in a study."""
    for name in NAMES:
        if name != "..":
            do = partial(_rename, name=name)
            yield Case(f"name/folder/{name!r}", ("evaluate", f"./{name}", "--episodes", "2"), do)
            yield Case(
                f"name/report/{name!r}",
                ("report", f"./{name}", *COMMANDS["report"].split()[2:]),
                partial(do, of="study"),
            )
        for command in ("report", "figure"):
            yield Case(
                f"name/agent/{name!r}/{command}",
                COMMANDS[command],
                partial(_rename_agent, name=name),
            )


def _rename(work: Path, name: str, of: str = "run") -> None:
    (work / of).rename(work / name)


def _rename_agent(work: Path, name: str) -> None:
    name = name.encode("utf-8", "replace").decode()
    for file in (work / "study" / "runs").glob("*/config.json"):
        values = json.loads(file.read_text())
        if values["config"]["memory"] != "mlp":
            values["config"]["memory"] = name
        file.write_text(json.dumps(values))


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def of_streams() -> Iterator[Case]:
    """Streams that are closed, full or abandoned; locales; settings of Python, JAX and matplotlib;
    odd options.
    """
    streams = {
        "no-out": ">&-",
        "no-err": "2>&-",
        "none": "<&- >&- 2>&-",
        "full": ">/dev/full",
        "head": "| head -1",
        "true": "| true",
    }
    for command in ("evaluate", "record", "gap-bias", "list", "report", "dry-run"):
        for name, redirect in streams.items():
            yield Case(f"stream/{name}/{command}", COMMANDS[command], redirect=redirect)
        yield Case(f"locale/ascii/{command}", COMMANDS[command], environment=ASCII)
        yield Case(f"python/-OO/{command}", COMMANDS[command], flags=("-OO",))
        notebook = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
        yield Case(f"environment/notebook/{command}", COMMANDS[command], environment=notebook)
        yield Case(
            f"environment/dumb/{command}",
            COMMANDS[command],
            environment={"TERM": "dumb", "COLUMNS": "20"},
        )
    for command in ("evaluate", "record", "list", "train"):
        for platform in ("cuda", "nonsense"):
            yield Case(
                f"environment/{platform}/{command}",
                COMMANDS[command],
                environment={"JAX_PLATFORMS": platform},
            )
    for words in (
        "lost",
        "train --seed 1e400",
        "evaluate run --episodes=-1",
        "evaluate run --episodes 1048576",
    ):
        yield Case(f"options/{words}", words)


SIGNALLED = ("train", "evaluate", "record", "analyze", "figure", "list", "report", "study")


def of_moments(seed: int, moments: int) -> Iterator[Case]:
    """Signals at random moments."""
    rng = random.Random(seed + 1)
    for command in SIGNALLED:
        for number in range(moments):
            which = rng.choice((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
            case = Case(
                f"signal/{which.name}/{command}/{number}",
                COMMANDS[command],
                moment=rng.uniform(0.0, 1.0),
            )
            yield case._replace(happens=partial(_send, number=which))
    for command in ("evaluate", "study"):
        yield Case(f"signal/twice/{command}", COMMANDS[command], moment=0.6, happens=_send_twice)


def _send(process: "subprocess.Popen[bytes]", work: Path, number: int) -> None:
    process.send_signal(number)


def _send_twice(process: "subprocess.Popen[bytes]", work: Path) -> None:
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
