"""Collects the facts from which the state of the node is judged."""

import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING

from graph_slam_ros.errors import message_of
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.findings.table import Effect, explain
from graph_slam_ros.node.diagnostics import STATES, WINDOW_S, Facts, Recent
from graph_slam_ros.node.worker import run_in_thread
from graph_slam_ros.slam import Counters

if TYPE_CHECKING:
    from graph_slam_ros.node.runtime import Runtime


_LATELY_S, _MANY_FAULTS = 3.0, 100
_OF_ITS_OWN = {"overflow"}  # the verdict has a sentence for it
Counts = Mapping[str, Mapping[str, int]]


class RecentInputs:
    """Remembers totals of the last seconds, and returns their differences."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, Counter[str], Counter[tuple[str, str]]]] = deque([(0.0, Counter(), Counter())])

    def observe(self, now_s: float, accepted: Mapping[str, int], before: Counts, after: Counts) -> dict[str, Recent]:
        """Return the counts of each input in the last seconds. Call it about every second.

        Parameters
        ----------
        now_s : by a clock that never stands
        accepted : things that were handed to the pipeline since the start, by input
        before, after : what was counted since the start by input and reason: before that, and by the pipeline
        """
        not_accepted, refused = _refused(before), _refused(before, after)
        came = Counter(accepted)
        for (name, _), times in not_accepted.items():
            came[name] += times
        self._past.append((now_s, came, refused))
        while len(self._past) > 2 and self._past[1][0] <= now_s - WINDOW_S:
            self._past.popleft()
        lately = next(one for one in self._past if one[0] >= now_s - _LATELY_S or one is self._past[-1])
        (_, came_before, refused_before), (_, came_lately, refused_lately) = self._past[0], lately
        out = {}
        for name in came:
            mine = {reason: n for (of, reason), n in (refused - refused_before).items() if of == name}
            is_refused = any(of == name for of, _ in refused - refused_lately)
            out[name] = Recent(came[name] - came_before[name], mine, is_refused or came[name] == came_lately[name])
        return out


def _refused(*counts: Counts) -> Counter[tuple[str, str]]:
    out: Counter[tuple[str, str]] = Counter()
    for some in counts:
        for name, reasons in some.items():
            for reason, times in reasons.items():
                if reason not in _OF_ITS_OWN and explain(reason).effect is Effect.REFUSED:
                    out[name.partition("#")[0], reason] += times
    return out


class FactCollector:
    """Collects facts about once a second. Recent facts are those since the last collection."""

    def __init__(self, run: "Runtime") -> None:
        self._run, self._node = run, run.node
        self._recent = RecentInputs()
        self._not_loaded = ""
        self._clock_ns, self._stands_since, self._processed = 0, 0.0, 0  # simulated time, since when it is that
        self._before = Counter[str]()  # what has happened until the last time

    def note_load(self, loaded: "Future[str]") -> None:
        """Note why the map that is to be loaded at the start cannot be."""
        if (error := loaded.exception()) is not None:
            self._not_loaded = message_of(error)

    def collect(self, lifecycle: str) -> Facts:
        """Collect the present facts."""
        run, node, session = self._run, self._node, self._run.session
        if not run.worker.waiting and node.now_ns:
            run.worker.offer(session.evaluate)
        if (check := run.ingest.check.job()) is not None:  # wrong units may keep the worker busy
            run_in_thread(node.guarded(check))
        pipeline, counters = Counters(), Counters()
        pipeline.update(session.slam.counters)
        counters.update(run.counters)
        counters.update(pipeline)
        counted = counters.as_dict()
        recent = self._recent.observe(
            time.monotonic(), run.publishers.processed, run.counters.as_dict(), pipeline.as_dict()
        )
        inputs = run.subscriptions
        return Facts(
            lifecycle,
            tuple(inputs.facts(node.now_ns, counted, recent, pipeline.used)) if inputs is not None else (),
            session.estimate,
            session.estimate.weakest(node.config.space) if session.estimate is not None else {},
            tuple(self._found(sum(of.get("overflow", 0) for of in counted.values()))),
            run.ingest.check.findings,
            run.ingest.outcome,
            run.publishers.path_version,
            run.worker.lag_s,
            run.worker.waiting,
            node.faults,
        )

    def _found(self, overflows: int) -> Iterator[Finding]:
        """Yield what is wrong with the parts of the node: errors, what it waits for, and what makes it worse."""
        run, node, session, worker = self._run, self._node, self._run.session, self._run.worker
        error, note, warning = (partial(Finding, severity=severity) for severity, _ in STATES)
        gate, health = run.ingest.gate, node.config.health
        counts = Counter(
            overflow=overflows, failures=session.failures, restarts=run.counters["node", "worker_restarted"]
        )
        lately, self._before = counts - self._before, counts
        if run.not_compiled:
            yield error("not_compiled", text=run.not_compiled)
        elif self._not_loaded and not session.loaded_keyframes:
            yield error("not_loaded", text=self._not_loaded)
        elif not worker.is_alive:
            yield error("worker_ended")
        if node.faults >= _MANY_FAULTS:
            yield error("callbacks", count=node.faults)
        if node.get_node_names_and_namespaces().count((node.get_name(), node.get_namespace())) > 1:
            yield error("twin")  # which broadcasts map -> odom, too
        elif run.broadcaster is not None and node.config.tf.publish_tf:
            yield from run.broadcaster.wrong()
        if gate.is_stopped:
            yield error("stopped")
        if session.recording_fails:
            yield error("unwritten")
        if run.preparing:
            yield note("preparing", text=run.preparing)
        if session.loads:
            yield note("loading", text=session.loads)
        if node.get_parameter("use_sim_time").value and not node.now_ns:
            yield note("no_clock") if session.estimate is None else warning("no_clock")
        if self._clock_stands(sum(run.publishers.processed.values())):
            yield warning("clock_stands")
        if gate.is_paused:
            yield warning("paused", text="paused")
        if failing := session.slam.view.failing:
            yield warning("unsolved", text=f"solves fail, the last good estimate stands: {failing}")
        elif lately["failures"]:
            yield warning("unsolved", text=f"{lately['failures']} solves failed: the last good estimate stands")
        if lately["restarts"]:
            yield warning("worker_restarted")
        if worker.busy_s > health.stuck_s and not session.loads:
            yield warning("stuck", value=worker.busy_s)
        if lately["overflow"]:
            yield warning("overflow", text=f"{lately['overflow']} messages refused: the queue is full")
        if worker.lag_s > health.lag_s:
            yield warning("lagging", value=worker.lag_s, count=worker.waiting)

    def _clock_stands(self, processed: int) -> bool:
        """Return whether simulated time stands still, and messages are processed all the same."""
        now_ns, now_s, before, self._processed = self._node.now_ns, time.monotonic(), self._processed, processed
        if not now_ns or now_ns != self._clock_ns:
            self._clock_ns, self._stands_since = now_ns, now_s
        return now_s - self._stands_since > 2.0 and processed > before
