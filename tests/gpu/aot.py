"""Compiles the games for an H100 where there is none: what a step launches, and an estimate of its
speed.

    python -m tests.gpu.aot results/gpu-aot.md      or: make gpu-aot

XLA compiles ahead of time for a card that a text describes (``h100.textproto``). Every program has
to be one command buffer (a CUDA graph) of few kernels, without loops, scatters, conditionals, calls
into libraries or into Python; ``STEPS`` says how many kernels, instructions and bytes. Nothing
runs on a card: the speed is an estimate, and the page says from what.

Exit code: 0 all programs keep their limits, 1 one does not, 2 something is missing.
"""

import argparse
import importlib.util
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

TARGET = Path(__file__).with_name("h100.textproto")
RAW = argparse.RawDescriptionHelpFormatter
ARCHITECTURE = "sm_90a"

NUM_ENVS = 4096
MIXED_ENVS = 4000

CORES = 132
ISSUES_A_CLOCK = 4  # instructions of a warp that a core begins in a clock
CLOCK_HZ = 1.755e9
BANDWIDTH = 3.35e12  # bytes a second
KERNEL_S = 1.3e-6  # the least that a kernel or a copy takes in a graph; assumed
WARP = 32
GRAPH_FROM = 5  # launches from which on XLA makes a command buffer of them

FORBIDDEN = ("while", "scatter", "conditional", "custom-call", "infeed", "outfeed", "send", "recv")
NO_KERNEL = ("parameter", "constant", "get-tuple-element", "tuple", "bitcast", "ROOT")
BYTES = {"pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "s32": 4, "u32": 4, "f32": 4, "s64": 8}


@dataclass(frozen=True)
class Limit:
    """The most that a program may have."""

    kernels: int = 20  # copies not counted
    instructions: int = 180  # of the kernel that draws
    traffic: float = 1.5  # bytes that all kernels read and write, over those of the frames
    sorts: int = 0  # of one env's cards each
    mframes: float = 0.0  # the least: million frames a second, estimated


STEPS = {
    "AutoEncodeEasy-v0": Limit(12, 130, 1.25, sorts=1, mframes=35),
    "BattleShipEasy-v0": Limit(15, 120, 1.25, mframes=35),
    "BreakoutEasy-v0": Limit(12, 140, 1.30, mframes=35),
    "CartPoleEasy-v0": Limit(11, 65, 1.12, mframes=35),
    "CountRecallEasy-v0": Limit(13, 130, 1.26, sorts=1, mframes=35),
    "MineSweeperEasy-v0": Limit(14, 80, 1.13, mframes=35),
    "NavigatorEasy-v0": Limit(19, 120, 1.22, mframes=35),
    "NoisyCartPoleEasy-v0": Limit(14, 65, 1.13, mframes=35),
    "SkittlesEasy-v0": Limit(19, 140, 1.28, mframes=35),
    "TetrisEasy-v0": Limit(20, 170, 1.42, mframes=35),
}
"""Of the fused step at 128 pixels."""
CARDS = ("AutoEncode", "CountRecall")  # their decks are shuffled by a sort
ROWS = Limit(traffic=1.8)  # the states of eight steps count whole, of which few rows are read
MIXTURE = Limit(130, 2000, 1.5, sorts=2)  # ten drawings, of which a thread does one


@dataclass(frozen=True)
class Kernel:
    """One launch of a program."""

    name: str
    threads: int  # of all blocks
    traffic: int  # bytes that it reads and writes, operands counted whole
    writes: int  # bytes of its results
    instructions: int = 0  # machine code, loops counted once
    registers: int = 0
    spills: int = 0  # bytes

    @property
    def issue_s(self) -> float:
        """The least time to issue its instructions, if every slot issues."""
        warps = self.threads / WARP
        return self.instructions * warps / (CORES * ISSUES_A_CLOCK * CLOCK_HZ)

    @property
    def memory_s(self) -> float:
        """The least time to move its bytes."""
        return self.traffic / BANDWIDTH

    @property
    def seconds(self) -> float:
        """The least time that it takes."""
        return max(self.issue_s, self.memory_s, KERNEL_S)


@dataclass(frozen=True)
class Program:
    """What is compiled: a name, the frames that it draws, and how it is traced."""

    name: str
    obs_size: int
    frames: int
    trace: Callable[[Any], Any]  # of a function that puts shapes on the device
    limit: Limit


@dataclass(frozen=True)
class Compiled:
    """What became of a program."""

    program: Program
    kernels: list[Kernel]
    copies: int
    command_buffers: int
    loose: int  # launches outside of them
    operations: dict[str, int]  # of the whole program, by name
    temporary: int  # bytes of memory
    seconds: float  # that compiling took

    @property
    def frame_bytes(self) -> int:
        """Bytes of all frames."""
        return self.program.frames * self.program.obs_size**2 * 3

    @property
    def draw(self) -> Kernel:
        """The kernel that writes the frames."""
        return max(self.kernels, key=lambda kernel: kernel.writes)

    @property
    def traffic(self) -> float:
        """Bytes that all kernels move, over those of the frames."""
        return sum(kernel.traffic for kernel in self.kernels) / self.frame_bytes

    @property
    def estimate_s(self) -> float:
        """The least time of the whole program, kernels one after the other."""
        return sum(kernel.seconds for kernel in self.kernels) + self.copies * KERNEL_S

    @property
    def mframes(self) -> float:
        """Million frames a second at most."""
        return self.program.frames / self.estimate_s / 1e6


def missing() -> str:
    """What this needs and does not find, in one line; empty if nothing."""
    lacking = []
    if importlib.util.find_spec("jax") is None:
        lacking.append("jax")
    plugins = importlib.util.find_spec("jax_plugins")
    if plugins is None or importlib.util.find_spec("jax_plugins.xla_cuda13") is None:
        lacking.append("JAX's plugin for CUDA 13 (jax-cuda13-plugin, jax-cuda13-pjrt)")
    if importlib.util.find_spec("triton") is None:
        lacking.append("ptxas and nvdisasm (triton)")
    if not lacking:
        return ""
    return f"gpu-aot needs {' and '.join(lacking)}: `make gpu-aot` installs them into .venv-aot"


def cuda_tool(*names: str) -> str:
    """The path of the first of some tools of CUDA that triton brings."""
    spec = importlib.util.find_spec("triton")
    assert spec is not None and spec.origin is not None
    folder = Path(spec.origin).parent / "backends" / "nvidia" / "bin"
    return next(str(folder / name) for name in names if (folder / name).exists())


def programs() -> Iterator[Program]:
    """All that is compiled."""
    from arcade_torch.compiled import CompiledGame
    from arcade_torch.envs_jax import MixedGames, make, registered_ids

    for id, limit in STEPS.items():
        game = CompiledGame(make(id))
        yield Program(f"{id} step", 128, NUM_ENVS, step_of(game, NUM_ENVS), limit)
    for id, limit in STEPS.items():
        game = CompiledGame(make(id, obs_size=256))
        larger = replace(limit, mframes=0)  # four times the bytes a frame
        yield Program(f"{id} step", 256, NUM_ENVS, step_of(game, NUM_ENVS), larger)
    for id in registered_ids():
        if "Medium" in id or "Hard" in id:
            game = CompiledGame(make(id))
            limit = Limit(sorts=int(id.startswith(CARDS)))
            yield Program(f"{id} step", 128, NUM_ENVS, step_of(game, NUM_ENVS), limit)
    rows = NUM_ENVS // 8
    for id in STEPS:
        game = CompiledGame(make(id))
        limit = Limit(sorts=int(id.startswith(CARDS)))
        yield Program(f"{id} reset", 128, NUM_ENVS, reset_of(game, NUM_ENVS), limit)
        yield Program(f"{id} draw_rows", 128, rows, rows_of(game, NUM_ENVS, rows), ROWS)
    mixed = CompiledGame(MixedGames([make(id) for id in STEPS]))
    yield Program("mixture of ten, step", 128, MIXED_ENVS, step_of(mixed, MIXED_ENVS), MIXTURE)


def batch_shapes(game: Any, num_envs: int) -> Any:
    """The shapes of a batch of running episodes."""
    import jax
    import jax.numpy as jnp

    keys = jax.ShapeDtypeStruct((num_envs, 2), jnp.uint32)
    partial = jax.ShapeDtypeStruct((num_envs,), bool)
    begin = game.batched.init
    return jax.eval_shape(lambda *a: game.batched.without_ends(begin(*a)), keys, partial)


def step_of(game: Any, num_envs: int) -> Callable[[Any], Any]:
    """How the fused step is traced."""
    import jax

    def trace(put: Any) -> Any:
        action = jax.ShapeDtypeStruct((num_envs,), "int32")
        return game.step.trace(put(batch_shapes(game, num_envs)), put(action), None)

    return trace


def reset_of(game: Any, num_envs: int) -> Callable[[Any], Any]:
    """How a reset by mask with its drawing is traced."""
    import jax

    def trace(put: Any) -> Any:
        mask = jax.ShapeDtypeStruct((num_envs,), "bool")
        return game.batched.reset_render.trace(put(batch_shapes(game, num_envs)), put(mask))

    return trace


def rows_of(game: Any, num_envs: int, rows: int) -> Callable[[Any], Any]:
    """How the drawing of final observations is traced: of 8 steps, as the collector asks for it."""
    import jax

    def trace(put: Any) -> Any:
        batch = put(batch_shapes(game, num_envs))
        index = put(jax.ShapeDtypeStruct((2, rows), "int32"))
        first = put(jax.ShapeDtypeStruct((), "int32"))
        return game.draw_rows[0].trace([batch.state] * 8, [batch.partial] * 8, index, first, None)

    return trace


def compile_for(program: Program, device: Any) -> Compiled:
    """Compile a program for a card that is not there, and read what XLA wrote of it."""
    import jax
    from jax.sharding import SingleDeviceSharding

    there = SingleDeviceSharding(device)

    def put(shapes: Any) -> Any:
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=there), shapes
        )

    began = time.perf_counter()
    lowered = program.trace(put).lower(lowering_platforms=("cuda",))
    with tempfile.TemporaryDirectory() as folder:
        options = {"xla_dump_to": folder, "xla_dump_hlo_as_text": True}
        executable = lowered.compile(compiler_options=options)
        seconds = time.perf_counter() - began
        files = Path(folder)
        launches = one_file(files, "thunk_sequence*.txt")
        text = one_file(files, "gpu_after_optimizations.txt")
        code = machine_code(files)
    moved = traffic_of(text)
    kernels = [
        Kernel(name, threads, *moved[name], *code[name]) for name, threads in kernels_of(launches)
    ]
    outermost = [line for line in launches.splitlines() if line.strip() and line[0] != " "]
    buffers = sum("kCommandBuffer" in line for line in outermost)
    memory = executable.memory_analysis()
    return Compiled(
        program,
        kernels,
        launches.count(": kCopy"),
        buffers,
        len(outermost) - buffers,
        operations_of(text),
        memory.temp_size_in_bytes,
        seconds,
    )


def one_file(folder: Path, ending: str) -> str:
    """The text of the one file whose name ends so."""
    latest = sorted(folder.glob(f"*{ending}"))[-1]
    return latest.read_text(encoding="utf-8")


def kernels_of(launches: str) -> list[tuple[str, int]]:
    """Name and threads of the kernels in a sequence of launches."""
    pattern = r"(\S+) grid: \[(\d+), (\d+), (\d+)\] threads: \[(\d+), (\d+), (\d+)\]"
    kernels = []
    for name, *sizes in re.findall(pattern, launches):
        threads = 1
        for size in sizes:
            threads *= int(size)
        kernels.append((name, threads))
    return kernels


def shape_bytes(shape: str) -> int:
    """Bytes of a type as XLA writes it, tuples summed: ``u8[4096,128]{1,0}`` is 524288."""
    total = 0
    for kind, sizes in re.findall(r"\b(\w+)\[([\d,]*)\]", shape):
        count = BYTES[kind]
        for size in filter(None, sizes.split(",")):
            count *= int(size)
        total += count
    return total


@dataclass(frozen=True)
class Instruction:
    """A line of a program's entry."""

    name: str
    shape: str
    operation: str
    operands: list[str]
    computation: str  # what a fusion computes, empty for others


def entry_of(text: str) -> list[Instruction]:
    """The instructions of a program's entry."""
    body = text[text.index("\nENTRY ") :].split("\n}")[0]
    pattern = r"^\s+(?:ROOT )?%(\S+) = (\(.*?\)|\S+) ([\w-]+)\((.*?)\)(?:, (.*))?$"
    instructions = []
    for name, shape, operation, operands, rest in re.findall(pattern, body, re.MULTILINE):
        names = re.findall(r"%([\w.-]+)", operands)
        calls = re.search(r"calls=%([\w.-]+)", rest)
        instructions.append(Instruction(name, shape, operation, names, calls[1] if calls else ""))
    return instructions


def traffic_of(text: str) -> dict[str, tuple[int, int]]:
    """Bytes that each kernel moves, and of these what it writes, by the name of the kernel.

    A kernel is named after its instruction, that of a sort after the root of what it computes.
    """
    computations = re.findall(r"^%(\S+) \(.*?^  ROOT %(\S+) = ", text, re.MULTILINE | re.DOTALL)
    roots = dict(computations)
    sizes = {}
    moved = {}
    for one in entry_of(text):
        writes = shape_bytes(one.shape)
        sizes[one.name] = writes
        if one.operation not in NO_KERNEL:
            reads = sum(sizes[operand] for operand in one.operands)
            for name in (roots.get(one.computation, one.name), one.name):
                moved[re.sub("[.-]", "_", name)] = (reads + writes, writes)
    return moved


def operations_of(text: str) -> dict[str, int]:
    """How often a program has operations that are forbidden, or sorts."""
    counts = {}
    for name in (*FORBIDDEN, "sort"):
        count = len(re.findall(rf" {name}(?:-start)?\(", text))
        if count:
            counts[name] = count
    return counts


def machine_code(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Instructions, registers and spilled bytes of the kernels, by name."""
    header = re.compile(r"^\.(version|target|address_size) .*$", re.MULTILINE)
    texts = []
    for number, path in enumerate(sorted(folder.glob("*.ptx"))):
        text = path.read_text(encoding="utf-8")
        if ".entry" in text:
            texts.append(text.replace("__cudart_i2opi_f", f"table_of_sines_{number}"))
    # in one file, for the tools take longer to start than to work
    joined = "\n".join([texts[0], *(header.sub("", text) for text in texts[1:])])
    source = folder / "all.ptx"
    binary = folder / "all.cubin"
    source.write_text(joined, encoding="utf-8")
    ptxas = cuda_tool("ptxas-blackwell", "ptxas")
    log = output_of([ptxas, "-v", f"-arch={ARCHITECTURE}", str(source), "-o", str(binary)])
    listing = output_of([cuda_tool("nvdisasm"), "-c", str(binary)])
    code = {}
    for report in log.split("Compiling entry function '")[1:]:
        name = report.split("'")[0]
        registers = re.search(r"Used (\d+) registers", report)
        spills = re.search(r"(\d+) bytes spill stores", report)
        assert registers is not None and spills is not None
        function = listing.split(f"\n.text.{name}:\n")[1].split("\n//-----")[0]
        instructions = re.findall(r"/\*[0-9a-f]{4,}\*/\s+(?!NOP)[^;]*;", function)
        code[name] = (len(instructions), int(registers[1]), int(spills[1]))
    return code


def output_of(command: list[str]) -> str:
    """What a command prints, on either stream."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name} failed: {done.stderr[-500:]}")
    return done.stdout + done.stderr


def faults_of(done: Compiled) -> list[str]:
    """What of a program is beyond its limits, in words."""
    limit = done.program.limit
    draw = done.draw
    launches = len(done.kernels) + done.copies
    in_one_graph = (done.command_buffers, done.loose) == (1, 0)
    faults = []
    if not in_one_graph and launches >= GRAPH_FROM:
        faults.append(f"{done.command_buffers} command buffers and {done.loose} launches beside")
    if len(done.kernels) > limit.kernels:
        faults.append(f"{len(done.kernels)} kernels, allowed {limit.kernels}")
    for name, count in done.operations.items():
        allowed = limit.sorts if name == "sort" else 0
        if count > allowed:
            faults.append(f"{count} times {name}, allowed {allowed}")
    if draw.instructions > limit.instructions:
        faults.append(f"drawing takes {draw.instructions} instructions, not {limit.instructions}")
    if done.traffic > limit.traffic:
        faults.append(f"moves {done.traffic:.2f} times the frames' bytes, not {limit.traffic}")
    spilled = [kernel.name for kernel in done.kernels if kernel.spills]
    if spilled:
        faults.append(f"registers are spilled in {', '.join(spilled)}")
    if done.mframes < limit.mframes:
        faults.append(f"{done.mframes:.1f} M frames/s estimated, wanted {limit.mframes}")
    return faults


def h100() -> Any:
    """A device of JAX that stands for the card."""
    from jax.experimental import topologies

    target = TARGET.read_text(encoding="utf-8")
    topology = topologies.get_topology_desc(
        "h100", platform="cuda", target_config=target, topology="1x1x1"
    )
    return topology.devices[0]


COLUMNS = (
    "program",
    "pixels",
    "kernels + copies",
    "drawing: instructions / registers",
    "drawing: issue / memory us",
    "bytes over frames",
    "temporary MB",
    "estimate us",
    "M frames/s",
    "compiled in s",
)
LIMITS_OF_THE_ESTIMATE = """
The estimate is the sum over kernels, one after the other, of the largest of three times: {kernel_us}
us (what a kernel or a copy in a graph takes at least; assumed, not measured), the time to issue its
instructions (instructions of the machine code x warps / ({cores} cores x {issues} x {clock} GHz), if
every slot issues), and the time to move its bytes (operands and results whole / {bandwidth} TB/s).

- **Nothing of this ran on a card.** The speed is a bound from above, not a forecast: caches, latency,
  and kernels with fewer warps than the card has room for are left out, and the tables that drawing
  reads (0.2 to 1.7 MB) are taken to come from the L2 cache for nothing.
- Instructions are counted once, as they stand: a loop counts as one round, and both ways of a branch
  count. XLA unrolls these kernels, so there are few of either.
- The mixture is drawn by one kernel that holds the drawing of all ten games; a thread does one of
  them, so its issue time is some ten times less than the table says.
- Kernels that do not depend on one another may overlap in a graph; in the sum none does.
- What the host does in between (JAX's call, DLPack, the policy) is not in it.
- Of fewer than {graph_from} launches (`draw_rows`) XLA makes no graph.
"""


def row_of(done: Compiled) -> list[str]:
    """A program as a line of the table."""
    draw = done.draw
    return [
        done.program.name,
        str(done.program.obs_size),
        f"{len(done.kernels)} + {done.copies}",
        f"{draw.instructions} / {draw.registers}",
        f"{draw.issue_s * 1e6:.0f} / {draw.memory_s * 1e6:.0f}",
        f"{done.traffic:.2f}",
        f"{done.temporary / 1e6:.1f}",
        f"{done.estimate_s * 1e6:.0f}",
        f"{done.mframes:.1f}",
        f"{done.seconds:.1f}",
    ]


def page_of(rows: Sequence[list[str]], faults: Sequence[str]) -> str:
    """The page of results."""
    import jax
    import jaxlib

    lines = [
        "# The games compiled for an H100, without one",
        "",
        f"Written by `make gpu-aot` (jax {jax.__version__}, jaxlib {jaxlib.__version__}, machine code "
        f"by {ptxas_version()}) with N = {NUM_ENVS:,} envs; the mixture has {MIXED_ENVS:,}, and "
        f"`draw_rows` draws {NUM_ENVS // 8}. Every program of {GRAPH_FROM} launches or more is one "
        "command buffer, a CUDA graph; there is no loop, scatter, conditional, custom call, host "
        "callback or spilled register, and no sort but that of a deck of cards.",
        "",
        *(f"**Beyond its limits**: {fault}\n" for fault in faults),
        f"| {' | '.join(COLUMNS)} |",
        f"|{'---|' * len(COLUMNS)}",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        "## The estimate, and its limits",
        LIMITS_OF_THE_ESTIMATE.format(
            kernel_us=KERNEL_S * 1e6,
            cores=CORES,
            issues=ISSUES_A_CLOCK,
            clock=CLOCK_HZ / 1e9,
            bandwidth=BANDWIDTH / 1e12,
            graph_from=GRAPH_FROM,
        ).rstrip(),
        "",
    ]
    return "\n".join(lines)


def ptxas_version() -> str:
    """Name and version of the assembler."""
    text = output_of([cuda_tool("ptxas-blackwell", "ptxas"), "--version"])
    version = re.search(r"release ([\d.]+)", text)
    return f"ptxas {version[1]}" if version else "ptxas"


def main(argv: Sequence[str] | None = None) -> int:
    """Compile all, print each, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=RAW)
    parser.add_argument("page", type=Path, help="the page to write")
    parser.add_argument("--only", default="", help="programs whose name contains this")
    parser.add_argument("--kernels", action="store_true", help="print each kernel, too")
    arguments = parser.parse_args(argv)
    lacking = missing()
    if lacking:
        print(lacking, file=sys.stderr)
        return 2
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["JAX_SKIP_CUDA_CONSTRAINTS_CHECK"] = "1"  # no cuDNN is needed to compile these
    device = h100()
    rows = []
    faults = []
    for program in programs():
        if arguments.only not in program.name:
            continue
        done = compile_for(program, device)
        rows.append(row_of(done))
        print(" | ".join(rows[-1]), flush=True)
        for kernel in done.kernels if arguments.kernels else ():
            print(f"  {kernel}")
        for fault in faults_of(done):
            faults.append(f"{program.name}, {program.obs_size} px: {fault}")
            print(f"  {fault}", flush=True)
    arguments.page.write_text(page_of(rows, faults), encoding="utf-8")
    print(f"{arguments.page}: {len(rows)} programs, {len(faults)} faults")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
