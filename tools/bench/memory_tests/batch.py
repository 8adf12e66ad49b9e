"""What a test of memory is: its data, a pure function of a seed, its sizes and its chance level."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Batch", "MemoryTest", "ask_at_the_end", "one_hot", "shuffled"]


class Batch(NamedTuple):
    """Episodes of one length, one a row; each begins at index 0."""

    inputs: Tensor
    """float [B, T, D], several ones at most in a step."""
    targets: Tensor
    """int64 [B, T], the right answer; 0 where nothing is asked."""
    mask: Tensor
    """bool [B, T], where an answer is asked and scored."""


@dataclass(frozen=True)
class MemoryTest:
    """One test: what is asked, at which sizes it is learned and asked, and what a guess earns."""

    name: str
    asks: str
    """What has to be done, in a sentence."""
    level: str
    """What the size of an episode counts, such as "steps between"."""
    inputs: int
    """D, numbers of an input step."""
    answers: int
    """Number of possible answers."""
    chance: Fraction
    """Share of right answers of the best guess that sees the current input alone, exact at every
    size."""
    trained: tuple[int, ...]
    """Sizes of the episodes that are learned from; one of them, drawn evenly, a batch."""
    tested: tuple[int, ...]
    """Sizes of the episodes in the test; those above the largest of ``trained`` are new."""
    draw: Callable[[torch.Generator, int, int], Batch]
    """From a generator, a number of episodes and a size to a batch."""

    def batch(self, seed: int, rows: int, level: int) -> Batch:
        """Episodes of one size.

        Args:
            seed: from 0 up; equal seeds give equal data.
            rows: number of episodes.
            level: their size, see the attribute ``level``.

        Returns:
            inputs, targets and mask.
        """
        generator = torch.Generator().manual_seed(seed)
        return self.draw(generator, rows, level)


def one_hot(tokens: Tensor, width: int) -> Tensor:
    """Numbers int64 [...] as float [..., width]; a number that is none of 0 to width - 1, such as
    -1, gives zeros.
    """
    places = torch.arange(width)
    return (tokens.unsqueeze(-1) == places).float()


def shuffled(generator: torch.Generator, rows: int, count: int) -> Tensor:
    """The numbers 0 to count - 1 in a random order, int64 [rows, count]; all orders are equally
    likely.
    """
    return torch.rand(rows, count, generator=generator).argsort(dim=1)


def ask_at_the_end(inputs: Tensor, answers: Tensor) -> Batch:
    """A batch that asks at its last steps alone: float [B, T, D], int64 [B, A] with A <= T."""
    rows, steps = inputs.shape[:2]
    asked = answers.shape[1]
    targets = torch.zeros(rows, steps, dtype=torch.int64)
    targets[:, steps - asked :] = answers
    mask = torch.zeros(rows, steps, dtype=torch.bool)
    mask[:, steps - asked :] = True
    return Batch(inputs, targets, mask)
