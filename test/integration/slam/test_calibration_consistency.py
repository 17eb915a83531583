"""Calibration over many drives: its covariance is honest, and clean drives are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from imperfect import Faults, driven, error_m, imperfect_drive
from random_drives import CLASSES, random_drive
from reliability import tell, times
from scipy.stats import chi2

from graph_slam_ros.slam.calibration.answers import setting_of

SEEDS = times(1, 100)


def drive(seed):
    """A drive with wrong parameters, and these."""
    rng = np.random.default_rng(1000 + seed)
    distance, turn = 1.0 + 0.05 * rng.standard_normal(2)
    clock_s, yaw = float(np.clip(0.1 * rng.standard_normal(), -0.25, 0.25)), np.radians(5.0) * rng.standard_normal()
    wrong = Faults(distance=distance, turn=turn, clock_s=clock_s, yaw=yaw)
    truth = {"distance": distance - 1.0, "turn": turn - 1.0, "clock": clock_s, "yaw": yaw}
    return imperfect_drive(wrong, seed=seed, seconds=times(40.0, 60.0)), truth


def parameter_nees(view, truth):
    """The normalised squared error of the four parameters by a trial fit."""
    fit, _ = view.trial_fit()
    error = fit.values - np.array([truth[p.name] for p in fit.parameters])
    return float(error @ np.linalg.solve(fit.covariance, error))


def test_what_calibration_finds_is_as_uncertain_as_it_says():
    nees = np.mean([parameter_nees(driven(wrong).view, truth) for wrong, truth in map(drive, range(SEEDS))])
    tell("calibration_nees", tried=SEEDS, worst={"parameters": nees})
    low, high = chi2.ppf([0.0005, 0.9995], 4 * SEEDS) / SEEDS
    assert low < nees < high


@pytest.mark.skipif(SEEDS == 1, reason="only in make soak")
def test_clean_drives_are_left_alone():
    wrong = []
    for seed in range(SEEDS):
        _, findings = driven(imperfect_drive(Faults(), seed=seed, seconds=30.0)).view.trial_fit()
        wrong += [f"seed {seed}: {one.text}" for one in findings if one.verdict == "admitted"]
    tell("calibration_clean", tried=SEEDS, corrected=len(wrong))
    assert len(wrong) <= 0.01 * SEEDS, wrong


WORSE, AND_M = 1.2, 0.02  # of the error without calibration: more is worse


def mended(drive, view):
    """The pipeline after a drive with the settings that a fit to it finds; None where it finds nothing."""
    values = {one.parameter: one.value for one in view.trial_fit(is_to_correct=True)[1] if one.verdict == "admitted"}
    settings = dict(setting_of(one, values, view.corrections.total) for one in values)
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
        on = mended(drive, off.view)
        before = error_m(off.view, truth)
        after = before if on is None else error_m(on.view, truth)
        sides.append((after, before))
        used += on is not None
        if after > WORSE * before + AND_M:
            worse.append(f"seed {seed}: {after:.3f} m instead of {before:.3f} m with {on.view.config}")
    median = np.median(np.array(sides), axis=0)
    tell(f"calibration_{name.replace(' ', '_')}", tried=len(sides), used=used, worse=len(worse), median=tuple(median))
    assert not worse, worse
