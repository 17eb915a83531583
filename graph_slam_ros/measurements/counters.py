"""Nothing is dropped or repaired silently: each case adds to a counter by (source, reason)."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any


class Counters:
    """Counts by (source, reason); a source is a topic or an input's name.

    Attributes
    ----------
    on_first : called with source and reason the first time each is counted
    received : messages of each input, zero included
    used : measurements of each input that the estimate is made of: odometry messages, sightings, fixes, closures
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

    def __getitem__(self, key: tuple[str, str]) -> int:
        return self._counts[key]

    def update(self, other: "Counters") -> None:
        """Add all counts of another."""
        for own, more in self._with(other):
            own.update(more)

    def raise_to(self, other: "Counters") -> None:
        """Take the larger of each count: both have counted the same."""
        for own, counts in self._with(other):
            for key, times in counts.items():
                own[key] = max(own[key], times)

    def since(self, before: "Counters") -> "Counters":
        """Return what was counted after there were these."""
        out = Counters()
        for counts, own in out._with(self):
            counts.update(own)
        for counts, less in out._with(before):
            counts.subtract(less)
        out._counts = +out._counts
        return out

    def _with(self, other: "Counters") -> Iterator[tuple[Counter[Any], Counter[Any]]]:
        """Each kind of count beside a copy of the other's: another thread may be counting there."""
        yield self._counts, Counter(other._counts)
        yield self.received, Counter(other.received)
        yield self.used, Counter(other.used)

    def as_dict(self) -> dict[str, dict[str, int]]:
        """``{source: {reason: times}}``, sorted by name."""
        out: dict[str, dict[str, int]] = {}
        for (source, reason), times in sorted(self._counts.items()):
            out.setdefault(source, {})[reason] = times
        return out
