"""The parser of a command, arguments that several commands have, and the types of their values."""

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError, did_you_mean

if TYPE_CHECKING:
    from graph_slam_ros.graph import Loss

LOSS_SCALE = 3.0  # [standard deviations], as for landmarks of a robot
CODES = "Exit codes: 0 done, 1 internal error, 2 refused, 3 done but something was lost, 130 interrupted."


class _Formatter(argparse.HelpFormatter):
    """Wraps paragraphs. Lines that begin with a space stay as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return "\n".join(line if line.startswith(" ") else fill(line, width, indent) for line in text.splitlines())


class CommandParser(argparse.ArgumentParser):
    """Reports usage errors in one line. Its help ends with examples and the exit codes."""

    more: Callable[[], str] | None = None  # what the help tells besides, where it takes imports to know it
    elsewhere: Mapping[str, str] = MappingProxyType({})  # words that are no commands, and what does the same
    codes = CODES

    def __init__(self, *args: Any, examples: Sequence[str] = (), **options: Any) -> None:
        super().__init__(*args, **options)
        self.formatter_class = _Formatter
        self.examples = examples

    def format_help(self) -> str:
        """The help."""
        shown = [f"Example{'s' * (len(self.examples) > 1)}:", *(f"  {line}" for line in self.examples)]
        self.epilog = "\n".join([self.more(), ""] if self.more else []) + "\n".join([*shown, self.codes])
        return super().format_help()

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse what is none of the choices of an argument, with the choice that is close."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            other = self.elsewhere.get(str(value))
            near = f"; {self.prog} {other}" if other else did_you_mean(str(value), map(str, action.choices or ()))
            raise argparse.ArgumentError(action, f"{error.message}{near}") from None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Refuse options that the command does not have, with the option that is close, and a second recording."""
        known, rest = super().parse_known_args(args, namespace)
        if options := [word.partition("=")[0] for word in rest if word.startswith("--")]:
            near = did_you_mean(options[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(rest)}{near}")
        if rest and (bare := [one for one in getattr(known, "set", None) or () if "=" not in one]):
            self.error(f"--set {bare[0]}: a setting is KEY=VALUE, no spaces around =; quote a value with spaces")
        if rest and hasattr(known, "bag"):
            self.error(f"{rest[0]} is one recording too many: put the parts of one drive into a folder, and name that")
        return known, rest

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        console.warn(f"{message} (--help shows what there is)", self.prog)
        self.exit(console.REFUSED)


def positive(text: str) -> float:
    """A finite number above 0. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _whole(what: str, least: int, most: int) -> Callable[[str], int]:
    """The type of whole numbers in a range, in digits alone."""

    def parsed(text: str) -> int:
        if not re.fullmatch(r"[+-]?\d{1,20}", text, re.ASCII) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text} is not {what}")
        return int(text)

    return parsed


count = _whole("a positive integer", 1, 999_999_999)
edge = _whole("the id of an edge", -(2**63), 2**64 - 1)
port = _whole("a port: 0 (a free one) to 65535", 0, 65535)


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
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node, or a preset's name")
    about = "set one parameter, before the file's"
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)


def add_shown(sub: CommandParser) -> None:
    """Add what a page on a run shows of other files."""
    add_truth(sub, required=False)
    sub.add_argument("--compare", type=Path, metavar="RUN2", help="another run: draw its path and list what differs")
    sub.add_argument("--plan", type=Path, metavar="MAP.yaml", help="floor plan to draw below: a map.yaml of Nav2")
