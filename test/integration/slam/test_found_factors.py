"""Factors of odometry that the association of landmarks without identities finds: the graph is corrected by them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_unnamed import park, path_rmse, without_ids

from graph_slam_ros.runs.map_journal import MapGrowth, extend
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.tools.simulation import measurements

SCALE = 1.1  # odometry tells so many times the way
SETTINGS = {"landmarks.association": "joint", "robust.noise_scale": "configured"}


@pytest.fixture(scope="module")
def recording():
    return park(1, laps=1)


def too_long(recording):
    for m in [*measurements(recording), Control("end"), Control("optimize")]:
        if isinstance(m, Odometry):
            x, y, heading = m.T_odom_base
            m = replace(m, T_odom_base=(SCALE * x, SCALE * y, heading))
        yield without_ids(m)


@pytest.fixture(scope="module")
def corrected(recording):
    """The pipeline after the drive, and its map as its records have it."""
    slam, growth, state = GraphSlam(Config.from_mapping(SETTINGS)), MapGrowth(), MapSnapshot()
    for k, m in enumerate(too_long(recording)):
        slam.process(m)
        if k % 500 == 0 or m == Control("optimize"):
            for record in growth.of(slam):
                if record["type"] == "growth":
                    extend(state, json.loads(json.dumps(record)))
    return slam, state


def test_the_factor_that_the_association_finds_corrects_the_graph(recording, corrected):
    slam, _ = corrected
    assert slam.calibrated("odometry", "distance") == pytest.approx(1.0 / SCALE, abs=0.015)
    assert slam.calibrated("odometry", "turn") == 1.0, "one circle does not determine it"
    assert slam.found_settings == {"odometry.distance_factor": pytest.approx(1.0 / SCALE, abs=0.015)}
    assert [one.parameter.name for one in slam.corrected] == ["distance"] * len(slam.corrected)
    assert path_rmse(slam, recording) < 0.4
    assert len(slam.landmarks) == len(recording.landmarks)


def test_a_map_has_the_corrected_measurements_and_goes_on_with_its_factors_whatever_is_configured(corrected):
    slam, state = corrected
    assert slam.recalibrations
    assert state.calibration == slam.calibration
    for mine, read in zip(slam.graph.tables.values(), state.graph.tables.values(), strict=True):
        np.testing.assert_array_equal(read.measured.values, mine.measured.values)
        np.testing.assert_array_equal(read.sqrt_information.values, mine.sqrt_information.values)
    state.values = slam.solver.values
    again = GraphSlam(Config.from_mapping(SETTINGS | {"odometry.distance_factor": 1.2}), start=state)
    assert again.calibrated("odometry", "distance") == pytest.approx(slam.calibrated("odometry", "distance"))
    assert again.calibration == pytest.approx(slam.calibration)
