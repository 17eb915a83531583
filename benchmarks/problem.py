"""A pose graph as plain arrays in time order: what every contender is given.

Only reading and simulating need more than NumPy, since some contenders live in an environment of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.graph import EdgeType, Graph

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Edges:
    """Measurements between two things each.

    Attributes
    ----------
    ends : (n, 2), of relative poses the two poses, of sightings the pose and the landmark
    measured : (n, p)
    root : (n, m, m) upper triangular R with ``R'R`` the information matrix
    """

    ends: Index
    measured: Array
    root: Array

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, rows: slice | NDArray[Any]) -> "Edges":
        return Edges(self.ends[rows], self.measured[rows], self.root[rows])


_NO_SIGHTINGS = Edges(np.empty((0, 2), dtype=np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))


@dataclass(frozen=True, slots=True)
class Step:
    """What arrives with one pose.

    Attributes
    ----------
    pose : its index
    landmarks : indices of the landmarks seen for the first time
    first : (n,) the sighting of each of them, a row of ``sightings``
    parent : the latest earlier pose that an edge joins it to (-1: it is the first)
    motion, forward : the measurement of that edge, and whether it leads from the parent to the pose
    """

    pose: int
    relative: Edges
    sightings: Edges
    landmarks: range
    first: Index
    parent: int
    motion: Array
    forward: bool


@dataclass(frozen=True, slots=True)
class Problem:
    """A graph: poses in order of time, landmarks in order of their first sighting.

    Attributes
    ----------
    poses : (n, 3) x, y, theta or (n, 7) x, y, z, quaternion (x, y, z, w): where a batch solver starts
    landmarks : (n, 2)
    relative : relative poses, in order of their later pose
    sightings : of landmarks, x and y in the pose's frame, in order of the pose
    left_out : lines of the file that were not used
    whole : it is no prefix of a longer one
    """

    name: str
    poses: Array
    landmarks: Array
    relative: Edges
    sightings: Edges
    left_out: int = 0
    whole: bool = True

    @property
    def planar(self) -> bool:
        """Whether it is in the plane."""
        return self.poses.shape[1] == 3

    @property
    def edges(self) -> int:
        """How many there are."""
        return len(self.relative) + len(self.sightings)

    def prefix(self, poses: int) -> "Problem":
        """The graph when it had that many poses."""
        sightings = self.sightings[self.sightings.ends[:, 0] < poses]
        return replace(
            self,
            poses=self.poses[:poses],
            landmarks=self.landmarks[: sightings.ends[:, 1].max(initial=-1) + 1],
            relative=self.relative[self.relative.ends.max(axis=1) < poses],
            sightings=sightings,
            whole=self.whole and poses >= len(self.poses),
        )

    def steps(self) -> Iterator[Step]:
        """Pose after pose, each with the edges whose other ends are there already."""
        counted = np.arange(len(self.poses) + 1)
        relative_at = np.searchsorted(self.relative.ends.max(axis=1), counted)
        sighting_at = np.searchsorted(self.sightings.ends[:, 0], counted)
        known = 0
        for pose in range(len(self.poses)):
            relative = self.relative[slice(*relative_at[pose : pose + 2])]
            sightings = self.sightings[slice(*sighting_at[pose : pose + 2])]
            seen, first = np.unique(sightings.ends[:, 1], return_index=True)
            new = range(known, max(known, int(seen.max(initial=-1)) + 1))
            known = new.stop
            parent, motion, forward = -1, np.empty(0), True
            if pose:
                earlier = relative.ends.min(axis=1)
                row = int(np.argmax(earlier))
                parent, motion = int(earlier[row]), relative.measured[row]
                forward = bool(relative.ends[row, 1] == pose)
            yield Step(pose, relative, sightings, new, first[seen >= new.start], parent, motion, forward)


def triangular(root: Array) -> Array:
    """Upper triangular square roots (n, m, m), of positive diagonal, of the same information matrices."""
    upper = np.asarray(np.linalg.qr(root, mode="r"))
    return upper * np.where(np.diagonal(upper, axis1=1, axis2=2) < 0.0, -1.0, 1.0)[:, :, None]


def polar(sightings: Edges) -> Edges:
    """The same sightings as bearing and range, their information carried over to first order."""
    x, y = sightings.measured.T
    distance = np.hypot(x, y)
    cartesian_by_polar = np.stack([np.stack([-y, x / distance], -1), np.stack([x, y / distance], -1)], axis=1)
    root = triangular(sightings.root @ cartesian_by_polar)
    return Edges(sightings.ends, np.stack([np.arctan2(y, x), distance], axis=1), root)


def read_problem(path: Path) -> Problem:
    """Read any text the package reads; lines it does not understand are left out and counted.

    Information matrices are taken as they are in the file. Without initial values the start is composed along a tree.

    Raises
    ------
    GraphSlamError
        The file cannot be read, has other kinds of edges, or a pose that is joined to no earlier one.
    """
    from graph_slam_ros.formats.g2o import read_g2o

    return _in_time_order(path.name.split(".")[0], read_g2o(path, lenient=True, raw=True))


def city_problem(poses: int, seed: int = 1) -> Problem:
    """Our simulator's Manhattan: 60 by 60 blocks, a closure per three poses once streets are revisited."""
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.tools.simulation.pose_graph import city_graph

    graph, _ = city_graph(seed, poses=poses)
    return _in_time_order(f"city{poses}", G2oFile(graph, list(range(graph.vertex_count))))


def chain_problem(poses: int = 3000) -> Problem:
    """A robot that goes a metre at a time and turns at random: one odometry edge each."""
    from graph_slam_ros.lie import se2

    rng, count, start = np.random.default_rng(0), poses - 1, [(0.0, 0.0, 0.0)]
    measured = np.array([1.0, 0.0, 0.0]) + rng.normal(size=(count, 3)) * [0.02, 0.02, 0.1]
    for motion in measured.tolist():
        start.append(se2.compose(start[-1], tuple(motion)))
    ends = np.column_stack([np.arange(count), np.arange(1, poses)])
    relative = Edges(ends, measured, np.tile(np.diag([10.0, 10.0, 50.0]), (count, 1, 1)))
    return Problem("chain", np.array(start), np.zeros((0, 2)), relative, _NO_SIGHTINGS)


def sphere_problem(poses: int = 2500, seed: int = 0) -> Problem:
    """Our simulator's sphere, with 0.1 rad of noise in each rotation."""
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.tools.simulation import sphere_graph

    graph, _ = sphere_graph(seed, poses=poses, sigma_rad=0.1)
    return _in_time_order("noisy sphere", G2oFile(graph, list(range(graph.vertex_count))))


def _in_time_order(name: str, file: "G2oFile") -> Problem:
    from graph_slam_ros.errors import FormatError
    from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3
    from graph_slam_ros.solver import initial_values

    graph, ids = file.graph, np.asarray(file.ids)
    edge_type, kind = (RELATIVE_POSE, SE2) if RELATIVE_POSE in graph.tables else (RELATIVE_POSE_3D, SE3)
    strange = set(graph.tables) - {edge_type, LANDMARK_POSITION}
    if strange or kind not in graph.kinds:
        raise FormatError(f"{name}: only relative poses and, in the plane, positions of landmarks can be raced")
    poses = np.flatnonzero(graph.kind.values == graph.kinds.index(kind))
    poses = poses[np.argsort(ids[poses])]
    values = initial_values(graph, "file" if file.has_values else "tree", int(poses[0]))
    index = np.arange(graph.vertex_count)
    index[poses] = np.arange(len(poses))

    relative = _edges(graph, edge_type, index)
    relative = relative[np.argsort(relative.ends.max(axis=1), kind="stable")]
    joined = np.isin(np.arange(1, len(poses)), relative.ends.max(axis=1))
    if not joined.all():
        raise FormatError(f"{name}: pose {ids[poses[1:][~joined][0]]} is joined to no earlier pose")

    points, sightings = np.empty(0, dtype=np.int64), _NO_SIGHTINGS
    if LANDMARK_POSITION in graph.tables:
        sightings = _edges(graph, LANDMARK_POSITION, index)
        sightings = sightings[np.lexsort((sightings.ends[:, 1], sightings.ends[:, 0]))]
        seen, first, which = np.unique(sightings.ends[:, 1], return_index=True, return_inverse=True)
        in_time = np.argsort(first)
        points = seen[in_time]
        sightings = replace(sightings, ends=np.column_stack([sightings.ends[:, 0], np.argsort(in_time)[which]]))

    def stored(vertices: Index, size: int) -> Array:
        return values[graph.begins(vertices)[:, None] + np.arange(size)]

    left_out = len(file.unknown) + len(file.skipped)
    return Problem(name, stored(poses, kind.size), stored(points, 2), relative, sightings, left_out)


def landmark_problem(name: str, graph: "Graph", poses: Array) -> Problem:
    """What the pipeline made of a drive in the plane, without its anchor; ranges and bearings become positions.

    Parameters
    ----------
    poses : (n, 3) of all keyframes
    """
    from graph_slam_ros.graph import LANDMARK_POSITION, RANGE_BEARING, RELATIVE_POSE, SE2

    index = np.arange(graph.vertex_count)
    for is_pose in (True, False):
        of_kind = (graph.kind.values == graph.kinds.index(SE2)) == is_pose
        index[of_kind] = np.arange(of_kind.sum())
    several = [_edges(graph, LANDMARK_POSITION, index)] if LANDMARK_POSITION in graph.tables else []
    if RANGE_BEARING in graph.tables:
        several.append(_cartesian(_edges(graph, RANGE_BEARING, index)))
    seen = joined(*several)
    relative = _edges(graph, RELATIVE_POSE, index)
    in_time, seen_in_time = (
        np.argsort(relative.ends.max(axis=1), kind="stable"),
        np.argsort(seen.ends[:, 0], kind="stable"),
    )
    landmarks = np.zeros((int(seen.ends[:, 1].max(initial=-1)) + 1, 2))
    return Problem(name, poses, landmarks, relative[in_time], seen[seen_in_time])


def _cartesian(seen: Edges) -> Edges:
    """Sightings by range, bearing and the sensor's pose as positions, their information carried over to first order."""
    from graph_slam_ros.lie import se2

    distance, bearing, *sensor = seen.measured.T
    c, s = np.cos(bearing), np.sin(bearing)
    polar_by_sensor = np.stack([np.stack([c, s], -1), np.stack([-s / distance, c / distance], -1)], axis=1)
    turn = np.cos(sensor[2]), np.sin(sensor[2])
    sensor_by_base = np.stack([np.stack([turn[0], turn[1]], -1), np.stack([-turn[1], turn[0]], -1)], axis=1)
    measured = np.column_stack(se2.act(tuple(sensor), (distance * c, distance * s)))
    return Edges(seen.ends, measured, triangular(seen.root @ polar_by_sensor @ sensor_by_base))


def joined(*several: Edges) -> Edges:
    """The edges of all."""
    ends, measured, root = (np.concatenate([getattr(e, key) for e in several]) for key in ("ends", "measured", "root"))
    return Edges(ends, measured, root)


def _edges(graph: "Graph", edge_type: "EdgeType", index: Index) -> Edges:
    table = graph.tables[edge_type]
    return Edges(index[table.vertices], table.measured.values.copy(), table.sqrt_information.values.copy())
