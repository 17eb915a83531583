"""Poses at sightings between two keyframes: odometry's motion, and what corrects it, spread over the time between."""

import numpy as np
import pytest

from graph_slam_ros.slam import Control, GraphSlam
from graph_slam_ros.tools.simulation import measurements, simulate


def test_odometry_is_corrected_evenly_from_one_keyframe_to_the_next():
    slam = GraphSlam()
    for m in [*measurements(simulate("warehouse", 1, aisles=2, laps=1)), Control("end"), Control("optimize")]:
        slam.process(m)
    group, seen, keyframes = slam.view.space.group, slam.view.sighting_poses, slam.view.trajectory()
    found, between = slam.view.sighting_trajectory(), 0
    assert np.isfinite(found).all()
    for at, pose in zip(seen, found, strict=True):
        k = at.keyframe
        carried = group.compose(tuple(keyframes[k]), at.T_keyframe_base)
        if k + 1 in (*slam.view.segments, len(slam.view.keyframes)):
            assert pose == pytest.approx(carried), "nothing after it corrects odometry"
            continue
        a, b = slam.view.keyframes[k], slam.view.keyframes[k + 1]
        reached = group.compose(tuple(keyframes[k]), group.between(a.T_odom_base, b.T_odom_base))
        whole = np.linalg.norm(np.subtract(keyframes[k + 1], reached)[:2])
        part = (at.stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        assert np.linalg.norm(np.subtract(pose, carried)[:2]) == pytest.approx(part * whole, rel=1e-2, abs=1e-9)
        between += 0.0 < part < 1.0
    assert between > 10
