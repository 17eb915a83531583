"""visualization_msgs/MarkerArray: landmarks with their uncertainty, the graph with how well its edges fit.

An array deletes all markers before it draws its own: what is not in it any more is gone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from graph_slam_ros.colours import DARK, rgba
from graph_slam_ros.formats.cdr import CdrWriter
from graph_slam_ros.graph import POINT_PRIOR, R2, R3, SE2, SE3, EdgeType
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import EdgeRows
from graph_slam_ros.lie import se3
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array, Index, Numbers

_ADD, _DELETE_ALL = 0, 3
_ARROW, _SPHERE, _CYLINDER, _LINE_LIST, _POINTS, _TEXT = 0, 2, 3, 5, 8, 9
_NONE = np.empty((0, 3))
_PLAIN = np.empty((0, 4), dtype=np.float32)  # colours, where points have none of their own

# RViz is dark unless it is set otherwise.
_OF_LANDMARKS, _OF_POSES = rgba(DARK["landmarks"], 0.8), rgba(DARK["estimate"], 1.0)
_OF_REJECTED = rgba(DARK["closures"], 0.8)
# Green over yellow to red in even steps of hue in OKLCH and ever a little darker, for those to whom they are alike.
_RAMP = np.array([[0.38, 0.90, 0.42], [0.69, 0.75, 0.03], [0.80, 0.60, 0.0], [0.85, 0.44, 0.0], [0.87, 0.23, 0.24]])
_DASHES = 5
_COORDINATES = {SE2: 2, SE3: 3, R2: 2, R3: 3}


@dataclass(frozen=True, slots=True)
class Lines:
    """Edges to draw, from ``start`` to ``end``, (n, 3) each; ``misfit`` (n,) is chi2 per degree of freedom."""

    start: Array
    end: Array
    misfit: Array


@dataclass(frozen=True, slots=True)
class GraphView:
    """The lines and points that represent a graph.

    Attributes
    ----------
    poses, landmarks : (n, 3)
    classes : lines of edges by label
    rejected : those of edges that are out: their weight is 0
    """

    poses: Array
    landmarks: Array
    classes: dict[str, Lines]
    rejected: Lines


def landmark_markers(
    stamp_ns: int, frame: str, names: Sequence[str], positions: Array, covariances: Sequence[Array]
) -> bytes:
    """A 2-sigma ellipse or ellipsoid and a name for each landmark.

    Parameters
    ----------
    positions : (n, 2) or (n, 3); covariances : n of (2, 2) or (3, 3), both in ``frame``
    """
    out = _Array(stamp_ns, frame, 2 * len(names))
    at, sizes = np.zeros((len(names), 7)), np.empty((len(names), 3))
    if len(names):
        at[:, : positions.shape[1]] = positions
        at[:, 3:], sizes = _two_sigma(np.array(covariances))
    flat = positions.shape[1] == 2
    for k, (name, pose, size) in enumerate(zip(names, at, sizes.tolist(), strict=True)):
        out.add("landmarks", k, _CYLINDER if flat else _SPHERE, at=pose, size=size)
        out.add("names", k, _TEXT, at=pose, size=(0.0, 0.0, 0.25), text=name)
    return out.message()


def graph_view(view: MapView, most: int) -> GraphView:
    """Draw at most so many keyframes, landmarks and edges of the graph at its estimate.

    An edge is a line between its vertices. An edge of a position alone is a line from there to the point of the robot.
    An edge without a position is not drawn.
    """
    graph, at = view.graph, _positions(view)
    drawn = [table for table in graph.tables.values() if _is_drawn(view.space, table.type)]
    ids = np.concatenate([table.ids for table in drawn] or [np.empty(0, dtype=np.int64)])
    chi2, numbers = view.solver.chi2_of(ids)
    misfit = np.zeros(graph.edge_ids.next)
    misfit[ids] = chi2 / numbers
    shown = np.zeros(graph.edge_ids.next, dtype=bool)
    shown[_worst_and_some(ids, misfit[ids], most)] = True

    parts = [(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.int64))]
    for table in drawn:
        some = table.at(np.flatnonzero(shown[table.ids]))
        label = np.where(some.weight == 0.0, len(graph.labels), some.label)
        parts.append((*_ends(view, at, table.type, some), misfit[some.ids], label))
    start, end, fit, labels = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    which = {name: labels == code for code, name in enumerate((*graph.labels, ""))}
    lines = {name: Lines(start[of], end[of], fit[of]) for name, of in which.items()}
    keyframes = view.keyframes.ids[thinned(len(view.keyframes.ids), most)]
    landmarks = np.array([mark.vertex for mark in view.landmarks.values()], dtype=np.int64)
    landmarks = landmarks[thinned(len(landmarks), most)]
    return GraphView(at[keyframes], at[landmarks], lines, rejected=lines.pop(""))


def thinned(count: int, most: int) -> Index:
    """Indices to show of ``count`` if at most ``most`` (two or more; 0: all) are allowed, with first and last.

    It takes every second, every fourth, and so on. While the count grows the choice stays the same until it is too
    large; then it is halved.
    """
    stride = 1
    while most and -(-(count - 1) // stride) + 1 > max(most, 2):
        stride *= 2
    kept = np.arange(0, count, stride)
    return kept if count == 0 or kept[-1] == count - 1 else np.append(kept, count - 1)


def _worst_and_some(ids: Index, misfit: Array, most: int) -> Index:
    """Select ids of edges with a misfit (n,), no more than ``most``, in order of their ids (n,).

    Half of them are the worst edges. The others are all edges whose id is divisible by a power of two.
    """
    if len(ids) <= most:
        return ids
    half = most // 2
    order = np.argpartition(-misfit, half)
    worst, others = ids[order[:half]], ids[order[half:]]
    stride = 1
    while len(others) > most - half:
        stride *= 2
        others = others[others % stride == 0]
    return np.sort(np.concatenate((worst, others)))


def _positions(view: MapView) -> Array:
    """Positions of all vertices that have one, each at its id, (n, 3)."""
    graph, out, every = view.graph, np.zeros((view.graph.vertex_ids.next, 3)), view.graph.vertex_ids.since()
    for code, kind in enumerate(graph.kinds):
        if n := _COORDINATES.get(kind, 0):
            ids = every[graph.kind_codes(every) == code]
            out[ids, :n] = view.solver.estimate(ids)[:, :n]
    return out


def _is_drawn(space: Geometry, kind: EdgeType) -> bool:
    if len(kind.accepts) > 1:
        return all(slot[0] in _COORDINATES for slot in kind.accepts[:2])
    return kind in (space.pose_prior, POINT_PRIOR[space.point], space.fixes["position"], space.coordinate_prior)


def _ends(view: MapView, at: Array, kind: EdgeType, some: EdgeRows) -> tuple[Array, Array]:
    """The ends of the lines of some rows of a table that is drawn."""
    space, n, end = view.space, view.space.dimensions, at[some.vertices[:, 0]]
    if len(kind.accepts) > 1:
        return end, at[some.vertices[:, 1]]
    start = some.measured[:, :n]
    if kind in (space.fixes["position"], space.coordinate_prior):  # they are of the antenna
        poses, lever = view.solver.estimate(some.vertices[:, 0]).reshape(-1, space.pose.size), some.measured[:, -n:]
        antenna = np.stack(space.group.act(tuple(poses.T), tuple(lever.T)), axis=-1)
        end = _in_space(antenna)
        if kind is space.coordinate_prior:  # from the nearest point with the measured coordinate
            residual = np.einsum("ij,ij->i", start, antenna) - some.measured[:, n]
            start = antenna - residual[:, None] * start
    return _in_space(start), end


def _in_space(points: Array) -> Array:
    return np.concatenate((points, np.zeros((len(points), 3 - points.shape[1]))), axis=1)


def graph_markers(stamp_ns: int, frame: str, view: GraphView) -> bytes:
    """Vertices as points, and edges as lines: those of each class by their misfit, rejected ones dashed.

    The namespaces are ``poses``, ``landmarks``, ``edges/CLASS`` and ``rejected``, as far as they are not empty: RViz
    reports a marker without points as an error.
    """
    shapes = [
        ("poses", _POINTS, 0.06, view.poses, _OF_POSES, _PLAIN),
        ("landmarks", _POINTS, 0.15, view.landmarks, _OF_LANDMARKS, _PLAIN),
    ]
    for name, lines in view.classes.items():
        points = np.stack((lines.start, lines.end), axis=1).reshape(-1, 3)
        colours = np.repeat(misfit_colours(lines.misfit), 2, axis=0)
        shapes.append((f"edges/{name}", _LINE_LIST, 0.02, points, _OF_LANDMARKS, colours))
    shapes.append(("rejected", _LINE_LIST, 0.01, _dashed(view.rejected), _OF_REJECTED, _PLAIN))
    shapes = [shape for shape in shapes if len(shape[3])]
    out = _Array(stamp_ns, frame, len(shapes))
    for name, type_, size, points, colour, colours in shapes:
        out.add(name, 0, type_, size=(size, size, 0.0), colour=colour, points=points, colours=colours)
    return out.message()


def misfit_colours(misfit: ArrayLike) -> NDArray[np.float32]:
    """Colours (n, 4): green up to 1, which is expected, then by the root of the misfit to red from 9 (three sigmas)."""
    place = (len(_RAMP) - 1) * np.clip(0.5 * (np.sqrt(np.asarray(misfit)) - 1.0), 0.0, 1.0)
    out = np.ones((len(place), 4), dtype=np.float32)
    for channel in range(3):
        out[:, channel] = np.interp(place, np.arange(len(_RAMP)), _RAMP[:, channel])
    return out


def _dashed(lines: Lines) -> Array:
    """The ends of the dashes of lines. Each line begins and ends with a dash."""
    along = np.arange(2 * _DASHES) / (2 * _DASHES - 1)
    return (lines.start[:, None] + along[:, None] * (lines.end - lines.start)[:, None]).reshape(-1, 3)


def _two_sigma(covariances: Array) -> tuple[Array, Array]:
    """Ellipses of covariances (n, 2, 2) or (n, 3, 3): the orientations (n, 4) and diameters (n, 3) [m].

    They have a minimum size, also if a covariance is unknown.
    """
    count, n, _ = covariances.shape
    known = np.isfinite(covariances).all(axis=(1, 2), keepdims=True)
    variances, directions = np.linalg.eigh(np.where(known, covariances, 0.0))
    axes, sizes = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    axes[:, :n, :n], sizes[:, :n] = directions, 4.0 * np.sqrt(np.maximum(variances, 0.0))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # rotations, not their mirror images
    return Rotation.from_matrix(axes).as_quat(), np.maximum(sizes, 0.05)


class _Array:
    """Writes a visualization_msgs/MarkerArray, marker by marker, after one that deletes all."""

    def __init__(self, stamp_ns: int, frame: str, count: int) -> None:
        self._stamp_ns, self._frame = stamp_ns, frame
        self._out = CdrWriter()
        self._out.numbers("I", 1 + count)
        self.add("", 0, _ARROW, action=_DELETE_ALL)

    def message(self) -> bytes:
        return self._out.message()

    def add(
        self,
        namespace: str,
        number: int,
        type_: int,
        *,
        action: int = _ADD,
        at: ArrayLike = se3.IDENTITY,
        size: Sequence[float] = (1.0, 1.0, 1.0),
        colour: Numbers = _OF_LANDMARKS,
        points: Array = _NONE,
        colours: NDArray[np.float32] = _PLAIN,
        text: str = "",
    ) -> None:
        """A marker; with ``points`` (n, 3) and, where each has its own, their ``colours`` (n, 4)."""
        out = self._out
        out.header(self._stamp_ns, self._frame)
        out.text(namespace)
        out.numbers("i", number, type_, action)
        out.array(at)
        out.numbers("d", *size)
        out.numbers("f", *colour)
        out.numbers("i", 0, 0)  # it lives until it is deleted
        out.numbers("?", False)  # not locked to its frame
        out.numbers("I", len(points))
        out.array(points)
        out.numbers("I", len(colours))
        out.array(colours, "<f4")
        out.text("")  # texture_resource, texture and uv_coordinates
        out.header(0, "")
        out.text("")
        out.numbers("I", 0, 0)
        out.text(text)
        out.text("")  # mesh_resource, mesh_file and mesh_use_embedded_materials
        out.text("")
        out.numbers("I", 0)
        out.numbers("?", False)
