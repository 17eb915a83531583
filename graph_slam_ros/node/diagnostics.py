"""The state of the node: one verdict with its reasons, judged from facts.

The lifecycle gives UNCONFIGURED, INACTIVE and FINALIZED. An active node is WAITING if something is missing, OK,
DEGRADED if the estimate goes on but is worse than it could be, or ERROR if somebody must act.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

from graph_slam_ros.config.config import Config
from graph_slam_ros.findings.finding import Finding, causes
from graph_slam_ros.findings.table import DOUBTS, explain, remedy
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES
from graph_slam_ros.messages.to_msg import ERROR, OK, WARN, Status
from graph_slam_ros.node.estimate import OFF, Estimate
from graph_slam_ros.node.events import Outcome
from graph_slam_ros.runs.outcome import MOTION, leaves_plane
from graph_slam_ros.runs.tables import INPUT_COLUMNS

_LEVELS = {"WAITING": WARN, "DEGRADED": WARN, "ERROR": ERROR}  # the others are as somebody wants them
_TF_BEHIND_S = 1.0
_UNSEEN_M, _UNSEEN_S, _NEVER_SEEN = 10.0, 10.0, 3.0
_LONGEST = 80  # of a frame's name
_LATE_S, _PLAYED_S = 0.3, 10.0  # later still, a recording is played without /clock
_NEARLY = 0.5  # of the lateness from which on an observation is refused
_NO_CLOCK = "use_sim_time is set and nothing comes on /clock"
_TRANSITIONS = {
    "unconfigured": "waits for ros2 lifecycle set NODE configure, or a lifecycle manager, or node.autostart:=true",
    "inactive": "waits for ros2 lifecycle set NODE activate, or a lifecycle manager",
}
_UNLINKED = ("frame_unknown", "child_frame_unknown", "odom_frame_unknown", "map_frame_unknown")
WINDOW_S = 10.0
_SHARE, _LEAST = 0.1, 3  # of what came, and how much at least


@dataclass(frozen=True, slots=True)
class Recent:
    """The counts of one input in the last ten seconds; of a message that holds several things, each counts.

    Attributes
    ----------
    came : things
    refused : how many of them by reason, by the border and by the pipeline; what was repaired is not refused
    goes_on : whether something was refused in the last three seconds, or nothing came then
    """

    came: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    goes_on: bool = False

    @property
    def times(self) -> int:
        """The number of refusals."""
        return sum(self.refused.values())

    @property
    def worst(self) -> str:
        """The most frequent reason; empty if nothing was refused."""
        return max(self.refused, key=lambda reason: self.refused[reason], default="")

    @property
    def is_bad(self) -> bool:
        """Return whether more than a tenth was refused, and refusals go on."""
        return self.goes_on and self.times >= _LEAST and self.times > _SHARE * self.came

    @property
    def is_nothing_used(self) -> bool:
        """Return whether all was refused."""
        return self.times >= self.came


@dataclass(frozen=True, slots=True)
class InputFacts:
    """The facts of one input.

    Attributes
    ----------
    received, used : messages, and what of them the estimate has used: of a message that holds several things, each
    counts : since the start, of what was refused, repaired or noted, by reason
    silent_s : since the last message, by the clock of the node; infinite before the first
    publishers : names of the nodes that publish it
    is_contested : whether several publish what is of one: an odometry
    mismatch : what keeps publisher and subscription from connecting, in words; empty where nothing does
    frames : those of its messages that nothing links to the robot, the last ones, each with the robot's
    recent : what became of it in the last seconds
    not_found : of odometry on /tf, the transform that has never come, and what mends that
    late_s : the least time from a stamp to its arrival, of the last messages; NaN where none came, or no clock runs
    alternatives : where nobody publishes it, other topics that it could use, each with the parameter that chooses it
    """

    name: str
    topic: str
    use: str
    received: int = 0
    used: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    silent_s: float = math.inf
    publishers: tuple[str, ...] = ()
    is_contested: bool = False
    mismatch: str = ""
    frames: tuple[tuple[str, str], ...] = ()
    recent: Recent = field(default_factory=Recent)
    not_found: str = ""
    alternatives: tuple[str, ...] = ()
    late_s: float = math.nan

    @property
    def unpublished(self) -> str:
        """Return that nobody publishes it, and what could be used instead; empty if somebody does."""
        return "" if self.publishers else "; ".join((f"nobody publishes {self.topic}", *self.alternatives))


@dataclass(frozen=True, slots=True)
class Facts:
    """The facts of the verdict.

    Attributes
    ----------
    lifecycle : ``unconfigured``, ``inactive``, ``active`` or ``finalized``
    weakest : the weakest direction of the newest pose, by quantity, and of all landmarks, with its sigma
    loads : the run whose map is being loaded; empty where none is
    faults : exceptions of callbacks in the last ten seconds
    busy_s : for how long the solver has been at what it does
    overflows, failures, restarts : messages refused for want of room, solves that failed, and threads of the solver
        that died, since the last look
    failing : why the last solve failed; empty where it did not
    authorities : other nodes that publish /tf, one of which broadcasts map -> odom, if somebody does
    static_authority : the transform to odometry's frame that one of these publishes on /tf_static, if one does
    findings : what is wrong with the inputs by a check that needs no fit
    outcome : what became of what was asked for last on a topic; None where nothing was
    tf_behind_s : how much earlier than the last map -> odom would be dated now, so that it is not sent
    preparing : what keeps the pipeline from beginning: kernels are compiled or loaded; empty when they are ready
    cannot_prepare : why that failed, or why the map to begin in cannot be loaded
    """

    lifecycle: str
    inputs: tuple[InputFacts, ...] = ()
    estimate: Estimate | None = None
    weakest: Mapping[str, str] = field(default_factory=dict)
    waits_for_clock: bool = False
    clock_stands: bool = False
    is_paused: bool = False
    loads: str = ""
    is_stopped: bool = False
    lag_s: float = 0.0
    waiting: int = 0
    busy_s: float = 0.0
    worker_is_alive: bool = True
    restarts: int = 0
    failing: str = ""
    faults: int = 0
    overflows: int = 0
    failures: int = 0
    recording_fails: bool = False
    path_version: int = 0
    has_other_authority: bool = False
    authorities: tuple[str, ...] = ()
    static_authority: str = ""
    twins: int = 0
    findings: tuple[Finding, ...] = ()
    outcome: Outcome | None = None
    tf_behind_s: float = 0.0
    preparing: str = ""
    cannot_prepare: str = ""


@dataclass(frozen=True, slots=True)
class Health:
    """The state and its reasons, the first the most important."""

    state: str
    reasons: tuple[str, ...] = ()

    @property
    def is_healthy(self) -> bool:
        """Return whether the state is OK."""
        return self.state == "OK"

    @property
    def level(self) -> int:
        """The level of a DiagnosticStatus."""
        return _LEVELS.get(self.state, OK)


def judge(facts: Facts, config: Config) -> Health:
    """The verdict."""
    if facts.lifecycle != "active":
        why = facts.cannot_prepare or facts.preparing or _TRANSITIONS.get(facts.lifecycle, "")
        return Health(facts.lifecycle.upper(), tuple(filter(None, (why,))))
    for state, found in (("ERROR", _errors(facts)), ("WAITING", _missing(facts)), ("DEGRADED", _faults(facts, config))):
        if reasons := tuple(found):
            return Health(state, reasons)
    return Health("OK")


def _errors(facts: Facts) -> Iterator[str]:
    if facts.cannot_prepare:
        yield facts.cannot_prepare
    elif not facts.worker_is_alive:
        yield "the solver's thread has ended"
    if facts.faults >= 100:
        yield f"{facts.faults} faults in callbacks in 10 s"
    if facts.twins:  # which broadcasts map -> odom, too
        yield "another node has this node's name and does the same: stop one, or rename it (-r __node:=NAME)"
    elif facts.has_other_authority:
        yield _rivals(facts)
    if facts.is_stopped:
        yield "stopped when the clock jumped back (time.on_jump); ~/reset begins anew"
    if facts.recording_fails:
        yield "the run cannot be written"


def _rivals(facts: Facts) -> str:
    """The reason that somebody else broadcasts map -> odom, or another static parent of odom."""
    who, static = ", ".join(facts.authorities), facts.static_authority
    several = f": one of {who}, which publish {'/tf_static' if static else '/tf'}: stop them one by one to find it"
    what = f"publishes {static} on /tf_static" if static else "broadcasts map -> odom"
    return f"somebody else {what}{several if len(facts.authorities) > 1 else who and f': {who}'}"


def _missing(facts: Facts) -> Iterator[str]:
    """Reasons why there is no estimate yet. Landmarks are among them only if something is wrong with them."""
    if facts.preparing:
        yield facts.preparing
    if facts.loads:
        yield f"loads the map of {facts.loads}"
        return
    if facts.waits_for_clock and facts.estimate is None:
        yield _NO_CLOCK
    for one in facts.inputs:
        if facts.estimate is None and one.use == "odometry":
            yield from _silence(one, facts.findings)
    if facts.estimate is None and not facts.inputs:
        yield "no input"


def _silence(one: InputFacts, findings: Sequence[Finding]) -> Iterator[str]:
    if one.mismatch:
        yield f"{one.topic}: {one.mismatch}"
    elif one.unpublished:
        yield one.unpublished
    elif not one.received:
        yield f"{one.topic}: {', '.join(one.publishers)} publishes it, but nothing has come yet"
    elif one.recent.times:
        yield f"{one.topic}: {_refused(one)}"
    elif one.not_found:
        yield f"{one.topic}: {one.not_found}"
    elif findings:
        yield from map(_said, findings)
    else:
        yield f"{one.topic}: its first messages wait for their turn"


def _refused(one: InputFacts) -> str:
    """The fraction of an input that was refused lately, with the most frequent reason and its remedy."""
    recent = one.recent
    meaning, mend = explain(recent.worst).meaning, remedy(one.name, recent.worst)
    if recent.worst in _UNLINKED and one.frames:
        meaning = "no transform links " + ", ".join(f"{frame[:_LONGEST]} to {robots}" for frame, robots in one.frames)
    if recent.worst == "odom_frame_unknown" and any(frame in MAP_FRAMES for frame, _ in one.frames):
        meaning = "odometry is given in the frame of a map, so it is the output of a localiser"
        mend = f"{one.name}.topic:=TOPIC, that of the wheels"
    much = "all" if recent.is_nothing_used else f"{recent.times} of {recent.came}"
    return f"{much} refused in {WINDOW_S:.0f} s ({recent.worst}): {meaning}{mend and ': '}{mend}"


def _faults(facts: Facts, config: Config) -> Iterator[str]:
    health, estimate = config.health, facts.estimate
    for one in facts.inputs:
        if one.is_contested:
            yield (
                f"{one.topic}: {' and '.join(one.publishers)} publish it, and one of them is used:"
                " give each odometry a topic and an input of its own (inputs.names)"
            )
        most_s = health.odometry_silent_s if one.use == "odometry" else health.landmarks_silent_s
        if one.mismatch:
            yield f"{one.topic}: {one.mismatch}"
        elif one.received and most_s and one.silent_s > most_s:
            yield f"{one.topic}: {one.not_found or f'silent for {one.silent_s:.1f} s'}"
        elif one.recent.is_bad and not (one.is_contested and one.recent.worst == "other_publisher"):
            yield f"{one.topic}: {_refused(one)}"
        if one.use == "odometry" and config.tf.stamp == "odometry" and config.tf.publish_tf:
            yield from _lateness(one, max(_LATE_S, config.tf.transform_tolerance))
        elif one.use not in MOTION:
            yield from _later_than_odometry(one, facts, config.ordering.late_s)
    if facts.clock_stands:
        yield "/clock stands still while messages come, so map -> odom waits; use_sim_time:=false where it should not"
    if facts.waits_for_clock:
        yield f"{_NO_CLOCK}: map -> odom waits for it, no input counts as silent; use_sim_time:=false, or publish it"
    yield from _uncorrected(facts)
    if facts.is_paused:
        yield "paused"
    if facts.tf_behind_s > _TF_BEHIND_S:
        yield (
            f"map -> odom is not sent: the last was dated {facts.tf_behind_s:.0f} s later"
            " (tf.stamp, tf.transform_tolerance); deactivate and activate the node, and listeners with it"
        )
    if facts.failing:
        yield f"solves fail, the last good estimate stands: {facts.failing}"
    elif facts.failures:
        yield f"{facts.failures} solves failed: the last good estimate stands"
    if facts.restarts:
        yield "a job would have ended the solver's thread, which went on"
    if facts.busy_s > health.stuck_s and not facts.loads:
        yield f"solver stuck: it has been at one thing for {facts.busy_s:.1f} s"
    if facts.overflows:
        yield f"{facts.overflows} messages refused: the queue is full (inputs.queue)"
    if facts.lag_s > health.lag_s:
        yield f"the solver is {facts.lag_s:.1f} s behind, {facts.waiting} messages wait"
    if estimate and (since := "the restart" if estimate.is_resumed else "it jumped" if estimate.is_lost else ""):
        yield (
            f"goes on by odometry alone since {since}, nothing recognised yet:"
            " drive past known landmarks, or give initialpose"
        )
    elif estimate and not estimate.is_confirmed:
        yield "where the robot is in the loaded map is not known yet: drive past known landmarks, or give initialpose"
    if estimate:
        yield from map(_said, causes(_of_measurements(facts, estimate, health.chi2_per_dof)))


def _lateness(one: InputFacts, most_s: float) -> Iterator[str]:
    if most_s < one.late_s < _PLAYED_S:
        yield (
            f"{one.topic}: comes {one.late_s:.1f} s after its stamps, and so does map -> odom:"
            f" tf.transform_tolerance:={math.ceil(10.0 * one.late_s + 1.0) / 10.0:.1f} dates it ahead;"
            f" {one.name}.offset_s for a clock that differs"
        )


def _later_than_odometry(one: InputFacts, facts: Facts, most_s: float) -> Iterator[str]:
    """Yield that an observation nearly comes too late to be used. If it does come too late, it is refused for that."""
    odometry_s = min((other.late_s for other in facts.inputs if other.use == "odometry"), default=math.nan)
    if _NEARLY * most_s < one.late_s - odometry_s < most_s:
        yield (
            f"{one.topic}: comes {one.late_s - odometry_s:.1f} s later than odometry of its time, and is refused if"
            f" that is ordering.late_s ({most_s:g} s): ordering.late_s:={2.0 * most_s:.1f}, or a faster"
            f" detector; {one.name}.offset_s for a clock that differs"
        )


def _of_measurements(facts: Facts, e: Estimate, chi2_per_dof: float) -> Iterator[Finding]:
    """Yield what is wrong with what is measured; nothing that may follow from an input that is mostly refused."""
    planes = [leaves_plane(one.name, one.counts, one.received) for one in facts.inputs if one.use in MOTION]
    found = [*facts.findings, *chain(*planes), *e.findings, *e.doubted]
    if chi2_per_dof and e.fit > chi2_per_dof:
        text = f"the measurements contradict each other: chi2 per degree of freedom is {e.fit:.1f}"
        found.append(Finding("contradictory", "error", text=text, remedy=""))
    is_explained = any(2 * one.recent.times > one.recent.came for one in facts.inputs)
    yield from (one for one in found if not (is_explained and one.code in (*DOUBTS, "confused")))


def _said(found: Finding) -> str:
    """A finding without the option of the commands before parameters, which a node does not have."""
    return str(found).replace("--set ", "")


def _uncorrected(facts: Facts) -> Iterator[str]:
    """Yield why each input is not used, once the robot has driven for a while and nothing corrects odometry."""
    others = [one for one in facts.inputs if one.use not in MOTION]
    if facts.estimate is None or any(one.used for one in others):
        return
    way = facts.estimate.unseen
    if way.length_m >= _UNSEEN_M and facts.estimate.stamp_ns - way.since_ns >= _UNSEEN_S * 1e9:
        yield from (f"nothing corrects odometry: {one.unpublished}" for one in others if one.unpublished)
    if way.length_m >= _NEVER_SEEN * _UNSEEN_M and not facts.findings:
        for one in (one for one in others if one.publishers):
            came = f"{one.topic}: {one.received} messages came, and nothing in them was used"
            yield f"nothing corrects odometry: {came if one.received else next(_silence(one, ()))}"


def statuses(facts: Facts, verdict: Health, node: str) -> Iterator[Status]:
    """Yield the statuses of /diagnostics: the verdict, each input, and the graph."""
    message = "; ".join((verdict.state, *verdict.reasons))
    healthy = {"healthy": str(verdict.is_healthy), "state": verdict.state}
    reasons = {f"reason {k}": reason for k, reason in enumerate(verdict.reasons, 1)}
    load = {"lag [s]": f"{facts.lag_s:.3f}", "messages waiting": str(facts.waiting)}
    load |= {"faults in 10 s": str(facts.faults)}
    yield Status(verdict.level, f"{node}: health", message, node, healthy | reasons | load)
    for one in facts.inputs:
        values = {"topic": one.topic, "use": one.use}
        values |= {INPUT_COLUMNS["received"]: str(one.received), INPUT_COLUMNS["used"]: str(one.used)}
        values |= {"came in 10 s": str(one.recent.came), "refused in 10 s": str(one.recent.times)}
        values |= {"silent [s]": f"{one.silent_s:.1f}", "publishers": ", ".join(one.publishers)}
        values |= {"late [s]": f"{one.late_s:.2f}"} if math.isfinite(one.late_s) else {}
        values |= {f"counted: {reason}": str(times) for reason, times in sorted(one.counts.items())}
        is_wrong = one.mismatch or one.is_contested or one.recent.is_bad
        is_absent = not one.received and (one.use == "odometry" or not one.publishers)
        level = WARN if is_wrong or is_absent else OK
        nobody = one.unpublished if is_absent else ""
        message = one.mismatch or nobody or f"{one.received} {INPUT_COLUMNS['received']}"
        yield Status(level, f"{node}: input {one.name}", message, node, values)
    if facts.outcome is not None:
        yield Status(OK if facts.outcome.is_done else WARN, f"{node}: asked", facts.outcome.text, node, {})
    if facts.estimate:
        values = _graph(facts.estimate) | {"path updates sent": str(facts.path_version)}
        yield Status(OK, f"{node}: weak directions", _weakness(facts, facts.estimate), node, facts.weakest)
        if calibration := facts.estimate.calibration:
            found = [name for name in calibration if name.startswith("corrected ")] or ["nothing corrected"]
            found += [f"{OFF}: {calibration[OFF]}"] if OFF in calibration else []
            yield Status(OK, f"{node}: calibration", "; ".join(found), node, dict(calibration))
        if gyro := facts.estimate.gyro:
            yield Status(OK, f"{node}: gyro", gyro, node, {"gyro": gyro})
        condensed = f"; condensed: {facts.estimate.condensed}" if facts.estimate.condensed else ""
        yield Status(OK, f"{node}: graph", f"{facts.estimate.keyframes} keyframes{condensed}", node, values)


def _weakness(facts: Facts, estimate: Estimate) -> str:
    """The weakest directions, and for how long and why the pose is weak, if no landmark is seen for long."""
    weakest, unseen_m = ", ".join(facts.weakest.values()), estimate.unseen.length_m
    uses_landmarks = any(one.use == "landmarks" for one in facts.inputs)
    unseen = (
        f"position and heading weak for {unseen_m:.0f} m: no landmark seen"
        if uses_landmarks and unseen_m >= _UNSEEN_M
        else ""
    )
    return "; ".join(filter(None, (weakest, unseen)))


def _graph(e: Estimate) -> dict[str, str]:
    return {
        "keyframes": str(e.keyframes),
        "landmarks": str(e.landmarks),
        "edges": str(e.edges),
        "segments": str(e.segments),
        "solves": str(e.solves),
        "chi2 per degree of freedom": f"{e.fit:.4g}",
        "last update [ms]": f"{1e3 * e.solve_s:.2f}",
        "slowest update [ms]": f"{1e3 * e.slowest_solve_s:.2f}",
        "last correction [m]": f"{e.correction.distance_m:.4f}",
        "last correction [rad]": f"{e.correction.angle_rad:.4f}",
        "driven since a landmark was seen [m]": f"{e.unseen.length_m:.1f}",
        "newest keyframe [ns]": str(e.stamp_ns),
    }
