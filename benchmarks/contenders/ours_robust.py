"""Ours among false measurements: a graph is driven through ``GraphSlam`` pose by pose, and solved at its end.

A second of odometry leads from each pose to the next. Its twist's noise is chosen so that the pipeline's edge has the
noise of the graph's, and nothing is added to that of others; all else is as configured by default. ``ours-plain`` has
no loss and takes every measurement for what it is: what robustness costs is told by it.
"""

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from benchmarks.contenders import OURS, OURS_PLAIN, Believed
from benchmarks.problem import Array, Edges, Problem
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.slam import Closure, Config, Control, GraphSlam, MapView, Measurement, Odometry, Sighting, Sightings
from graph_slam_ros.solver.linearization import loss_weights
from graph_slam_ros.warmup import warmup

_REHEARSED = 100  # poses that are driven before the clock runs, so that code is loaded
_SECOND_NS = 10**9
_AS_THE_GRAPH: Mapping[str, Any] = {
    "odometry.still_m_s": 0.0,
    "odometry.still_rad_s": 0.0,
    "odometry.still_m": 0.0,
    "odometry.still_rad": 0.0,
    "odometry.max_speed_m_s": 1e6,
    "landmarks.added_sigma_m": 0.0,
    "map.condense": False,  # all of it is compared
    "robust.noise_scale": "configured",  # the noise of the file is what its optimum, and chi2, are by
}
_LOSSES: Mapping[str, Mapping[str, Any]] = {
    OURS: {},
    OURS_PLAIN: {"landmarks.loss": "none", "robust.loss": "none", "robust.decide": False},
}


def believe(problem: Problem, closures: Edges, name: str) -> Believed:
    """See ``contenders.believe``."""
    warmup()
    _run(problem.prefix(_REHEARSED), closures[closures.ends.max(axis=1) < _REHEARSED], name)
    return _run(problem, closures, name)


def weights(view: MapView, label: str) -> Array:
    """What each edge of a class counts (n,), from 0 to 1: as it was decided, and as its loss has it now."""
    edges = view.graph.edges_of(label)
    decided = view.graph.weights(edges)
    losses = view.solver.settings.losses.get(label, ())
    return (
        decided * loss_weights(losses[-1].kind, losses[-1].scale, view.solver.chi2_of(edges)[0]) if losses else decided
    )


def measurements(problem: Problem, closures: Edges) -> Iterator[Measurement]:
    """A graph as it would have been recorded."""
    group = se2 if problem.planar else se3
    arrived = np.searchsorted(closures.ends.max(axis=1), np.arange(len(problem.poses) + 1))
    for step in problem.steps():
        stamp_ns = step.pose * _SECOND_NS
        yield Odometry(stamp_ns, tuple(problem.poses[step.pose].tolist()), _twist_covariance(problem, step.relative))
        if len(step.sightings):
            yield Sightings(stamp_ns, "landmarks", tuple(_sightings(step.sightings)))
        first, end = arrived[step.pose : step.pose + 2].tolist()
        for k in range(first, end):
            earlier, later = closures.ends[k].tolist()
            measured, covariance = tuple(closures.measured[k].tolist()), _covariance(closures.root[k])
            if earlier > later:
                back = group.adjoint(measured)
                earlier, later, measured = later, earlier, tuple(float(x) for x in group.inverse(measured))
                covariance = back @ covariance @ back.T
            source = f"closures{k - first:06}"  # what one says twice is taken once, and graphs repeat edges; in order
            yield Closure(later * _SECOND_NS, earlier * _SECOND_NS, source, measured, _flat(covariance))


def _run(problem: Problem, closures: Edges, name: str) -> Believed:
    slam = GraphSlam(
        Config.from_mapping(_AS_THE_GRAPH | _LOSSES[name] | {"world.dimensions": 2 if problem.planar else 3})
    )
    recorded = list(measurements(problem, closures))
    believed, begin = Believed(), time.process_time()
    for m in recorded:
        slam.process(m)
    slam.process(Control("end"))
    believed.online_s = time.process_time() - begin
    believed.online, believed.online_weights = slam.view.trajectory(), _weights(slam.view)
    begin = time.process_time()
    slam.process(Control("optimize"))
    believed.batch_s = time.process_time() - begin
    believed.batch, believed.weights = slam.view.trajectory(), _weights(slam.view)
    if len(believed.weights) != len(closures) + len(problem.sightings):
        believed.fault = f"not every measurement became an edge: {slam.counters.as_dict()}"
    return believed


def _weights(view: MapView) -> Array:
    return np.concatenate([weights(view, label) for label in ("closures", "landmarks")])


def _twist_covariance(problem: Problem, relative: Edges) -> tuple[float, ...] | None:
    """With ``d = Log(step)``, noise Q of the velocity makes ``J Q J'`` of the step's."""
    if not len(relative):
        return None
    group, measured = (se2, se3)[not problem.planar], tuple(relative.measured[0].tolist())
    covariance = _covariance(relative.root[0])
    if relative.ends[0, 0] > relative.ends[0, 1]:
        back = group.adjoint(measured)
        measured, covariance = group.inverse(measured), back @ covariance @ back.T
    j = np.linalg.inv(group.right_jacobian(tuple(float(x) for x in group.log(measured))))
    return _flat(j @ covariance @ j.T)


def _sightings(seen: Edges) -> Iterator[Sighting]:
    for (_, landmark), measured, root in zip(seen.ends.tolist(), seen.measured.tolist(), seen.root, strict=True):
        yield Sighting(str(landmark), "position", tuple(measured), _flat(_covariance(root)))


def _covariance(root: Array) -> Array:
    inverse = np.linalg.inv(root)
    return np.asarray(inverse @ inverse.T)


def _flat(covariance: Array) -> tuple[float, ...]:
    return tuple((0.5 * (covariance + covariance.T)).ravel().tolist())
