"""Public recordings of GRAPH_SLAM_DATASETS written as bags, as their owners would record them, without the truth."""

import gzip
import shutil
import sys
from operator import itemgetter

import messages
import numpy as np
from places import DATASETS, HAS_MRCLAM, ROOT, mrclam

from graph_slam_ros.lie import se2
from graph_slam_ros.messages.to_msg import odometry as odometry_of
from graph_slam_ros.messages.to_msg import transform
from graph_slam_ros.recordings.bag import BagWriter

RECORDED = DATASETS / "recorded"
EPOCH_S = 1_700_000_000.0
"""Added to stamps that are seconds since a computer was started."""


def ns(stamp_s):
    return round((stamp_s + EPOCH_S) * 1e9)


def cloud(stamp_ns, frame, **columns):
    """A PointCloud2 of doubles."""
    rows = zip(*(np.asarray(column, float).tolist() for column in columns.values()), strict=True)
    layout = [(name, "f8") for name in columns]
    return messages.CLOUD, messages.cloud(layout, *rows, padding=0, frame=frame, stamp_ns=stamp_ns)


def odometry(stamp_s, pose):
    """An Odometry of a pose in the plane, without a twist."""
    message = odometry_of(ns(stamp_s), "odom", "base_link", tuple(pose), np.zeros((3, 3)), 0.0)
    return "/odom", "nav_msgs/msg/Odometry", ns(stamp_s), message


def write(file, rows, *static):
    """A recording of (topic, type, stamp, bytes), in that order; none is recorded earlier than the one before."""
    now_ns = 0
    with BagWriter(file) as bag:
        for child, at in static:
            bag.write("/tf_static", "tf2_msgs/msg/TFMessage", rows[0][2], transform(0, "base_link", child, at))
        for topic, type_name, stamp_ns, message in rows:
            now_ns = max(now_ns, stamp_ns)
            bag.write(topic, type_name, now_ns, message)
    return file


def plaza(folder):
    """A lawn mower and four radio beacons: ranges alone."""
    pose, out = (0.0, 0.0, 0.0), []
    steps = np.loadtxt(RECORDED / "plaza2/Plaza2_DR.txt")
    for stamp_s, forward, turned in steps.tolist():
        pose = tuple(map(float, se2.compose(pose, se2.exp((forward, 0.0, turned)))))
        out.append(odometry(stamp_s, pose))
    for stamp_s, _, beacon, distance in np.loadtxt(RECORDED / "plaza2/Plaza2_TD.txt").tolist():
        if stamp_s > steps[0, 0]:
            seen = cloud(ns(stamp_s), "base_link", id=[beacon], range=[distance], sigma=[0.5])
            out.append(("/ranges", seen[0], ns(stamp_s), seen[1]))
    return write(folder / "plaza2.mcap", sorted(out, key=itemgetter(2)))


def park(folder):
    """A car among trees that have no names."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.victoria_park import BEARING_RAD, LASER, RANGE_M, TRUNK_PART, read_drive

    drive = read_drive(RECORDED / "victoria_park")
    out = [odometry(stamp_s, pose) for stamp_s, *pose in drive.odometry.tolist()]
    for stamp_s, trees in drive.scans:
        far, bearing, diameter = trees.reshape(3, -1)
        sigmas = {"sigma": np.hypot(RANGE_M, TRUNK_PART * diameter), "sigma_bearing": np.full(len(far), BEARING_RAD)}
        seen = cloud(ns(stamp_s), "laser", range=far, bearing=bearing - 0.5 * np.pi, **sigmas)
        out.append(("/trees", seen[0], ns(stamp_s), seen[1]))
    return write(folder / "victoria_park.mcap", sorted(out, key=itemgetter(2)), ("laser", LASER))


def recordings(folder):
    """The files, one after the other."""
    for write_one, of in ((plaza, "plaza2"), (park, "victoria_park")):
        if (RECORDED / of).is_dir():
            yield write_one(folder)
    for bag in sorted((RECORDED / "bags").rglob("*")):
        if bag.suffix in (".mcap", ".bag"):
            yield bag
        elif bag.name.endswith(".bag.gz"):
            with gzip.open(bag) as packed, (folder / bag.stem).open("wb") as out:
                shutil.copyfileobj(packed, out)
            yield folder / bag.stem
    for robot in range(1, 6) if HAS_MRCLAM else ():
        yield mrclam(robot, folder / f"mrclam7_{robot}")
