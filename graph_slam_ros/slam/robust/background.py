"""Search for better hypotheses in the background, while the robot drives on.

A search starts on a frozen copy at one keyframe, and its outcome is used at a fixed later one. If it is not done by
then, the pipeline waits. Both keyframes follow from the ingest sequence alone, so that a replay decides as the live run
did.
"""

from collections.abc import Callable
from dataclasses import dataclass

from graph_slam_ros.config.pipeline import RobustConfig
from graph_slam_ros.slam.robust.hypotheses import CancelToken, FrozenGraph, Outcome, search_alternatives
from graph_slam_ros.typing import Executor as Executor
from graph_slam_ros.typing import Result

_MORE = 1.5  # times as many out as at the last look: looks become rarer as their cost grows

Work = Callable[[], Outcome | None]


def run_when_asked(work: Callable[[], Result], /) -> Callable[[], Result]:
    """Runs the work when its result is requested."""
    return work


@dataclass(frozen=True, slots=True)
class _Job:
    apply_at: int
    outcome: Work
    wanted: CancelToken


class Background:
    """Runs at most one search at a time. Its outcome is due at a fixed keyframe."""

    def __init__(self, config: RobustConfig, executor: Executor) -> None:
        self._config, self._executor = config, executor
        self._out = 0  # candidates that were out at the last look
        self._job: _Job | None = None

    @property
    def is_busy(self) -> bool:
        """Return whether a search goes on."""
        return self._job is not None

    def is_due(self, out: int) -> bool:
        """Return whether a search is due by this number of rejected candidates."""
        after, self._out = self._config.second_look_after, min(self._out, out)
        if self._job is not None or after <= 0:
            return False
        return out >= max(self._out + after, _MORE * self._out)

    def start(self, frozen: FrozenGraph, out: int) -> None:
        """Start with the present graph."""
        self._out = out
        wanted = CancelToken()
        outcome = self._executor(lambda: search_alternatives(self._config, frozen, wanted))
        self._job = _Job(frozen.keyframe + self._config.apply_after_keyframes, outcome, wanted)

    def outcome(self, keyframe: int) -> Outcome | None:
        """The outcome of the search at its keyframe, after waiting for it; None if there is none."""
        if self._job is None or keyframe < self._job.apply_at:
            return None
        job, self._job = self._job, None
        return job.outcome()

    def cancel(self, out: int) -> None:
        """Cancel the running search, because everything was reviewed with this number of rejected candidates."""
        if self._job is not None:
            self._job.wanted.still = False
        self._job, self._out = None, out
