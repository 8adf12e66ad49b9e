"""Training of one memory model in one test, and its share of right answers at each size."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from arcade_torch.models import MemoryBlock
from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest

__all__ = ["MOST_SEED", "MOST_STEPS", "Setting", "Trained", "train"]

SEEDS_A_RUN = 2**20
SEEDS_OF_LOOKS = 2**18
SEEDS_OF_TESTS = 2**19
"""Seeds of data: how many belong to one run, and where among them those begin that decide when a
training ends, and those of the tests at its end. What is learned begins at 0."""
MOST_STEPS = SEEDS_OF_LOOKS
MOST_SEED = 2**32
SEEDS_A_SIZE = 2**9
ROWS_AT_ONCE = 128

Memory = str | Callable[..., nn.Module]


@dataclass(frozen=True)
class Setting:
    """How every model is trained in every test."""

    hidden_size: int = 64
    """Width of the memory block."""
    steps: int = 600
    """Gradient steps at most."""
    rows: int = 64
    """Episodes a batch."""
    learning_rate: float = 3e-3
    """Of Adam."""
    max_norm: float = 1.0
    """Largest norm of a gradient."""
    check_every: int = 50
    """Gradient steps between two looks at whether it is solved."""
    solved: float = 0.995
    """Share of right answers at the largest size of training that ends it early."""
    answers: int = 1000
    """Answers in the test of a size, at least."""


class Trained(NamedTuple):
    """What one training gave."""

    accuracy: dict[int, tuple[float, int]]
    """size -> (share of right answers, how many were asked)"""
    steps: int
    """of training"""
    seconds: float
    """processor time of these steps"""
    parameters: int
    state_numbers: int


class Reader(nn.Module):
    """Inputs to logits: memory block of one cell, linear."""

    def __init__(self, memory: Memory, hidden_size: int, test: MemoryTest) -> None:
        super().__init__()
        self.block = MemoryBlock(test.inputs, hidden_size, memory, layers=1)
        self.head = nn.Linear(hidden_size, test.answers)

    def forward(self, batch: Batch) -> Tensor:
        """Logits of the answers that are asked for, float [answers, classes]."""
        is_init = torch.zeros(batch.mask.shape, dtype=torch.bool)
        is_init[:, 0] = True
        y, _ = self.block(batch.inputs, self.block.initial_state(len(is_init)), is_init)
        return self.head(y[batch.mask])  # type: ignore[no-any-return]


def train(memory: Memory, test: MemoryTest, seed: int, setting: Setting = Setting()) -> Trained:
    """Train one model until it is right or its steps are spent, then ask it at every size.

    Args:
        memory: name of a memory model, or a factory ``(input_size, hidden_size) -> nn.Module``.
        test: what it learns.
        seed: of weights and data, from 0 up; equal seeds give equal results on one machine.
        setting: the same for all.

    Returns:
        shares of right answers on data that it has not seen, and what the training took.
    """
    torch.manual_seed(seed)
    reader = Reader(memory, setting.hidden_size, test)
    optimizer = torch.optim.Adam(reader.parameters(), setting.learning_rate)
    levels = torch.Generator().manual_seed(seed)
    first = seed * SEEDS_A_RUN
    steps = 0
    began = time.process_time()
    while steps < setting.steps:
        level = test.trained[int(torch.randint(len(test.trained), (), generator=levels))]
        _learn(reader, optimizer, test.batch(first + steps, setting.rows, level), setting.max_norm)
        steps += 1
        if steps % setting.check_every == 0:
            look = first + SEEDS_OF_LOOKS + steps
            right, _ = accuracy(reader, test, test.trained[-1], look, setting.rows)
            if right >= setting.solved:
                break
    seconds = time.process_time() - began
    results = {}
    for level in test.tested:
        unseen = first + SEEDS_OF_TESTS + SEEDS_A_SIZE * level
        results[level] = accuracy(reader, test, level, unseen, setting.answers)
    parameters = sum(p.numel() for p in reader.parameters())
    state = reader.block.initial_state(1)
    numbers = sum(leaf.numel() for leaf in state.values(True, True))
    return Trained(results, steps, round(seconds, 2), parameters, numbers)


def _learn(reader: Reader, optimizer: torch.optim.Optimizer, batch: Batch, max_norm: float) -> None:
    """One gradient step on a batch."""
    loss = nn.functional.cross_entropy(reader(batch), batch.targets[batch.mask])
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(reader.parameters(), max_norm)
    optimizer.step()


@torch.no_grad()
def accuracy(
    reader: Reader, test: MemoryTest, level: int, first_seed: int, answers: int
) -> tuple[float, int]:
    """Share of right answers to ``answers`` questions or some more, and how many they were."""
    right = 0
    asked = 0
    seed = first_seed
    while asked < answers:
        batch = test.batch(seed, ROWS_AT_ONCE, level)
        guesses = reader(batch).argmax(dim=-1)
        targets = batch.targets[batch.mask]
        right += int((guesses == targets).sum())
        asked += len(targets)
        seed += 1
    return right / asked, asked
