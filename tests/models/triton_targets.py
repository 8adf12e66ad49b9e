"""Compiles every Triton kernel for cards that need not be there: python -m
tests.models.triton_targets

Prints a JSON line a kernel, card and dtype: name, card, dtype, bytes of machine code, registers of
a thread, bytes that it spills, and how many bytes an access to memory moves at least and at most
(start flags, one byte a step, and the initial state, read once, left out).
"""

import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from arcade_torch.models import _triton_kernels
from arcade_torch.models.scan_triton import CHUNK, LANE_BYTES, WARPS

CARDS = (80, 90, 100)  # compute capabilities, times ten
SIZES = {"fp32": 4, "fp64": 8}
ALIGNED = [["tt.divisibility", 16]]
CUOBJDUMP = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
ACCESS = re.compile(r"\b(?:ld|st)\.global(?:\.v(\d))?\.b(\d+)\b")
USAGE = re.compile(r"REG:(\d+) STACK:(\d+) .*?LOCAL:(\d+)")


def source(name: str, dtype: str) -> ASTSource:
    """A kernel with the arguments of contiguous tensors whose width is a multiple of 16."""
    kernel = getattr(_triton_kernels, name)
    kinds: dict[str, Any] = {}
    constants: dict[Any, int] = {}
    hints: dict[tuple[int, ...], Any] = {}
    parts = 2 if name.endswith("complex") else 1
    sizes = {"CHUNK": CHUNK, "LANES": LANE_BYTES // SIZES[dtype] // parts}
    for i, argument in enumerate(kernel.arg_names):
        if argument in sizes:
            kinds[argument] = "constexpr"
            constants[argument] = sizes[argument]
        elif argument.endswith("_by"):
            count = 2 if argument in ("start_by", "h0_by") else 3
            kinds[argument] = ("i32",) * (count - 1) + ("constexpr",)
            constants[i, count - 1] = 1
            if argument != "start_by":
                hints |= {(i, j): ALIGNED for j in range(count - 1)}
        elif argument in ("T", "F"):
            kinds[argument] = "i32"
            if argument == "F":
                hints[i,] = ALIGNED
        else:
            kinds[argument] = "*u8" if argument == "start" else f"*{dtype}"
            hints[i,] = ALIGNED
    return ASTSource(kernel, kinds, constants, hints)


def registers_and_spills(code: bytes) -> tuple[int, int]:
    """Registers of a thread, and bytes that it keeps in memory for want of registers."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(code)
        file.flush()
        command = [str(CUOBJDUMP), "--dump-resource-usage", file.name]
        report = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    usage = USAGE.search(report)
    if usage is None:
        raise RuntimeError(f"cuobjdump names no registers: {report!r}")
    registers, stack, local = (int(number) for number in usage.groups())
    return registers, stack + local


def main() -> None:
    """Compile all of them."""
    for card in CARDS:
        for name in _triton_kernels.__all__:
            for dtype in SIZES:
                target = GPUTarget("cuda", card, 32)
                program = triton.compile(
                    source(name, dtype), target=target, options={"num_warps": WARPS}
                )
                accesses = [
                    int(count or 1) * int(bits) // 8
                    for count, bits in ACCESS.findall(program.asm["ptx"])
                ]
                registers, spilled = registers_and_spills(program.asm["cubin"])
                row = {
                    "kernel": name,
                    "card": card,
                    "dtype": dtype,
                    "code": len(program.asm["cubin"]),
                    "registers": registers,
                    "spilled": spilled,
                    "accesses": {size: accesses.count(size) for size in sorted(set(accesses))},
                }
                print(json.dumps(row))


if __name__ == "__main__":
    main()
