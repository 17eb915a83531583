"""Calibration over many drives: its covariance is honest, and clean drives are left alone."""

import numpy as np
import pytest
from imperfect import Faults, driven, imperfect_drive
from reliability import tell, times
from scipy.stats import chi2

SEEDS = times(1, 100)


def drive(seed):
    """A drive with wrong parameters, and these."""
    rng = np.random.default_rng(1000 + seed)
    distance, turn = 1.0 + 0.05 * rng.standard_normal(2)
    clock_s, yaw = float(np.clip(0.1 * rng.standard_normal(), -0.25, 0.25)), np.radians(5.0) * rng.standard_normal()
    wrong = Faults(distance=distance, turn=turn, clock_s=clock_s, yaw=yaw)
    truth = {"distance": distance - 1.0, "turn": turn - 1.0, "clock": clock_s, "yaw": yaw}
    return imperfect_drive(wrong, seed=seed, seconds=60.0), truth


def parameter_nees(slam, truth):
    """The normalised squared error of the four parameters by a trial fit."""
    fit, _ = slam.trial_fit()
    error = fit.values - np.array([truth[p.name] for p in fit.parameters])
    return float(error @ np.linalg.solve(fit.covariance, error))


def test_what_calibration_finds_is_as_uncertain_as_it_says():
    nees = np.mean([parameter_nees(driven(wrong), truth) for wrong, truth in map(drive, range(SEEDS))])
    tell("calibration_nees", tried=SEEDS, worst={"parameters": nees})
    low, high = chi2.ppf([0.0005, 0.9995], 4 * SEEDS) / SEEDS
    assert low < nees < high


@pytest.mark.skipif(SEEDS == 1, reason="only in make soak")
def test_clean_drives_are_left_alone():
    wrong = []
    for seed in range(SEEDS):
        _, findings = driven(imperfect_drive(Faults(), seed=seed, seconds=30.0)).trial_fit()
        wrong += [f"seed {seed}: {one.text}" for one in findings if one.verdict == "admitted"]
    tell("calibration_clean", tried=SEEDS, corrected=len(wrong))
    assert len(wrong) <= 0.01 * SEEDS, wrong
