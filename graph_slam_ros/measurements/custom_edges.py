"""The check whether a custom edge fits the edge type of its plugin."""

import math
import re

import numpy as np

from graph_slam_ros.edge_tags import built_in, map_edge_of, plugin_edge
from graph_slam_ros.errors import ConfigError, FormatError, NoiseError
from graph_slam_ros.graph import SE2, SE3, EdgeType, Gaussian
from graph_slam_ros.measurements.types import CustomEdge
from graph_slam_ros.typing import Array

LABEL = "custom"
"""The class of such edges."""
_LONGEST_NAME = 128  # bytes, of a landmark


def refuse_unusable(tag: str) -> None:
    """Raise ConfigError if a custom edge cannot have this edge type: it is built in, or its plugin cannot be used."""
    if built_in(tag):
        raise ConfigError(f"{tag}: a built-in edge type: choose another tag, or give a Sighting, Fix or Closure")
    map_edge_of(tag)


def edge_type_of(m: CustomEdge) -> tuple[EdgeType, Array]:
    """Return the edge type of a custom edge, as maps have it, and all that was measured, with its defaults.

    Raises
    ------
    ConfigError
        No plugin has the type, or it cannot be used.
    FormatError
        The numbers or ends are not those of the edge type.
    """
    refuse_unusable(m.tag)
    given, edge = plugin_edge(m.tag), map_edge_of(m.tag)
    short = given.measured_size - len(given.tail)
    if len(m.measured) not in (short, given.measured_size):
        sizes = " or ".join(map(str, sorted({short, given.measured_size})))
        raise FormatError(f"{m.tag}: measured has {len(m.measured)} numbers, not {sizes}")
    if not all(map(math.isfinite, m.measured)):
        raise FormatError(f"{m.tag}: measured {list(m.measured)} is not finite")
    if len(m.ends) != len(given.accepts):
        raise FormatError(f"{m.tag}: {len(m.ends)} ends, not {len(given.accepts)}")
    for end, kinds in zip(m.ends, given.accepts, strict=True):
        if isinstance(end, int) and kinds not in ((SE2,), (SE3,)):
            raise FormatError(f"{m.tag}: the stamp {end} where a vertex {kinds[0].name} is due")
        if isinstance(end, str) and (not 0 < len(end.encode()) <= _LONGEST_NAME or re.search(r"[\x00-\x1f]", end)):
            raise FormatError(f"{m.tag}: {end[:40]!r} is no name of a landmark")
    if len(set(m.ends)) < len(m.ends):
        raise FormatError(f"{m.tag}: one of its ends is there twice")
    _refuse_covariance(m, given.residual_size)
    return edge, np.array([*m.measured, *given.tail[len(m.measured) - short :]], dtype=float)


def _refuse_covariance(m: CustomEdge, size: int) -> None:
    if len(m.covariance) != size * size:
        raise FormatError(f"{m.tag}: covariance has {len(m.covariance)} numbers, not {size * size}")
    try:
        Gaussian.from_covariance(np.reshape(m.covariance, (size, size)))
    except NoiseError as error:
        raise FormatError(f"{m.tag}: {error}") from None
