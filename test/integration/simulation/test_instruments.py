"""The satellite receiver and the IMU that a simulated robot may have."""

import numpy as np
import pytest

from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.inputs.fixes import east_north_up
from graph_slam_ros.messages.to_msg import transform
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import measurements as measured
from graph_slam_ros.slam import Closure, Config, Counters, Fix
from graph_slam_ros.tools.simulation import Fault, measurements, simulate, spoil_messages, with_closures, write_bag
from graph_slam_ros.tools.simulation.bag import TRUE_LANDMARKS_TOPIC, TRUTH_TOPIC
from graph_slam_ros.tools.simulation.drive import TRANSFORMS, Drive, Message
from graph_slam_ros.tools.simulation.instruments import ANTENNA_M, DATUM, geodetic
from graph_slam_ros.tools.simulation.motion import space_of

SMALL = {"warehouse": {"aisles": 2, "aisle_m": 8.0, "laps": 1}, "flight": {"laps": 1}}
INPUTS = {
    "gps": {"type": "sensor_msgs/msg/NavSatFix", "topic": "/gps/fix", "datum": " ".join(map(str, DATUM))},
    "imu": {"type": "sensor_msgs/msg/Imu", "topic": "/imu/data"},
}


def fixes_of(recording, path, name):
    """What the border makes of an instrument, what it counts, and the true poses (n, 7) then."""
    write_bag(recording, path)
    dimensions = space_of(recording.T_world_base[0]).dimensions
    settings = {"inputs.names": f"odom {name}", name: INPUTS[name], "world.dimensions": dimensions}
    config, bag, counters = Config.from_mapping(settings), open_bag(path), Counters()
    several = [m for some in measured(bag, choose_inputs(bag, config), config, counters) for m in some]
    fixes = [m for m in several if isinstance(m, Fix)]
    at = np.searchsorted(recording.stamps_ns, [m.stamp_ns for m in fixes])
    return fixes, counters, se3.in_space(recording.T_world_base)[at]


@pytest.mark.parametrize("world", SMALL)
def test_fixes_are_where_the_antenna_truly_was_as_well_as_their_covariance_says(world, tmp_path):
    recording = simulate(world, 3, **SMALL[world], gnss=5, gnss_correlation_s=0.0, gnss_outage_s=4.0)
    gps, counters, truth = fixes_of(recording, tmp_path / "a.mcap", "gps")
    n = len(gps[0].measured)
    error = np.array([m.measured for m in gps]) - np.stack(se3.act(tuple(truth.T), ANTENNA_M), 1)[:, :n]
    nees = [e @ np.linalg.solve(np.reshape(m.covariance, (n, n)), e) for e, m in zip(error, gps, strict=True)]
    assert len(gps) >= 70
    assert np.mean(nees) == pytest.approx(n, rel=4.0 * np.sqrt(2.0 / (n * len(gps))))
    assert gps[0].point == pytest.approx(ANTENNA_M[:n])
    assert 19 <= counters["gps", "no_fix"] <= 21, "an outage, which the receiver says"
    assert len(gps) + counters["gps", "no_fix"] == len(recording.gnss.stamps_ns)


def test_the_orientation_of_the_imu_is_off_by_its_noise_and_by_its_drift(tmp_path):
    recording = simulate("flight", 3, laps=1, imu=50, imu_drift_rad_s=0.01)
    imu, _, truth = fixes_of(recording, tmp_path / "a.mcap", "imu")
    turned = tuple(np.array([m.measured for m in imu]).T)
    error = np.stack(so3.log(so3.compose(turned, so3.inverse(tuple(truth[:, 3:].T)))), axis=1)
    assert error[:, :2].std() == pytest.approx(0.02, rel=0.4)
    assert np.polyfit(0.02 * np.arange(len(error)), error[:, 2], 1)[0] == pytest.approx(0.01, rel=0.2)


def test_the_drive_is_the_same_with_and_without_instruments():
    plain, fitted = simulate("warehouse", 3), simulate("warehouse", 3, gnss=1, imu=100, landmarks=False)
    assert np.array_equal(plain.T_odom_base, fitted.T_odom_base)
    assert plain.gnss is None and plain.imu is None
    assert plain.seen and not fitted.seen
    assert len(fitted.imu.stamps_ns) == pytest.approx(100 * (plain.stamps_ns[-1] - plain.stamps_ns[0]) * 1e-9, abs=2)
    points = np.array([[0.0, 0.0, 0.0], [5000.0, -3000.0, 120.0]])
    for here, point in zip(geodetic(points, DATUM).tolist(), points, strict=True):
        assert east_north_up(tuple(here), DATUM) == pytest.approx(point, abs=1e-6)


def test_a_clock_that_is_set_back_is_that_of_everything_but_the_truth(tmp_path):
    recording = with_closures(simulate("warehouse", 3, **SMALL["warehouse"], gnss=5, imu=20), 20, seed=1)
    write_bag(recording, tmp_path / "a.mcap")
    drive, last = Drive(tmp_path / "a.mcap"), int(recording.stamps_ns[-1])
    drive.messages.append(Message("/tf", TRANSFORMS, last, transform(last, "odom", "base_link", se3.IDENTITY)))
    spoil_messages(drive, [Fault.named("clock_set_back", at=0.1)], seed=0)
    at_ns, back_ns, names = np.quantile(recording.stamps_ns, 0.1), 30_000_000_000, set()
    for m in drive.messages:
        if m.topic in (TRUTH_TOPIC, TRUE_LANDMARKS_TOPIC):
            assert isinstance(m.content, bytes)
        else:
            names |= {m.topic} if m.log_ns > at_ns else set()
            assert m.stamp_ns == m.log_ns - back_ns * (m.log_ns > at_ns)
    assert names == {"/odom", "/landmarks", "/gps/fix", "/imu/data", "/closures", "/tf"}
    earlier = {int(one.id) for m in drive.messages if m.topic == "/closures" for one in m.content.detections}
    closures = [m for m in measurements(recording) if isinstance(m, Closure)]
    assert earlier == {m.from_stamp_ns - back_ns * (m.from_stamp_ns > at_ns) for m in closures}
    assert any(m.from_stamp_ns > at_ns for m in closures)
    drive.write(tmp_path / "b.mcap")
