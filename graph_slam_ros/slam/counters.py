"""Nothing is dropped or repaired silently: each case adds to a counter by (source, reason)."""

from collections import Counter
from collections.abc import Callable


class Counters:
    """Counts by (source, reason); a source is a topic or an input's name.

    Attributes
    ----------
    on_first : called with source and reason the first time each is counted
    """

    def __init__(self) -> None:
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
        self._counts.update(other._counts)

    def since(self, before: "Counters") -> "Counters":
        """What was counted after there were these."""
        out = Counters()
        out._counts = Counter(self._counts) - before._counts  # of a copy: another thread may be counting
        return out

    def as_dict(self) -> dict[str, dict[str, int]]:
        """``{source: {reason: times}}``, sorted by name."""
        out: dict[str, dict[str, int]] = {}
        for (source, reason), times in sorted(self._counts.items()):
            out.setdefault(source, {})[reason] = times
        return out
