"""A recording that repeats its work: what a CUDA graph does, where there is no GPU."""

from typing import ClassVar

from arcade_torch.agents.cuda_graph import Work


class Repeated:
    """Records by keeping the work, and replays by doing it again on the memory that it knows."""

    recordings: ClassVar[list["Repeated"]] = []

    def __init__(self) -> None:
        self.warm_ups = 0
        self.replays = 0
        self._work: Work | None = None
        Repeated.recordings.append(self)

    def warm_up(self, work: Work) -> None:
        self.warm_ups += 1
        work()

    def record(self, work: Work) -> None:
        assert self._work is None
        self._work = work

    def replay(self) -> None:
        assert self._work is not None
        self.replays += 1
        self._work()
