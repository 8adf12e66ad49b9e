"""The data of the tests of memory: a slow oracle in plain Python gives the same answers, masks are
where a question is, and who remembers nothing earns exactly the chance level.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from fractions import Fraction

import pytest
import torch

from arcade_torch.tools.bench.memory_tests import TESTS, Batch
from arcade_torch.tools.bench.memory_tests.batch import MemoryTest

Step = tuple[int, ...]
"""The places of the ones in an input step."""
Oracle = Callable[[Sequence[Step]], list[int | None]]
"""From the steps of an episode to the answer at each step, None where nothing is asked."""
CASES = [(test, level) for test in TESTS.values() for level in test.tested]


def steps_of(inputs: torch.Tensor) -> list[Step]:
    """The steps of one episode, float [T, D]."""
    assert ((inputs == 0) | (inputs == 1)).all()
    return [tuple(step.nonzero().flatten().tolist()) for step in inputs]


def delay(steps: Sequence[Step]) -> list[int | None]:
    assert all(4 <= token < 8 for (token,) in steps[1:-1]) and steps[-1] == (8,)
    return [None] * (len(steps) - 1) + [steps[0][0]]


def noise(steps: Sequence[Step]) -> list[int | None]:
    (marked,) = [step[0] for step in steps if 5 in step]
    assert steps[-1] == (4,) and all(step[0] < 4 for step in steps[:-1])
    return [None] * (len(steps) - 1) + [marked]


def capacity(steps: Sequence[Step]) -> list[int | None]:
    held: dict[int, int] = {}
    answers: list[int | None] = []
    for (token,) in steps:
        if token < 64:
            place, symbol = divmod(token, 4)
            assert place not in held
            held[place] = symbol
            answers.append(None)
        else:
            answers.append(held.pop(token - 64))
    assert not held
    return answers


def keys_and_values(steps: Sequence[Step], keys: int) -> list[int | None]:
    latest: dict[int, int] = {}
    answers: list[int | None] = []
    for key, shown in steps:
        value = shown - keys
        if value < 4:
            latest[key] = value
            answers.append(None)
        else:
            answers.append(latest.pop(key))
    assert not latest
    return answers


def forgetting(steps: Sequence[Step]) -> list[int | None]:
    held: dict[int, int] = {}
    answers: list[int | None] = []
    for (token,) in steps:
        if token < 40:
            held[token // 4] = token % 4
        elif token < 50:
            assert held[token - 40] < 4
            held[token - 40] = 4
        answers.append(held.pop(token - 50) if token >= 50 else None)
    assert not held
    return answers


def copy(steps: Sequence[Step]) -> list[int | None]:
    symbols = [token for (token,) in steps if token < 4]
    assert [token for (token,) in steps[len(symbols) :]] == [4] * len(symbols)
    return [None] * len(symbols) + list[int | None](symbols)


def counting(steps: Sequence[Step]) -> list[int | None]:
    return [None] * (len(steps) - 1) + [sum(token == 0 for (token,) in steps)]


def from_the_first_new_step(answers: list[int]) -> list[int | None]:
    """Answers at all steps but the first; in episodes of more than 16 steps from the 17th on."""
    first = 1 if len(answers) <= 16 else 16
    return [None] * first + list[int | None](answers[first:])


def parity(steps: Sequence[Step]) -> list[int | None]:
    odd = False
    answers = []
    for (bit,) in steps:
        odd = odd != bool(bit)
        answers.append(int(odd))
    return from_the_first_new_step(answers)


def cups(steps: Sequence[Step], count: int) -> list[int | None]:
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    ball = [False] * count
    ball[steps[0][0]] = True
    answers = [steps[0][0]]
    for (token,) in steps[1:]:
        a, b = pairs[token - count]
        ball[a], ball[b] = ball[b], ball[a]
        answers.append(ball.index(True))
    return from_the_first_new_step(answers)


ORACLES: dict[str, Oracle] = {
    "delay": delay,
    "noise": noise,
    "capacity": capacity,
    "association": lambda steps: keys_and_values(steps, 16),
    "rewriting": lambda steps: keys_and_values(steps, 4),
    "forgetting": forgetting,
    "copy": copy,
    "counting": counting,
    "parity": parity,
    "s3": lambda steps: cups(steps, 3),
    "s5": lambda steps: cups(steps, 5),
}


def test_every_test_has_an_oracle_and_its_own_name() -> None:
    assert set(ORACLES) == set(TESTS) and all(test.name == name for name, test in TESTS.items())


@pytest.mark.parametrize(("test", "level"), CASES, ids=lambda x: getattr(x, "name", x))
def test_a_slow_oracle_gives_the_same_answers_at_the_same_steps(
    test: MemoryTest, level: int
) -> None:
    for size in {level, test.trained[0], test.trained[-1]}:
        batch = test.batch(3, 40, size)
        rows, steps, width = batch.inputs.shape
        assert (rows, width) == (40, test.inputs) and batch.inputs.dtype == torch.float32
        assert batch.targets.shape == batch.mask.shape == (rows, steps)
        for row in range(rows):
            answers = ORACLES[test.name](steps_of(batch.inputs[row]))
            assert batch.mask[row].tolist() == [answer is not None for answer in answers]
            asked = batch.targets[row][batch.mask[row]].tolist()
            assert asked == [answer for answer in answers if answer is not None]


@pytest.mark.parametrize("test", TESTS.values(), ids=lambda test: test.name)
def test_data_is_a_function_of_the_seed_alone(test: MemoryTest) -> None:
    level = test.tested[0]
    torch.manual_seed(1)
    first = test.batch(7, 16, level)
    torch.manual_seed(2)
    before = torch.get_rng_state()
    again = test.batch(7, 16, level)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(first.inputs, test.batch(8, 16, level).inputs)


def answers_by_input(batch: Batch) -> dict[Step, Counter[int]]:
    """What is seen at a step where something is asked -> how often each answer is right."""
    seen: dict[Step, Counter[int]] = defaultdict(Counter)
    asked = steps_of(batch.inputs[batch.mask])
    for step, target in zip(asked, batch.targets[batch.mask].tolist(), strict=True):
        seen[step][target] += 1
    return seen


@pytest.mark.parametrize(("test", "level"), CASES, ids=lambda x: getattr(x, "name", x))
def test_the_best_guess_without_memory_earns_the_chance_level(test: MemoryTest, level: int) -> None:
    """The guess is the answer that is right most often after what is seen at that step, learned on
    one half of the data and judged on the other.
    """
    rows = max(200, 2400 // int(test.batch(0, 1, level).mask.sum()))
    learned = answers_by_input(test.batch(11, rows, level))
    judged = answers_by_input(test.batch(12, rows, level))
    right = 0
    asked = 0
    for seen, counts in judged.items():
        best = max(range(test.answers), key=lambda answer, seen=seen: learned[seen][answer])
        right += counts[best]
        asked += counts.total()
    chance = float(test.chance)
    spread = math.sqrt(chance * (1 - chance) / asked)
    assert asked >= 2000
    assert abs(right / asked - chance) < 4 * spread


@pytest.mark.parametrize(("test", "level"), CASES, ids=lambda x: getattr(x, "name", x))
def test_answers_are_even_whatever_is_seen(test: MemoryTest, level: int) -> None:
    """Why a guess earns no more: after each thing that is seen all answers are as likely."""
    assert test.chance == Fraction(1, test.answers)
    rows = max(200, 2400 // int(test.batch(0, 1, level).mask.sum()))
    for counts in answers_by_input(test.batch(13, rows, level)).values():
        asked = counts.total()
        expected = asked / test.answers
        for answer in range(test.answers):
            assert abs(counts[answer] - expected) <= 5 * math.sqrt(expected) + 1
