"""Calibration of random drives that are wrong in more ways than one: nothing is used that makes the error worse."""

import numpy as np
import pytest
from imperfect import driven, error_m
from random_drives import CLASSES, random_drive
from reliability import tell, times

ON = {"calibrate.groups": "auto"}
WORSE, AND_M = 1.2, 0.02  # of the error without calibration: more is worse


@pytest.mark.parametrize("name", CLASSES if times(0, 1) else ["many wrong ids"])
def test_nothing_is_used_that_makes_the_error_worse(name):
    worse, used, sides = [], 0, []
    for seed in range(times(1, 100)):
        drive, settings, truth, _ = random_drive(name, seed)
        on, off = driven(drive, ON | settings), driven(drive)
        report = on.calibration_report
        assert all(one["text"].count(":") and one["verdict"] for one in report["parameters"]), "a refusal has no reason"
        after, before = error_m(on, truth), error_m(off, truth)
        sides.append((after, before))
        used += bool(report["settings"])
        if report["settings"] and after > WORSE * before + AND_M:
            worse.append(f"seed {seed}: {after:.3f} m instead of {before:.3f} m with {report['settings']}")
        if not report["settings"]:
            assert (on.solver.values == off.solver.values).all(), f"seed {seed}: nothing was used, but all is different"
    median = np.median(np.array(sides), axis=0)
    tell(f"calibration_{name.replace(' ', '_')}", tried=len(sides), used=used, worse=len(worse), median=tuple(median))
    assert not worse, worse
