"""Keyframes of visits that are in no place, which stay: they are a least distance apart, or look another way."""

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Numbers

Key = tuple[int, ...]


class Skeleton:
    """The positions at which a keyframe has stayed, and which axis of the map each looked along.

    Parameters
    ----------
    apart_m : between two that look the same way, at least

    Attributes
    ----------
    positions : by cell of a grid of that width, axis and sign
    """

    def __init__(self, apart_m: float = 2.0) -> None:
        self.apart_m = apart_m
        self.positions: dict[Key, list[Numbers]] = {}

    def __len__(self) -> int:
        return sum(map(len, self.positions.values()))

    def adds(self, space: Geometry, pose: Sequence[float]) -> bool:
        """Add a pose, if none that looks the same way is near; return whether it was added."""
        at, way = tuple(pose[: space.dimensions]), _way(space, pose)
        cell = np.floor(np.array(at) / self.apart_m).astype(np.int64).tolist()
        for off in product((-1, 0, 1), repeat=len(cell)):
            near = self.positions.get((*(a + b for a, b in zip(cell, off, strict=True)), *way), ())
            if any(np.linalg.norm(np.subtract(at, one)) < self.apart_m for one in near):
                return False
        self.positions.setdefault((*cell, *way), []).append(at)
        return True

    def spread(self, apart_m: float) -> None:
        """Set the least distance from now on."""
        rows, self.apart_m, self.positions = list(self.rows()), apart_m, {}
        if rows:
            self.restore(rows, len(rows[0]) - 2)

    def copy(self) -> "Skeleton":
        """Return a copy."""
        out = Skeleton(self.apart_m)
        out.positions = {key: [*several] for key, several in self.positions.items()}
        return out

    def rows(self) -> Iterator[list[float]]:
        """Yield the position, axis and sign of each, in order."""
        for key, several in self.positions.items():
            yield from ([*at, *key[len(at) :]] for at in several)

    def restore(self, rows: Sequence[Sequence[float]], dimensions: int) -> None:
        """Add ``rows`` of a map that was saved."""
        for row in rows:
            at, way = tuple(row[:dimensions]), tuple(map(int, row[dimensions:]))
            cell = np.floor(np.array(at) / self.apart_m).astype(np.int64).tolist()
            self.positions.setdefault((*cell, *way), []).append(at)


def _way(space: Geometry, pose: Sequence[float]) -> tuple[int, int]:
    """Return which axis of the map a pose looks along, as its number and its sign."""
    forward = space.turn(tuple(pose))[:, 0]
    axis = int(np.argmax(np.abs(forward)))
    return axis, int(np.sign(forward[axis]))
