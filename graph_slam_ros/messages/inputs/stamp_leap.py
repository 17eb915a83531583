"""Single stamps that are far from all others of their topic, such as a misread clock or a corrupted byte."""

from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")

_FAR_NS, _SURE, _SURE_FAR = 60_000_000_000, 2, 3  # stamps that must agree, of a gap and of what is farther away
_MOST_HELD = 100


class StampLeap(Generic[Item]):
    """Holds items dated far from the newest until others agree with them. Refuses them if the rest goes on without.

    Parameters
    ----------
    refuse : called once for each that is refused
    """

    def __init__(self, refuse: Callable[[], None]) -> None:
        self._refuse = refuse
        self._held: list[tuple[int, Item]] = []

    @property
    def holds(self) -> bool:
        """Return whether items are held."""
        return bool(self._held)

    def accept(self, stamp_ns: int, item: Item, newest_ns: int, room_ns: float) -> list[tuple[int, Item]]:
        """Accept an item. Returns those that may be used now, with their stamps, in order of arrival.

        Parameters
        ----------
        newest_ns : stamp of the newest that is used
        room_ns : what is not farther from that is no leap; 0: nothing is one
        """
        far_ns = abs(stamp_ns - newest_ns)
        if not room_ns or far_ns <= room_ns:
            self.forget()
            return [(stamp_ns, item)]
        self._held.append((stamp_ns, item))
        agreeing = [
            one
            for one in self._held
            if abs(one[0] - stamp_ns) <= max(room_ns, 2 * min(far_ns, abs(one[0] - newest_ns)))
        ]
        if len({at for at, _ in agreeing}) < (_SURE if far_ns <= _FAR_NS else _SURE_FAR):
            if len(self._held) > _MOST_HELD:
                del self._held[0]
                self._refuse()
            return []
        for _ in range(len(self._held) - len(agreeing)):
            self._refuse()
        self._held.clear()
        return agreeing

    def forget(self) -> None:
        """Refuse what is held, because the rest goes on without it, or ends."""
        for _ in self._held:
            self._refuse()
        self._held.clear()
