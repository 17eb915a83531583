"""Drives that are wrong in more ways than one: ``check`` says what is true of them, and answers with its exit code."""

import json

import numpy as np
import pytest
from public_recordings import cloud, write
from random_drives import CLASSES, random_drive
from reliability import times

from graph_slam_ros.cli import main
from graph_slam_ros.messages.to_msg import odometry
from graph_slam_ros.slam import Odometry

IDS = {"id_twice", "id_conflict", "ids_wrong"}
COVERAGE = {"silent", "no_closure", "no_landmarks", "seen_once"}
FITTED = {"mount_yaw": "yaw", "clock_offset": "clock_s", "odometry_scale": "distance", "turn_scale": "turn"}
WITHIN = 0.03
TRUE = {
    "some wrong ids": IDS,
    "many wrong ids": IDS | {"id_reused", "landmark_moved", "ids_unsure"},  # an id can seem to be of two places
    "two alike": {"id_twice", "id_conflict", "id_reused"},
    "a landmark that moves": {"landmark_moved"},
    "standing": {"static"},
}
FOUND = {"some wrong ids": "ids_wrong", "many wrong ids": "ids_wrong", "two alike": "id_twice", "standing": "static"}
"""By class: errors and warnings that are true of it, and what the first drive of it is to have."""


def recorded(file, drive):
    """Write measurements as the messages of a robot: odometry without covariance, and a cloud of landmarks."""
    out = []
    for m in drive:
        if isinstance(m, Odometry):
            message = odometry(m.stamp_ns, "odom", "base_link", m.T_odom_base, np.zeros((3, 3)), 0.0)
            out.append(("/odom", "nav_msgs/msg/Odometry", m.stamp_ns, message))
        elif m.sightings:
            first, second = np.array([s.measured for s in m.sightings]).T
            columns = {"id": [int(s.id) for s in m.sightings]}
            if m.sightings[0].kind == "range_bearing":
                sigmas = np.sqrt([s.covariance for s in m.sightings])
                columns |= {"range": first, "bearing": second, "sigma": sigmas[:, 0], "sigma_bearing": sigmas[:, 3]}
            else:
                columns |= {"x": first, "y": second, "z": 0.0 * first}
            type_name, message = cloud(m.stamp_ns, "base_link", **columns)
            out.append(("/landmarks", type_name, m.stamp_ns, message))
    return write(file, out)


@pytest.mark.parametrize("name", times(["some wrong ids", "two alike"], list(CLASSES)))
def test_what_is_said_of_a_drive_that_is_wrong_in_several_ways_is_true(name, tmp_path, capsys):
    for seed in range(times(1, 20)):
        drive, _, faults = random_drive(name, seed)
        code = main(["check", str(recorded(tmp_path / f"{seed}.mcap", drive)), "--json"])
        findings = json.loads(capsys.readouterr().out)["findings"]
        said = {one["code"]: one["value"] for one in findings if one["severity"] != "note"}
        assert code == (4 if said else 0)
        assert said.keys() - FITTED.keys() <= TRUE.get(name, set()) | COVERAGE, (seed, said)
        for one, of in FITTED.items():
            if one in said and not (one == "clock_offset" and name == "a clock that jumps"):
                expected = getattr(faults, of) - (of in ("distance", "turn"))
                assert said[one] == pytest.approx(expected, abs=WITHIN), (seed, one)
        if seed == 0 and name in FOUND:
            assert FOUND[name] in {one["code"] for one in findings}
