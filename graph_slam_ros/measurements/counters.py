"""Counters of what was dropped, repaired or used, by source and reason."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError


class Counters:
    """Counts by (source, reason); a source is the name of a topic or of an input.

    Attributes
    ----------
    on_first : called with source and reason when they are counted for the first time
    received : number of messages of each input, zero included
    used : number of measurements of each input that were used: odometry messages, sightings, fixes, closures
    """

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.used: Counter[str] = Counter()
        self._counts: Counter[tuple[str, str]] = Counter()
        self.on_first: Callable[[str, str], None] = lambda source, reason: None

    def count(self, source: str, reason: str, times: int = 1) -> None:
        """Add to one counter."""
        if (source, reason) not in self._counts:
            self.on_first(source, reason)
        self._counts[source, reason] += times

    def count_failure(self, source: str, error: Exception) -> None:
        """Count a computation that failed and changed nothing: ``unsolved``, or the type of a program's error."""
        is_known = isinstance(error, (GraphSlamError, np.linalg.LinAlgError, MemoryError))
        self.count(source, "unsolved" if is_known else type(error).__name__)

    def __getitem__(self, key: tuple[str, str]) -> int:
        return self._counts[key]

    def update(self, other: "Counters") -> None:
        """Add the counts of another object."""
        for own, more in self._with(other):
            own.update(more)

    def raise_to(self, other: "Counters") -> None:
        """Keep the larger of each count, if both objects have counted the same measurements."""
        for own, counts in self._with(other):
            for key, times in counts.items():
                own[key] = max(own[key], times)

    def since(self, before: "Counters") -> "Counters":
        """Return the counts of this object minus those of an earlier copy."""
        out = Counters()
        for counts, own in out._with(self):
            counts.update(own)
        for counts, less in out._with(before):
            counts.subtract(less)
        out._counts = +out._counts
        return out

    def _with(self, other: "Counters") -> Iterator[tuple[Counter[Any], Counter[Any]]]:
        """Pairs of our counts and a copy of the other's, which another thread may be changing."""
        yield self._counts, Counter(other._counts)
        yield self.received, Counter(other.received)
        yield self.used, Counter(other.used)

    def as_dict(self) -> dict[str, dict[str, int]]:
        """``{source: {reason: times}}``, sorted by name."""
        out: dict[str, dict[str, int]] = {}
        for (source, reason), times in sorted(self._counts.items()):
            out.setdefault(source, {})[reason] = times
        return out
