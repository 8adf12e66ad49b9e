"""Interrupts a collector at random moments, in a process of its own: ``python -m
tests.arcade_torch.interrupts -h``.

Prints how many windows were collected and interrupted. A crash ends the process, a fault raises.
"""

import argparse
import random
import signal
import time
from collections import deque

import torch

from arcade_torch import ArcadeCollector, make

NUM_ENVS = 16
STEPS = 32


armed = False  # whether the next signal interrupts


def interrupt(number: int, frame: object) -> None:
    """What Ctrl-C does, once."""
    global armed
    if armed:
        armed = False
        raise KeyboardInterrupt


def check(held: "deque[tuple]") -> None:
    """Every batch in hand is what it was."""
    for batch, copy in held:
        for key, value in copy.items(True, True):
            assert torch.equal(batch[key], value), f"{key} of a batch in hand has changed"


def follows_on(batch) -> None:
    """A window is one piece: counts and start flags fit each other."""
    ended = batch["next", "done"][:, :-1]
    count = batch["next", "step_count"][:, :-1]
    assert torch.equal(batch["is_init"][:, 1:].reshape(ended.shape), ended)
    assert torch.equal(batch["step_count"][:, 1:], count.masked_fill(ended, 0))


def run(game: str, same: bool, interrupts: int, seed: int) -> tuple[int, int]:
    """Collect until there were so many interrupts; returns how many windows were collected, and
    interrupted.
    """
    global armed
    draw = random.Random(seed)
    env = make(game, num_envs=NUM_ENVS, seed=seed)
    collector = ArcadeCollector(
        env, None, frames_per_batch=NUM_ENVS * STEPS, return_same_td=same, seed=seed
    )
    collector.collect()
    began = time.perf_counter()
    collector.collect()
    longest = 1.2 * (time.perf_counter() - began)
    signal.signal(signal.SIGALRM, interrupt)
    held: deque[tuple] = deque(maxlen=3)
    windows = 0
    stopped = 0
    while stopped < interrupts:
        batch = None
        try:
            armed = True
            signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-5, longest))
            batch = collector.collect()
            armed = False
        except KeyboardInterrupt:
            stopped += 1
        if batch is None:
            # With shared storage the window that was lost has written over the batch before; it can
            # still be read.
            for old, _ in held if same else ():
                old.apply(lambda value: value.clone())
            held = deque(maxlen=3) if same else held
            batch = collector.collect()
        follows_on(batch)
        windows += 1
        if same:
            held.clear()
        held.append((batch, batch.clone()))
        check(held)
    return windows, stopped


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("game")
    parser.add_argument("--same", action="store_true", help="return_same_td=True")
    parser.add_argument("--interrupts", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    windows, stopped = run(given.game, given.same, given.interrupts, given.seed)
    print(f"{given.game} same={given.same}: {stopped} interrupts, {windows} windows")


if __name__ == "__main__":
    main()
