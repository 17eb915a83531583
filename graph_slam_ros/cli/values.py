"""Types of the values of options."""

import argparse
import re
from typing import TYPE_CHECKING

from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.graph import Loss

LOSS_SCALE = 3.0  # [standard deviations], as for landmarks of a robot


def positive(text: str) -> float:
    """A finite number above 0. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def count(text: str) -> int:
    """An integer above 0. Raises ArgumentTypeError."""
    if not re.fullmatch(r"0*[1-9]\d{0,8}", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text} is not a positive integer")
    return int(text)


def edge(text: str) -> int:
    """The id of an edge. Raises ArgumentTypeError."""
    from graph_slam_ros.formats.strict import integer

    try:
        return integer(text)
    except GraphSlamError:
        raise argparse.ArgumentTypeError(f"{text} is not the id of an edge") from None


def method(text: str) -> str:
    """One of the methods of the solver. Raises ArgumentTypeError."""
    from graph_slam_ros.solver import Settings

    try:
        return Settings(method=text).method
    except GraphSlamError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def port(text: str) -> int:
    """A port, 0 to 65535. Raises ArgumentTypeError."""
    if not re.fullmatch(r"\d{1,5}", text, re.ASCII) or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text} is not a port: 0 (a free one) to 65535")
    return int(text)


def loss(text: str) -> "Loss":
    """A robust loss, NAME or NAME:SCALE. Raises ArgumentTypeError."""
    from graph_slam_ros.graph import Loss

    name, separator, scale = text.partition(":")
    if separator and name == "none":
        raise argparse.ArgumentTypeError("none has no scale")
    try:
        return Loss.named(name, positive(scale) if separator else LOSS_SCALE)
    except GraphSlamError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
