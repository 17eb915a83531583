"""The node under test, and who is around it."""

import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.live.processes import Process, running
from benchmarks.live.robot import HERE
from benchmarks.live.streams import LANDMARKS, ODOMETRY


class Node(Process):
    """Our node, recording into a folder."""

    def __init__(self, folder: Path, parameters: dict[str, Any]) -> None:
        self._folder = folder
        given = {"output.folder": folder} | parameters
        words = [word for key, value in given.items() for word in ("-p", f"{key}:={_text(value)}")]
        super().__init__("graph_slam_ros.node.node", "--ros-args", "--log-level", "error", *words, name="the node")

    def finished(self) -> dict[str, Any]:
        """What it tells of its run, once it has ended."""
        self.stop()
        told: dict[str, Any] = json.loads((self._folder / "run.json").read_text(encoding="utf-8"))
        return told


def sender(stream: str, *topics: str, **values: Any) -> Process:
    """Who sends a stream, see ``benchmarks.live.streams``."""
    names = ",".join(topics or (ODOMETRY, LANDMARKS))
    return Process(HERE, "send", stream, json.dumps(values), names, name="the sender")


def listener(*names: str) -> Process:
    """Who listens to outputs of the node."""
    return Process(HERE, "listen", *names, name="the listener")


@contextlib.contextmanager
def node(parameters: dict[str, Any], *others: Process) -> Iterator[Node]:
    """A node for as long as the context lasts; the others end with it."""
    with tempfile.TemporaryDirectory() as folder:
        ours = Node(Path(folder) / "run", parameters)
        with running(*others, ours):
            yield ours


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else "''" if value == "" else str(value)
