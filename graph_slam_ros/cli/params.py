"""The command ``params``: every parameter with its default, unit, bounds and meaning."""

import argparse
import fnmatch
from collections.abc import Iterator

from graph_slam_ros.cli import console
from graph_slam_ros.cli.usage import CommandParser
from graph_slam_ros.config.config import parameters
from graph_slam_ros.config.parameter import Parameter
from graph_slam_ros.errors import GraphSlamError


def params_options(sub: CommandParser) -> None:
    """Add the options of ``params``."""
    about = "part of a name or of its help, or a name with * (default: all)"
    sub.add_argument("pattern", nargs="?", default="", metavar="PATTERN", help=about)


def params(args: argparse.Namespace) -> int:
    """List the parameters whose name or meaning matches a pattern."""
    found = [p for p in parameters() if _matches(p, args.pattern)]
    if not found:
        raise GraphSlamError(f"no parameter matches {args.pattern!r} (without a pattern all are listed)")
    for p in found:
        console.show(*_lines(p))
    console.then(f"set one with --set {found[0].name}={_word(found[0].default)}, or in a parameter file (--config)")
    return console.DONE


def _matches(p: Parameter, pattern: str) -> bool:
    """Match by the name, with * and ?; a plain word also matches within the name or the meaning."""
    word = pattern.lower()
    return fnmatch.fnmatchcase(p.name, word) or word in p.name or word in p.meaning.lower()


def _lines(p: Parameter) -> Iterator[str]:
    unit = f" {p.unit}" if p.unit else ""
    limits = ""
    if p.choices:
        limits = f"one of {', '.join(p.choices)}"
    elif p.low is not None or p.high is not None:
        limits = f"in {p.range_text()}"
    when = "may change at any time" if p.live else "read at the start"
    yield f"{p.name} = {_word(p.default)}{unit}   ({'; '.join(filter(None, (limits, when)))})"
    yield f"    {p.meaning}"


def _word(default: object) -> str:
    if isinstance(default, bool):
        return str(default).lower()
    return f"{default:g}" if isinstance(default, float) else str(default) or '""'
