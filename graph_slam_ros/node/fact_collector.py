"""Collects the facts from which the state of the node is judged."""

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING

from graph_slam_ros.errors import message_of
from graph_slam_ros.findings.table import Effect, explain
from graph_slam_ros.node.diagnostics import WINDOW_S, Facts, Recent
from graph_slam_ros.node.ingest import Ingest
from graph_slam_ros.node.preparation import Preparation
from graph_slam_ros.node.publishers import Publishers, PublishingClock
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.subscriptions import Subscriptions
from graph_slam_ros.node.tf_broadcaster import TfBroadcaster
from graph_slam_ros.node.worker import Worker, run_in_thread
from graph_slam_ros.slam import Counters

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode


_LATELY_S = 3.0
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
    """Collects facts about once a second. Recent facts are those since the last collection.

    Parameters
    ----------
    counters : of what is refused before the pipeline
    """

    def __init__(
        self,
        node: "GraphSlamNode",
        counters: Counters,
        session: Session,
        worker: Worker,
        ingest: Ingest,
        publishers: Publishers,
        clock: PublishingClock,
    ) -> None:
        self._node, self._counters, self._session = node, counters, session
        self._worker, self._ingest, self._publishers, self._clock = worker, ingest, publishers, clock
        self._recent = RecentInputs()
        self._not_loaded = ""
        self._clock_ns, self._stands_since, self._processed = 0, 0.0, 0  # simulated time, since when it is that
        self._before = 0, 0, 0  # overflows, failures and restarts until the last time

    def note_load(self, loaded: "Future[str]") -> None:
        """Note why the map that is to be loaded at the start cannot be."""
        if (error := loaded.exception()) is not None:
            self._not_loaded = f"output.load: the map was not loaded: {message_of(error)}"

    def collect(
        self,
        lifecycle: str,
        subscriptions: Subscriptions | None,
        broadcaster: TfBroadcaster | None,
        preparation: Preparation,
    ) -> Facts:
        """Collect the present facts.

        Parameters
        ----------
        lifecycle : the state of the lifecycle
        subscriptions, broadcaster : None while the node is not active
        """
        session, node, worker, gate = self._session, self._node, self._worker, self._ingest.gate
        if not worker.waiting and node.now_ns:
            worker.offer(session.evaluate)
        if (check := self._ingest.check.job()) is not None:  # wrong units may keep the worker busy
            run_in_thread(partial(_reported, check, node.report_fault))
        pipeline = Counters()
        pipeline.update(session.slam.counters)
        counters = Counters()
        counters.update(self._counters)
        counters.update(pipeline)
        counted, processed = counters.as_dict(), self._clock.processed
        recent = self._recent.observe(time.monotonic(), processed, self._counters.as_dict(), pipeline.as_dict())
        overflows = sum(of.get("overflow", 0) for of in counted.values())
        failures, restarts = session.failures, self._counters["node", "worker_restarted"]
        before, self._before = self._before, (overflows, failures, restarts)
        rivals, static = _rivals(broadcaster) if broadcaster is not None and node.config.tf.publish_tf else (None, "")
        return Facts(
            lifecycle,
            subscriptions.facts(node.now_ns, counted, recent, pipeline.used) if subscriptions is not None else (),
            session.estimate,
            weakest=session.estimate.weakest(node.config.space) if session.estimate is not None else {},
            waits_for_clock=node.get_parameter("use_sim_time").value and not node.now_ns,
            clock_stands=self._clock_stands(sum(processed.values())),
            is_paused=gate.is_paused,
            loads=session.loads,
            is_stopped=gate.is_stopped,
            lag_s=worker.lag_s,
            waiting=worker.waiting,
            busy_s=worker.busy_s,
            worker_is_alive=worker.is_alive,
            restarts=restarts - before[2],
            failing=session.slam.view.failing,
            overflows=overflows - before[0],
            failures=failures - before[1],
            recording_fails=session.recording_fails,
            path_version=self._publishers.path_version,
            has_other_authority=rivals is not None,
            authorities=rivals or (),
            static_authority=static,
            twins=node.get_node_names_and_namespaces().count((node.get_name(), node.get_namespace())) - 1,
            findings=self._ingest.check.findings,
            outcome=self._ingest.outcome,
            tf_behind_s=broadcaster.behind_s if broadcaster is not None else 0.0,
            preparing=preparation.status,
            cannot_prepare=preparation.fault or ("" if session.loaded_keyframes else self._not_loaded),
        )

    def _clock_stands(self, processed: int) -> bool:
        """Return whether simulated time stands still, and messages are processed all the same."""
        now_ns, now_s, before, self._processed = self._node.now_ns, time.monotonic(), self._processed, processed
        if not now_ns or now_ns != self._clock_ns:
            self._clock_ns, self._stands_since = now_ns, now_s
        return now_s - self._stands_since > 2.0 and processed > before


def _rivals(broadcaster: TfBroadcaster) -> tuple[tuple[str, ...] | None, str]:
    """The nodes that may broadcast the transform as well, None where nobody does; and the transform if it is static."""
    broadcaster.static.refresh()
    if transform := broadcaster.static.transform:
        return broadcaster.static.candidates(), transform
    return (broadcaster.candidates() if broadcaster.has_rival else None), ""


def _reported(work: Callable[[], None], on_fault: Callable[[Exception], None]) -> None:
    """Do work in a thread, whose exception nobody else would see."""
    try:
        work()
    except Exception as error:
        on_fault(error)
