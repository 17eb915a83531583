"""The map is held while the robot is located in it, and edited by hand while the robot drives."""

import numpy as np
import pytest
from driven import without_names

from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.robust.ledger import Verdict
from graph_slam_ros.tools.simulation import measurements, simulate


@pytest.fixture(scope="module")
def world():
    return list(measurements(simulate("warehouse", 0, aisles=2, laps=2, aisle_m=5.0)))


def test_while_the_map_is_held_it_stays_to_the_bit_the_robot_is_located_in_it_and_a_replay_does_the_same(world):
    before, after = split(world, 0.6)
    accepted = []
    mapped = driven(GraphSlam(), [*before, Control("optimize")])
    held = driven(GraphSlam(sink=accepted.append), [*before, HOLD])
    there, path = places(held.view), held.view.trajectory()
    driven(held, after)
    driven(mapped, after)
    assert places(held.view) == there
    assert held.view.trajectory()[: len(path)].tobytes() == path.tobytes()
    apart = np.linalg.norm(held.view.trajectory()[-1, :2] - mapped.view.trajectory()[-1, :2])
    sigma, of_mapping = (np.sqrt(np.trace(slam.view.pose_covariance[:2, :2])) for slam in (held, mapped))
    assert apart < 2.0 * of_mapping  # that far the map was off when it was held
    assert 0.0 < sigma < 0.2 * of_mapping
    seen = held.view.solver.evaluate().classes["landmarks"]
    assert seen.chi2 < 1.2 * seen.residuals
    assert held.view.landmark_covariances()[0].max() == 0.0
    assert driven(GraphSlam(), accepted).view.trajectory().tobytes() == held.view.trajectory().tobytes()
    state = held.view.snapshot()
    restored = GraphSlam(Config().changed(state.settings), start=state)
    assert restored.view.config.map.localize
    assert len(restored.view.solver.held) == len(restored.view.solver.vertices)
    assert places(restored.view).keys() == there.keys()
    assert np.array(list(places(restored.view).values())) == pytest.approx(np.array(list(there.values())), abs=1e-6)


def test_edges_and_landmarks_are_removed_and_what_cannot_be_is_counted_and_changes_nothing(world):
    before, after = split(world, 0.3)
    slam = driven(GraphSlam(), [*before, Control("optimize")])
    path, graph = slam.view.trajectory().tobytes(), slam.view.graph
    for what in (("edge", 10**6), ("edge", -1), ("edge", int(graph.edges_of("odometry")[0])), ("landmark", "nobody")):
        slam.process(Control("remove", (what,)))
    assert slam.view.trajectory().tobytes() == path
    (name, mark), *_ = slam.view.landmarks.items()
    edges = [e for e in graph.edges_of("landmarks").tolist() if mark.vertex in graph.edge(e).vertices]
    for edge in edges:
        slam.process(Control("remove", (("edge", edge),)))
    assert name not in slam.view.landmarks, "the last edge takes it along"
    last = max(slam.view.landmarks, key=lambda one: slam.view.landmarks[one].last_seen_ns)
    vertex = slam.view.landmarks[last].vertex
    driven(slam, [Control("remove", (("landmark", last),)), Control("optimize")])
    assert last not in slam.view.landmarks
    assert slam.view.is_solved
    assert vertex not in slam.view.solver.vertices
    driven(slam, after)
    assert all(slam.view.ledger.verdict_of(edge) is Verdict.REJECTED for edge in edges)
    assert slam.view.landmarks[last].vertex != vertex, "it begins anew"
    driven(slam, [HOLD, Control("remove", (("landmark", last),))])
    counted = slam.counters.as_dict()["edit"]
    assert counted.pop("removed") == len(edges) + 1
    assert counted == {"unknown_edge": 2, "needed_edge": 1, "unknown_landmark": 1, "held_in_map": 1}


HOLD = Control("set", (("map.localize", True),))


def driven(slam, some):
    for m in some:
        slam.process(m)
    return slam


def places(view):
    return {name: tuple(view.solver.estimate([mark.vertex])[0]) for name, mark in view.landmarks.items()}


def split(world, fraction):
    at = int(fraction * len(world))
    return world[:at], world[at:]


@pytest.mark.parametrize("association", ["id", "joint"])
def test_sightings_are_matched_to_the_held_map_and_what_it_does_not_have_begins_nothing(world, association):
    before, after = split(list(without_names(world)) if association == "joint" else world, 0.2)
    held = driven(GraphSlam(Config.from_mapping({"landmarks.association": association})), [*before, HOLD])
    there, sightings = places(held.view), sum(mark.sightings for mark in held.view.landmarks.values())
    driven(held, after)
    assert places(held.view) == there
    assert sum(mark.sightings for mark in held.view.landmarks.values()) > sightings
    assert association == "joint" or held.counters.as_dict()["/landmarks"]["not_in_map"] > 0
