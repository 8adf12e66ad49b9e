"""Which run to start next, where several processes on several machines work on one study."""

import time
from collections.abc import Callable

from arcade_torch.agents.lease import Lease
from arcade_torch.tools.studies.engines import Job
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study

LOOK_AGAIN_S = 2.0
"""Seconds between two looks at runs that others carry out."""


class RunQueue:
    """Hands out the runs of a study that nobody works on, each under a lock; an iterator of jobs.

    ``None`` means that the runs that are left are all in other hands: those come back if their owner is lost.

    Args:
        what: the study.
        folder: its folder, claimed.
        ended: called with the name of a run that others finished, or failed at, in the meantime, and the error.
        now: clock in seconds.
    """

    def __init__(
        self,
        what: Study,
        folder: StudyFolder,
        ended: Callable[[str, str], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what, self._folder, self._ended, self._now = what, folder, ended, now
        self._left = {run.name: run for run in what.runs() if folder.run(run).final() is None}
        self._runs = dict(self._left)
        self._locks = {run.name: (folder.reservation(run), folder.training(run)) for run in self._left.values()}
        self._old_failures = {name: folder.failure(run) for name, run in self._left.items()}
        self._mine: dict[str, Lease] = {}
        self._not_before = 0.0

    @property
    def names(self) -> set[str]:
        """Runs that are not finished and not ours yet."""
        return set(self._left)

    def __iter__(self) -> "RunQueue":
        """The queue is its own iterator."""
        return self

    def __next__(self) -> Job | None:
        """The next job, with its lock taken; None if there is none at the moment.

        Raises:
            StopIteration: every run is finished, failed, or was handed out here.
        """
        if self._left and self._now() < self._not_before:
            return None
        for name, run in list(self._left.items()):
            if self._settled(name, run):
                continue
            reservation, training = self._locks[name]
            busy, reserved = training.held(), reservation.held()  # both, so that both silences are watched at once
            if busy or reserved or not reservation.try_take():
                continue
            if self._settled(name, run):  # a moment ago
                reservation.release()
                continue
            del self._left[name]
            self._mine[name] = reservation
            return self._job(run)
        if not self._left:
            raise StopIteration
        self._not_before = self._now() + LOOK_AGAIN_S
        return None

    def done(self, name: str, error: str = "") -> None:
        """Note how a run that was handed out ended, and let go of it.

        Args:
            name: of the run.
            error: why it failed; empty if it did not.
        """
        try:
            self._folder.note_failure(self._runs[name], error)
        finally:
            self._mine.pop(name).release()

    def close(self) -> None:
        """Let go of all runs that were handed out and did not end."""
        for name in list(self._mine):
            self._mine.pop(name).release()

    def _settled(self, name: str, run: RunSpec) -> bool:
        """Whether others are through with a run."""
        error = ""
        if self._folder.run(run).final() is None:
            failure = self._folder.failure(run)
            if failure is None or failure == self._old_failures[name]:
                return False
            error = failure[1]
        del self._left[name]
        self._ended(name, error)
        return True

    def _job(self, run: RunSpec) -> Job:
        path = self._folder.run(run).path
        words = [*self._what.arguments(run, path), "--resume"]  # starts a run that is not there yet
        return Job(run.name, tuple(words), self._folder.log(run), path)
