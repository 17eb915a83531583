"""Calibration on the way: what was wrong is corrected, and where nothing is, nothing changes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from imperfect import Faults, driven, error_m, imperfect_drive, imperfect_drive_and_truth

from graph_slam_ros import Config
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.map_journal import MapGrowth, extend, state_of
from graph_slam_ros.slam import GraphSlam, Odometry
from graph_slam_ros.slam.calibrator import FIRST_DUE
from graph_slam_ros.slam.robust.background import run_when_asked
from graph_slam_ros.slam.snapshot import MapSnapshot

ON = {"calibrate.groups": "auto"}
FAULTS = Faults(distance=0.95, turn=1.05, clock_s=0.12, yaw=0.08)


@pytest.fixture(scope="module")
def wrong():
    return imperfect_drive(FAULTS, seconds=70.0)


@pytest.fixture(scope="module")
def calibrated(wrong):
    return driven(wrong, ON)


def spread_error(slam, reference):
    """RMSE of distances between landmarks against those of another map."""
    names = sorted(slam.landmarks.keys() & reference.landmarks.keys())
    a, b = (np.array([one.solver.estimate([one.landmarks[n].vertex])[0] for n in names]) for one in (slam, reference))
    first, second = np.triu_indices(len(names), 1)
    far = [np.linalg.norm(x[first] - x[second], axis=1) for x in (a, b)]
    return float(np.sqrt(np.mean((far[0] - far[1]) ** 2)))


def test_what_is_wrong_is_corrected_on_the_way(wrong, calibrated):
    lines = calibrated.calibration_report["settings"]
    assert lines["odometry.distance_factor"] == pytest.approx(0.95, abs=0.01)
    assert lines["odometry.turn_factor"] == pytest.approx(1.05, abs=0.015)
    assert lines["detections.offset_s"] == pytest.approx(0.12, abs=0.02)
    yaw = float(lines["detections.mount_correction"].split()[5])
    assert yaw == pytest.approx(0.08, abs=0.006)
    perfect = driven(imperfect_drive(Faults(), seconds=70.0))
    assert spread_error(calibrated, perfect) < 0.3 * spread_error(driven(wrong), perfect)


def test_the_lines_applied_leave_nothing_to_correct(wrong, calibrated):
    again = driven(_earlier(wrong, calibrated), {**ON, **_without_clock(calibrated)})
    found = {p["name"]: p["correction"] for p in again.calibration_report["parameters"]}
    assert found == dict.fromkeys(found, 0.0), found


def _without_clock(slam):
    return {k: v for k, v in slam.calibration_report["settings"].items() if not k.endswith("offset_s")}


def _earlier(measurements, slam):
    """``offset_s`` is applied where messages are read."""
    shift_ns = round(slam.calibration_report["settings"]["detections.offset_s"] * 1e9)
    out = [replace(m, stamp_ns=m.stamp_ns + shift_ns) if hasattr(m, "sightings") else m for m in measurements]
    return sorted(out, key=lambda m: m.stamp_ns)


def test_where_nothing_is_wrong_the_graph_is_the_same_to_the_last_bit():
    measurements = imperfect_drive(Faults(), seconds=40.0)
    off, on = driven(measurements), driven(measurements, ON)
    assert on.calibration_report["trials"] >= 2
    assert not on.calibration_report["settings"]
    assert (off.solver.values == on.solver.values).all()
    assert (off.keyframe_covariances() == on.keyframe_covariances()).all()


def test_covariances_have_the_uncertainty_of_the_parameters(calibrated):
    (marginal,) = calibrated.solver.marginal([calibrated.keyframes[-1].vertex])
    for wider in (calibrated.keyframe_covariances()[-1], calibrated.pose_covariance):
        added = np.linalg.eigvalsh(wider - marginal)
        assert added[0] > -1e-12
        assert added[-1] > 0.01 * np.trace(marginal)
    landmarks = calibrated.solver.marginal([one.vertex for one in calibrated.landmarks.values()])
    assert np.trace(sum(calibrated.landmark_covariances())) > 1.01 * np.trace(sum(landmarks))


def test_odometry_in_its_own_frame_is_not_corrected(wrong, calibrated):
    """Whoever publishes odom -> base publishes it uncorrected: map -> odom has to fit that."""
    odometry = {m.stamp_ns: m.T_odom_base for m in wrong if not hasattr(m, "sightings")}
    keyframes = [k for k in calibrated.keyframes if k.stamp_ns in odometry]
    assert len(keyframes) >= 20  # as many as are compared
    for one in keyframes[-20:]:
        np.testing.assert_allclose(one.T_odom_base[:2], odometry[one.stamp_ns][:2], atol=2e-3)


def test_a_map_that_is_loaded_goes_on_with_its_calibration(calibrated):
    state = state_of(calibrated)
    again = GraphSlam(Config.from_mapping(ON), start=state)
    assert again.calibration == pytest.approx(calibrated.calibration)
    configured = {"odometry.distance_factor": calibrated.calibration_report["settings"]["odometry.distance_factor"]}
    told = GraphSlam(Config.from_mapping(configured), start=state_of(calibrated))
    assert told._frontend.corrections.found["odometry", "distance"] == pytest.approx(0.0, abs=1e-5)


def test_in_a_loaded_map_trials_begin_by_what_was_driven_since(wrong, calibrated):
    """As many keyframes after loading as after the beginning of a map, whatever the map has."""
    again = GraphSlam(Config.from_mapping(ON), start=state_of(calibrated))
    loaded, trials = len(again.keyframes), []
    assert loaded > 2 * FIRST_DUE
    later_ns = wrong[-1].stamp_ns + 10**9 - wrong[0].stamp_ns
    for m in wrong:
        again.process(replace(m, stamp_ns=m.stamp_ns + later_ns))
        trials.append((len(again.keyframes) - loaded, again.calibration_report["trials"]))
    first = next(driven for driven, count in trials if count)
    assert FIRST_DUE <= first < 2 * FIRST_DUE
    assert trials[-1][1] > 1


def test_a_covariance_of_odometry_that_is_absurd_lets_nothing_in():
    """Its heading drifts, and nothing but a track width could explain it."""
    drive = imperfect_drive(Faults(), seconds=60.0)
    none = tuple(np.diag([1e-12] * 3).ravel().tolist())
    tiny = [replace(m, twist_covariance=none) if isinstance(m, Odometry) else m for m in drive]
    slam = driven(tiny, ON)
    assert slam.calibration_report["settings"] == {}
    assert all("states" in one["text"] for one in slam.calibration_report["parameters"])


@pytest.mark.parametrize(
    ("groups", "why"),
    [
        ("factors range_factor", "one scale"),
        ("auto range_factor", "one scale"),
        ("auto none", "none and some"),
        ("wheels", "'wheels' is not none, association, auto or one of factors"),
    ],
)
def test_what_cannot_be_told_apart_is_refused_by_configuration(groups, why):
    with pytest.raises(ConfigError, match=why):
        Config.from_mapping({"calibrate.groups": groups})


def test_mount_and_range_offset_need_a_ruler():
    both = {"calibrate.groups": "mount range_offset", "calibrate.mount_sigma_m": 0.5}
    with pytest.raises(ConfigError, match="measure the mount"):
        Config.from_mapping(both)
    assert Config.from_mapping(both | {"calibrate.mount_sigma_m": 0.05})


def test_factors_and_range_factor_are_allowed_where_landmarks_are_surveyed():
    survey = {"landmarks.surveyed": "id,x,y,sigma\na,0,0,0.01\nb,5,0,0.01"}
    assert Config.from_mapping({"calibrate.groups": "factors range_factor", **survey})


@pytest.mark.parametrize("noise_scale", ["configured", "estimated"])
def test_trials_in_the_background_and_what_is_recorded_give_the_same_graph(wrong, noise_scale):
    """A job that is done at once and one that is done when its outcome is due decide alike.

    A record may have several solves: noise is scaled before and after measurements are corrected.
    """

    def at_once(work):
        outcome = work()
        return lambda: outcome

    settings = ON | {"robust.noise_scale": noise_scale}
    slams = [GraphSlam(Config.from_mapping(settings), executor=one) for one in (at_once, run_when_asked)]
    growth, state, every = MapGrowth(), MapSnapshot(), 20 if noise_scale == "configured" else 280
    seconds = 40 if noise_scale == "configured" else 24
    for k, m in enumerate([m for m in wrong if m.stamp_ns < wrong[0].stamp_ns + seconds * 10**9]):
        for slam in slams:
            slam.process(m)
        if k % every == every - 1:
            for record in growth.of(slams[0]):
                if record["type"] == "growth":
                    extend(state, json.loads(json.dumps(record)))
            assert_same_edges(slams[0], state)
    assert slams[0].corrected
    assert (slams[0].solver.values == slams[1].solver.values).all()
    assert state.calibration == slams[0].calibration


def assert_same_edges(slam, state):
    for mine, read in zip(slam.graph.tables.values(), state.graph.tables.values(), strict=True):
        np.testing.assert_array_equal(read.measured.values, mine.measured.values)
        np.testing.assert_array_equal(read.sqrt_information.values, mine.sqrt_information.values)


def with_distance_that_changes(measurements, factor):
    """The same drive, whose odometry says less by a factor from the middle on."""
    middle_ns = (measurements[0].stamp_ns + measurements[-1].stamp_ns) // 2
    before = at = None
    for m in measurements:
        if not isinstance(m, Odometry):
            yield m
            continue
        x, y, turned = se2.log(se2.between(before or m.T_odom_base, m.T_odom_base))
        now = factor if m.stamp_ns > middle_ns else 1.0
        at = se2.compose(at or m.T_odom_base, se2.exp((x / now, y / now, turned)))
        before = m.T_odom_base
        yield replace(m, T_odom_base=tuple(map(float, at)))


def test_a_factor_that_changes_on_the_way_is_followed_where_that_is_asked_for():
    drive, truth = imperfect_drive_and_truth(Faults(), seconds=110.0)
    changed = list(with_distance_that_changes(drive, 0.9))
    settings = ON | {"robust.noise_scale": "configured"}  # estimated noise allows for the change in part
    constant, drifting = (driven(changed, settings | {"calibrate.drift": rate}) for rate in (0.0, 3.0))
    assert "odometry.distance_factor" not in constant.calibration_report["settings"], "no one value is right"
    report = drifting.calibration_report
    assert report["settings"] == {"odometry.distance_factor": pytest.approx(0.9, abs=0.01)}
    assert report["windows"] == [{"first_keyframe": 0, "settings": {}}]
    assert error_m(drifting, truth) < 0.7 * error_m(constant, truth), "9 of 14 mm"
