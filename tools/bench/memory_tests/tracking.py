"""State tracking: parity, and the place of a ball under three or five cups that are swapped.

*Parity* shows a bit a step and asks for the parity of all bits so far. *Cups* show the place of the
ball at the first step and then two cups that change places at each step, and ask where the ball is.
Swaps of three cups generate the group S3, which is not commutative, and those of five S5, which is
not solvable.

It is learned at 2 to 16 steps and asked at 64. An answer is asked at every step but the first, in
episodes longer than the learned ones at the new steps alone. What was before a step is spread
evenly and does not depend on the bit or swap that is shown, so the answer is spread evenly too: the
best guess is right in 1 of 2, 3 and 5.

Source: arXiv 2404.08819 (scans with a diagonal matrix cannot track S5); arXiv 2411.12537 (with
factors from 0 to 1 not even parity).
"""

from fractions import Fraction
from functools import partial
from itertools import combinations

import torch
from torch import Tensor

from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest, one_hot

__all__ = ["PARITY", "S3", "S5", "swaps"]

LONGEST = 16
"""Steps of the longest episode that is learned."""


def draw_bits(generator: torch.Generator, rows: int, steps: int) -> Batch:
    """A bit a step, and the parity so far."""
    bits = torch.randint(2, (rows, steps), generator=generator)
    return Batch(one_hot(bits, 2), bits.cumsum(dim=1) % 2, _asked(rows, steps))


def swaps(cups: int) -> list[tuple[int, int]]:
    """All pairs of cups, in the order of their tokens."""
    return list(combinations(range(cups), 2))


def draw_swaps(generator: torch.Generator, rows: int, steps: int, *, cups: int) -> Batch:
    """The place of the ball, then a swap a step, and the place so far."""
    pairs = swaps(cups)
    after = torch.tensor([_moved(cups, pair) for pair in pairs])
    swap = torch.randint(len(pairs), (rows, steps - 1), generator=generator)
    place = torch.randint(cups, (rows,), generator=generator)
    places = [place]
    for t in range(steps - 1):
        place = after[swap[:, t], place]
        places.append(place)
    tokens = torch.cat([places[0].unsqueeze(1), cups + swap], dim=1)
    targets = torch.stack(places, dim=1)
    return Batch(one_hot(tokens, cups + len(pairs)), targets, _asked(rows, steps))


def _moved(cups: int, pair: tuple[int, int]) -> list[int]:
    """Where the ball of each cup is after a swap."""
    places = list(range(cups))
    first, second = pair
    places[first] = second
    places[second] = first
    return places


def _asked(rows: int, steps: int) -> Tensor:
    """Every step but the first; of longer episodes than the learned ones the new steps."""
    mask = torch.zeros(rows, steps, dtype=torch.bool)
    mask[:, 1 if steps <= LONGEST else LONGEST :] = True
    return mask


def _cups(name: str, cups: int) -> MemoryTest:
    """The test with so many cups."""
    return MemoryTest(
        name=name,
        asks=f"say under which of {cups} cups the ball is, two of which change places a step",
        level="steps",
        inputs=cups + len(swaps(cups)),
        answers=cups,
        chance=Fraction(1, cups),
        trained=tuple(range(2, LONGEST + 1)),
        tested=(LONGEST, 4 * LONGEST),
        draw=partial(draw_swaps, cups=cups),
    )


PARITY = MemoryTest(
    name="parity",
    asks="say whether the number of ones so far is odd",
    level="steps",
    inputs=2,
    answers=2,
    chance=Fraction(1, 2),
    trained=tuple(range(2, LONGEST + 1)),
    tested=(LONGEST, 4 * LONGEST),
    draw=draw_bits,
)
S3 = _cups("s3", 3)
S5 = _cups("s5", 5)
