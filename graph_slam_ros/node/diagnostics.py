"""The state of the node: one verdict with its reasons, judged from facts.

The lifecycle gives UNCONFIGURED, INACTIVE and FINALIZED. An active node is WAITING if something is missing, OK,
DEGRADED if the estimate goes on but is worse than it could be, or ERROR if somebody must act.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

from graph_slam_ros.check.odometry import leaves_plane
from graph_slam_ros.config.config import Config
from graph_slam_ros.findings.finding import Finding, Severity, causes
from graph_slam_ros.findings.table import DOUBTS, explain
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES
from graph_slam_ros.messages.to_msg import ERROR, OK, WARN, Status
from graph_slam_ros.node.estimate import OFF, Estimate
from graph_slam_ros.runs.outcome import MOTION
from graph_slam_ros.runs.tables import INPUT_COLUMNS

_LEVELS = {"WAITING": WARN, "DEGRADED": WARN, "ERROR": ERROR}  # the others are as somebody wants them
_UNSEEN_M, _UNSEEN_S, _NEVER_SEEN = 10.0, 10.0, 3.0
_LONGEST = 80  # of a frame's name
_LATE_S, _PLAYED_S = 0.3, 10.0  # later still, a recording is played without /clock
_NEARLY = 0.5  # of the lateness from which on an observation is refused
STATES: tuple[tuple[Severity, str], ...] = (
    ("error", "ERROR"),
    ("note", "WAITING"),
    ("warning", "DEGRADED"),
)  # by severity, the worst first
_AT_START = ("not_compiled", "not_loaded", "preparing")
_UNLINKED = ("frame_unknown", "child_frame_unknown", "odom_frame_unknown", "map_frame_unknown")
WINDOW_S = 10.0
_SHARE, _LEAST = 0.1, 3  # of what came, and how much at least


@dataclass(frozen=True, slots=True)
class Recent:
    """The counts of one input in the last ten seconds; of a message that holds several things, each counts."""

    came: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)  # by reason, by the border and by the pipeline
    goes_on: bool = False  # something was refused in the last three seconds, or nothing came then

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
    """The facts of one input."""

    name: str
    topic: str
    use: str
    received: int = 0  # messages
    used: int = 0  # of what they hold, what the estimate has used
    counts: Mapping[str, int] = field(default_factory=dict)  # since the start, by reason
    silent_s: float = math.inf  # since the last message, by the clock of the node
    publishers: tuple[str, ...] = ()  # names of their nodes
    is_contested: bool = False  # several publish what is of one: an odometry
    mismatch: str = ""  # what keeps publisher and subscription from connecting, in words
    frames: tuple[tuple[str, str], ...] = ()  # the last that nothing links to the robot, each with the robot's
    recent: Recent = field(default_factory=Recent)
    not_found: str = ""  # of odometry on /tf, the transform that has never come, and what mends that
    alternatives: tuple[str, ...] = ()  # where nobody publishes it, other topics, with the parameters that choose them
    late_s: float = math.inf  # the least time from a stamp to its arrival, of the last messages

    @property
    def unpublished(self) -> Finding | None:
        """Return that nobody publishes it, and what could be used instead; None if somebody does."""
        other = "; ".join(self.alternatives) or None
        return None if self.publishers else Finding("unpublished", "note", topic=self.topic, remedy=other)


@dataclass(frozen=True, slots=True)
class Facts:
    """What the state of the node is judged from."""

    lifecycle: str  # its state; all else counts while it is active
    inputs: tuple[InputFacts, ...] = ()
    estimate: Estimate | None = None
    weakest: Mapping[str, str] = field(default_factory=dict)  # directions of the newest pose and of landmarks, in words
    of_node: tuple[Finding, ...] = ()  # errors, what it waits for (notes), and what makes the estimate worse
    of_inputs: tuple[Finding, ...] = ()  # of the check of what they measure
    outcome: Status | None = None  # of the last ~/remove or initialpose
    path_version: int = 0
    lag_s: float = 0.0
    waiting: int = 0  # messages
    faults: int = 0  # exceptions of callbacks in the last ten seconds


@dataclass(frozen=True, slots=True)
class Health:
    """The state and why it is so, the most important first."""

    state: str
    found: tuple[Finding, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """One sentence of each finding, without the option of the commands, which a node does not have."""
        return tuple(str(one).replace("--set ", "") for one in self.found)

    @property
    def text(self) -> str:
        """The state and the reasons in one line."""
        return "; ".join((self.state, *self.reasons))

    @property
    def level(self) -> int:
        """The level of a DiagnosticStatus."""
        return _LEVELS.get(self.state, OK)


def judge(facts: Facts, config: Config) -> Health:
    """The verdict."""
    if facts.lifecycle != "active":
        why = [one for one in facts.of_node if one.code in _AT_START]
        why += [Finding(facts.lifecycle, "note")] if facts.lifecycle in ("unconfigured", "inactive") else []
        return Health(facts.lifecycle.upper(), tuple(why[:1]))
    found = {state: [one for one in facts.of_node if one.severity == severity] for severity, state in STATES}
    found["WAITING"] += _missing(facts)
    found["DEGRADED"] += _faults(facts, config)
    state = next(filter(found.get, found), "OK")
    return Health(state, tuple(found.get(state, ())))


def _missing(facts: Facts) -> Iterator[Finding]:
    """Why there is no estimate yet. Landmarks are among them only if something is wrong with them."""
    if facts.estimate is None and not any(one.code == "loading" for one in facts.of_node):
        for one in facts.inputs:
            yield from _silence(one, facts.of_inputs) if one.use == "odometry" else ()
        if not facts.inputs:
            yield Finding("no_input", "note")


def _silence(one: InputFacts, of_inputs: Sequence[Finding]) -> Iterator[Finding]:
    note = partial(Finding, severity="note", topic=one.topic, source=one.name)
    if one.mismatch:
        yield note("unconnected", text=one.mismatch)
    elif one.unpublished:
        yield one.unpublished
    elif not one.received:
        yield note("nothing_came", text=", ".join(one.publishers))
    elif one.recent.times:
        yield _refused(one)
    elif one.not_found:
        yield note("unconnected", text=one.not_found, remedy="")
    elif of_inputs:
        yield from of_inputs
    else:
        yield note("its_turn")


def _refused(one: InputFacts) -> Finding:
    """The fraction of an input that was refused lately, with the most frequent reason and its remedy."""
    recent, mend = one.recent, None
    meaning = explain(recent.worst).meaning
    if recent.worst in _UNLINKED and one.frames:
        meaning = "no transform links " + ", ".join(f"{frame[:_LONGEST]} to {robots}" for frame, robots in one.frames)
    if recent.worst == "odom_frame_unknown" and any(frame in MAP_FRAMES for frame, _ in one.frames):
        meaning = "odometry is given in the frame of a map, so it is the output of a localiser"
        mend = f"{one.name}.topic:=TOPIC, that of the wheels"
    much = "all" if recent.is_nothing_used else f"{recent.times} of {recent.came}"
    text = f"{one.topic}: {much} refused in {WINDOW_S:.0f} s ({recent.worst}): {meaning}"
    return Finding(recent.worst, "warning", text=text, topic=one.topic, source=one.name, remedy=mend)


def _faults(facts: Facts, config: Config) -> Iterator[Finding]:
    health, tf, estimate = config.health, config.tf, facts.estimate
    odometry_s = min((one.late_s for one in facts.inputs if one.use == "odometry"), default=math.nan)
    for one in facts.inputs:
        warning = partial(Finding, severity="warning", topic=one.topic, source=one.name)
        if one.is_contested:
            text = f"{one.topic}: {' and '.join(one.publishers)} publish it, and one of them is used"
            yield warning("two_publishers", text=text)
        most_s = health.odometry_silent_s if one.use == "odometry" else health.landmarks_silent_s
        is_silent = one.received and most_s and one.silent_s > most_s
        if one.mismatch:
            yield warning("unconnected", text=one.mismatch)
        elif is_silent and one.not_found:
            yield warning("unconnected", text=one.not_found, remedy="")
        elif is_silent:
            yield warning("input_silent", value=one.silent_s)
        elif one.recent.is_bad and not (one.is_contested and one.recent.worst == "other_publisher"):
            yield _refused(one)
        if one.use == "odometry":
            follows = tf.publish_tf and tf.stamp == "odometry"
            if follows and max(_LATE_S, tf.transform_tolerance) < one.late_s < _PLAYED_S:
                yield warning("comes_late", value=one.late_s, limit=math.ceil(10.0 * one.late_s + 1.0) / 10.0)
        elif one.use not in MOTION:
            later_s, most_s = one.late_s - odometry_s, config.ordering.late_s
            if _NEARLY * most_s < later_s < most_s:
                yield warning("nearly_late", value=later_s, limit=2.0 * most_s)
    yield from _uncorrected(facts)
    if estimate and (since := "the restart" if estimate.is_resumed else "it jumped" if estimate.is_lost else ""):
        yield Finding("by_odometry_alone", "warning", text=since)
    elif estimate and not estimate.is_confirmed:
        yield Finding("unlocated", "warning")
    if estimate:
        yield from causes(_of_measurements(facts, estimate, health.chi2_per_dof))


def _of_measurements(facts: Facts, e: Estimate, chi2_per_dof: float) -> Iterator[Finding]:
    """Yield what is wrong with what is measured; nothing that may follow from an input that is mostly refused."""
    planes = [leaves_plane(one.name, one.counts, one.received) for one in facts.inputs if one.use in MOTION]
    found = [*facts.of_inputs, *chain(*planes), *e.findings, *e.doubted]
    if chi2_per_dof and e.fit > chi2_per_dof:
        text = f"the measurements contradict each other: chi2 per degree of freedom is {e.fit:.1f}"
        found.append(Finding("contradictory", "error", text=text, remedy=""))
    is_explained = any(2 * one.recent.times > one.recent.came for one in facts.inputs)
    yield from (one for one in found if not (is_explained and one.code in (*DOUBTS, "confused")))


def _uncorrected(facts: Facts) -> Iterator[Finding]:
    """Yield why each input is not used, once the robot has driven for a while and nothing corrects odometry."""
    others = [one for one in facts.inputs if one.use not in MOTION]
    if facts.estimate is None or any(one.used for one in others):
        return
    way, why = facts.estimate.unseen, list[object]()
    if way.length_m >= _UNSEEN_M and facts.estimate.stamp_ns - way.since_ns >= _UNSEEN_S * 1e9:
        why += [one.unpublished for one in others if one.unpublished]
    if way.length_m >= _NEVER_SEEN * _UNSEEN_M and not facts.of_inputs:
        for one in (one for one in others if one.publishers):
            came = f"{one.topic}: {one.received} messages came, and nothing in them was used"
            why.append(came if one.received else next(_silence(one, ())))
    yield from (Finding("odometry_alone", "warning", text=f"nothing corrects odometry: {x}", remedy="") for x in why)


def statuses(facts: Facts, verdict: Health, node: str) -> Iterator[Status]:
    """Yield the statuses of /diagnostics: the verdict, each input, and the graph."""
    status = partial(Status, hardware_id=node)
    values = {"healthy": str(verdict.state == "OK"), "state": verdict.state}
    values |= {f"reason {k}": reason for k, reason in enumerate(verdict.reasons, 1)}
    values |= {"lag [s]": f"{facts.lag_s:.3f}", "messages waiting": str(facts.waiting)}
    values |= {"faults in 10 s": str(facts.faults)}
    yield status(verdict.level, f"{node}: health", verdict.text, values=values)
    for one in facts.inputs:
        yield _input_status(one, node)
    if facts.outcome is not None:
        yield status(facts.outcome.level, f"{node}: asked", facts.outcome.message)
    if (e := facts.estimate) is None:
        return
    yield status(OK, f"{node}: weak directions", _weakness(facts, e), values=facts.weakest)
    if e.calibration:
        found = [name for name in e.calibration if name.startswith("corrected ")] or ["nothing corrected"]
        found += [f"{OFF}: {e.calibration[OFF]}"] if OFF in e.calibration else []
        yield status(OK, f"{node}: calibration", "; ".join(found), values=dict(e.calibration))
    if e.gyro:
        yield status(OK, f"{node}: gyro", e.gyro, values={"gyro": e.gyro})
    condensed = f"; condensed: {e.condensed}" if e.condensed else ""
    values = _graph(e) | {"path updates sent": str(facts.path_version)}
    yield status(OK, f"{node}: graph", f"{e.keyframes} keyframes{condensed}", values=values)


def _input_status(one: InputFacts, node: str) -> Status:
    values = {"topic": one.topic, "use": one.use}
    values |= {INPUT_COLUMNS["received"]: str(one.received), INPUT_COLUMNS["used"]: str(one.used)}
    values |= {"came in 10 s": str(one.recent.came), "refused in 10 s": str(one.recent.times)}
    values |= {"silent [s]": f"{one.silent_s:.1f}", "publishers": ", ".join(one.publishers)}
    values |= {"late [s]": f"{one.late_s:.2f}"} if math.isfinite(one.late_s) else {}
    values |= {f"counted: {reason}": str(times) for reason, times in sorted(one.counts.items())}
    is_wrong = one.mismatch or one.is_contested or one.recent.is_bad
    is_absent = not one.received and (one.use == "odometry" or not one.publishers)
    nobody = str(one.unpublished) if is_absent and one.unpublished else ""
    message = one.mismatch or nobody or f"{one.received} {INPUT_COLUMNS['received']}"
    return Status(WARN if is_wrong or is_absent else OK, f"{node}: input {one.name}", message, node, values)


def _weakness(facts: Facts, estimate: Estimate) -> str:
    """The weakest directions, and for how long the pose is weak, if no landmark is seen for long."""
    text, unseen_m = ", ".join(facts.weakest.values()), estimate.unseen.length_m
    if unseen_m >= _UNSEEN_M and any(one.use == "landmarks" for one in facts.inputs):
        text = f"{text}; position and heading weak for {unseen_m:.0f} m: no landmark seen"
    return text


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
