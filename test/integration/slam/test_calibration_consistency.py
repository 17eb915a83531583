"""Calibration over many drives: its covariance is honest, and clean drives are left alone."""

import numpy as np
from imperfect import Faults, driven, imperfect_drive
from reliability import tell, times
from scipy.stats import chi2

ON = {"calibrate.groups": "auto"}
SEEDS = times(1, 100)


def errors(seed):
    """The errors of the four parameters by the last trial fit, and their covariance."""
    rng = np.random.default_rng(1000 + seed)
    distance, turn = 1.0 + 0.05 * rng.standard_normal(2)
    clock_s, yaw = float(np.clip(0.1 * rng.standard_normal(), -0.25, 0.25)), np.radians(5.0) * rng.standard_normal()
    drive = imperfect_drive(Faults(distance=distance, turn=turn, clock_s=clock_s, yaw=yaw), seed=seed, seconds=60.0)
    slam = driven(drive, ON)
    truth = {"distance": distance - 1.0, "turn": turn - 1.0, "clock": clock_s, "yaw": yaw}
    fit, _ = slam.trial_fit()
    found = slam._frontend.corrections.found
    used = np.array([found.get((p.source, p.name), 0.0) for p in fit.parameters])
    return used + fit.values - np.array([truth[p.name] for p in fit.parameters]), fit.covariance


def test_what_calibration_finds_is_as_uncertain_as_it_says():
    nees = []
    for seed in range(SEEDS):
        error, covariance = errors(seed)
        nees.append(float(error @ np.linalg.solve(covariance, error)))
    tell("calibration_nees", tried=SEEDS, worst={"mean": float(np.mean(nees))})
    low, high = chi2.ppf([0.0005, 0.9995], 4 * SEEDS) / SEEDS
    assert low < np.mean(nees) < high


def test_clean_drives_are_left_alone():
    wrong = []
    for seed in range(SEEDS):
        slam = driven(imperfect_drive(Faults(), seed=seed, seconds=30.0), ON)
        wrong += [f"seed {seed}: {one.text}" for one in slam.corrected]
    tell("calibration_clean", tried=SEEDS, corrected=len(wrong))
    assert len(wrong) <= 0.01 * SEEDS, wrong
