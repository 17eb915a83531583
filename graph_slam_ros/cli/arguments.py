"""Arguments that several commands have, and the types of their values."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from graph_slam_ros.cli.usage import CommandParser
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


def add_run(sub: CommandParser) -> None:
    """Add the run folder."""
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")


def add_out(sub: CommandParser, *, required: bool = True, default: str = "") -> None:
    """Add ``--out DIR`` and ``--force``."""
    about = f"folder for the results{f' (default: {default})' if default else ''}"
    sub.add_argument("--out", type=Path, metavar="DIR", required=required, help=about)
    add_force(sub)


def add_force(sub: CommandParser) -> None:
    """Add ``--force``."""
    about = "replace an existing run or file; nothing else is overwritten"
    sub.add_argument("--force", action="store_true", help=about)


def add_json(sub: CommandParser, what: str = "all of it") -> None:
    """Add ``--json``."""
    sub.add_argument("--json", action="store_true", help=f"print {what} as one line of JSON")


def add_truth(sub: CommandParser, *, required: bool) -> None:
    """Add the truth of a run, and how it is laid on it."""
    sub.add_argument("--truth", required=required, metavar="BAG|FILE.tum", help="the truth: a recording, or a TUM file")
    sub.add_argument(
        "--topic",
        default="",
        metavar="TOPIC",
        help="topic of the truth: poses, odometry, NavSatFix or PointStamped; of transforms /tf:PARENT:CHILD"
        " (default: /ground_truth, or the only one that may be it)",
    )
    about = "do not align: the map is in the frame of the truth already"
    sub.add_argument("--no-align", action="store_true", help=about)


def check_truth(args: argparse.Namespace, command: str) -> None:
    """Refuse options of a truth that is not given. Raises GraphSlamError."""
    if not args.truth and (args.topic or args.no_align):
        raise GraphSlamError(f"{command}: no use for --topic or --no-align without --truth")


def add_inputs(sub: CommandParser, recording: str = "file or folder of a recording") -> None:
    """Add a recording, the topics that are used of it, and parameters."""
    sub.add_argument("bag", type=Path, metavar="BAG", help=recording)
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: as info chooses)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: as info chooses)")
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    about = "set one parameter, before the file's"
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)


def add_shown(sub: CommandParser) -> None:
    """Add what a page on a run shows of other files."""
    add_truth(sub, required=False)
    sub.add_argument("--compare", type=Path, metavar="RUN2", help="another run: draw its path and list what differs")
    sub.add_argument("--plan", type=Path, metavar="MAP.yaml", help="floor plan to draw below: a map.yaml of Nav2")
