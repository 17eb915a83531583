"""A run folder of a graph that a file has. Its poses are the keyframes, each at its id in seconds.

Where ids are too large for that, such as the keys of GTSAM, it is their place in order of id.
"""

from collections import Counter
from pathlib import Path

import numpy as np

from graph_slam_ros.graph import POINT_PRIOR, Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.optimization import Solution
from graph_slam_ros.runs.folder import RunError
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Config, Control
from graph_slam_ros.slam.anchor import TIGHT
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.robust.ledger import OUTSIDE, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Array, Numbers

_SECOND_NS, _LARGEST_S = 10**9, 10**9


def write_graph_run(solution: Solution, out: Path, name: str, *, force: bool = False) -> tuple[int, int]:
    """Write the solved graph of a file as a run: its closures are judged as those of a drive.

    What the solution holds is anchored, in its graph, too. Returns how many measurements are not in the map, and how
    many may be wrong. Raises RunError: it has no poses, odometry alone, or vertices that no run has.
    """
    file, solver = solution.file, solution.solver
    graph = file.graph
    space = SPATIAL if SPATIAL.pose in graph.kinds else PLANAR
    poses = sorted((v for v in range(graph.vertex_count) if graph.kind_of(v) is space.pose), key=file.ids.__getitem__)
    if not poses:
        raise RunError(f"{name}: it has no poses, and a run is a path")
    if others := [kind.name for kind in graph.kinds if kind not in (space.pose, space.point)]:
        raise RunError(f"{name}: it has vertices of {', '.join(others)}, which a run has not: poses and points alone")
    if not any(len(graph.edges_of(label)) for label in graph.labels if label != "odometry"):
        raise RunError(f"{name}: it has odometry alone, so there is nothing to judge: is the file whole?")
    graph.sources[:] = graph.labels  # an input of a run is a class of the file
    for table in graph.tables.values():
        table.source.values[:] = table.label.values
    state = MapSnapshot(graph=graph, values=solver.values)
    ids = [file.ids[vertex] for vertex in poses]
    stamps_ns = [k * _SECOND_NS for k in (ids if ids[0] >= 0 and ids[-1] < _LARGEST_S else range(len(ids)))]
    state.keyframes, state.segments = _path(graph, space, poses, stamps_ns, solver.estimate(poses))
    state.drives = [0]
    state.sighting_poses = StampedPoses(SightingPose, space.pose.size)
    seen = Counter(vertex for table in graph.tables.values() for vertex in table.vertices.ravel().tolist())
    state.landmarks = {
        str(file.ids[v]): Landmark(str(file.ids[v]), v, sightings=seen[v], last_seen_ns=stamps_ns[-1])
        for v in sorted(seen.keys() - set(poses))
    }
    for vertex in solver.held.tolist():
        kind, at = graph.kind_of(vertex), solver.estimate([vertex])[0].tolist()
        edge, label = (space.pose_prior, "anchor") if kind is space.pose else (POINT_PRIOR[kind], "priors")
        graph.add_edge(edge, [vertex], at, Gaussian.from_sigmas(*[TIGHT] * kind.dof), label)
    settings = {"world.dimensions": space.dimensions, "robust.noise_scale": "configured", "map.condense": False}
    config, ended = Config.from_mapping(settings), [Control("optimize")]
    slam, _ = record_run(out, config, ended, file.losses, state, recording=name, force=force)
    verdicts = slam.view.ledger.verdict.values
    return int(np.isin(verdicts, OUTSIDE).sum()), int((verdicts != Verdict.NOT_EVALUATED).sum())


def _path(
    graph: Graph, space: Geometry, poses: list[int], stamps_ns: list[int], estimates: Array
) -> tuple[StampedPoses[Keyframe], list[int]]:
    """The keyframes, with their poses by odometry alone, and those that no odometry joins to the one before."""
    steps: dict[tuple[int, ...], Numbers] = {}
    for edge in map(graph.edge, graph.edges_of("odometry").tolist()):
        if edge.type is space.relative_pose:
            steps[edge.vertices] = tuple(edge.measured.tolist())
            steps[edge.vertices[::-1]] = space.group.inverse(steps[edge.vertices])
    keyframes, segments, at = StampedPoses(Keyframe, space.pose.size), list[int](), space.identity
    for k, vertex in enumerate(poses):
        if k and (step := steps.get((poses[k - 1], vertex))):
            at = tuple(map(float, space.group.compose(at, step)))
        else:
            segments.append(k)
            at = tuple(estimates[k].tolist())
        keyframes.append(vertex, stamps_ns[k], at)
    return keyframes, segments
