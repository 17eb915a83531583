"""The mirror images of a map of ranges: a range does not tell on which side of the robot a landmark is.

The sides follow from the turns of odometry. Where these are noisy, the first landmarks may be put on the wrong side,
and the path turns the wrong way. Small steps do not lead from there to the truth. So a search starts at the mirror
image, too.
"""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.typing import Array

_MOTION = ("odometry", "anchor")  # labels
_RANGES = {one for space in (PLANAR, SPATIAL) for one in (space.sightings["range"], space.range_with_offset)}


def is_of_ranges(graph: Graph) -> bool:
    """Return whether a graph has ranges, and nothing else but odometry."""
    has_ranges = False
    for edge_type, table in graph.tables.items():
        is_motion = graph.has_label(table.id.values, _MOTION)
        if edge_type not in _RANGES and not is_motion.all():
            return False
        has_ranges |= edge_type in _RANGES and len(table) > 0
    return has_ranges


def mirror_images(graph: Graph, values: Array) -> Iterator[Array]:
    """Yield the stored numbers of all vertices mirrored left to right, and in space also top to bottom.

    The first pose stays where it is.
    """
    space = PLANAR if PLANAR.pose in graph.kinds else SPATIAL
    begin = graph.vertex(int(np.argmax(graph.kind.values == graph.kinds.index(space.pose))))
    group, there = space.group, tuple(values[begin.stored].tolist())
    for axis in range(1, space.dimensions):
        out = values.copy()
        for code, kind in enumerate(graph.kinds):
            at = graph.offset.values[graph.kind.values == code][:, None] + np.arange(kind.size)
            if kind is space.pose:
                seen = group.between(there, tuple(values[at].T))
                out[at] = np.stack(group.compose(there, tuple(_mirrored(space, np.stack(seen), axis))), axis=-1)
            elif kind is space.point:
                seen = group.act(group.inverse(there), tuple(values[at].T))
                out[at] = np.stack(group.act(there, tuple(_mirrored(space, np.stack(seen), axis))), axis=-1)
        yield out


def _mirrored(space: Geometry, numbers: Array, axis: int) -> Array:
    """Points (n, k) or poses (size, k), mirrored along an axis. The axis of a turn is mirrored the other way round."""
    out, n = numbers.copy(), space.dimensions
    out[axis] *= -1.0
    if len(out) == n + 1:
        out[n] *= -1.0
    elif len(out) > n:
        out[[n + k for k in range(n) if k != axis]] *= -1.0
    return out
