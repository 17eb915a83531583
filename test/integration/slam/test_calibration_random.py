"""Calibration of random drives that are wrong in more ways than one: nothing is used that makes the error worse."""

from dataclasses import replace

import numpy as np
import pytest
from imperfect import driven, error_m
from random_drives import CLASSES, random_drive
from reliability import tell, times

from graph_slam_ros.slam.calibration.uncorrected import setting_of

WORSE, AND_M = 1.2, 0.02  # of the error without calibration: more is worse


def mended(drive, slam):
    """The pipeline after a drive with the settings that a fit to it finds; None where it finds nothing."""
    values = {one.parameter: one.value for one in slam.trial_fit(is_to_correct=True)[1] if one.verdict == "admitted"}
    settings = dict(setting_of(one, values, slam.calibrated) for one in values)
    late_ns = round(1e9 * settings.pop("detections.offset_s", 0.0))  # which is applied where messages are read
    moved = [replace(m, stamp_ns=m.stamp_ns + late_ns) if hasattr(m, "sightings") else m for m in drive]
    return driven(sorted(moved, key=lambda m: m.stamp_ns), settings) if values else None


@pytest.mark.skipif(not times(0, 1), reason="only in make soak")
@pytest.mark.parametrize("name", list(CLASSES)[: times(1, None)])
def test_nothing_is_used_that_makes_the_error_worse(name):
    worse, used, sides = [], 0, []
    for seed in range(100):
        drive, truth, _ = random_drive(name, seed)
        off = driven(drive)
        on = mended(drive, off)
        before = error_m(off, truth)
        after = before if on is None else error_m(on, truth)
        sides.append((after, before))
        used += on is not None
        if after > WORSE * before + AND_M:
            worse.append(f"seed {seed}: {after:.3f} m instead of {before:.3f} m with {on.config}")
    median = np.median(np.array(sides), axis=0)
    tell(f"calibration_{name.replace(' ', '_')}", tried=len(sides), used=used, worse=len(worse), median=tuple(median))
    assert not worse, worse
