"""The map is held while the robot is located in it, and edited by hand while the robot drives."""

import numpy as np
import pytest
from driven import without_names

from graph_slam_ros.runs.map_journal import state_of
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.robust.ledger import Verdict
from graph_slam_ros.tools.simulation import measurements, simulate


@pytest.fixture(scope="module")
def world():
    return list(measurements(simulate("warehouse", 0, aisles=2, laps=2, aisle_m=8.0)))


def settings(**values):
    return Control("set", tuple((name.replace("__", "."), value) for name, value in values.items()))


HOLD = settings(map__localize=True)


def driven(slam, some):
    for m in some:
        slam.process(m)
    return slam


def places(slam):
    return {name: tuple(slam.solver.estimate([mark.vertex])[0]) for name, mark in slam.landmarks.items()}


def split(world, fraction):
    at = int(fraction * len(world))
    return world[:at], world[at:]


def test_while_the_map_is_held_it_stays_to_the_bit_and_the_robot_is_located_in_it(world):
    before, after = split(world, 0.6)
    mapped = driven(GraphSlam(), [*before, Control("optimize")])
    held = driven(GraphSlam(), [*before, HOLD])
    there, path = places(held), held.trajectory()
    driven(held, after)
    driven(mapped, after)
    assert places(held) == there
    assert held.trajectory()[: len(path)].tobytes() == path.tobytes()
    apart = np.linalg.norm(held.trajectory()[-1, :2] - mapped.trajectory()[-1, :2])
    sigma, of_mapping = (np.sqrt(np.trace(slam.pose_covariance[:2, :2])) for slam in (held, mapped))
    assert apart < 2.0 * of_mapping  # that far the map was off when it was held
    assert 0.0 < sigma < 0.2 * of_mapping
    seen = held.solver.evaluate().classes["landmarks"]
    assert seen.chi2 < 1.2 * seen.residuals
    assert held.landmark_covariances()[0].max() == 0.0


def test_what_the_held_map_does_not_have_is_counted_and_begins_no_landmark(world):
    before, after = split(world, 0.2)
    held = driven(GraphSlam(), [*before, HOLD])
    known = set(held.landmarks)
    everywhere = set(driven(GraphSlam(), world).landmarks)
    assert known < everywhere
    driven(held, after)
    assert set(held.landmarks) == known
    assert held.counters.as_dict()["/landmarks"]["not_in_map"] > 0


def test_unnamed_sightings_are_matched_to_the_held_map_and_begin_nothing(world):
    before, after = split(list(without_names(world)), 0.2)
    config = Config.from_mapping({"landmarks.association": "joint"})
    held = driven(GraphSlam(config), [*before, HOLD])
    there, known = places(held), held._landmarks.map.known
    names, sightings = set(known), sum(mark.sightings for mark in known.values())
    driven(held, after)
    assert (places(held), set(known)) == (there, names)
    assert sum(mark.sightings for mark in known.values()) > sightings


def test_holding_is_part_of_the_sequence_and_of_the_map_that_is_taken_up(world):
    before, after = split(world, 0.5)
    accepted = []
    live = driven(GraphSlam(sink=accepted.append), [*before, HOLD, *after])
    again = driven(GraphSlam(), accepted)
    assert again.trajectory().tobytes() == live.trajectory().tobytes()
    there = places(live)
    state = state_of(live)
    restored = GraphSlam(Config().changed(state.settings), start=state)
    assert restored.config.map.localize
    assert len(restored.solver.held) == len(restored.solver.vertices)
    assert places(restored).keys() == there.keys()
    assert np.array(list(places(restored).values())) == pytest.approx(np.array(list(there.values())), abs=1e-6)


def test_a_landmark_that_is_removed_is_gone_and_begins_anew_when_it_is_seen(world):
    before, after = split(world, 0.5)
    slam = driven(GraphSlam(), before)
    name = max(slam.landmarks, key=lambda one: slam.landmarks[one].last_seen_ns)
    vertex = slam.landmarks[name].vertex
    slam.process(Control("remove", (("landmark", name),)))
    assert name not in slam.landmarks
    assert slam.is_solved
    assert vertex not in slam.solver.vertices
    driven(slam, after)
    assert slam.landmarks[name].vertex != vertex
    assert slam.counters.as_dict()["edit"] == {"removed": 1}


def test_an_edge_that_is_removed_stays_out_and_the_last_one_takes_its_landmark_along(world):
    slam = driven(GraphSlam(), split(world, 0.3)[0])
    name, mark = next(iter(slam.landmarks.items()))
    edges = [e for e in slam.graph.edges_of("landmarks").tolist() if mark.vertex in _vertices(slam, e)]
    for edge in edges:
        slam.process(Control("remove", (("edge", edge),)))
    assert all(slam.ledger.verdict_of(edge) is Verdict.REJECTED for edge in edges)
    assert name not in slam.landmarks
    slam.process(Control("optimize"))
    assert slam.is_solved
    assert all(slam.ledger.verdict_of(edge) is Verdict.REJECTED for edge in edges)


def _vertices(slam, edge):
    table, row = slam.graph.row(edge)
    return table.vertices.values[row].tolist()


def test_what_cannot_be_removed_is_counted_and_changes_nothing(world):
    slam = driven(GraphSlam(), [*split(world, 0.3)[0], Control("optimize")])
    path = slam.trajectory().tobytes()
    odometry = int(slam.graph.edges_of("odometry")[0])
    name = next(iter(slam.landmarks))
    for what in (("edge", 10**6), ("edge", -1), ("edge", odometry), ("landmark", "nobody")):
        slam.process(Control("remove", (what,)))
    assert slam.trajectory().tobytes() == path
    driven(slam, [HOLD, Control("remove", (("landmark", name),))])
    counted = slam.counters.as_dict()["edit"]
    assert counted == {"unknown_edge": 2, "needed_edge": 1, "unknown_landmark": 1, "held_in_map": 1}
