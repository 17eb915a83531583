"""Worlds: what is measured is off the truth by its noise, and a bag has what was measured."""

import itertools

import numpy as np
import pytest

from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config, Counters, Fix, Odometry
from graph_slam_ros.tools.simulation import WORLDS, city_graph, measurements, simulate, sphere_graph, write_bag
from graph_slam_ros.tools.simulation.instruments import ANTENNA_M, DATUM
from graph_slam_ros.tools.simulation.recording import space_of

SMALL = {
    "pythonrobotics": {},
    "manhattan": {"poses": 60, "blocks": 6},
    "warehouse": {"aisles": 2, "laps": 1},
    "flight": {"laps": 1, "beacons": 4},
}


@pytest.mark.parametrize("world", WORLDS)
def test_a_bag_decodes_to_the_measurements_it_was_made_of(world, tmp_path):
    recording = simulate(world, 1, **SMALL[world])
    write_bag(recording, tmp_path / "bag.mcap")
    counters = Counters()
    border = MessageConverter(Config.from_mapping({"world.dimensions": 3 if world == "flight" else 2}), counters)
    decoded = []
    for record in open_bag(tmp_path / "bag.mcap").messages(["/odom", "/landmarks"]):
        decoded += border.convert("odom" if record.topic == "/odom" else "detections", record.cdr)
    for a, b in itertools.zip_longest(decoded, measurements(recording)):
        assert (type(a), a.stamp_ns) == (type(b), b.stamp_ns)
        if isinstance(a, Odometry):
            assert a.T_odom_base == pytest.approx(b.T_odom_base, abs=1e-12)
            assert a.twist_covariance == pytest.approx(b.twist_covariance)
            continue
        for one, other in zip(a.sightings, b.sightings, strict=True):
            assert one.id == other.id
            assert one.measured == pytest.approx(other.measured, abs=1e-12)
            assert one.covariance == pytest.approx(other.covariance, abs=1e-12)
    assert counters.as_dict() == {}


def chi2_at(graph, values, label, edge_type):
    """The mean square of whitened residuals, by how much it may be off one, and the ends of the edges of a class."""
    table, size = graph.tables[edge_type], values.shape[1]
    residual, _ = edge_type.linearize(values.ravel(), size * table.vertices, table.measured.values)
    mine = table.label.values == graph.labels.index(label)
    whitened = np.einsum("nij,nj->ni", table.sqrt_information.values[mine], residual[mine])
    return (whitened**2).mean(), 5.0 * np.sqrt(2.0 / whitened.size), table.vertices[mine]


def test_the_truth_explains_the_graph_of_a_city_or_sphere_within_its_noise():
    for factor in (1.0, 5.0):
        city, truth = city_graph(4, poses=3000, blocks=10, odometry_noise_factor=factor)
        for label in ("odometry", "closures"):
            mean, most, ends = chi2_at(city, truth, label, RELATIVE_POSE)
            assert mean == pytest.approx(1.0, abs=most)

    earlier, later = ends.T
    assert len(ends) == pytest.approx(3000 / 3, rel=0.05)
    assert (later - earlier).min() >= 20 and len(np.unique(later)) == len(later)
    assert np.abs(truth[earlier, :2] - truth[later, :2]).max() <= 2.0
    for sigma_rad in (0.01, 0.1):
        sphere, truth = sphere_graph(2, poses=1000, sigma_rad=sigma_rad, odometry_noise_factor=2.0)
        for label in ("odometry", "closures"):
            mean, most, ends = chi2_at(sphere, truth, label, RELATIVE_POSE_3D)
            assert mean == pytest.approx(1.0, abs=most)


INPUTS = {
    "gps": {"type": "sensor_msgs/msg/NavSatFix", "topic": "/gps/fix", "datum": " ".join(map(str, DATUM))},
    "imu": {"type": "sensor_msgs/msg/Imu", "topic": "/imu/data"},
}


def fixes_of(recording, path, name):
    """What the border makes of an instrument, what it counts, and the true poses (n, 7) then."""
    write_bag(recording, path)
    dimensions = space_of(recording.T_world_base[0]).dimensions
    settings = {"inputs.names": f"odom {name}", name: INPUTS[name], "world.dimensions": dimensions}
    config, bag = Config.from_mapping(settings), open_bag(path)
    runs = RecordedRuns(bag, choose_inputs(bag, config), config)
    fixes = [m for _, some in runs for m in some if isinstance(m, Fix)]
    at = np.searchsorted(recording.stamps_ns, [m.stamp_ns for m in fixes])
    return fixes, runs.counters, se3.in_space(recording.T_world_base)[at]


@pytest.mark.parametrize("world", ["warehouse", "flight"])
def test_fixes_are_where_the_antenna_truly_was_as_well_as_their_covariance_says(world, tmp_path):
    small = {"aisles": 2, "aisle_m": 8.0} if world == "warehouse" else {}
    recording = simulate(world, 3, laps=1, **small, gnss=5, gnss_correlation_s=0.0, gnss_outage_s=4.0)
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
