"""What a run asks of its process: seeds, threads, and signals that stop it."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

import torch

from arcade_torch.agents.config import TrainConfig


@contextlib.contextmanager
def own_settings(config: TrainConfig) -> Iterator[None]:
    """Seed torch's global generators and set its threads for the duration of a run."""
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(config.threads or threads)
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop; outside the main thread, signals stay as they are."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if asked.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
