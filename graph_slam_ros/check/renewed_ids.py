"""A check of identities: whether the detector has numbered the landmarks anew on the way."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.finding import Finding
from graph_slam_ros.check.pairs import usable
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.slam.landmarks.renewed_ids import LEAST, renewed_ids
from graph_slam_ros.typing import Array, Index


def check_renewed(s: SightingColumns, points: Array, path_ns: Index, dimensions: int) -> Iterator[Finding]:
    """Yield the finding that ids are new from some time on, if they are.

    Parameters
    ----------
    points : (k, 3) where each sighting puts its landmark in the map
    """
    use = usable(s, path_ns) & np.isfinite(points).all(axis=1)
    numbers, counts = np.unique(s.name[use], return_counts=True)
    of = [np.flatnonzero(use & (s.name == one)) for one in numbers[counts >= LEAST]]
    if len(of) < 2 * LEAST:
        return
    at = np.array([np.median(points[rows, :dimensions], axis=0) for rows in of])
    first_ns, last_ns = (np.array([end(s.stamp_ns[rows]) for rows in of]) for end in (np.min, np.max))
    if found := renewed_ids(at, first_ns, last_ns):
        text = f"{s.topic}: {found}"
        yield Finding(
            "ids_renewed", "warning", found.same, LEAST, "landmarks", text, s.topic, found.since_ns, found.new
        )
