"""The start of the beam from the solver, against the inverse of the dense information matrix of the whole graph."""

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.association.beam import BeamSettings
from graph_slam_ros.slam.association.belief import SolverBelief
from graph_slam_ros.slam.association.scans import Cluster, Reckoned, Scan
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.landmarks.rotations import rotation_vector

S = 1_000_000_000
SPACES = {2: PLANAR, 3: SPATIAL}
MARKS = np.array([[4.0, 1.0, 0.5], [3.0, -2.0, 1.0], [6.0, 0.5, -0.5], [5.0, 3.0, 0.0]])
SCALE_SIGMA = 0.1


def moved(n, x, y, yaw):
    return (x, y, yaw) if n == 2 else (x, y, 0.1 * x, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


@pytest.fixture(scope="module", params=[2, 3])
def drive(request):
    """Five keyframes, each of which sees four landmarks."""
    n = request.param
    space, rng = SPACES[n], np.random.default_rng(n)
    slam = GraphSlam(Config.from_mapping({"world.dimensions": n, "solve.every_keyframes": 1}))
    for k in range(5):
        at = moved(n, 0.6 * k, 0.1 * k, 0.3 * k)
        slam.process(Odometry(k * S, at, None))
        seen = np.stack(space.group.act(space.group.inverse(at), tuple(MARKS[:, :n].T)), axis=1)
        seen += 0.05 * rng.normal(size=seen.shape)
        noise = tuple((0.05**2 * np.eye(n)).ravel().tolist())
        found = [Sighting(str(i), "position", tuple(p.tolist()), noise) for i, p in enumerate(seen)]
        slam.process(Sightings(k * S, "eye", tuple(found)))
    for control in ("end", "optimize"):
        slam.process(Control(control))
    return n, slam


def a_scan(n, view):
    """Half a second after the last keyframe, with odometry's covariance since; one cluster at landmark 2."""
    space, rng = SPACES[n], np.random.default_rng(7)
    root = 0.02 * rng.normal(size=(space.dof, space.dof))
    last, vertex = len(view.keyframes) - 1, int(view.keyframes.ids[-1])
    where = PoseAtStamp(last, vertex, 9 * S // 2, moved(n, 0.4, -0.2, 0.5), root @ root.T)
    base = space.group.compose(tuple(view.solver.estimate([vertex])[0]), where.T_keyframe_base)
    seen = np.array(space.group.act(space.group.inverse(base), tuple(MARKS[2, :n])))
    return Scan(Reckoned(0, space.identity), where, (Cluster(seen, np.eye(n), ()),))


def dense(n, view, scan, names):
    """Covariance of position, rotation in the robot's frame and landmarks: central differences of dense marginals."""
    space, solver = SPACES[n], view.solver
    covariance = np.linalg.inv(solver.information_matrix())
    vertices = np.arange(view.graph.vertex_count)
    dof = [view.graph.kind_of(v).dof for v in vertices.tolist()]
    first = np.cumsum([0, *dof])
    marks = [view.landmarks[name].vertex for name in names]
    keyframe = scan.where.vertex
    rows = np.concatenate([np.arange(first[v], first[v + 1]) for v in (keyframe, *marks)])
    covariance = covariance[np.ix_(rows, rows)]
    T_map_keyframe = tuple(solver.estimate([keyframe])[0])
    places = solver.estimate(marks)[:, :n]
    d = space.dof
    step = scan.where.covariance
    whole = np.zeros((len(covariance) + d,) * 2)
    whole[: len(covariance), : len(covariance)] = covariance
    whole[len(covariance) :, len(covariance) :] = step
    base = space.group.compose(T_map_keyframe, scan.where.T_keyframe_base)

    def state(e):
        at = space.group.retract(T_map_keyframe, tuple(e[:d]))
        now = space.group.compose(at, space.group.retract(scan.where.T_keyframe_base, tuple(e[-d:])))
        turn = rotation_vector((space.turn(base).T @ space.turn(now))[None])[0]
        return np.concatenate([now[:n], turn, (places + e[d:-d].reshape(-1, n)).ravel()])

    h = 1e-6
    j = np.array([(state(h * e) - state(-h * e)) / (2.0 * h) for e in np.eye(len(whole))]).T
    return j @ whole @ j.T


def belief_of(n, slam):
    return SolverBelief(SPACES[n], slam.view.solver, slam._landmarks.map)


def without_scales(covariance, dof):
    keep = np.r_[:dof, dof + 2 : len(covariance)]
    return covariance[np.ix_(keep, keep)]


def test_a_beam_begins_with_the_joint_gaussian_of_the_whole_graph(drive):
    n, slam = drive
    scan, names, dof = a_scan(n, slam.view), {k: str(k) for k in range(len(MARKS))}, SPACES[n].dof
    beam = belief_of(n, slam).begin(BeamSettings(10.0, 0.0), scan, names, np.zeros(2), SCALE_SIGMA)
    covariance, known = beam.covariance[0], dense(n, slam.view, scan, [names[k] for k in beam.ids[0].tolist()])
    assert without_scales(covariance, dof) == pytest.approx(known, rel=1e-5, abs=1e-9)
    assert covariance[dof : dof + 2] == pytest.approx(SCALE_SIGMA**2 * np.eye(len(covariance))[dof : dof + 2])
