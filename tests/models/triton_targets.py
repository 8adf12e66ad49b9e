"""Compiles every Triton kernel for cards that need not be there: python -m
tests.models.triton_targets

Prints a JSON line a kernel, card and dtype: name, card, dtype, whether machine code came out, and
the widest access to memory in it (4: four neighbours at a time).
"""

import json
import re

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from arcade_torch.models import _triton_kernels
from arcade_torch.models.scan_triton import CHUNK, LANE_BYTES, WARPS

CARDS = (80, 90)  # compute capabilities, times ten
SIZES = {"fp32": 4, "fp64": 8}
ALIGNED = [["tt.divisibility", 16]]


def source(name: str, dtype: str) -> ASTSource:
    """A kernel with the arguments of contiguous tensors whose width is a multiple of 16."""
    kernel = getattr(_triton_kernels, name)
    kinds, constants, known = {}, {}, {}
    parts = 2 if name.endswith("complex") else 1
    for i, argument in enumerate(kernel.arg_names):
        if argument in ("CHUNK", "LANES"):
            kinds[argument] = "constexpr"
            constants[argument] = (
                CHUNK if argument == "CHUNK" else LANE_BYTES // SIZES[dtype] // parts
            )
        elif argument.endswith("_by"):
            count = 2 if argument in ("start_by", "h0_by") else 3
            kinds[argument] = ("i32",) * (count - 1) + ("constexpr",)
            constants[i, count - 1] = 1
            known |= {(i, j): ALIGNED for j in range(count - 1) if argument != "start_by"}
        elif argument in ("T", "F"):
            kinds[argument] = "i32"
            known |= {(i,): ALIGNED} if argument == "F" else {}
        else:
            kinds[argument] = "*u8" if argument == "start" else f"*{dtype}"
            known[i,] = ALIGNED
    return ASTSource(kernel, kinds, constants, known)


def main() -> None:
    """Compile all of them."""
    for card in CARDS:
        for name in _triton_kernels.__all__:
            for dtype in SIZES:
                target = GPUTarget("cuda", card, 32)
                made = triton.compile(
                    source(name, dtype), target=target, options={"num_warps": WARPS}
                )
                widths = [
                    int(width)
                    for width in re.findall(r"\b(?:ld|st)\.global\.v(\d)", made.asm["ptx"])
                ]
                row = {"kernel": name, "card": card, "dtype": dtype, "code": len(made.asm["cubin"])}
                print(json.dumps(row | {"widest": max(widths, default=1)}))


if __name__ == "__main__":
    main()
