"""One file of a recording: what readers of all kinds of files have in common."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from graph_slam_ros.errors import GraphSlamError


class BagError(GraphSlamError):
    """A recording that cannot be read, or lacks what was asked for."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A recorded topic.

    Attributes
    ----------
    definition : the message definition recorded with it (ROS .msg text), or empty
    encoding : of its messages; those of ROS 1 are converted to CDR where their type is known
    """

    name: str
    type: str
    count: int
    definition: str = ""
    encoding: str = "cdr"


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One recorded message: CDR bytes and the time it was received."""

    topic: str
    log_ns: int
    cdr: bytes


class Part:
    """One file of a recording.

    Attributes
    ----------
    first_ns : time of its first message, or 0 where that is not known
    ros1 : by topic: from a message of ROS 1 to CDR
    """

    def __init__(self, file: Path) -> None:
        self.file, self.first_ns = file, 0
        self.topics: list[Topic] = []
        self.ros1: dict[str, Callable[[bytes], bytes]] = {}

    def messages(self, topics: Collection[str], losses: list[str], warnings: list[str]) -> Iterator[BagMessage]:
        """Messages in order of the file."""
        raise NotImplementedError
