"""The batch solver against independent optimisers and dense algebra, and what it must refuse."""

import functools
import itertools

import numpy as np
import pytest
from rows import each
from scipy.optimize import least_squares

from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph import (
    CAUCHY,
    HUBER,
    LANDMARK_POSITION,
    NONE,
    POSE_PRIOR,
    POSITION_PRIOR,
    R2,
    RELATIVE_POSE,
    SE2,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver

POSES, POINTS = 12, 3
TIGHT = {"step_tolerance": 1e-11, "cost_tolerance": 1e-15, "max_iterations": 100}
EPS = np.finfo(float).eps


def covariance(rng, size, sigma):
    a = rng.standard_normal((size, size))
    return sigma**2 * (a @ a.T / size + 0.3 * np.eye(size))


class World:
    """A loop of poses with landmarks: the graph, and the same problem as plain arrays for the oracle."""

    def __init__(self, seed=0, *, origin=(0.0, 0.0), outliers=False):
        rng = np.random.default_rng(seed)
        self.graph, self.edges = Graph(), []
        turn = 2 * np.pi / POSES
        truth = [(*origin, 0.3)]
        for _ in range(POSES - 1):
            truth.append(se2.compose(truth[-1], (2.0, 0.1, turn)))
        points = np.array(origin) + rng.uniform(-4, 4, (POINTS, 2)) + [0.0, 3.0]
        self.true = np.concatenate([np.ravel(truth), points.ravel()])
        estimate, steps = [truth[0]], []
        for i in range(POSES - 1):
            sigma = covariance(rng, 3, 0.05)
            step = se2.retract(se2.between(truth[i], truth[i + 1]), rng.multivariate_normal(np.zeros(3), sigma))
            steps.append((RELATIVE_POSE, (i, i + 1), step, sigma, "odometry"))
            estimate.append(se2.compose(estimate[-1], step))
        self.graph.add_vertices(SE2, estimate)
        self.graph.add_vertices(R2, points + 0.3 * rng.standard_normal((POINTS, 2)))
        self.anchor = covariance(rng, 3, 0.2)
        self.add(POSE_PRIOR, (0,), truth[0], self.anchor, "anchor")
        for step in steps:
            self.add(*step)
        for i, j in ((0, 11), (2, 9), (5, 1)):
            sigma = covariance(rng, 3, 0.05)
            z = se2.retract(se2.between(truth[i], truth[j]), rng.multivariate_normal(np.zeros(3), sigma))
            self.add(RELATIVE_POSE, (i, j), z, sigma, "closures")
        for i in range(POSES):
            for k in range(POINTS):
                sigma = covariance(rng, 2, 0.1)
                seen = se2.act(se2.inverse(truth[i]), points[k]) + rng.multivariate_normal(np.zeros(2), sigma)
                if outliers and (i, k) in ((1, 1), (7, 0), (9, 2)):
                    seen = np.add(seen, [1.5, -2.0])
                self.add(LANDMARK_POSITION, (i, POSES + k), seen, sigma, "landmarks")

    def add(self, kind, ends, measured, sigma, label):
        self.graph.add_edge(kind, ends, measured, Gaussian.from_covariance(sigma), label)
        self.edges.append((kind, ends, np.array(measured), np.linalg.inv(np.linalg.cholesky(sigma)), label))

    def solver(self, **settings):
        solver = Solver(self.graph, Settings(**settings))
        solver.add(range(self.graph.vertex_count), range(self.graph.edge_count))
        return solver


def homogeneous(v):
    c, s = np.cos(v[2]), np.sin(v[2])
    return np.array([[c, -s, v[0]], [s, c, v[1]], [0.0, 0.0, 1.0]])


def whitened(world, x, losses):
    """Residuals whose squares sum up to the cost, with matrices and nothing of the package."""
    poses, points = x[: 3 * POSES].reshape(-1, 3), x[3 * POSES :].reshape(-1, 2)
    out = []
    for kind, ends, z, root, label in world.edges:
        if kind is LANDMARK_POSITION:
            r = (np.linalg.inv(homogeneous(poses[ends[0]])) @ [*points[ends[1] - POSES], 1.0])[:2] - z
        else:
            first = homogeneous(poses[ends[0]])
            t = first if len(ends) == 1 else np.linalg.inv(first) @ homogeneous(poses[ends[1]])
            t = np.linalg.inv(homogeneous(z)) @ t
            r = np.array([t[0, 2], t[1, 2], np.arctan2(t[1, 0], t[0, 0])])
        r = root @ r
        s = r @ r
        name, scale = losses.get(label, ("none", 1.0))
        if name == "huber" and s > scale**2:
            r = r * np.sqrt((2 * scale * np.sqrt(s) - scale**2) / s)
        if name == "cauchy":
            r = r * np.sqrt(scale**2 * np.log1p(s / scale**2) / s)
        out.append(r)
    return np.concatenate(out)


@functools.cache
def oracle(loss):
    """From near the truth: a redescending loss from dead reckoning may end elsewhere."""
    world = World(1, outliers=loss != "none")
    losses = {} if loss == "none" else {"landmarks": (loss, SCALES[loss])}
    ends = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-12}
    found = least_squares(lambda x: whitened(world, x, losses), world.true, jac="3-point", **ends)
    found.x[2 : 3 * POSES : 3] = se2.wrap(found.x[2 : 3 * POSES : 3])
    return found.x, 2.0 * found.cost


STAGES = {"none": [Loss(NONE)], "huber": [Loss(HUBER, 1.0)], "cauchy": [Loss(HUBER, 1.0), Loss(CAUCHY, 2.0)]}
SCALES = {"huber": 1.0, "cauchy": 2.0}


@each("method", ["gn", "lm", "dogleg"])
@each("loss", ["none", "huber", "cauchy"])
def test_the_optimum_is_that_of_an_independent_optimiser(loss, method):
    best, cost = oracle(loss)
    solver = World(1, outliers=loss != "none").solver(method=method, losses={"landmarks": STAGES[loss]}, **TIGHT)
    report = solver.optimize()
    assert (report.converged, report.method) == (True, method)
    # the cost is quadratic at its minimum: 1e-9 of it are 1e-4 of a sigma (0.05) and more where it is flat
    assert report.cost_final == pytest.approx(cost, rel=1e-9)
    assert report.cost_final <= cost * (1.0 + 1e-12)
    assert solver.estimate(range(POSES)) == pytest.approx(best[: 3 * POSES].reshape(-1, 3), abs=5e-5)
    assert solver.estimate(range(POSES, POSES + POINTS)).ravel() == pytest.approx(best[3 * POSES :], abs=5e-5)
    if loss == "none":
        assert report.chi2_final == pytest.approx(report.cost_final, rel=1e-12)
    else:
        assert report.chi2_final > 1.5 * report.cost_final  # the outliers are there, and are not in the cost


def test_a_report_adds_up():
    world = World(2, outliers=True)
    solver = world.solver(losses={"landmarks": [Loss(HUBER, 1.5)]})
    start = world.graph.initial.values.copy()
    report = solver.optimize()
    assert report.stop in ("step", "cost")
    plain, huber = (whitened(world, start, losses) for losses in ({}, {"landmarks": ("huber", 1.5)}))
    assert report.chi2_initial == pytest.approx(plain @ plain, rel=1e-12)
    assert report.cost_initial == pytest.approx(huber @ huber, rel=1e-12)
    assert {name: c.edges for name, c in report.classes.items()} == {
        "anchor": 1,
        "odometry": 11,
        "closures": 3,
        "landmarks": 36,
    }
    assert sum(c.chi2 for c in report.classes.values()) == pytest.approx(report.chi2_final, rel=1e-12)
    x = np.concatenate([solver.estimate(range(POSES)).ravel(), solver.estimate(range(POSES, POSES + POINTS)).ravel()])
    r = whitened(world, x, {})
    labels = np.concatenate([[label] * len(z) for _, _, z, _, label in world.edges])
    for name, part in report.classes.items():
        assert part.chi2 == pytest.approx((r[labels == name] ** 2).sum(), rel=1e-12)
        assert part.residuals == (labels == name).sum()
    last = report.iterations[-1]
    assert (last.chi2, last.cost) == pytest.approx((report.chi2_final, report.cost_final), rel=1e-12)
    assert last.damping == 0.0


def test_why_it_stopped_is_told():
    loose = World(0).solver(cost_tolerance=1e-3, step_tolerance=1e-15).optimize()
    assert (loose.stop, loose.converged) == ("cost", True)
    step = World(0).solver(cost_tolerance=0.0, step_tolerance=1e-4).optimize()
    assert (step.stop, step.converged) == ("step", True)
    assert step.iterations[-1].step <= 1e-4 < step.iterations[-2].step
    short = World(0).solver(max_iterations=1, cost_tolerance=0.0, step_tolerance=0.0).optimize()
    assert (short.stop, short.converged) == ("max_iterations", False)


def test_a_second_update_changes_nothing():
    world = World(0)
    solver = world.solver()
    first = solver.optimize()
    before = solver.estimate(range(POSES))
    again = solver.optimize()
    assert (again.stop, again.iterations, again.converged) == ("nothing_to_do", (), True)
    assert np.array_equal(solver.estimate(range(POSES)), before)
    assert again.chi2_initial == again.chi2_final == first.chi2_final
    assert again.classes == first.classes
    assert solver.optimize(Settings(**TIGHT)).stop != "nothing_to_do"  # another question


def test_G9_an_update_that_ran_out_of_iterations_goes_on_with_the_next():
    world = World(0)
    solver = world.solver(max_iterations=3, step_tolerance=1e-6, cost_tolerance=0.0)
    reports = [solver.optimize()]
    while not reports[-1].converged and len(reports) < 20:
        reports.append(solver.optimize())
    assert reports[0].stop == "max_iterations"
    assert reports[-1].stop == "step"
    assert reports[-1].chi2_final == pytest.approx(World(0).solver(**TIGHT).optimize().chi2_final, rel=1e-9)


def dense_of(world, solver):
    """Ids in order, the dense H, its inverse, and where each vertex begins."""
    h = solver.information_matrix()
    dofs = [world.graph.kind_of(v).dof for v in range(world.graph.vertex_count)]
    return h, np.linalg.inv(h), np.concatenate([[0], np.cumsum(dofs)])


@each("wanted", [[3], [0, POSES, 7], [POSES + 2, 1, POSES - 1, POSES], list(range(POSES + POINTS))])
@each("loss", ["none", "huber"])
def test_marginals_are_the_blocks_of_the_dense_inverse_in_the_order_asked_for(loss, wanted):
    world = World(5, outliers=True)
    solver = world.solver(losses={"landmarks": STAGES[loss]})
    solver.optimize()
    h, inverse, first = dense_of(world, solver)
    rows = np.concatenate([np.arange(first[v], first[v + 1]) for v in wanted])
    block = inverse[np.ix_(rows, rows)]
    found, bound = solver.joint_marginal(wanted), max(1e-9, 100 * EPS * np.linalg.cond(h))
    assert np.abs(found - block).max() <= bound * np.diag(block).max()
    assert np.array_equal(found, found.T)
    for vertex, own in zip(wanted, solver.marginal(wanted), strict=True):
        block = inverse[first[vertex] : first[vertex + 1], first[vertex] : first[vertex + 1]]
        assert np.abs(own - block).max() <= bound * np.diag(block).max()
        assert np.array_equal(own, own.T)


def test_a_joint_marginal_is_zero_where_a_vertex_is_held_and_refuses_one_asked_for_twice():
    world = World(5)
    solver = world.solver()
    solver.hold(2)
    solver.optimize()
    found = solver.joint_marginal([2, 4])
    assert np.array_equal(found[:3], np.zeros((3, 6)))
    assert found[3:, 3:] == pytest.approx(solver.marginal([4])[0], abs=1e-15)
    assert not solver.joint_marginal([2]).any()
    with pytest.raises(GraphSlamError, match="with itself"):
        solver.joint_marginal([1, 4, 1])


def test_the_information_matrix_is_that_of_numeric_derivatives():
    world = World(5)
    solver = world.solver()
    solver.optimize()
    poses, points = solver.estimate(range(POSES)), solver.estimate(range(POSES, POSES + POINTS))

    def residuals(step):
        moved = SE2.retract(poses, step[: 3 * POSES].reshape(-1, 3))
        return whitened(world, np.concatenate([moved.ravel(), points.ravel() + step[3 * POSES :]]), {})

    width = 3 * POSES + 2 * POINTS
    j = np.stack([(residuals(e) - residuals(-e)) / 2e-6 for e in 1e-6 * np.eye(width)], axis=1)
    h = solver.information_matrix()
    scale = np.sqrt(np.outer(np.diag(h), np.diag(h)))
    assert np.abs((h - j.T @ j) / scale).max() < 1e-7  # central differences of residuals up to 100


@each("seed", range(4))
def test_G2_loops_do_not_make_the_anchored_pose_more_certain_than_its_anchor(seed):
    world = World(seed)
    solver = world.solver()
    solver.optimize()
    anchor = np.linalg.inv(world.graph.row(0)[0].sqrt_information.values[0])
    cond = np.linalg.cond(solver.information_matrix())
    (found,) = solver.marginal([0])
    bound = 1e-12 if cond < 1e4 else 100 * EPS * cond
    assert np.abs(found - anchor @ anchor.T).max() <= bound * np.abs(anchor @ anchor.T).max()


def small(*values, kind=SE2):
    graph = Graph()
    graph.add_vertices(kind, list(values))
    return graph


PLANAR, FLAT = Gaussian.from_sigmas(0.1, 0.2, 0.05), Gaussian.from_sigmas(0.1, 0.2)


def solve(graph, held=(), **settings):
    solver = Solver(graph, Settings(**settings))
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    for vertex in held:
        solver.hold(vertex)
    return solver, solver.optimize()


def test_where_all_is_held_nothing_is_to_do():
    nothing = Solver(Graph())
    report = nothing.optimize()
    assert (report.stop, report.chi2_final, report.classes) == ("nothing_to_do", 0.0, {})
    assert (nothing.marginal([]), len(nothing.estimate([]))) == ([], 0)
    graph = small([0.0, 0.0, 0.0], [2.0, 0.0, 0.0])
    graph.add_edge(RELATIVE_POSE, [0, 1], [1.0, 0.0, 0.0], PLANAR, "odometry")
    solver, report = solve(graph, held=[0, 1])
    assert (report.stop, report.chi2_final) == ("nothing_to_do", pytest.approx(100.0))
    assert not np.array(solver.marginal([0, 1])).any()
    assert solver.information_matrix().shape == (0, 0)


@each("seed", [3, 8])
def test_gauss_newton_that_fails_is_done_again_with_damping(seed):
    rng = np.random.default_rng(seed)  # readings that contradict each other by far: undamped steps jump about
    graph = small(*np.column_stack([rng.uniform(-5, 5, (6, 2)), rng.uniform(-3, 3, 6)]))
    graph.add_edge(POSE_PRIOR, [0], [0.0, 0.0, 0.0], PLANAR, "anchor")
    for i, j in itertools.combinations(range(6), 2):
        noise = Gaussian.from_sigmas(0.01, 0.01, 3.0)
        graph.add_edge(RELATIVE_POSE, [i, j], rng.uniform(-3, 3, 3), noise, "closures")
    _, report = solve(graph, max_iterations=60)
    assert (report.method, report.converged) == ("lm", True)
    assert all(i.damping > 0.0 for i in report.iterations)
    assert (np.diff([report.cost_initial, *(i.cost for i in report.iterations)]) <= 0).all()


@each("method", ["gn", "lm", "dogleg"])
def test_a_start_that_leaves_something_open_is_recovered_from(method):
    graph = small([0.0, 0.0, 0.0], [0.5, 0.5, 0.1])
    graph.add_vertices(R2, [[2.0, 2.0], [2.0, 2.0]])  # two landmarks in one place do not fix a direction
    graph.add_edge(POSE_PRIOR, [0], [0.0, 0.0, 0.0], PLANAR, "anchor")
    for k, seen in enumerate(([3.0, 1.0], [1.0, 3.0])):
        graph.add_edge(LANDMARK_POSITION, [0, 2 + k], seen, FLAT, "landmarks")
        graph.add_edge(LANDMARK_POSITION, [1, 2 + k], np.subtract(seen, 1.0), FLAT, "landmarks")
    solver, report = solve(graph, method=method)
    assert report.converged
    assert solver.estimate([1])[0] == pytest.approx([1.0, 1.0, 0.0], abs=1e-6)


@each("origin", [(5e5, 4e6), (-4e6, 5e5)])
def test_G17_far_from_the_origin_the_answer_is_the_same(origin):
    near, far = World(9), World(9, origin=origin)
    one, other = near.solver(), far.solver()
    at_home, abroad = one.optimize(), other.optimize()
    assert abroad.converged
    # a coordinate of 4e6 is stored to 5e-10 m, sigmas are 0.05 m
    assert abroad.chi2_final == pytest.approx(at_home.chi2_final, rel=1e-6)
    moved = other.estimate(range(POSES)) - [*origin, 0.0]
    assert moved == pytest.approx(one.estimate(range(POSES)), abs=1e-6)
    assert other.marginal([7])[0] == pytest.approx(one.marginal([7])[0], rel=1e-5, abs=1e-9)


def test_a_refused_add_leaves_nothing_behind():
    world = World(0)
    solver = Solver(world.graph)
    solver.add([0, 1], [0, 1])
    for vertices, edges, culprit in (
        ([2, 1], [], "vertex 1 was added before"),
        ([2, 2], [], "vertex 2 was added before"),
        ([2], [1, 2], "edge 1 was added before"),
        ([2], [2, 2], "edge 2 was added before"),
        ([2], [3], "needs vertex 3"),
        ([99], [], "vertex 99 does not exist"),
        ([-1], [], "vertex -1 does not exist"),
        ([2], [999], "edge 999 does not exist"),
    ):
        with pytest.raises(GraphSlamError, match=culprit):
            solver.add(vertices, edges)
    solver.add([2], [2])
    assert {name: c.edges for name, c in solver.optimize().classes.items()} == {"anchor": 1, "odometry": 2}


@each("wrong", [-1, 1000, 10**12])
def test_ids_that_do_not_exist_are_refused_wherever_they_are_asked_for(wrong):
    solver = World(0).solver()
    for ask in (solver.estimate, solver.marginal, lambda ids: solver.hold(ids[0])):
        with pytest.raises(GraphSlamError, match=f"vertex {wrong} does not exist"):
            ask([wrong])
    of_edges = solver.chi2_of, solver.residuals_of, solver.leave_out, lambda ids: solver.graph.has_label(ids, ("one",))
    for ask in (*of_edges, lambda ids: solver.set_weight(ids[-1], 1.0)):
        with pytest.raises(GraphSlamError, match=f"edge {wrong} does not exist"):
            ask(np.array([0, wrong]))
    for weight in (-1.0, np.nan, np.inf):
        with pytest.raises(GraphSlamError, match="edge 3: weight"):
            solver.set_weight(3, weight)
    with pytest.raises(GraphSlamError, match="not of one kind"):
        solver.estimate([0, POSES])


@each("count, seed", [(17, 0), (31, 1), (59, 2), (143, 0), (300, 1)])
def test_a_chain_that_may_turn_about_its_only_fix_is_refused_at_any_length(count, seed):
    rng, graph, pose = np.random.default_rng(seed), Graph(), (0.0, 0.0, 0.0)
    noise, edges, step = Gaussian.from_sigmas(0.1, 0.1, 0.05), [], None
    for k in range(count):
        graph.add_vertex(SE2, pose)
        if k:
            edges.append(graph.add_edge(RELATIVE_POSE, [k - 1, k], step, noise, "odometry"))
        step = (1.0, 0.1 * rng.normal(), 0.3 * rng.normal())
        pose = se2.compose(pose, step)
    edges.append(graph.add_edge(POSITION_PRIOR, [0], [0, 0], Gaussian.from_sigmas(0.1, 0.1), "fix"))
    for way in (Solver.update, Solver.optimize):
        solver = Solver(graph)
        solver.add(range(count), edges)
        with pytest.raises(SingularError, match="rounding"):
            way(solver)


def test_the_end_of_a_long_open_chain_is_told_as_far_as_rounding_lets():
    count, sigma, turn, anchor = 3000, 0.005, 0.02, 0.01
    graph = Graph()
    graph.add_vertices(SE2, [[k, 0.0, 0.0] for k in range(count)])
    edges = [graph.add_edge(POSE_PRIOR, [0], [0, 0, 0], Gaussian.from_sigmas(anchor, anchor, anchor), "anchor")]
    noise = Gaussian.from_sigmas(sigma, sigma, turn)
    edges += [graph.add_edge(RELATIVE_POSE, [k, k + 1], [1, 0, 0], noise, "odometry") for k in range(count - 1)]
    solver = Solver(graph)
    solver.add(range(count), edges)
    solver.update()
    left = np.arange(count - 1)
    across = anchor**2 * (1 + (count - 1) ** 2) + (count - 1) * sigma**2 + turn**2 * (left**2).sum()
    assert solver.marginal([count - 1])[0][1, 1] == pytest.approx(across, rel=1e-2)
