"""A graph as text files represent it, and g2o's tags of its vertices and edges."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from graph_slam_ros.graph import POSE_PRIOR_3D, RELATIVE_POSE_3D, Gaussian, Graph
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Array

Values: TypeAlias = Callable[[Sequence[int]], Array]

NO_EDGES = ("VERTEX", "PARAMS", "EDGE_SWITCH_PRIOR", "ROBOTLASER", "RAWLASER")  # begin unknown tags that lose nothing
AT_OFFSET = ("EDGE_SE3_PRIOR", "EDGE_SE3_TRACKXYZ")  # a parameter's number follows the vertices
# of our residual, in g2o's
HALVED = dict.fromkeys((RELATIVE_POSE_3D, POSE_PRIOR_3D), np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]))


@dataclass(slots=True)
class G2oFile:
    """A graph as read from, or to be written to, a g2o file.

    Attributes
    ----------
    ids : the file's id of each vertex of the graph
    fixed : vertices (ids of the graph) that FIX lines hold
    offsets : the parameters, where on the robot sensors are: T_base_sensor (7,) by number
    seen_from : the number of the parameter of each edge that has one
    unknown : lines with tags that are not understood, in order
    notes : what was repaired or had to be assumed, and where
    skipped : in lenient reading, what was wrong with each line left out
    raw : whether the information of rotations in space was, and is to be written, unscaled
    has_values : whether the file gave initial values; without, all are at the origin
    absent : vertices that are not written
    """

    graph: Graph
    ids: list[int]
    fixed: list[int] = field(default_factory=list)
    offsets: dict[int, se3.Pose] = field(default_factory=dict)
    seen_from: dict[int, int] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    raw: bool = False
    has_values: bool = True
    notes: list[str] = field(default_factory=list)
    absent: frozenset[int] = frozenset()

    @property
    def losses(self) -> list[str]:
        """Lines of the file that are not in the graph: bad ones if reading was lenient, edges of unknown kinds."""
        edges = [line for line in self.unknown if not line.startswith(NO_EDGES)]
        return [*self.skipped, *(f"{tag}: of an unknown kind, so they are not in the graph" for tag in tags_of(edges))]


def tags_of(lines: Iterable[str]) -> list[str]:
    """The tags of lines, each with how often it is there."""
    return [f"{count} {tag}" for tag, count in Counter(line.split()[0] for line in lines).items()]


def moved(points: Array, root: Array, offsets: Sequence[se3.Pose]) -> tuple[Array, Gaussian]:
    """Points (n, 3) seen in the frames of sensors, in the robot's frame: ``R p + t``, and their noise with them."""
    turn = np.array([so3.matrix(se3.rotation(offset)) for offset in offsets]).reshape(-1, 3, 3)
    shift = np.array([se3.position(offset) for offset in offsets]).reshape(-1, 3)
    return np.einsum("nij,nj->ni", turn, points) + shift, Gaussian(root @ np.swapaxes(turn, 1, 2))
