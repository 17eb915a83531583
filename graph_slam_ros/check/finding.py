"""A finding of ``graph_slam check``, and the table of all kinds of findings.

docs/check.md explains each row of ``KINDS``. A refusal that is counted is a finding under the name of its counter;
``measurements/reasons.py`` explains it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.typing import Index

Severity: TypeAlias = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True, slots=True)
class Kind:
    """One row of the table.

    Attributes
    ----------
    meaning : what was measured, in one sentence without a full stop
    mend : how it is mended, beyond the settings that a finding carries; empty where nothing is to be done
    ends : whether other findings mean nothing while it is there
    """

    meaning: str
    mend: str
    ends: bool = False


_DRIVER = "correct the driver (REP 103: metres, radians, x ahead, y to the left, turning left is positive)"
_DENSITY = "correct the driver; until then set odometry.noise=density"
_MOUNT = "publish the transform on /tf_static, or set INPUT.mount"
_ONE_CLOCK = "synchronise the clocks (chrony, PTP); set use_sim_time for all nodes or for none"
_PUBLISHER = "let one node only publish each frame"
_ID = "give each landmark an id of its own"
_ASSUMED, _MEND_FIRST = "frame_unlinked", "mend what is above first, then check again"
_WHEELS = "choose the topic of the wheels with --odom"

KINDS: dict[str, Kind] = {
    # -- inputs
    "no_odometry": Kind(
        "the recording has no odometry that can be used", "record nav_msgs/Odometry, or odom -> base_link on /tf", True
    ),
    "no_landmarks": Kind(
        "the recording has no landmark, fix or closure, so nothing corrects odometry", "record a topic of landmarks"
    ),
    "input_unused": Kind(
        "a topic of landmarks or odometry cannot be used",
        "record it as a type of docs/inputs.md, or name another topic with --odom or --landmarks",
    ),
    "damaged": Kind("a part of the recording cannot be read", "try ros2 bag reindex, or record it again"),
    # -- times
    "wrong_stamps": Kind(
        "the stamps of an input do not advance as its messages were recorded",
        "correct the driver: header.stamp has the seconds, and the nanoseconds of the second (0 to 999999999)",
        True,
    ),
    "clock_domains": Kind("two inputs are stamped by different clocks", f"{_ONE_CLOCK}; or set INPUT.offset_s"),
    "latency": Kind("messages were recorded before the time in their stamps", f"{_ONE_CLOCK}; or set INPUT.offset_s"),
    "clock_jump": Kind(
        "the stamps of an input step, and stay there: its clock was set, or its messages came later from then on",
        f"{_ONE_CLOCK}; cut the recording there",
    ),
    "no_overlap": Kind(
        "sightings are stamped before odometry begins or after it ends", f"{_ONE_CLOCK}; or set INPUT.offset_s", True
    ),
    "odometry_short": Kind(
        "sightings were recorded before odometry began or after it ended, and these are not used",
        "record odometry from the beginning to the end; find out whether its driver stopped",
    ),
    "time_jump": Kind(
        "stamps step back by more than a second: the clock was set, or two recordings were joined",
        "cut the recording in two; time.on_jump sets what a run does at the step",
    ),
    "constant_stamps": Kind(
        "all messages of an input have one stamp", "stamp each message when it is measured (header.stamp)", True
    ),
    "coarse_stamps": Kind(
        "the stamps of odometry are rounded so much that most messages have the stamp of the one before",
        "stamp each message when it is measured, to the millisecond",
        True,
    ),
    "rounded_stamps": Kind(
        "the stamps of odometry are rounded, and the first message of each stamp is used",
        "stamp each message when it is measured, to the millisecond",
    ),
    "duplicates": Kind(
        "messages have the stamp of the message before",
        "let one node publish the topic (ros2 topic info -v TOPIC), and record it once",
    ),
    "out_of_order": Kind(
        "messages are older than the one before, by more than the window that sorts them", "set ordering.window_s"
    ),
    "gap": Kind("odometry is silent for a while", "check the CPU and the disk of the recorder, and the driver"),
    "slow_odometry": Kind(
        "odometry is so slow that the pose at a sighting is interpolated over a long time",
        "publish odometry at 10 Hz or more",
    ),
    # -- frames
    "frame_unlinked": Kind("no transform links a sensor's frame to the robot", _MOUNT),
    "two_parents": Kind("a frame has two parents, so transforms through it are arbitrary", _PUBLISHER),
    "seen_in_fixed_frame": Kind(
        "sightings are given in a frame that does not move with the robot", "publish them in the sensor's frame", True
    ),
    "odometry_in_map": Kind("odometry is given in the frame of a map, so it is the output of a localiser", _WHEELS),
    # -- odometry
    "pose_stands": Kind(
        "the pose of odometry stays where it is, though its twist says that the robot moves",
        "have the driver fill in the pose",
        True,
    ),
    "static": Kind("the robot does not move", "choose another topic with --odom, or drive", True),
    "units": Kind("distances or speeds are larger than any robot's", _DRIVER, True),
    "no_orientation_of_odometry": Kind(
        "the orientation of odometry never changes, and the robot drives round bends, not sideways",
        "have the driver fill in the orientation of the pose",
        True,
    ),
    "odometry_jumps": Kind(
        "odometry jumps",
        "correct the driver; a run begins a segment where it is faster than odometry.max_speed_m_s, and with that set "
        "nothing is said",
    ),
    "odometry_reset": Kind("odometry goes back to zero: its driver was restarted", "cut the recording there"),
    "corrected": Kind("odometry jumps again and again, as the output of a localiser does", _WHEELS),
    "not_planar": Kind("the robot leaves the plane", "set world.dimensions=3"),
    "twist_scale": Kind("the twist has other units than the pose, or the opposite sign", _DENSITY),
    "twist_frame": Kind("the twist is given along the axes of the odometry frame, not of the robot", _DENSITY),
    "twist_unrelated": Kind("the twist does not describe the motion of the pose", _DENSITY),
    "covariance_negative": Kind("a variance of the twist is negative or not a number", _DENSITY),
    "covariance_tiny": Kind("the covariance of the twist is smaller than any wheels can be", _DENSITY),
    "covariance_useless": Kind("the standard deviation of the twist is larger than the speed", _DENSITY),
    # -- fixes and headings
    "fix_mirrored": Kind(
        "the axes of fixes are exchanged or mirrored", "correct its driver (REP 103: east, north, up)"
    ),
    "fix_frozen": Kind("a fix stands still while the robot drives", "have its driver send nothing while it has no fix"),
    "fix_jumps": Kind("a fix jumps", "mend its covariance, or set INPUT.sigma_m; a run leaves out what contradicts"),
    "heading_clockwise": Kind(
        "a heading counts clockwise", "correct its driver (REP 103: counter-clockwise from east)"
    ),
    "heading_offset": Kind("a heading is off the course", "correct its driver (0 is east), or where it is mounted"),
    # -- a gyro that is used as part of odometry
    "gyro_scale": Kind(
        "the gyro turns more or less than odometry, or the other way",
        "correct its driver (rad/s), or its transform; or set odometry.turn_factor, INPUT.mount or INPUT.use=none",
    ),
    "gyro_bias": Kind(
        "the gyro turns where odometry does not, by more than its bias may be",
        "let the robot stand when its gyro starts; or set gyro.bias_sigma",
    ),
    "gyro_unrelated": Kind("the gyro's turns are not those of odometry", "check its topic, its frame and its clock"),
    # -- sightings and odometry
    "mirrored": Kind("sightings and odometry turn in opposite directions", _DRIVER, True),
    "axes": Kind(
        "sightings agree with odometry only in other axes", "correct the sensor's transform, or its frame", True
    ),
    "unrelated": Kind(
        "sightings do not agree with odometry at all", "check the topic, the ids and the units of both", True
    ),
    "id_twice": Kind("one message has the same id twice", _ID),
    "noise_zero": Kind(
        "the covariance of sightings is nearly zero: no sensor is so exact",
        "correct the driver; or set INPUT.noise=sigmas with INPUT.sigma_m",
        True,
    ),
    "seen_once": Kind(
        "most ids are seen less than three times: are they numbers of tracks, not of landmarks?",
        "let the detector give each landmark its own id; without ids set landmarks.association=joint",
    ),
    "no_closure": Kind(
        "no landmark is seen again later in the drive, or hardly one over more than a tenth of it",
        "record a drive with a loop; where there was one, ids change: let the detector give each landmark its own",
    ),
    "no_parallax": Kind(
        "landmarks are not seen again after the robot has moved, so neither mount nor clock can be checked",
        "record a drive past landmarks, with turns in sight of them",
    ),
    # -- a replay in memory, and a fit that begins at its estimate
    "clock_offset": Kind("sightings agree with odometry better at other stamps", f"set INPUT.offset_s; {_ONE_CLOCK}"),
    "mount_place": Kind(
        "the sensor is at another place on the robot",
        "measure it, and correct its transform; or set INPUT.mount_correction",
    ),
    "mount_yaw": Kind("the sensor is turned on the robot", "correct its transform, or set INPUT.mount_correction"),
    "odometry_scale": Kind(
        "the robot drives more or less than odometry says", "correct the wheel radius, or set odometry.distance_factor"
    ),
    "turn_scale": Kind(
        "the robot turns more or less than odometry says", "correct the track width, or set odometry.turn_factor"
    ),
    "range_scale": Kind(
        "ranges are longer or shorter than odometry says",
        "correct the size of the tags, or the sensor's driver, or set INPUT.range_factor",
        True,
    ),
    "not_observable": Kind("the drive does not determine a clock, a mount or a scale", "drive what the text names"),
    "over_confident": Kind(
        "the residuals of an input are larger than its noise says",
        "correct its noise: INPUT.noise=sigmas with INPUT.sigma_m; robust.noise_scale=estimated (the default) allows "
        "for 3 times",
    ),
    "odometry_over_confident": Kind(
        "odometry is worse than its noise says",
        "state its noise (odometry.noise); robust.noise_scale=estimated (the default) allows for it",
    ),
    "odometry_slips": Kind(
        "in a stretch odometry drives or turns far more or less than the map shows",
        "look at the ground and the tyres there; a run finds slips (odometry.doubt); a gyro helps in turns",
    ),
    "id_reused": Kind("two landmarks have the same id", _ID),
    "ids_unsure": Kind(
        "many ids are seen at more than one place", "correct the detector, or set landmarks.association=joint"
    ),
    "ids_exchanged": Kind("two landmarks exchange their ids", _ID),
    "ids_renewed": Kind(
        "the ids of all landmarks are new from some time on, once or again and again",
        "let the detector keep its ids when it begins anew; without ids set landmarks.association=joint",
    ),
    "landmark_moves": Kind(
        "a landmark moves: a person, a vehicle, or a tag that the robot carries",
        "let the detector leave out this id; a run believes none of its sightings that contradict the others",
    ),
    "landmark_moved": Kind("a landmark was moved during the drive", "use landmarks that nobody moves"),
    "map_breaks": Kind(
        "many landmarks are elsewhere after some time, so the robot's path has a break there",
        "find out whether the robot was carried or slipped",
    ),
    "outliers": Kind("many sightings are far from their landmark", "correct the detector, or set landmarks.loss"),
    "fit_unsure": Kind("the fit of clock, mount and scale failed", "mend the other findings first"),
    "silent": Kind("nothing is seen for most of the drive", "record a drive past landmarks all the way"),
}
"""What ``check`` finds, beyond counters."""


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
        return KINDS[self.code].mend.replace("INPUT", self.source or "the input") if self.code in KINDS else ""

    @property
    def ends(self) -> bool:
        """Return whether other findings mean nothing while it is there."""
        return self.code in KINDS and KINDS[self.code].ends and self.severity != "note"

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


def where(
    topic: str, stamps_ns: Sequence[int] | Index = (), count: int | None = None, settings: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return the topic, first stamp and count (of the stamps, where it is not given) of a finding, and its settings."""
    first_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
    number = len(stamps_ns) if count is None else int(count)
    return {"topic": topic, "first_ns": first_ns, "count": number, "settings": settings}


def in_order(findings: list[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes, each in the order found."""
    return sorted(findings, key=lambda one: SEVERITIES.index(one.severity))


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


def worst(findings: list[Finding]) -> Finding | None:
    """The first of the most severe findings, notes left out; None where there is none."""
    return next((one for one in in_order(findings) if one.severity != "note"), None)
