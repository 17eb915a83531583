"""A map of ranges that is the mirror image of the truth is turned over: odometry's turns say that it is likelier so."""

from dataclasses import asdict
from itertools import combinations

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.runs.outcome import ambiguities
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.robust import background
from graph_slam_ros.slam.robust.mirrored import is_of_ranges, mirror_images
from graph_slam_ros.tools.simulation import measurements, simulate

KINDS = [  # the sensor of the second is ahead of the base, so its ranges are only nearly the same
    ("pythonrobotics", {}, {}, 1e-6),
    ("flight", {"laps": 1}, {"world.dimensions": 3}, 4.0),
]


def driven(world, seed, options, settings, sensor="range"):
    recording = simulate(world, seed=seed, sensor=sensor, **options)
    slam = GraphSlam(Config.from_mapping(settings))
    for m in [*measurements(recording), Control("end")]:
        slam.process(m)
    return slam, recording


def sides(points):
    """Of each three points in a plane the side of the third from the way between the others."""
    return [
        np.sign(np.cross(*(np.append(p - points[a], 0.0) for p in (points[b], points[c])))[2])
        for a, b, c in combinations(sorted(points), 3)
    ]


def positions(slam):
    return {name: slam.solver.estimate([mark.vertex])[0] for name, mark in slam.landmarks.items()}


@pytest.mark.parametrize("seed", times([3, 20], range(30)))
def test_a_mirrored_map_is_turned_over_when_everything_is_solved(seed):
    """Of 30 drives whose turns have a sigma of 20 degrees, three began on the wrong side (13 m off)."""
    slam, recording = driven("pythonrobotics", seed, {}, {})
    slam.process(Control("optimize"))
    true = {name: np.array(recording.landmarks[name][:2]) for name in positions(slam)}
    assert len(true) > 3
    assert sides(positions(slam)) == sides(true)


def test_it_is_turned_over_on_the_way(monkeypatch):
    found, _ = driven("pythonrobotics", 16, {}, {})
    monkeypatch.setattr(background, "_FIRST_MIRRORED", 1000)
    wrong, recording = driven("pythonrobotics", 16, {}, {})
    true = sides({name: np.array(recording.landmarks[name][:2]) for name in positions(wrong)})
    assert sides(positions(wrong)) != true
    assert sides(positions(found)) == true


@pytest.mark.parametrize(("world", "options", "settings", "most"), KINDS)
def test_a_mirror_image_has_the_same_ranges_and_turns_the_other_way(world, options, settings, most):
    slam, _ = driven(world, 1, options, settings)
    graph, solver, space = slam.graph, slam.solver, slam.space
    values, ranges = solver.values, graph.edges_of("landmarks")
    before, odometry = solver.chi2_of(ranges)[0], solver.chi2_of(graph.edges_of("odometry"))[0].sum()
    images = list(mirror_images(graph, values))
    assert len(images) == space.dimensions - 1
    for image in images:
        solver.start_at(image)
        assert solver.chi2_of(ranges)[0] == pytest.approx(before, abs=most)
        assert solver.chi2_of(graph.edges_of("odometry"))[0].sum() > odometry + 10.0
        first = graph.vertex(int(slam.keyframes.ids[0])).stored
        assert np.allclose(image[first], values[first])
        assert any(np.allclose(again, values) for again in mirror_images(graph, image))


def test_where_odometry_does_not_decide_the_map_is_called_ambiguous():
    """Of the first keyframes both images fit; later turns decide, and nothing is said any more."""
    recording, slam, said = simulate("pythonrobotics", seed=10, sensor="range"), GraphSlam(Config()), []
    for m in [*measurements(recording), Control("end"), Control("optimize")]:
        slam.process(m)
        said.append(list(ambiguities([asdict(rival) for rival in slam.backend.rivals])))
    assert any("mirror image" in text for text, *_ in filter(None, said))
    assert not said[-1]


def test_turning_over_is_counted():
    slam, _ = driven("pythonrobotics", 20, {}, {})
    slam.process(Control("optimize"))
    assert slam.counters["map", "turned_over"] == 1


def test_only_ranges_and_odometry_are_mirrored():
    assert is_of_ranges(driven("pythonrobotics", 1, {}, {})[0].graph)
    assert not is_of_ranges(driven("pythonrobotics", 1, {}, {}, sensor="range_bearing")[0].graph)
