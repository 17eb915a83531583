"""A robot that maps a hall with the graph and its solver alone: no gates, no decisions, a visit condensed at a time."""

from dataclasses import dataclass, field

import numpy as np

from benchmarks.hall import Hall
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.slam.lifelong.compaction import compact
from graph_slam_ros.slam.lifelong.condenser import Condenser
from graph_slam_ros.slam.lifelong.outcome import RemovedPose, poses_of
from graph_slam_ros.solver import Solver

CELL_M, LONGEST = 10.0, 60
ENOUGH = 3  # landmarks of a visit: with fewer it goes on in the next cell, as in the pipeline
DEAD = 8  # edges in the tables for each that counts: then these are made anew


@dataclass(slots=True)
class Robot:
    """A robot that maps a hall, a keyframe at a time; ``window`` keyframes stay as they are, all of them where it is 0.

    Attributes
    ----------
    vertices : of the keyframes that are in the problem; marks : of the landmarks
    removed : the other keyframes: their number, that of their base, and the pose between them
    first : the oldest keyframe that was not condensed; ends : how often a visit ended how
    statistics, degrees : of the visits that were added to a place, together
    """

    world: Hall
    window: int = 0
    vertices: dict[int, int] = field(default_factory=dict)
    removed: list[RemovedPose] = field(default_factory=list)
    marks: dict[int, int] = field(default_factory=dict)
    first: int = 1
    ends: dict[str, int] = field(default_factory=dict)
    statistics: float = 0.0
    degrees: int = 0
    solver: Solver = field(init=False)
    condenser: Condenser = field(init=False)

    def __post_init__(self):
        self.solver = Solver(Graph())
        self.condenser = Condenser(self.world.space, self.solver)

    def drive(self, keyframe):
        """Add a keyframe, solve, and condense a visit if one has left the window."""
        world, space, graph = self.world, self.world.space, self.graph
        new, edges = [], []
        if not keyframe:
            pose = world.poses[0]
        else:
            (before,) = self.solver.estimate([self.vertices[keyframe - 1]]).tolist()
            pose = tuple(map(float, space.group.compose(tuple(before), world.steps[keyframe - 1])))
        vertex = graph.add_vertex(space.pose, space.normalized(pose))
        new.append(vertex)
        if not keyframe:
            noise = Gaussian.from_sigmas(*[1e-3] * space.dof)
            edges.append(graph.add_edge(space.pose_prior, [vertex], pose, noise, "priors"))
        else:
            noise, ends = Gaussian.from_sigmas(*world.sigmas), [self.vertices[keyframe - 1], vertex]
            edges.append(graph.add_edge(space.relative_pose, ends, world.steps[keyframe - 1], noise, "odometry"))
        for mark, seen, covariance in world.sightings[keyframe]:
            if mark not in self.marks:
                self.marks[mark] = graph.add_vertex(space.point, np.array(space.group.act(pose, tuple(seen))))
                new.append(self.marks[mark])
            noise, ends = Gaussian.from_covariance(covariance), [vertex, self.marks[mark]]
            edges.append(graph.add_edge(space.sightings["position"], ends, seen, noise, "landmarks"))
        self.vertices[keyframe] = vertex
        self.solver.add(new, edges)
        self.solver.update()
        if self.window and keyframe >= self.first + self.window:
            self._condense(keyframe)

    def _condense(self, newest):
        first = self.first
        at = self.solver.estimate([self.vertices[k] for k in range(first, min(first + LONGEST, newest))])
        cells = list(map(tuple, np.floor(at[:, : self.world.space.dimensions] / CELL_M).tolist()))
        seen = [{one[0] for one in self.world.sightings[first + k]} for k in range(len(cells))]
        enough = [len(set().union(*seen[:k])) >= ENOUGH for k in range(len(cells))]
        length = next((k for k, cell in enumerate(cells) if cell != cells[0] and enough[k]), len(cells))
        end = first + length
        if end + self.window > newest:
            return
        ahead = {self.marks[one[0]] for seen in self.world.sightings[end : newest + 1] for one in seen}
        done = self.condenser.condense(
            [self.vertices[k] for k in range(first, end)], self.vertices[end], cells[0], ahead
        )
        self.ends[done.how] = self.ends.get(done.how, 0) + 1
        self.statistics, self.degrees = self.statistics + done.statistic, self.degrees + done.degrees
        if done.how != "waits":
            self.first = end
        number = {vertex: k for k, vertex in self.vertices.items()}
        self.removed += [RemovedPose(number[one.vertex], number[one.base], one.T_base_vertex) for one in done.removed]
        for one in done.removed:
            del self.vertices[number[one.vertex]]
        if done.how not in ("waits", "kept"):
            self.solver.update()
        if self.graph.edge_count > DEAD * len(self.solver.edges):
            self.compact()

    def compact(self):
        """Make graph and solver anew without what was removed."""
        new = compact(self.solver)
        self.condenser.renumber(new)
        self.vertices = {k: int(new.vertices[vertex]) for k, vertex in self.vertices.items()}
        self.marks = {mark: int(new.vertices[vertex]) for mark, vertex in self.marks.items()}
        self.solver.update()

    @property
    def graph(self):
        """The present graph."""
        return self.solver.graph

    def landmarks(self):
        """Estimated and true positions of the landmarks."""
        marks = sorted(self.marks)
        return self.solver.estimate([self.marks[mark] for mark in marks]), self.world.points[marks]

    def path(self):
        """Estimated positions of all keyframes, those that were removed included."""
        n, kept = self.world.space.dimensions, list(self.vertices)
        at = map(tuple, self.solver.estimate([self.vertices[k] for k in kept]).tolist())
        poses = poses_of(self.world.space, self.removed, dict(zip(kept, at, strict=True)))
        return np.array([poses[k][:n] for k in sorted(poses)])
