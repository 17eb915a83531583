"""A run folder of a graph that a file has. Its poses are the keyframes, each at its id in seconds.

Where ids are too large for that, such as the keys of GTSAM, it is their place in order of id.
"""

from collections import Counter
from pathlib import Path

from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.runs.folder import RunError
from graph_slam_ros.runs.restore import Summary, record_run
from graph_slam_ros.slam import Config, Control
from graph_slam_ros.slam.anchor import TIGHT
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Array, Numbers

_SECOND_NS, _LARGEST_S = 10**9, 10**9
_PRIORS = ("anchor", "priors", "fixes")


def write_graph_run(file: G2oFile, values: Array, out: Path, name: str, *, force: bool = False) -> Summary:
    """Write a solved graph as a run: its closures are judged as those of a drive.

    Parameters
    ----------
    values : the stored numbers of the solution
    name : of the file

    Raises
    ------
    RunError
        It has no poses, or odometry alone.
    """
    graph = file.graph
    space = SPATIAL if SPATIAL.pose in graph.kinds else PLANAR
    poses = sorted((v for v in range(graph.vertex_count) if graph.kind_of(v) is space.pose), key=file.ids.__getitem__)
    if not poses:
        raise RunError(f"{name}: it has no poses, and a run is a path")
    if not any(len(graph.edges_of(label)) for label in graph.labels if label != "odometry"):
        raise RunError(f"{name}: it has odometry alone, so there is nothing to judge: is the file whole?")
    state = MapSnapshot(graph=graph, values=values)
    ids = [file.ids[vertex] for vertex in poses]
    stamps_ns = [k * _SECOND_NS for k in (ids if ids[0] >= 0 and ids[-1] < _LARGEST_S else range(len(ids)))]
    state.keyframes, state.segments, state.drives = *_path(graph, space, poses, stamps_ns, values), [0]
    state.sighting_poses = StampedPoses(SightingPose, space.pose.size)
    seen = Counter(vertex for table in graph.tables.values() for vertex in table.vertices.values.ravel().tolist())
    of_pose = set(poses)
    state.landmarks = {
        str(file.ids[v]): Landmark(str(file.ids[v]), v, sightings=seen[v], last_seen_ns=stamps_ns[-1])
        for v in range(graph.vertex_count)
        if v not in of_pose and seen[v]
    }
    held = file.fixed or ([] if any(label in _PRIORS for label in graph.labels) else poses[:1])
    sigmas = Gaussian.from_sigmas(*space.sigmas(TIGHT, TIGHT))
    for vertex in held:
        graph.add_edge(space.pose_prior, [vertex], _at(graph, vertex, values), sigmas, "anchor")
    settings = {"world.dimensions": space.dimensions, "robust.noise_scale": "configured", "map.condense": False}
    config, ended = Config.from_mapping(settings), [Control("optimize")]
    return record_run(out, config, ended, file.losses, state, recording=name, force=force)[1]


def _path(
    graph: Graph, space: Geometry, poses: list[int], stamps_ns: list[int], values: Array
) -> tuple[StampedPoses[Keyframe], list[int]]:
    """The keyframes, with their poses by odometry alone, and those that no odometry joins to the one before."""
    steps: dict[tuple[int, ...], Numbers] = {}
    for edge in map(graph.edge, graph.edges_of("odometry").tolist()):
        if edge.type is space.relative_pose:
            steps[edge.vertices] = tuple(edge.measured.tolist())
            steps[edge.vertices[::-1]] = space.group.inverse(steps[edge.vertices])
    keyframes, segments = StampedPoses(Keyframe, space.pose.size), list[int]()
    at = _at(graph, poses[0], values)
    for k, vertex in enumerate(poses):
        step = steps.get((poses[k - 1], vertex)) if k else None
        if step is None:
            segments.append(k)
        at = _at(graph, vertex, values) if step is None else tuple(map(float, space.group.compose(at, step)))
        keyframes.append(vertex, stamps_ns[k], at)
    return keyframes, segments


def _at(graph: Graph, vertex: int, values: Array) -> Numbers:
    start = graph.vertex(vertex).stored.start
    return tuple(values[start : start + graph.kind_of(vertex).size].tolist())
