"""All checks of a recording, in order: a finding of an early check can make the later ones meaningless."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from graph_slam_ros.check.columns import MOST, Columns
from graph_slam_ros.check.contradictions import check_contradictions
from graph_slam_ros.check.fixes import check_fixes
from graph_slam_ros.check.frames import check_frames
from graph_slam_ros.check.gyro import check_gyro
from graph_slam_ros.check.odometry import check_odometry, check_publishers, of_one_publisher
from graph_slam_ros.check.times import check_times, rounded_s
from graph_slam_ros.findings.finding import Finding, Severity, in_order
from graph_slam_ros.findings.table import Effect, explain

_USUAL = {  # of single messages: detectors err, and a recording begins and ends somewhere
    *("zero_stamp", "no_id", "late", "before_odometry", "after_odometry", "overhead", "beyond_max_distance"),
    *("no_fix", "no_result", "other_publisher", "future", "far_in_time", "id_conflict", "poor_tag"),
    *("duplicate_stamp", "undecodable", "transform_gaps"),
}
_USUAL_SHARE = 0.05  # of the messages
_JOINT = ("landmarks.association=joint",)
# those that a check of its own explains better
ELSEWHERE = {"frame_unknown", "child_frame_unknown", "odom_frame_unknown", "map_frame_unknown", "no_id", "id_merged"}
_OF_ROUNDED = ("other_publisher", "duplicate_stamp")  # of odometry whose stamps are rounded
_OF_COVARIANCE = ("covariance_not_positive_definite", "nonfinite_covariance", "covariance_asymmetric")
Check = Callable[[Columns], Iterator[Finding]]


def check_refusals(c: Columns) -> Iterator[Finding]:
    """Every refusal that a replay would count; of few, where a few are usual, a note."""
    items = {s.input: len(s.stamp_ns) for s in c.sightings}
    for source, counts in c.counters.as_dict().items():
        topic = c.topic_of(source)
        for reason, times in counts.items():
            row = explain(reason)
            is_odometry = source == c.odometry.input
            is_told = is_odometry and reason in _OF_ROUNDED and rounded_s(c.odometry) > 0.0
            is_lost = row.effect is Effect.REFUSED and reason not in ELSEWHERE
            if not (is_lost or reason == "mount_unknown") or is_told:
                continue
            received = max(c.counters.received[source], items.get(source, 0) + times, times)
            share = times / received
            limit = _USUAL_SHARE if reason in _USUAL else 0.0
            severity: Severity = "error" if share > MOST and is_lost else "warning" if share > limit else "note"
            text = f"{source}: {times} of {received}{' are refused' * is_lost}: {row.meaning}"
            stated = "odometry.noise=density" if is_odometry else f"{source}.noise=sigmas"
            settings = (stated,) if reason in _OF_COVARIANCE and (is_odometry or source in items) else ()
            name, first_ns = (source, 0) if topic is None else (topic.topic, int(next(iter(topic.stamp_ns), 0)))
            yield Finding(reason, severity, share, limit, "part", text, name, first_ns, times, settings, source)


def check_unnamed(c: Columns) -> Iterator[Finding]:
    """Landmarks without identities, where identities are asked for."""
    for s in c.sightings if c.config.landmarks.association == "id" else ():
        if not len(s.name) or "" not in s.names:
            continue
        unnamed = s.name == s.names.index("")
        share = float(np.mean(unnamed))
        severity: Severity = "error" if share > MOST else "warning" if share > _USUAL_SHARE else "note"
        text = f"{share:.1%} of the sightings have no id, and are not used"
        of_unnamed = s.some(unnamed)
        yield of_unnamed.finding("no_id", severity, share, _USUAL_SHARE, "part", text, settings=_JOINT)


CHECKS: tuple[Check, ...] = (
    check_refusals,
    check_times,
    check_frames,
    check_odometry,
    check_fixes,
    check_gyro,
    check_unnamed,
    check_contradictions,
)
"""They need no fit: milliseconds for each minute of a recording."""

OF_A_REPLAY: tuple[Check, ...] = (check_times, check_frames, check_odometry, check_fixes, check_contradictions)
"""Those that a replay does by itself; its own table has the refusals."""

_FROM_THE_BEGINNING = ("units", "mirrored", "axes", "unrelated")  # what is read later does not make it right
_IN_OUTCOME = ("out_of_plane", "no_landmarks")
_OF_POSE = ("no_orientation_of_odometry", "pose_stands")
_WHILE_DRIVING = (*_FROM_THE_BEGINNING, "clock_domains", "constant_stamps", *_OF_POSE, "noise_zero")
_OF_TWIST = ("twist_scale", "twist_frame", "twist_unrelated", "covariance_tiny", "covariance_useless")
_ONCE_IT_MOVES = (*_OF_TWIST, "slow_odometry")
_LATEST_S = 60.0  # that a message comes by a slow detector, and not by a clock that differs
_MANY_IDS_M = 20.0  # before that, a landmark may be seen for the first time just now
_LEAST_WAY_M = 10.0  # before that, the speed of a robot that begins to drive says nothing of its twist


def check_columns(c: Columns, checks: tuple[Check, ...] = CHECKS) -> list[Finding]:
    """Findings of all checks, the most severe first; one that makes others meaningless ends it. It never fails."""
    found: list[Finding] = []
    with np.errstate(all="ignore"):
        whole, c = c, of_one_publisher(c)
        found += check_publishers(whole) if whole is not c else []
        told = explain("two_publishers").hides if found else ()
        if codes := {one.code for one in refused_odometry(c)}.difference(told):  # all follows, and this may from units
            found += [one for one in check_odometry(c) if one.code == "units" and codes == {"other_publisher"}]
            checks = tuple(check for check in checks if check is check_refusals and not found)
        for check in checks:
            found += check(c)
            if any(one.ends for one in found):
                break
        else:
            others = (one for one in c.topics.values() if one.use != "odometry")
            if not any(len(one.stamp_ns) for one in (*others, *c.sightings)):  # tags on /tf have no header
                text = "the recording has no landmark, fix or closure that is used: a replay would be odometry alone"
                found.append(Finding("no_landmarks", "warning", 0, 1, "topics", text, c.odometry.topic))
    return in_order(with_inputs(c, found))


def with_inputs(c: Columns, found: Iterable[Finding]) -> list[Finding]:
    """Findings with the name of the input that their topic is of."""
    inputs = {name: topic.inputs[0] for name, topic in c.topics.items() if topic.inputs}
    return [replace(one, source=one.source or inputs.get(one.topic, "")) for one in found]


def refused_odometry(c: Columns) -> list[Finding]:
    """Findings that most messages of odometry were refused: all other findings may follow from these."""
    return [one for one in check_refusals(c) if one.forbids_replay and one.topic == c.odometry.topic]


def worst_of_replay(c: Columns, *, is_damaged: bool = False) -> Finding | None:
    """The worst error or warning beyond what the end of a replay says anyway; None where there is none."""
    known = (*_IN_OUTCOME, *(explain("damaged").hides if is_damaged else ()))
    return next((f for f in check_columns(c, OF_A_REPLAY) if f.severity != "note" and f.code not in known), None)


def first_of_replay(c: Columns, *, is_whole: bool) -> Finding | None:
    """The worst error that makes the result meaningless, as far as the recording was read; None where there is none.

    Nor is there one without odometry: then there will be no result.
    """
    if not len(c.path_ns):
        return None
    errors = [one for one in check_columns(c, OF_A_REPLAY) if one.severity == "error" and one.code not in _IN_OUTCOME]
    return next((one for one in errors if is_whole or one.code in _FROM_THE_BEGINNING), None)


def worst_while_driving(c: Columns) -> list[Finding]:
    """Return what is wrong with the inputs of a robot that drives, by its last minutes.

    It is the worst error that makes the result meaningless; without one, it is what is wrong with odometry's twist
    or rate, and ids that are those of tracks.
    """
    found = check_columns(of_one_publisher(c, is_live=True), OF_A_REPLAY)
    errors = [one for one in found if one.severity == "error" and one.code in _WHILE_DRIVING]
    others = [one for one in errors if one.code == "clock_domains" and one.topic != c.odometry.topic]
    late = [one for one in others if -_LATEST_S < one.value < 0.0]  # its clock may be right, and its messages come late
    if errors := [one for one in errors if one not in late]:
        return errors[:1]
    way_m = float(np.linalg.norm(np.diff(c.path[:, :3], axis=0), axis=1).sum())
    codes = (*_ONCE_IT_MOVES, *(["seen_once"] if way_m > _MANY_IDS_M else []))
    return [one for one in found if one.severity != "note" and one.code in codes] if way_m > _LEAST_WAY_M else []
