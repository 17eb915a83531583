"""The messages of a topic that the middleware lost on their way to the node."""

from collections.abc import Callable, Mapping
from typing import Any

_NUMBER = "publication_sequence_number"
_UNSUPPORTED = 2**63
_ASK_AGAIN_NS = 1_000_000_000


class Losses:
    """Counts lost messages by the numbers that their publisher gives them, where a topic has one publisher.

    Numbers of several publishers cannot be told apart: rclpy names no publisher with a message. So nothing is counted
    while there are several, and nothing at the first gap after the publisher changed.

    Parameters
    ----------
    publishers : returns the identifiers of the topic's publishers; it is asked at the first message and at gaps
    """

    def __init__(self, publishers: Callable[[], frozenset[bytes]]) -> None:
        self._publishers = publishers
        self._known: frozenset[bytes] = frozenset()
        self._expected: int | None = None
        self._ask_at_ns = 0

    def before(self, info: Mapping[str, Any], now_ns: int) -> int:
        """Return how many messages were lost between the last message and this one.

        Parameters
        ----------
        info : what rclpy says of a message beside its content
        now_ns : the time; while a topic has several publishers, they are asked for once a second
        """
        number = info.get(_NUMBER)
        if number is None or number >= _UNSUPPORTED:
            return 0
        expected, self._expected = self._expected, number + 1
        if (expected is not None and number <= expected) or now_ns < self._ask_at_ns:
            return 0
        before, self._known = self._known, self._publishers()
        if len(self._known) != 1:
            self._ask_at_ns = now_ns + _ASK_AGAIN_NS
            return 0
        return 0 if expected is None or self._known != before else number - expected
