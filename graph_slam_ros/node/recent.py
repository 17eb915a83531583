"""Counts of each input in the last seconds. The state is judged from these, not from the counts since the start."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from graph_slam_ros.measurements.reasons import Effect, explain

WINDOW_S, LATELY_S = 10.0, 3.0
_SHARE, _LEAST = 0.1, 3  # of what came, and how much at least
_OF_ITS_OWN = {"overflow"}  # the verdict has a sentence for it


@dataclass(frozen=True, slots=True)
class Recent:
    """The counts of one input in the last ten seconds; of a message that holds several things, each counts.

    Attributes
    ----------
    came : things
    refused : how many of them by reason, by the border and by the pipeline; what was repaired is not refused
    goes_on : whether something was refused in the last three seconds, or nothing came then
    """

    came: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    goes_on: bool = False

    @property
    def times(self) -> int:
        """The number of refusals."""
        return sum(self.refused.values())

    @property
    def worst(self) -> str:
        """The most frequent reason; empty if nothing was refused."""
        return max(self.refused, key=lambda reason: self.refused[reason], default="")

    @property
    def is_bad(self) -> bool:
        """Return whether more than a tenth was refused, and refusals go on."""
        return self.goes_on and self.times >= _LEAST and self.times > _SHARE * self.came

    @property
    def is_nothing_used(self) -> bool:
        """Return whether all was refused."""
        return self.times >= self.came


Counts = Mapping[str, Mapping[str, int]]


class RecentInputs:
    """Remembers totals of the last seconds, and returns their differences."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, Counter[str], Counter[tuple[str, str]]]] = deque([(0.0, Counter(), Counter())])

    def observe(self, now_s: float, accepted: Mapping[str, int], before: Counts, after: Counts) -> dict[str, Recent]:
        """Return the counts of each input in the last seconds. Call it about every second.

        Parameters
        ----------
        now_s : by a clock that never stands
        accepted : things that were handed to the pipeline since the start, by input
        before, after : what was counted since the start by input and reason: before that, and by the pipeline
        """
        not_accepted, refused = _refused(before), _refused(before, after)
        came = Counter(accepted)
        for (name, _), times in not_accepted.items():
            came[name] += times
        self._past.append((now_s, came, refused))
        while len(self._past) > 2 and self._past[1][0] <= now_s - WINDOW_S:
            self._past.popleft()
        lately = next(one for one in self._past if one[0] >= now_s - LATELY_S or one is self._past[-1])
        (_, came_before, refused_before), (_, came_lately, refused_lately) = self._past[0], lately
        out = {}
        for name in came:
            mine = {reason: n for (of, reason), n in (refused - refused_before).items() if of == name}
            is_refused = any(of == name for of, _ in refused - refused_lately)
            out[name] = Recent(came[name] - came_before[name], mine, is_refused or came[name] == came_lately[name])
        return out


def _refused(*counts: Counts) -> Counter[tuple[str, str]]:
    out: Counter[tuple[str, str]] = Counter()
    for some in counts:
        for name, reasons in some.items():
            for reason, times in reasons.items():
                if reason not in _OF_ITS_OWN and explain(reason).effect is Effect.REFUSED:
                    out[name.partition("#")[0], reason] += times
    return out
