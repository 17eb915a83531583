"""Messages of ``~/events``: one status for each event, with its numbers as values."""

from collections.abc import Iterator

from graph_slam_ros.messages.to_msg import OK, WARN, Status
from graph_slam_ros.slam import MapView, Update
from graph_slam_ros.slam.doubt.record import ELSEWHERE, Doubt
from graph_slam_ros.slam.robust.ledger import Verdict, VerdictChange

_EDGES = 1000  # of one update that are moved one by one


def happened(what: str, message: str, level: int = OK, **values: object) -> Status:
    """An event that no update caused: a reset, a jump of the clock, a second broadcaster."""
    return Status(level, f"graph_slam: {what}", message, "", {name: str(value) for name, value in values.items()})


def of_update(view: MapView, update: Update) -> Iterator[Status]:
    """New vertices, edges and segments, changed verdicts, and the correction if there was one."""
    graph = view.graph
    for k in update.keyframes:
        keyframe = view.keyframes[k]
        values = {"vertex": keyframe.vertex, "stamp_ns": keyframe.stamp_ns}
        yield happened("vertex", f"keyframe {k}", **values)
        if k and k in view.segments:
            yield happened("segment", f"a new segment begins at keyframe {k}", WARN, **values)
    for edge in list(update.edges)[:_EDGES]:
        one = graph.edge(edge)
        label, vertices = one.label, list(one.vertices)
        what, verdict = "closure" if label == "closures" else "edge", view.ledger.verdict_of(edge).name.lower()
        yield happened(
            what, f"edge {edge}: {label} of {vertices}", edge=edge, label=label, vertices=vertices, verdict=verdict
        )
    for change in update.changes[:_EDGES]:
        yield _verdict(view, change)
    for found in update.calibrated:
        value, sigma, source = f"{found.value:.6g}", f"{found.sigma:.3g}", found.parameter.source
        yield happened("calibration", f"corrected {found.text}", value=value, sigma=sigma, source=source)
    for alarm in update.alarms:
        yield _alarm(alarm)
    if update.solved and update.correction.distance_m + update.correction.angle_rad > 0.0:
        yield correction(view, update)


def _verdict(view: MapView, change: VerdictChange) -> Status:
    verdict, reason = change.verdict.name.lower(), change.reason.name.lower()
    why = f": {reason.replace('_', ' ')}" if change.reason else ""
    edge = change.edge
    return happened(
        "verdict",
        f"edge {edge} ({name_of(view, change.edge)}) {verdict.replace('_', ' ')}{why},"
        f" chi2 {change.statistic:.3g} against {change.threshold:.3g}",
        OK if change.verdict is Verdict.ACCEPTED else WARN,
        edge=edge,
        keyframe=change.keyframe,
        verdict=verdict,
        reason=reason,
        statistic=f"{change.statistic:.6g}",
        threshold=f"{change.threshold:.6g}",
    )


def _alarm(alarm: Doubt) -> Status:
    """An alarm that began, was decided or ended."""
    values: dict[str, object] = {"began_ns": alarm.began_ns, "evidence": alarm.evidence}
    what = "displaced" if alarm.kind == ELSEWHERE else "slip"
    if alarm.segment is not None:
        values |= {"segment": alarm.segment, "distance_m": f"{alarm.distance_m:.6f}"}
        values |= {"angle_rad": f"{alarm.angle_rad:.6f}"}
    if alarm.ended_ns is None:
        return happened(what, str(alarm), WARN, **values)
    agree = "the landmarks and odometry agree again"
    return happened(what, f"{agree}: {alarm}", OK, **values, ended_ns=alarm.ended_ns)


def correction(view: MapView, update: Update, level: int = OK) -> Status:
    """The motion of the robot in the map that a solve caused, and the edges that caused it."""
    moved = update.correction
    causes = [
        f"{e} ({name_of(view, e)}, {fit:.1f})" for e, fit in zip(moved.edges, moved.chi2, strict=True) if fit > 1.0
    ]
    return happened(
        "correction",
        f"map -> odom moved the robot by {moved.distance_m:.3f} m, {moved.angle_rad:.3f} rad"
        + (f"; caused by edges {', '.join(causes)}" if causes else ""),
        level,
        distance_m=f"{moved.distance_m:.6f}",
        angle_rad=f"{moved.angle_rad:.6f}",
        edges=" ".join(map(str, moved.edges)),
        chi2_per_dof=" ".join(f"{fit:.3g}" for fit in moved.chi2),
    )


def name_of(view: MapView, edge: int) -> str:
    """The class of an edge, and the name of its landmark."""
    one = view.graph.edge(edge)
    of = next((name for name, mark in view.landmarks.items() if mark.vertex in one.vertices), "")
    return f"{one.label} {of}".strip()
