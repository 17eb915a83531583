"""Odometry that begins after the landmarks, or ends before them: the clocks are right."""

import numpy as np
from recordings import short_drive
from rows import each

from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import Drive


def cut(drive, part, *, begins):
    """Leave out odometry of the beginning, or of the end."""
    first_ns, last_ns = drive.odometry_ns[[0, -1]]
    at_ns = first_ns + int(part * (last_ns - first_ns))
    drive.drop([m for m in drive.odometry if (m.stamp_ns < at_ns) == begins])
    return drive


def found(drive, file):
    drive.write(file)
    return [one for one in check(file, quick=True).findings if one.code in ("odometry_short", "no_overlap")]


@each("part, begins, said", [(0.4, True, "s after the first of them"), (0.5, False, "s before the last of them")])
def test_odometry_of_a_part_of_the_drive_is_no_clock_that_differs(part, begins, said, tmp_path):
    drive = cut(Drive(short_drive(tmp_path / "drive.mcap")), part, begins=begins)
    (one,) = found(drive, tmp_path / "cut.mcap")
    assert (one.code, one.severity) == ("odometry_short", "warning")
    assert said in one.text
    assert not one.settings


def test_a_clock_that_differs_is_named_as_such_where_all_was_recorded_at_once(tmp_path):
    drive = Drive(short_drive(tmp_path / "drive.mcap"))
    span_ns = int(np.ptp(drive.odometry_ns))
    drive.restamp(drive.landmarks, lambda stamps_ns: stamps_ns + span_ns // 2)
    assert [one.code for one in found(drive, tmp_path / "late.mcap")] in (["no_overlap"], [])
    assert "clock_domains" in {one.code for one in check(tmp_path / "late.mcap", quick=True).findings}
