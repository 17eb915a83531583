"""Checks of what the converters refuse: each counter is a finding under its own name."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.columns import Columns
from graph_slam_ros.check.finding import Finding, Severity
from graph_slam_ros.check.times import rounded_s
from graph_slam_ros.measurements.reasons import Effect, explain, remedy

_MOST = 0.5
_USUAL = {  # of single messages: detectors err, and a recording begins and ends somewhere
    *("zero_stamp", "no_id", "late", "before_odometry", "after_odometry", "overhead", "beyond_max_distance"),
    *("no_fix", "no_result", "other_publisher", "future", "far_in_time", "id_conflict", "poor_tag"),
    *("duplicate_stamp", "undecodable", "transform_gaps"),
}
_USUAL_SHARE = 0.05
_JOINT = ("landmarks.association=joint",)
# those that a check of its own explains better
ELSEWHERE = {"frame_unknown", "child_frame_unknown", "odom_frame_unknown", "map_frame_unknown", "no_id", "id_merged"}
_OF_TWIST = ("covariance_not_positive_definite", "nonfinite_covariance")
_OF_ROUNDED = ("other_publisher", "duplicate_stamp")  # of odometry whose stamps are rounded
_OF_COVARIANCE = {*_OF_TWIST, "covariance_asymmetric"}


def check_refusals(c: Columns) -> Iterator[Finding]:
    """Every refusal that a replay would count; of few, where a few are usual, a note."""
    items = {s.input: len(s.stamp_ns) for s in c.sightings}
    for source, counts in c.counters.as_dict().items():
        topic = c.topic_of(source)
        for reason, times in counts.items():
            row = explain(reason)
            is_told = reason in _OF_TWIST or (reason in _OF_ROUNDED and rounded_s(c.odometry) > 0.0)
            is_lost = row.effect is Effect.REFUSED and reason not in ELSEWHERE
            if not (is_lost or reason == "mount_unknown") or (source == c.odometry.input and is_told):
                continue
            received = max(c.counters.received[source], items.get(source, 0) + times, times)
            share = times / received
            limit = _USUAL_SHARE if reason in _USUAL else 0.0
            severity: Severity = "error" if share > _MOST and is_lost else "warning" if share > limit else "note"
            what = f"{source}: {times} of {received}{' are refused' * is_lost}: {row.meaning}"
            text = "; ".join(filter(None, (what, remedy(source, reason))))
            settings = (f"{source}.noise=sigmas",) if reason in _OF_COVARIANCE and source in items else ()
            name, first_ns = (source, 0) if topic is None else (topic.topic, int(next(iter(topic.stamp_ns), 0)))
            yield Finding(reason, severity, share, limit, "part", text, name, first_ns, times, settings)


def check_unnamed(c: Columns) -> Iterator[Finding]:
    """Landmarks without identities, where identities are asked for."""
    for s in c.sightings if c.config.landmarks.association == "id" else ():
        if not len(s.name) or "" not in s.names:
            continue
        unnamed = s.name == s.names.index("")
        share = float(np.mean(unnamed))
        severity: Severity = "error" if share > _MOST else "warning" if share > _USUAL_SHARE else "note"
        text = f"{share:.1%} of the sightings have no id, and are not used"
        of_unnamed = s.some(unnamed)
        yield of_unnamed.finding("no_id", severity, share, _USUAL_SHARE, "part", text, settings=_JOINT)
