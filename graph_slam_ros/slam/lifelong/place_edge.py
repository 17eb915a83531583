"""Places in the graph: each is one edge."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from graph_slam_ros.graph import Edge, Gaussian, Graph, place_edge
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.graph.place import LABEL
from graph_slam_ros.slam.lifelong.constellation import Constellation
from graph_slam_ros.slam.lifelong.elimination import product
from graph_slam_ros.slam.lifelong.place import Place
from graph_slam_ros.typing import Array


@dataclass(slots=True)
class PlaceEdge:
    """A place, the vertex that it is seen from and its edge; ``strikes`` of each landmark that visits contradict."""

    base: int
    place: Place
    edge: int
    strikes: dict[int, int] = field(default_factory=dict)


def place_of(
    edge: Edge, linearized_at: Array | None, visits: int, strikes: Mapping[int, int] | None = None
) -> PlaceEdge:
    """Return the place of an edge, which has its other numbers.

    Parameters
    ----------
    linearized_at : numbers as those that the edge measured; without it, it is linearised at these
    """
    base, *members = edge.vertices
    space = PLANAR if PLANAR.pose in edge.type.accepts[0] else SPATIAL
    information = product(edge.sqrt_information.T, edge.sqrt_information)
    seen, at = (
        Constellation.from_numbers(space, numbers, len(members))
        for numbers in (edge.measured, edge.measured if linearized_at is None else linearized_at)
    )
    return PlaceEdge(base, Place(tuple(members), seen, at, information, visits), edge.id, dict(strikes or {}))


def added_place(space: Geometry, graph: Graph, base: int, place: Place, root: Array) -> PlaceEdge:
    """Add the edge of a place to a graph.

    Parameters
    ----------
    base : the vertex that the place is seen from
    root : square root of its information
    """
    poses = len(place.seen.turns)
    kind = place_edge(space.pose, len(place.members) - poses, poses)
    edge = graph.edge(graph.add_edge(kind, [base, *place.members], place.seen.numbers, Gaussian(root), LABEL))
    return place_of(edge, place.linearized_at.numbers, place.visits)
