"""Changes of a problem since its last update."""

import numpy as np

from graph_slam_ros.typing import Index

NONE = np.empty(0, dtype=np.int64)


class PendingChanges:
    """Changes that the next update integrates.

    Attributes
    ----------
    vertices : that were added
    new, back : edges that were added; that came back, or have another weight or a newly held vertex
    touched : vertices that lost an edge or a neighbour
    may_float : whether something that held parts together may be gone
    moved : whether all linearisation points were moved, so that nothing is linearised there yet
    broken : whether the tree must be made anew
    """

    __slots__ = ("back", "broken", "may_float", "moved", "new", "touched", "vertices")

    def __init__(self) -> None:
        self.vertices = self.new = self.touched = NONE
        self.back: list[Index] = []
        self.may_float = self.moved = self.broken = False

    def __bool__(self) -> bool:
        is_changed = len(self.vertices) or len(self.new) or self.back or len(self.touched)
        return bool(is_changed or self.moved or self.broken)

    def is_plain(self) -> bool:
        """Return whether vertices and edges were added, and nothing else was changed."""
        is_special = self.back or self.may_float or self.moved or self.broken
        return not is_special and len(self.vertices) + len(self.new) > 0

    def add(self, vertices: Index, edges: Index) -> None:
        """Append new vertices and edges."""
        all_vertices = np.concatenate((self.vertices, vertices)) if len(self.vertices) else vertices
        all_new = np.concatenate((self.new, edges)) if len(self.new) else edges
        self.vertices, self.new = all_vertices, all_new  # both, or where memory lacks neither

    def again(self, edges: Index) -> None:
        """Append edges to be linearised again, even if they are pending already."""
        self.back.append(edges)

    def edges(self) -> Index:
        """Return all edges to be linearised, each once."""
        return np.unique(np.concatenate((self.new, *self.back))) if self.back else self.new

    def touch(self, vertices: Index) -> None:
        """Append vertices that lost an edge or a neighbour."""
        self.touched = np.concatenate((self.touched, vertices))

    def forget(self, vertices: Index) -> None:
        """Drop vertices that were removed before an update integrated them."""
        if len(self.vertices):
            self.vertices = self.vertices[~np.isin(self.vertices, vertices)]
