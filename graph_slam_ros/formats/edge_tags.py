"""Tags of edge types in g2o files: those that are built in, else those of plugins (``graph_slam_ros.edges``)."""

from dataclasses import replace
from typing import Any

from graph_slam_ros.errors import ConfigError, FormatError
from graph_slam_ros.formats.graph_file import EDGE_TAGS, OFFSET, VERTEX_TAGS
from graph_slam_ros.graph import INVERSE_RELATIVE_POSE, EdgeType
from graph_slam_ros.plugins import EDGES, in_one_line, load, names
from graph_slam_ros.typing import Array, Index

_BUILT_IN = {edge: tag for tag, edge in EDGE_TAGS.items()} | {INVERSE_RELATIVE_POSE: "EDGE_SE2"}
_loaded: dict[str, EdgeType] = {}
_tags: dict[EdgeType, str] = {}


def plugin_tags() -> frozenset[str]:
    """Return the tags that installed plugins have, usable or not, less those that are built in."""
    return frozenset(names(EDGES)) - EDGE_TAGS.keys() - VERTEX_TAGS.keys() - {OFFSET, "FIX"}


def edge_of(tag: str) -> EdgeType:
    """Return the edge type of a tag that is built in or of a plugin; what a plugin's raises names it.

    Raises
    ------
    ConfigError
        The plugin cannot be used, or there is none.
    """
    if tag in EDGE_TAGS:
        return EDGE_TAGS[tag]
    if tag not in _loaded:
        found = load(EDGES, tag, _wrong)
        if found is None:
            raise ConfigError(f"{tag}: no plugin has an edge of this tag")
        _loaded[tag] = _guarded(*found)
        _tags.update({found[0]: tag, _loaded[tag]: tag})
    return _loaded[tag]


def tag_of(edge: EdgeType) -> str:
    """Return the tag of an edge type.

    Raises
    ------
    FormatError
        It is not built in, and no plugin has it; those that cannot be used are named.
    """
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


def _wrong(there: Any) -> str:
    if not isinstance(there, EdgeType):
        return f"it is a {type(there).__name__}, not an EdgeType"
    kinds = {kind for kinds in there.accepts for kind in kinds}
    unknown = ", ".join(sorted(kind.name for kind in kinds - set(VERTEX_TAGS.values())))
    return f"g2o has no tag for its vertices {unknown}" if unknown else ""


def _guarded(edge: EdgeType, plugin: str) -> EdgeType:
    """The same edge type, whose faults name the plugin."""

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        try:
            residuals, jacobians = edge.linearize(x, at, measured)
            shapes = residuals.shape, jacobians.shape
        except Exception as error:  # whatever another's function does
            raise ConfigError(f"edge {edge.name!r}, {plugin}: {in_one_line(error)}") from error
        due = (len(at), edge.residual_size), (len(at), edge.residual_size, sum(edge.dofs))
        if shapes != due:
            raise ConfigError(
                f"edge {edge.name!r}, {plugin}: shapes {shapes[0]} and {shapes[1]}, not {due[0]} and {due[1]}"
            )
        return residuals, jacobians

    return replace(edge, linearize=linearize)
