"""Jobs in the background, on a copy of the map: begun at one keyframe, and used at a fixed later one.

Both keyframes follow from the accepted measurements alone. So a replay decides as the live run did.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.typing import Executor, Result

Outcome = TypeVar("Outcome")


@dataclass(slots=True)
class CancelToken:
    """Tells a job that its outcome is not needed any more."""

    still: bool = True


Work = Callable[[CancelToken], Outcome]


def run_when_asked(work: Callable[[], Result], /) -> Callable[[], Result]:
    """Run the work when its result is requested."""
    return work


def guarded(counters: Counters, what: str, part: Callable[[], Result]) -> Result | None:
    """Do a part of the work; None after an exception, which is counted under ``what``."""
    try:
        return part()
    except Exception as error:
        counters.count_failure(what, error)
        return None


@dataclass(frozen=True, slots=True)
class _Job(Generic[Outcome]):
    used_at: int  # keyframe
    outcome: Callable[[], Outcome]
    token: CancelToken


class Background(Generic[Outcome]):
    """Jobs of one policy. The pipeline waits for one that is not done when it is used. A failure is counted.

    Parameters
    ----------
    what : what failures are counted under
    after : keyframes from the begin of a job until its outcome is used
    """

    def __init__(self, what: str, executor: Executor, after: int, counters: Counters) -> None:
        self._what, self._executor, self._after, self._counters = what, executor, after, counters
        self._jobs = list[_Job[Outcome]]()

    @property
    def is_busy(self) -> bool:
        """Return whether a job goes on."""
        return len(self._jobs) > 0

    def begin(self, frozen: Callable[[], Work[Outcome]], keyframe: int, *, at_once: bool = False) -> bool:
        """Begin a job at a keyframe; returns whether that was possible.

        Parameters
        ----------
        frozen : copies what the job needs, and returns the job
        at_once : whether it is used from now on, in place of all others
        """

        def begun() -> _Job[Outcome]:
            work, token = frozen(), CancelToken()
            return _Job(keyframe + (0 if at_once else self._after), self._executor(lambda: work(token)), token)

        job = guarded(self._counters, self._what, begun)
        if job is not None:
            self._jobs = [*([] if at_once else self._jobs[-1:]), job]  # each holds a copy of the map
        return job is not None

    def due(self, keyframe: int) -> Callable[[], Outcome | None] | None:
        """Return a function that waits for the newest outcome that is used at this keyframe, if there is one."""
        ready = [job.outcome for job in self._jobs if job.used_at <= keyframe]
        if not ready:
            return None
        self._jobs = [job for job in self._jobs if job.used_at > keyframe]
        return lambda: guarded(self._counters, self._what, ready[-1])

    def cancel(self) -> None:
        """Cancel all jobs, because what they began with has changed."""
        for job in self._jobs:
            job.token.still = False
        self._jobs = []
