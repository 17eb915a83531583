"""Edge types: derivatives against central differences, hand-computed residuals, and one written by a user."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros import graph as g
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se3, so3


def direction(rng):
    u = rng.standard_normal(3)
    return u / np.linalg.norm(u)


DRAWN = {
    g.RANGE_BEARING: lambda rng: [rng.uniform(0.5, 9.0), rng.uniform(-np.pi, np.pi)],
    g.BEARING: lambda rng: [rng.uniform(-np.pi, np.pi)],
    g.RANGE: lambda rng: [rng.uniform(0.5, 9.0)],
    g.RANGE_WITH_OFFSET: lambda rng: [rng.uniform(0.5, 9.0)],
    g.RANGE_BEARING_3D: lambda rng: [rng.uniform(0.5, 9.0), rng.uniform(-np.pi, np.pi), rng.uniform(-1.5, 1.5)],
    g.BEARING_3D: lambda rng: [rng.uniform(-np.pi, np.pi), rng.uniform(-1.5, 1.5)],
    g.RANGE_3D: lambda rng: [rng.uniform(0.5, 9.0)],
    g.RANGE_WITH_OFFSET_3D: lambda rng: [rng.uniform(0.5, 9.0)],
    g.POSITION_PRIOR: None,
    g.COORDINATE_PRIOR: lambda rng: [*direction(rng)[:2], rng.normal()],
    g.HEADING_PRIOR: lambda rng: [rng.uniform(-np.pi, np.pi)],
    g.POSITION_PRIOR_3D: None,
    g.COORDINATE_PRIOR_3D: lambda rng: [*direction(rng), rng.normal()],
    g.ATTITUDE_PRIOR_3D: lambda rng: so3.exp(tuple(rng.standard_normal(3))),
    g.HEADING_PRIOR_3D: lambda rng: [rng.uniform(-np.pi, np.pi)],
    g.TAG_POSITION_3D: None,
    **dict.fromkeys((g.RELATIVE_POSE, g.INVERSE_RELATIVE_POSE, g.POSE_PRIOR)),
    **dict.fromkeys((*g.DIFFERENCE.values(), *g.POINT_PRIOR.values())),
    g.LANDMARK_POSITION: None,
    g.TAG_POSITION: None,
    g.LANDMARK_POSITION_3D: None,
    g.RELATIVE_POSE_3D: lambda rng: se3.exp(tuple(rng.standard_normal(6))),
    g.POSE_PRIOR_3D: lambda rng: se3.exp(tuple(rng.standard_normal(6))),
}


@each("edge", DRAWN)
def test_an_edge_type_is_what_the_solver_takes_it_for(edge):
    g.check_edge(edge, DRAWN[edge], tolerance=3e-7)


@each("edge", [edge for edge in DRAWN if edge.tail])
def test_so_it_is_with_a_sensor_anywhere_on_the_robot(edge):
    def draw(rng):
        size = len(edge.tail)
        place = se3.exp(tuple(rng.standard_normal(6))) if size == 7 else rng.standard_normal(size)
        head = DRAWN[edge](rng) if DRAWN[edge] else rng.standard_normal(edge.measured_size - size)
        return [*head, *place]

    g.check_edge(edge, draw, tolerance=3e-6)  # relative to derivatives that grow where a landmark is near the sensor


def residual(edge, values, measured):
    x = np.concatenate([np.asarray(v, dtype=float) for v in values])
    at = np.cumsum([0, *(len(v) for v in values[:-1])])[None, :]
    return edge.linearize(x, at, edge.whole([measured]))[0][0]


UP = (*so3.exp((0.0, 0.0, np.pi / 2)),)  # a quarter turn to the left
NOSE_UP = (*so3.exp((0.0, -np.pi / 4, 0.0)),)


@each(
    "edge, values, measured, expected",
    [
        # from (1, 2) facing north, (2, 5) lies 3 ahead and 1 to the right; (0.5, -0.5) is turned back by 0.3
        (
            g.RELATIVE_POSE,
            ([1, 2, np.pi / 2], [2, 5, np.pi / 2 + 0.5]),
            [2.5, -0.5, 0.3],
            [0.5 * (np.cos(0.3) - np.sin(0.3)), -0.5 * (np.cos(0.3) + np.sin(0.3)), 0.2],
        ),
        (g.LANDMARK_POSITION, ([1, 2, np.pi / 2], [-1, 5]), [2.9, 2.2], [0.1, -0.2]),
        (g.TAG_POSITION, ([1, 2, np.pi / 2], [-1, 5, 2.2]), [2.9, 2.2], [0.1, -0.2]),
        (g.POSE_PRIOR, ([1, 3, np.pi / 2 + 0.1],), [1, 2, np.pi / 2], [1.0, 0.0, 0.1]),
        (g.RELATIVE_POSE, ([1, 2, 0.5], [1, 2, 0.5 + np.pi + 1e-3]), [0, 0, 3 * np.pi], [0, 0, 1e-3]),
        # a robot at (1, 2) that looks along y sees (-3, 5) at 3 ahead and 4 to its left
        (g.RANGE_BEARING, ([1, 2, np.pi / 2], [-3, 5]), [4.5, 0.1], [0.5, np.arctan2(4, 3) - 0.1]),
        (g.BEARING, ([1, 2, np.pi / 2], [-3, 5]), [0.0], [np.arctan2(4, 3)]),
        (g.BEARING, ([0, 0, 0], [-1, -1e-3]), [3.14], [np.pi + np.arctan(1e-3) - 3.14]),  # over the cut
        (g.RANGE, ([1, 2, 0.3], [-3, 5]), [4.5], [0.5]),
        (g.RANGE_WITH_OFFSET, ([1, 2, 0.3], [-3, 5], [0.7]), [4.5], [1.2]),
        (g.RANGE_BEARING_3D, ([1, 2, 0, *UP], [1, 5, 4]), [4.0, 0.1, 0.2], [1.0, -0.1, np.arctan2(4, 3) - 0.2]),
        (g.BEARING_3D, ([0, 0, 0, *UP], [-2, 0, 0]), [0.0, 0.0], [np.pi / 2, 0.0]),
        (g.RANGE_3D, ([1, 2, 0, *UP], [1, 5, 4]), [4.0], [1.0]),
        (g.RANGE_WITH_OFFSET_3D, ([1, 2, 0, *UP], [1, 5, 4], [-2.0]), [4.0], [-1.0]),
        # and so it does by a sensor at its 1 ahead, 2 to its left, that looks to its left: 2 ahead, 2 to the right
        (g.RANGE_BEARING, ([1, 2, np.pi / 2], [-3, 5]), [2, 0, 1, 2, np.pi / 2], [8**0.5 - 2, -np.pi / 4]),
        (g.RANGE, ([1, 2, np.pi / 2], [-3, 5]), [2, 1, 2, 7], [8**0.5 - 2]),
        (g.BEARING_3D, ([0, 0, 0, *UP], [-2, 0, 1]), [0, 0, 0, 0, 1, *UP], [0, 0]),
        (g.POSITION_PRIOR, ([3, 4, np.pi / 2],), [1, 1, 10, 20], [-18, 13]),
        (g.COORDINATE_PRIOR, ([3, 4, np.pi / 2],), [0, 1, 1, 10, 20], [13]),
        (g.POSITION_PRIOR_3D, ([3, 4, 5, *UP],), [1, 1, 1, 10, 20, 30], [-18, 13, 34]),
        (g.COORDINATE_PRIOR_3D, ([3, 4, 5, *UP],), [0, 1, 0, 1, 10, 20, 30], [13]),
        (g.POSITION_PRIOR, ([3, 4, 1],), [1, 1], [2, 3]),
        (g.COORDINATE_PRIOR, ([3, 4, 1],), [0.6, 0.8, 1], [4]),
        (g.HEADING_PRIOR, ([3, 4, 3.0],), [-3.0], [6 - 2 * np.pi]),
        (g.POSITION_PRIOR_3D, ([3, 4, 5, *UP],), [1, 1, 1], [2, 3, 4]),
        (g.COORDINATE_PRIOR_3D, ([3, 4, 5, *UP],), [0, 0, 1, 1], [4]),
        (g.ATTITUDE_PRIOR_3D, ([3, 4, 5, *UP],), [0, 0, 0, 1], [0, 0, np.pi / 2]),
        (g.HEADING_PRIOR_3D, ([3, 4, 5, *so3.compose(UP, NOSE_UP)],), [1.0], [np.pi / 2 - 1.0]),
    ],
)
def test_residuals_are_those_computed_by_hand(edge, values, measured, expected):
    assert residual(edge, values, measured) == pytest.approx(expected, abs=1e-12)


@each("edge", [g.RANGE_BEARING, g.BEARING, g.RANGE_BEARING_3D, g.BEARING_3D, g.RANGE, g.RANGE_3D])
def test_a_landmark_at_the_sensor_gives_finite_numbers(edge):
    values = [0, 0, 0.3, 0, 0] if edge.accepts[0] == (g.SE2,) else [0, 0, 0, *UP, 0, 0, 0]
    at = np.array([[0, 3 if len(values) == 5 else 7]])
    for array in edge.linearize(np.array(values, dtype=float), at, np.zeros((1, edge.measured_size))):
        assert np.isfinite(array).all()


def _speed(values, measured):
    """Of two poses a known time apart: how fast the robot went, whatever way."""
    a, b = values
    return [np.hypot(*(b[:2] - a[:2])) / measured[1] - measured[0]]


def speed(**more):
    return g.edge_from_residual("speed", ((g.SE2,), (g.SE2,)), 2, 1, _speed, **more)


def of_numbers(linearize):
    return g.EdgeType("odd", ((g.R1,),), 1, 1, linearize)


@each(
    "edge, complaint",
    [
        (speed(jacobian=lambda v, z: [[1.0, 0, 0, 0, 0, 0]]), r"speed: Jacobian\[0, \d\] is"),
        (speed(jacobian=lambda v, z: [[np.nan, 0, 0, 0, 0, 0]]), "speed: not finite at vertices"),
        (of_numbers(lambda x, at, z: (np.zeros(len(at)), np.zeros((len(at), 1, 1)))), "shapes"),
        (
            of_numbers(lambda x, at, z: (x[at] * 0.0 + len(at), np.zeros((len(at), 1, 1)))),
            "odd: edges linearised in one call",
        ),
        (
            of_numbers(lambda x, at, z: (x.__iadd__(1.0)[at] * 0.0, np.zeros((len(at), 1, 1)))),
            "writes into what it was given",
        ),
    ],
)
def test_the_check_names_what_is_wrong(edge, complaint):
    with pytest.raises(GraphSlamError, match=complaint):
        g.check_edge(edge, (lambda rng: rng.uniform(0.5, 2.0, 2)) if edge.measured_size == 2 else None)
