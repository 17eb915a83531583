"""Lost messages are counted by their numbers, and none that was not lost."""

import pytest

pytest.importorskip("rclpy")

from graph_slam_ros.node.subscriptions import Losses

ONE, OTHER, BOTH = frozenset({b"1"}), frozenset({b"2"}), frozenset({b"1", b"2"})


class Topic:
    """Counts what is lost of messages, and how often it asks who publishes."""

    def __init__(self, publishers=ONE):
        self.publishers, self.asked, self.lost = publishers, 0, 0
        self._losses = Losses(self._ask)

    def _ask(self):
        self.asked += 1
        return self.publishers

    def hear(self, *numbers, now_s=0.0):
        for number in numbers:
            info = {} if number is None else {"publication_sequence_number": number}
            self.lost += self._losses.before(info, int(now_s * 1e9))
        return self.lost


def test_a_publisher_without_numbers_or_that_starts_again_has_lost_nothing():
    assert Topic().hear(*[None] * 3) == Topic().hear(*[2**64 - 1] * 3) == 0
    topic = Topic()
    topic.hear(100, 101)
    topic.publishers = OTHER
    assert topic.hear(1, 2, 3) == 0
    assert topic.hear(5) == 0, "the first gap after the change"
    assert topic.hear(8) == 2


def test_of_several_publishers_nothing_is_counted_and_they_are_asked_for_once_a_second():
    topic = Topic(BOTH)
    for k in range(100):
        assert topic.hear(k, 1000 + k, now_s=0.01 * k) == 0
    assert topic.asked == 1
    topic.publishers = ONE
    assert topic.hear(1200, now_s=5.0) == 0, "the first gap with one publisher"
    assert topic.hear(1203, now_s=5.1) == 2
