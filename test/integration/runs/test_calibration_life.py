"""Maps with a calibration: frozen, continued and merged."""

from dataclasses import replace

import numpy as np
import pytest
from imperfect import Faults, imperfect_drive

from graph_slam_ros.maps.merge import merge
from graph_slam_ros.runs.restore import freeze, map_of, record_run
from graph_slam_ros.slam import Config, Control, GraphSlam

FAULTS = Faults(distance=0.95, turn=1.05, clock_s=0.12, yaw=0.08)
ON = {"calibrate.groups": "auto"}
LATER_NS = 10**12
END = (Control("end"), Control("optimize"))
QUIET = {
    "odometry.translation_density": 0.01,
    "odometry.lateral_density": 0.002,
    "odometry.rotation_density": 0.01,
    "landmarks.added_sigma_m": 0.0,
}


def drive():
    return imperfect_drive(FAULTS, seconds=28.0)


def later(measurements):
    """The same drive once more, another day."""
    return [replace(m, stamp_ns=m.stamp_ns + LATER_NS) for m in measurements]


def recorded(folder, measurements, settings=ON):
    record_run(folder, Config.from_mapping({**QUIET, **settings}), [*measurements, *END], [])
    return folder


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A run that has found what was wrong."""
    run = recorded(tmp_path_factory.mktemp("calibrated") / "run", drive())
    assert {name for _, name in map_of(run, []).calibration} >= {"distance", "turn", "clock", "yaw"}
    return run


def off_path(slam, first, keyframes):
    """RMS distance of a drive's keyframes from where the same drive was before."""
    stamps = first.keyframes.stamps_ns
    new = np.arange(keyframes, len(slam.keyframes))
    inside = new[slam.keyframes.stamps_ns[new] - LATER_NS < stamps[-1]][30:]
    at = slam.keyframes.stamps_ns[inside] - LATER_NS
    before = np.stack([np.interp(at, stamps, first.trajectory()[:, axis]) for axis in (0, 1)], axis=-1)
    return float(np.sqrt(np.mean(np.sum((slam.trajectory()[inside, :2] - before) ** 2, axis=1))))


@pytest.mark.parametrize("how", ["frozen", "continued"])
def test_a_map_goes_on_with_its_calibration_whatever_is_configured(calibrated, tmp_path, how):
    run = calibrated
    if how == "frozen":
        run = tmp_path / "frozen"
        freeze(calibrated, run)
    configured = Config.from_mapping({**QUIET, "odometry.distance_factor": 1.2})
    found, off = map_of(calibrated, []).calibration, {}
    first = GraphSlam(configured, start=map_of(calibrated, []))
    for honoured in (True, False):
        state = map_of(run, [])
        assert state.calibration == pytest.approx(found)
        if not honoured:
            state.calibration.clear()
        count, slam = len(state.keyframes), GraphSlam(configured, start=state)
        for m in (*later(drive()), *END):
            slam.process(m)
        assert not honoured or slam.calibration == pytest.approx(found)
        off[honoured] = off_path(slam, first, count)
    assert off[True] < 0.5 * off[False], off


def test_a_merged_map_goes_on_with_the_first_calibration_and_names_what_differs(calibrated, tmp_path):
    other = imperfect_drive(replace(FAULTS, distance=0.88), seconds=28.0)
    second = recorded(tmp_path / "second", later(other))
    done = merge(calibrated, second, tmp_path / "merged")
    assert map_of(tmp_path / "merged", []).calibration == pytest.approx(map_of(calibrated, []).calibration)
    (line,) = done.calibrations
    assert line.startswith("distance of odometry is 0.9"), line
    assert line.endswith("in B: the merged map goes on with that of A")
