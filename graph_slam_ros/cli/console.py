"""What the commands share: exit codes, what is said and where, and whether ROS is here."""

import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
DONE, FAULT, REFUSED, LOSSES = 0, 1, 2, 3
NOT_CERTIFIED, NOT_APPLICABLE = 4, 5  # of optimize --certify
DIFFERENT = 4  # of diff


def say(*lines: str) -> None:
    """The answer of a command, on standard output."""
    for line in lines:
        print(line)


def tell(what: str, programme: str = "graph_slam") -> None:
    """What stands beside the answer, on standard error: a line, whatever is in the names that it tells."""
    line = _CONTROL.sub(lambda found: repr(found[0])[1:-1], what)
    print(f"{programme}: {line}", file=sys.stderr)


def told(losses: Sequence[str], warnings: Sequence[str] = ()) -> int:
    """Tell what was lost, and what to beware of; returns the exit code."""
    for warning in warnings:
        tell(f"beware: {warning}")
    for loss in dict.fromkeys(losses):
        tell(f"lost: {loss}")
    return LOSSES if losses else DONE


def progress(label: str) -> Any:
    """A bar on standard error around what is iterated over, where a person may be looking."""
    from tqdm import tqdm

    def bar(items: Iterable[Any], total: int) -> Iterable[Any]:
        quiet = None if os.environ.get("GRAPH_SLAM_PROGRESS") is None else False
        return tqdm(items, desc=label, total=total or None, unit="msg", leave=False, disable=quiet, file=sys.stderr)

    return bar


def has_ros() -> bool:
    """Whether the node and the player can run."""
    names = ("rclpy", "tf2_msgs", "vision_msgs")
    return all(getattr(importlib.util.find_spec(name), "origin", None) for name in names)
