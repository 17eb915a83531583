"""A finding of ``graph_slam check``, and the table of all kinds of findings.

docs/check.md explains each row of ``KINDS``. A refusal that is counted is a finding under the name of its counter;
``measurements/reasons.py`` explains it.
"""

import json
import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from graph_slam_ros.formats.parameters import parse_setting

Severity: TypeAlias = Literal["error", "warning", "note"]
Where: TypeAlias = dict[str, Any]
"""Topic, first stamp and count of several findings."""

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
_DENSITY = "correct the driver; until then odometry.noise=density"
_MOUNT = "publish the transform on /tf_static, or INPUT.mount"
_ONE_CLOCK = "synchronise the clocks (chrony, PTP); use_sim_time for all nodes or for none"
_SEE = "drive again: "

KINDS: dict[str, Kind] = {
    # -- inputs
    "no_odometry": Kind("no odometry in the recording can be used", "record nav_msgs/Odometry, or odom on /tf", True),
    "no_landmarks": Kind(
        "no landmark, fix or closure is in the recording, so nothing corrects odometry", "record a landmark topic"
    ),
    "input_unused": Kind("a topic of landmarks or odometry cannot be used", "as the text says"),
    "damaged": Kind("a part of the recording cannot be read", "record it again; ros2 bag reindex"),
    # -- times
    "clock_domains": Kind("stamps of two inputs are of different clocks", f"{_ONE_CLOCK}; INPUT.offset_s"),
    "latency": Kind("messages are recorded before the time they are stamped with", f"{_ONE_CLOCK}; INPUT.offset_s"),
    "clock_drift": Kind(
        "the clock of an input runs faster or slower than the recorder's", f"{_ONE_CLOCK}: an offset mends no drift"
    ),
    "no_overlap": Kind("sightings are stamped outside the time of odometry", f"{_ONE_CLOCK}; INPUT.offset_s", True),
    "time_jump": Kind(
        "stamps step back by more than time.jump_back_s: the clock was set, or two recordings were joined",
        "cut the recording in two; time.on_jump says what becomes of the rest",
    ),
    "duplicates": Kind(
        "messages repeat the stamp before", "one publisher for each topic: ros2 topic info -v TOPIC; record once"
    ),
    "out_of_order": Kind("messages are older than the one before, by more than is put in order", "ordering.window_s"),
    "gap": Kind("odometry is silent while the robot moves", "the recorder's CPU and disk; the driver"),
    "slow_odometry": Kind(
        "odometry is rare, so the pose at a sighting is interpolated over a long time", "10 Hz or more"
    ),
    "jitter": Kind("the times between stamps vary a lot", "stamp where it is measured, not on arrival"),
    # -- frames
    "frame_unlinked": Kind("no transform has the pose of a frame on the robot", _MOUNT),
    "two_parents": Kind(
        "a frame has two parents, so transforms through it are arbitrary", "one publisher of each frame"
    ),
    "static_changes": Kind("a static transform is published twice and differs", "one publisher of each frame"),
    "seen_in_fixed_frame": Kind(
        "sightings are given in a frame that does not move with the robot", "publish them in the sensor's frame"
    ),
    "tf_differs": Kind(
        "odometry's topic and /tf are not the same motion", "choose with --odom, or stop one of the two"
    ),
    "odometry_in_map": Kind(
        "odometry is given in the frame of a map: somebody's estimate", "--odom: the wheels' topic"
    ),
    # -- odometry
    "static": Kind("the robot does not move", "another topic, or drive", True),
    "units": Kind("distances or speeds are beyond any robot's", _DRIVER, True),
    "odometry_jumps": Kind("odometry jumps", "the driver; odometry.max_speed_m_s for a robot as fast as that"),
    "odometry_reset": Kind("odometry goes back to zero: its driver was restarted", "cut the recording there"),
    "corrected": Kind("odometry is corrected again and again, as a localiser does", "--odom: the wheels' topic"),
    "not_planar": Kind("the robot leaves the plane", "world.dimensions=3"),
    "twist_scale": Kind("the twist is in other units than the pose, or mirrored", _DENSITY),
    "twist_frame": Kind("the twist is given along the axes of the odometry frame", _DENSITY),
    "twist_unrelated": Kind("pose and twist do not go together", _DENSITY),
    "covariance_zero": Kind("the twist has no covariance: the configured densities are used", ""),
    "covariance_negative": Kind("a variance of the twist is negative or no number", _DENSITY),
    "covariance_tiny": Kind("the twist's covariance is smaller than any wheels are good", _DENSITY),
    "covariance_useless": Kind("the twist's covariance is larger than its speed", _DENSITY),
    # -- sightings and odometry
    "mirrored": Kind("sightings and odometry turn opposite ways", _DRIVER, True),
    "axes": Kind("sightings fit odometry with other axes only", "the sensor's transform, or its frame", True),
    "unrelated": Kind("sightings and odometry do not go together", "the topic, identities, units", True),
    "id_twice": Kind("a message has an identity twice", "one id for each landmark"),
    "few_sightings": Kind("there are hardly any sightings", _SEE + "past more landmarks"),
    "seen_once": Kind("most identities are seen less than three times: of tracks, not of things?", "ids of things"),
    "no_closure": Kind("no landmark is seen over a long way, or again after it", _SEE + "a loop"),
    "no_parallax": Kind(
        "landmarks are not seen again after the robot has moved, so neither mount nor clock can be checked",
        _SEE + "past landmarks, and turn in their sight",
    ),
    # -- a replay in memory, and a fit that begins at its estimate
    "clock_offset": Kind("sightings fit odometry better at other stamps", f"INPUT.offset_s; {_ONE_CLOCK}"),
    "mount_yaw": Kind("the sensor is turned on the robot", "correct its transform; INPUT.mount_correction"),
    "odometry_scale": Kind(
        "the robot drives more or less than odometry says", "wheel radius; odometry.distance_factor"
    ),
    "turn_scale": Kind("the robot turns more or less than odometry says", "track width; odometry.turn_factor"),
    "not_observable": Kind("the drive cannot determine a clock, mount or scale", "the manoeuvre that the text names"),
    "over_confident": Kind("residuals of an input are larger than its noise says", "robust.noise_scale=estimated"),
    "odometry_over_confident": Kind("odometry is worse than its noise says", "robust.noise_scale=estimated"),
    "id_reused": Kind("an identity is of two places in turn", "one id for each landmark"),
    "ids_unsure": Kind("many identities are of more than one place", "the detector; landmarks.association=joint"),
    "ids_exchanged": Kind("two identities exchange their places", "one id for each landmark"),
    "landmark_moved": Kind("a landmark stands elsewhere from some time on", "landmarks that nobody moves"),
    "map_breaks": Kind("many landmarks stand elsewhere from some time on", "was the robot carried?"),
    "outliers": Kind("many sightings are far from where their landmark is", "the detector; landmarks.loss"),
    "fit_unsure": Kind("odometry and sightings cannot be brought together", "other findings first"),
    "silent": Kind("nothing is seen for most of the drive", _SEE + "past landmarks all the way"),
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

    @property
    def ends(self) -> bool:
        """Return whether other findings mean nothing while it is there."""
        return self.code in KINDS and KINDS[self.code].ends

    def as_dict(self) -> dict[str, Any]:
        """Plain values; a number that JSON has not is null."""
        numbers = {"value": self.value, "limit": self.limit}
        finite = {name: float(x) if math.isfinite(x) else None for name, x in numbers.items()}
        evidence = {"topic": self.topic, "first_ns": self.first_ns, "count": self.count}
        first = {"code": self.code, "severity": self.severity, **finite, "unit": self.unit}
        return first | {"evidence": evidence, "text": self.text, "settings": list(self.settings)}


def assignment(key: str, value: str | float) -> str:
    """``KEY=VALUE`` as ``--set`` takes it, which stays text where it is one."""
    text = f"{key}={value}"
    return text if parse_setting(text) == (key, value) else f"{key}={json.dumps(value)}"


def in_order(findings: list[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes, each in the order found."""
    return sorted(findings, key=lambda one: SEVERITIES.index(one.severity))


def worst(findings: list[Finding]) -> Finding | None:
    """The first of the most severe findings, notes left out; None where there is none."""
    return next((one for one in in_order(findings) if one.severity != "note"), None)
