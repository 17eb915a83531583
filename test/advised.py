"""For tests of ``advise``: a simulated run with its truth, and what really comes out when something is added to it."""

import numpy as np
from driven import drive

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.weak_direction import position_covariance
from graph_slam_ros.solver import Solver
from graph_slam_ros.tools.advise.advice import KINDS, NEW, Advisor, expected, stored_values
from graph_slam_ros.tools.advise.weakness import HEADING, Weakness
from graph_slam_ros.tools.simulation import measurements, simulate

HELPS = 0.97  # of the sigma is left, or less
TRIED = 100  # additions of a kind


class SimulatedRun:
    """A run of a simulated world, its truth in the map, and what is advised."""

    def __init__(self, folder, world, seed, settings=None, **options):
        recording = simulate(world, seed, **options)
        dimensions = 3 if world == "flight" else 2
        config = Config.from_mapping({"world.dimensions": dimensions} | (settings or {}))
        slam = drive(folder, config, measurements(recording))
        self.run = SavedGraph(folder, [])
        self.advisor = Advisor(Weakness(self.run))
        self.truth = self._truth(recording, slam.view)

    def _truth(self, recording, view):
        """The true values of all vertices: the map lies as its first keyframe."""
        space, values = self.run.space, self.run.solver.values.copy()
        true = recording.T_world_base[np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns)]
        true = true if space.dimensions == 3 else se3.in_plane(true) if true.shape[1] == 7 else true
        first = tuple(values[self.run.graph.vertex(self.run.keyframes[0]).stored].tolist())
        T_map_world = space.group.compose(first, space.group.inverse(tuple(true[0].tolist())))
        for vertex, pose in zip(self.run.keyframes, true, strict=True):
            values[self.run.graph.vertex(vertex).stored] = space.group.compose(T_map_world, tuple(pose.tolist()))
        for name, vertex in self.run.landmarks.items():
            at = tuple(map(float, recording.landmarks[name]))
            if self.run.graph.kind_of(vertex) is space.point:
                values[self.run.graph.vertex(vertex).stored] = space.group.act(T_map_world, at[: space.dimensions])
            elif len(at) == space.pose.size:
                values[self.run.graph.vertex(vertex).stored] = space.group.compose(T_map_world, at)
        return values

    def sigmas_with(self, addition, rng):
        """The sigmas of what was weakest when an addition was truly measured, with its noise, and all solved again."""
        run, graph, space = self.run, self.run.graph.copy(), self.run.space
        edges = [entry.edge for entry in run.entries if entry.is_in]
        new = []
        if addition.value:
            kind = next(k for k in (space.point, space.pose) if k.size == len(addition.value))
            new.append(graph.add_vertex(kind, addition.value))
        for edge in addition.edges:
            x, at = stored_values(run.graph, self.truth, edge, addition.value)
            measured = expected(space, edge.type, x, at, edge.measured)
            error = np.linalg.solve(edge.noise.sqrt_information, rng.normal(size=edge.type.residual_size))
            if edge.type is space.relative_pose and space.dimensions == 3:
                error = (*error[:3], *so3.exp(tuple(error[3:])))
                measured = np.array(space.group.compose(tuple(measured), error))
            elif edge.type is space.relative_pose:
                measured = np.array(space.group.compose(tuple(measured), tuple(error)))
            else:
                measured[: len(error)] += error
            vertices = [new[0] if v == NEW else v for v in edge.vertices]
            edges.append(graph.add_edge(edge.type, vertices, measured, edge.noise, edge.label, edge.source))
        solver = Solver(graph, run.config.solver_settings())
        solver.add(np.unique([*run.keyframes, *(v for e in edges for v in graph.edge(e).vertices)]), edges)
        solver.optimize()
        return [self._sigma(solver, one) for one in self.advisor.weakest]

    def _sigma(self, solver, one):
        """In the same direction of the map, at the new estimate."""
        space = self.run.space
        (covariance,) = solver.marginal([one.vertex])
        value = tuple(solver.estimate([one.vertex])[0].tolist())
        if one.what == HEADING:
            turns = space.in_parent_axes(value, covariance)[space.dimensions :, space.dimensions :]
            return float(np.sqrt(one.direction.axis @ turns @ one.direction.axis))
        return float(np.sqrt(one.direction.axis @ position_covariance(space, value, covariance) @ one.direction.axis))

    def comparisons(self, rng, of_each_kind, kinds=None):
        """Of additions that help: (kind, what was weakest, its sigma now, predicted, and as it comes out)."""
        for kind in kinds or KINDS:
            additions, left = [*self.advisor.additions([kind])], of_each_kind
            for k in rng.permutation(len(additions))[:TRIED].tolist():
                if left and (found := [*self._comparison(additions[k], rng)]):
                    left -= 1
                    yield from ((kind, *one) for one in found)

    def _comparison(self, addition, rng):
        predicted, _ = self.advisor.predict(addition)
        now = [one.direction.sigma for one in self.advisor.weakest]
        if (predicted < HELPS * np.array(now)).any():
            for one, *numbers in zip(
                self.advisor.weakest, now, predicted, self.sigmas_with(addition, rng), strict=True
            ):
                if numbers[1] < HELPS * numbers[0]:
                    yield one.what, *map(float, numbers)
