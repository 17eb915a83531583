"""Tags of edge types: the names by which files and maps call them. Built-in types are here, others are plugins'.

This is the only table of them. A plugin's edge type is an entry point of the group ``graph_slam_ros.edges``: it is
tested once, and what it raises names the plugin.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros import graph as graphs
from graph_slam_ros import plugins
from graph_slam_ros.errors import ConfigError, FormatError, GraphSlamError
from graph_slam_ros.graph import SE2, SE3, EdgeType, VertexKind, place_edge
from graph_slam_ros.graph.edge_type import jacobian_fault, random_value
from graph_slam_ros.graph.place import MOST_MEMBERS, members_of
from graph_slam_ros.plugins import EDGES, in_one_line, load, names
from graph_slam_ros.typing import Array, Index

VERTEX_TAGS: dict[str, VertexKind] = {
    "VERTEX_SE2": SE2,
    "VERTEX_XY": graphs.R2,
    "VERTEX_SE3:QUAT": SE3,
    "VERTEX_TRACKXYZ": graphs.R3,
    "VERTEX_OFFSET": graphs.R1,  # ours
}
EDGE_TAGS: dict[str, EdgeType] = {
    "EDGE_SE2": graphs.RELATIVE_POSE,
    "EDGE_SE2_XY": graphs.LANDMARK_POSITION,
    "EDGE_PRIOR_SE2": graphs.POSE_PRIOR,
    "EDGE_PRIOR_SE2_XY": graphs.POSITION_PRIOR,
    "EDGE_PRIOR_XY": graphs.POINT_PRIOR[graphs.R2],
    "EDGE_BEARING_SE2_XY": graphs.BEARING,
    "EDGE_SE3:QUAT": graphs.RELATIVE_POSE_3D,
    "EDGE_SE3_PRIOR": graphs.POSE_PRIOR_3D,
    "EDGE_SE3_TRACKXYZ": graphs.LANDMARK_POSITION_3D,
    "EDGE_POINTXYZ_PRIOR": graphs.POINT_PRIOR[graphs.R3],
    # ours; of a landmark that is a pose, only the POSITION was seen
    "EDGE_SE2_POSITION": graphs.TAG_POSITION,
    "EDGE_SE3_POSITION": graphs.TAG_POSITION_3D,
    "EDGE_RANGE_SE2_XY": graphs.RANGE,
    "EDGE_RANGE_BEARING_SE2_XY": graphs.RANGE_BEARING,
    "EDGE_RANGE_OFFSET_SE2_XY": graphs.RANGE_WITH_OFFSET,
    "EDGE_PRIOR_OFFSET": graphs.POINT_PRIOR[graphs.R1],
    "EDGE_COORDINATE_SE2": graphs.COORDINATE_PRIOR,
    "EDGE_HEADING_SE2": graphs.HEADING_PRIOR,
    "EDGE_RANGE_SE3_XYZ": graphs.RANGE_3D,
    "EDGE_BEARING_SE3_XYZ": graphs.BEARING_3D,
    "EDGE_RANGE_BEARING_SE3_XYZ": graphs.RANGE_BEARING_3D,
    "EDGE_RANGE_OFFSET_SE3_XYZ": graphs.RANGE_WITH_OFFSET_3D,
    "EDGE_POSITION_SE3": graphs.POSITION_PRIOR_3D,
    "EDGE_COORDINATE_SE3": graphs.COORDINATE_PRIOR_3D,
    "EDGE_ATTITUDE_SE3": graphs.ATTITUDE_PRIOR_3D,
    "EDGE_HEADING_SE3": graphs.HEADING_PRIOR_3D,
}
SWITCHED = {  # closures that may be false: Vertigo's, and RTAB-Map's where it is robust; a switch follows the poses
    "EDGE_SE2_SWITCHABLE": "EDGE_SE2",
    "EDGE_SE2_MAXMIX": "EDGE_SE2",
    "EDGE_SE3_SWITCHABLE": "EDGE_SE3:QUAT",
    "EDGE_SE3:QUAT_SWITCHABLE": "EDGE_SE3:QUAT",
}
OF_POSES = {("EDGE_POINTXYZ_PRIOR", SE3): "EDGE_POSITION_SE3", ("EDGE_PRIOR_XY", SE2): "EDGE_PRIOR_SE2_XY"}
_PLACE = re.compile(r"(0|[1-9][0-9]{0,2})(?::([1-9][0-9]{0,2}))?", re.ASCII)
OFFSET = "PARAMS_SE3OFFSET"
PLACE_TAGS = {"EDGE_PLACE_SE2_XY": SE2, "EDGE_PLACE_SE3_XYZ": SE3}  # ours; ":3" follows, or ":3:1" with a pose
_BUILT_IN = {edge: tag for tag, edge in EDGE_TAGS.items()} | {graphs.INVERSE_RELATIVE_POSE: "EDGE_SE2"}
_RESERVED = frozenset({*EDGE_TAGS, *VERTEX_TAGS, OFFSET, "FIX"})
_loaded: dict[str, EdgeType] = {}  # of plugins
_tags: dict[EdgeType, str] = {}
_TRIALS, _TOLERANCE = 20, 1e-4  # at random values; of the largest number of a Jacobian


def built_in(tag: str) -> EdgeType | None:
    """Return the edge type of a tag that is built in; None for others."""
    base, _, members = tag.partition(":")
    if base in PLACE_TAGS and (found := _PLACE.fullmatch(members)):
        points, poses = int(found[1]), int(found[2] or 0)
        return place_edge(PLACE_TAGS[base], points, poses) if 0 < points + poses <= MOST_MEMBERS else None
    return EDGE_TAGS.get(tag)


def plugin_tags() -> frozenset[str]:
    """Return the tags that installed plugins have, usable or not, less those that are built in."""
    return frozenset(names(EDGES)) - _RESERVED


def edge_of(tag: str) -> EdgeType:
    """Return the edge type of a tag that is built in or of a plugin; what a plugin's raises names it.

    Raises ConfigError: the plugin cannot be used, or there is none.
    """
    return built_in(tag) or _plugin(tag)


def tag_of(edge: EdgeType) -> str:
    """Return the tag of an edge type.

    Raises FormatError: it is not built in, and no plugin has it; those that cannot be used are named.
    """
    if members := members_of(edge):
        points, poses = members
        base = next(tag for tag, pose in PLACE_TAGS.items() if pose in edge.accepts[0])
        return f"{base}:{points}" + (f":{poses}" if poses else "")
    faults = []
    if edge not in _BUILT_IN and edge not in _tags:
        for tag in sorted(plugin_tags()):
            try:
                edge_of(tag)
            except ConfigError as error:
                faults.append(str(error))
    found = _BUILT_IN.get(edge) or _tags.get(edge)
    if found is None:
        raise FormatError("; ".join([f"g2o has no tag for an edge {edge.name}", *faults]))
    return found


def described() -> list[str]:
    """Return a line for each edge type that an installed plugin has, and why it cannot be used where that is so."""
    return plugins.described(EDGES, _RESERVED, lambda tag, of: f"{tag}: {edge_of(tag).name!r}, an edge type of {of}")


def _plugin(tag: str) -> EdgeType:
    if tag not in _loaded:
        found = None if tag in _RESERVED else load(EDGES, tag, _wrong)
        if found is None:
            remedy = f"install the package that has the entry point {tag} of the group {EDGES}"
            raise ConfigError(f"{tag}: no plugin has an edge of this tag: {remedy}")
        if not re.fullmatch(r"[A-Za-z_][\w:.+-]*", tag, re.ASCII):
            raise ConfigError(f"{tag!r}: {found[1]}: a tag is one word of letters, digits and _:.+-")
        _loaded[tag] = _named(*found)
        _tags.update(dict.fromkeys((found[0], _loaded[tag]), tag))
    return _loaded[tag]


def _wrong(there: Any) -> str:
    if not isinstance(there, EdgeType):
        return f"it is a {type(there).__name__}, not an EdgeType"
    kinds = {kind for kinds in there.accepts for kind in kinds}
    unknown = ", ".join(sorted(kind.name for kind in kinds - set(VERTEX_TAGS.values())))
    return f"g2o has no tag for its vertices {unknown}" if unknown else _fault_of(there)


def _fault_of(edge: EdgeType) -> str:
    """Try an edge type at random values, which also compiles it; return what is wrong with it, or nothing.

    A residual may raise, or not be finite, at values that it is not made for: only what else it returns is judged.
    """
    rng, faults = np.random.default_rng(0), list[str]()
    for _ in range(_TRIALS):
        values = tuple(random_value(kinds[0], rng) for kinds in edge.accepts)
        measured = edge.whole(rng.standard_normal(edge.measured_size - len(edge.tail)))
        try:
            fault = jacobian_fault(edge, values, measured, _TOLERANCE)
            faults += [] if fault is None else [fault]
        except GraphSlamError as error:
            return str(error)
        except Exception:  # whatever another's function does
            continue
    wrong = [fault for fault in faults if fault]
    return wrong[0] if 2 * len(wrong) > len(faults) else ""


def _named(edge: EdgeType, plugin: str) -> EdgeType:
    """The same edge type, whose faults are a ConfigError that names the plugin."""

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        try:
            out = edge.linearize(x, at, measured)
            shapes = tuple(map(np.shape, out))
            due = (len(at), edge.residual_size), (len(at), edge.residual_size, sum(edge.dofs))
            fault = "" if shapes == due else f"shapes {shapes[0]} and {shapes[1]}, not {due[0]} and {due[1]}"
        except Exception as error:  # whatever another's function does
            fault = in_one_line(error)
        if fault:
            raise ConfigError(f"edge {edge.name!r}, {plugin}: {fault}")
        return out

    return replace(edge, linearize=linearize)
