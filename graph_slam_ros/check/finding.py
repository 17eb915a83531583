"""A finding of ``graph_slam check``, and the table of all kinds of findings.

docs/check.md says what each row of ``KINDS`` measures. A refusal that is counted is a finding under the name of its
counter; ``measurements/reasons.py`` explains it.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.typing import Index, Mask

Severity: TypeAlias = Literal["error", "warning", "note"]
SomeTopicData = TypeVar("SomeTopicData", bound="TopicData")

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

_DRIVER = "correct the driver (REP 103: metres, radians, x ahead, y to the left, turning left is positive)"
_DENSITY = "correct the driver; until then set odometry.noise=density"
_ONE_CLOCK = "synchronise the clocks (chrony, PTP); set use_sim_time for all nodes or for none"
_ID = "give each landmark an id of its own"
NO_IDS = ("landmarks.association=joint", "landmarks.id_from=none")
_NO_ID = f"{_ID}, or set {', '.join(NO_IDS)}"
_ASSUMED, _MEND_FIRST = "frame_unlinked", "mend what is above first, then check again"
_WHEELS = "choose the topic of the wheels with --odom"

KINDS: dict[str, str] = {
    # -- inputs
    "no_odometry": "record nav_msgs/Odometry, or odom -> base_link on /tf",
    "no_landmarks": "record a topic of landmarks",
    "input_unused": "record it as a type of docs/inputs.md, or name another topic with --odom or --landmarks",
    "damaged": "copy it again, with all of its files, or record it again",
    # -- times
    "wrong_stamps": "correct the driver: header.stamp has seconds, and nanoseconds of the second (0 to 999999999)",
    "clock_domains": f"{_ONE_CLOCK}; or set INPUT.offset_s",
    "latency": f"{_ONE_CLOCK}; or set INPUT.offset_s",
    "clock_jump": f"{_ONE_CLOCK}; cut the recording there",
    "no_overlap": f"{_ONE_CLOCK}; or set INPUT.offset_s",
    "odometry_short": "record odometry from the beginning to the end; find out whether its driver stopped",
    "time_jump": "cut the recording in two; time.on_jump sets what a run does at the step",
    "constant_stamps": "stamp each message when it is measured (header.stamp)",
    "coarse_stamps": "stamp each message when it is measured, to the millisecond",
    "rounded_stamps": "stamp each message when it is measured, to the millisecond",
    "duplicates": "let one node publish the topic (ros2 topic info -v TOPIC), and record it once",
    "two_publishers": "let one node publish the topic (ros2 topic info -v TOPIC)",
    "out_of_order": "set ordering.window_s",
    "gap": "check the CPU and the disk of the recorder, and the driver",
    "slow_odometry": "publish odometry at 10 Hz or more",
    # -- frames
    "frame_unlinked": "publish the transform on /tf_static, or set INPUT.mount",
    "two_parents": "let one node only publish each frame",
    "seen_in_fixed_frame": "publish them in the sensor's frame",
    "odometry_in_map": _WHEELS,
    # -- odometry
    "pose_stands": "have the driver fill in the pose",
    "static": "choose another topic with --odom, or drive",
    "units": _DRIVER,
    "no_orientation_of_odometry": "have the driver fill in the orientation of the pose",
    "odometry_jumps": "correct the driver; a run begins a segment where it is faster than odometry.max_speed_m_s",
    "odometry_reset": "cut the recording there",
    "corrected": _WHEELS,
    "not_planar": "set world.dimensions=3",
    "twist_scale": _DENSITY,
    "twist_frame": _DENSITY,
    "twist_unrelated": _DENSITY,
    "covariance_negative": _DENSITY,
    "covariance_tiny": _DENSITY,
    "covariance_useless": _DENSITY,
    # -- fixes and headings
    "fix_mirrored": "correct its driver (REP 103: east, north, up)",
    "fix_frozen": "have its driver send nothing while it has no fix",
    "fix_jumps": "mend its covariance, or set INPUT.sigma_m; a run leaves out what contradicts",
    "heading_clockwise": "correct its driver (REP 103: counter-clockwise from east)",
    "heading_offset": "correct its driver (0 is east), or where it is mounted",
    # -- a gyro that is used as part of odometry
    "gyro_scale": "correct its driver (rad/s) or transform, or set odometry.turn_factor, INPUT.mount or INPUT.use=none",
    "gyro_bias": "let the robot stand when its gyro starts; or set gyro.bias_sigma",
    "gyro_unrelated": "check its topic, its frame and its clock",
    # -- sightings and odometry
    "mirrored": _DRIVER,
    "axes": "correct the sensor's transform, or its frame",
    "unrelated": "check the topic, the ids and the units of both",
    "id_twice": _ID,
    "noise_zero": "correct the driver; or set INPUT.noise=sigmas with INPUT.sigma_m",
    "seen_once": _NO_ID,
    "no_closure": "record a drive with a loop; where there was one, ids change: let each landmark have its own",
    "no_parallax": "record a drive past landmarks, with turns in sight of them",
    # -- a replay in memory, and a fit that begins at its estimate
    "clock_offset": f"set INPUT.offset_s; {_ONE_CLOCK}",
    "mount_place": "measure it, and correct its transform; or set INPUT.mount_correction",
    "mount_moved": "fix the sensor on the robot, and cut the recording where it moved",
    "mount_yaw": "correct its transform, or set INPUT.mount_correction",
    "odometry_scale": "measure a way, and correct the wheel radius, or the size of the tags",
    "turn_scale": "correct the track width, or set odometry.turn_factor",
    "range_scale": "correct the tags' size, the sensor's driver, or odometry: a measured way tells",
    "not_observable": "drive what the text names",
    "over_confident": (
        "correct its noise: INPUT.noise=sigmas with INPUT.sigma_m; robust.noise_scale=estimated (the default) allows "
        "for 3 times"
    ),
    "odometry_over_confident": "state it (odometry.noise); robust.noise_scale=estimated (the default) allows for it",
    "odometry_slips": "look at ground and tyres there; a run finds slips (odometry.doubt); a gyro helps in turns",
    "id_reused": _ID,
    "ids_unsure": _NO_ID,
    "ids_exchanged": _ID,
    "ids_renewed": _NO_ID,
    "landmark_moves": "let the detector leave out this id; a run believes no sighting of it that contradicts others",
    "landmark_moved": "use landmarks that nobody moves",
    "map_breaks": "find out whether the robot was carried or slipped",
    "outliers": "correct the detector, or set landmarks.loss",
    "fit_unsure": "mend what else is found, or ids and the mount",
    "silent": "record a drive past landmarks all the way",
}
"""What ``check`` finds, beyond counters, and how each is mended, beyond the settings that a finding carries."""

ENDS = {
    *("no_odometry", "wrong_stamps", "no_overlap", "constant_stamps", "coarse_stamps", "seen_in_fixed_frame"),
    *("pose_stands", "static", "units", "no_orientation_of_odometry", "mirrored", "axes", "unrelated", "noise_zero"),
    *("range_scale", "odometry_scale"),
}
"""Findings while which others mean nothing."""

_OF_STAMPS = (
    *("after_odometry", "before_odometry", "late", "odometry_gap", "duplicate_stamp", "other_publisher"),
    *("overflow", "frozen", "jump"),
)
_OF_A_PATH = ("odometry_slips", "landmark_moved", "map_breaks", "id_reused", "ids_unsure", "outliers", "over_confident")
FOLLOWS = {
    **dict.fromkeys(("wrong_stamps", "constant_stamps", "coarse_stamps"), _OF_STAMPS),
    "pose_stands": ("frozen",),
    "frame_empty": ("frame_unknown",),
    "frame_unlinked": ("mount_assumed",),
    "units": ("other_publisher", "odometry_gap", "jump", "late", "twist_scale"),
    "mirrored": ("twist_unrelated", "twist_frame"),
    "id_twice": ("id_conflict",),
    "duplicates": ("other_publisher", "duplicate_stamp"),
    "two_publishers": ("other_publisher", "duplicate_stamp", "duplicates"),
    "seen_once": ("no_closure", "no_parallax", "not_observable"),
    "damaged": ("no_closure", "silent", "gap"),
    "clock_offset": ("latency",),
    **dict.fromkeys(("out_of_order", "time_jump"), ("odometry_jumps", "corrected", "fit_unsure")),
    **dict.fromkeys(("mount_moved", "covariance_tiny"), _OF_A_PATH),
    **dict.fromkeys(("clock_jump", "gyro_scale"), (*_OF_A_PATH, "clock_offset")),
}
"""What is no finding of its own beside an error or a warning."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a recording, or good to know.

    Attributes
    ----------
    code : its name, a row of ``KINDS`` or of ``measurements.reasons.REASONS``
    severity : error: a replay fails or means nothing; warning: it is worse than it could be; note: good to know
    value, limit : what was measured, and from where on it is a finding, in ``unit``
    text : what was measured, in one sentence
    topic, first_ns, count : where: the topic, the first stamp (0: unknown), and how many messages or sightings
    settings : ``KEY=VALUE``, which together mend it; empty where no parameter does
    source : the input of the topic; empty where it is of none
    """

    code: str
    severity: Severity
    value: float
    limit: float
    unit: str
    text: str
    topic: str = ""
    first_ns: int = 0
    count: int = 0
    settings: tuple[str, ...] = ()
    source: str = ""

    @property
    def mend(self) -> str:
        """Return what mends it beyond the settings, with the name of the input; empty where nothing is to be done."""
        return KINDS.get(self.code, "").replace("INPUT", self.source or "the input")

    @property
    def ends(self) -> bool:
        """Return whether other findings mean nothing while it is there."""
        is_doubted = self.severity == "warning" and self.code == "odometry_scale"
        return self.code in ENDS and self.severity != "note" and not is_doubted

    @property
    def forbids_replay(self) -> bool:
        """Return whether a replay is of no use until the cause is corrected: no setting mends it."""
        return self.severity == "error" and not self.settings and (self.ends or self.code not in KINDS)

    def as_dict(self) -> dict[str, Any]:
        """Plain values; a number that JSON has not is null."""
        numbers = {"value": self.value, "limit": self.limit}
        finite = {name: float(x) if math.isfinite(x) else None for name, x in numbers.items()}
        evidence = {"topic": self.topic, "input": self.source, "first_ns": self.first_ns, "count": self.count}
        first = {"code": self.code, "severity": self.severity, **finite, "unit": self.unit}
        return first | {"evidence": evidence, "text": self.text, "settings": list(self.settings)}


class TopicData:
    """Arrays with a row for each message or measurement of a topic; makes the findings on them."""

    __slots__ = ()
    topic: str
    stamp_ns: Index

    def some(self: SomeTopicData, which: Index | Mask) -> SomeTopicData:
        """The same of some of them."""
        rows = {one.name: getattr(self, one.name) for one in fields(self)}  # type: ignore[arg-type]
        arrays = {name: row[which] for name, row in rows.items() if isinstance(row, np.ndarray)}
        return replace(self, **arrays)  # type: ignore[type-var]

    def finding(
        self,
        code: str,
        severity: Severity,
        value: float,
        limit: float,
        unit: str,
        text: str,
        count: int | None = None,
        at: Index | None = None,
        settings: tuple[str, ...] = (),
    ) -> Finding:
        """A finding of the topic, or of so many of its messages, or those at some stamps."""
        stamps_ns = self.stamp_ns if at is None else at
        first_ns, number = int(next(iter(stamps_ns), 0)), len(stamps_ns) if count is None else int(count)
        whole = f"{self.topic or 'odometry'}: {text}"
        return Finding(code, severity, value, limit, unit, whole, self.topic, first_ns, number, settings)


def in_order(findings: list[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes, each in the order found, without what follows from others."""
    hidden = {code for one in findings if one.severity != "note" for code in FOLLOWS.get(one.code, ())}
    return sorted((one for one in findings if one.code not in hidden), key=lambda one: SEVERITIES.index(one.severity))


def with_one_value(findings: list[Finding]) -> list[Finding]:
    """Findings that give each parameter one value: a later one that has another value for it prints no settings.

    A place that is only assumed, as nothing links its frame, gives way to one that was measured.
    """
    values, out = dict[str, tuple[Any, str]](), dict[int, Finding]()
    for k, one in sorted(enumerate(findings), key=lambda pair: pair[1].code == _ASSUMED):
        own = dict(parse_setting(text) for text in one.settings)
        others = [values[key][1] for key, value in own.items() if key in values and values[key][0] != value]
        if others:
            first = f"{others[0]} has the setting" if one.code == _ASSUMED else _MEND_FIRST
            out[k] = replace(one, settings=(), text=f"{one.text} ({first})")
        else:
            values |= {key: (value, one.code) for key, value in own.items()}
            out[k] = one
    return [out[k] for k in range(len(findings))]
