"""The command ``info``: the contents of a recording, and the replay command that fits."""

import argparse
import textwrap
from pathlib import Path

from graph_slam_ros.cli import console
from graph_slam_ros.cli.arguments import CommandParser
from graph_slam_ros.messages.inputs import CONVERTERS
from graph_slam_ros.messages.inputs.plugins import described
from graph_slam_ros.overview.contents import TopicContents
from graph_slam_ros.recordings.bag import Bag, open_bag
from graph_slam_ros.runs.folder import is_run, suggested_out
from graph_slam_ros.runs.suggestion import Suggestion


def info_options(sub: CommandParser) -> None:
    """Add the options of ``info``."""
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording")


def info(args: argparse.Namespace) -> int:
    """Print the contents of a recording."""
    if is_run(args.bag):
        console.show(f"an earlier run: {console.command('replay', args.bag, '--out', suggested_out(args.bag))}")
        return console.DONE
    bag = open_bag(args.bag)
    lines, fits = describe(bag, args.bag)
    checked = f"what is wrong with it, and what mends it: {console.command('check', args.bag)}"
    console.show(*lines[:-1], checked, lines[-1])  # the command to paste is the last line
    return console.report_losses(bag.losses, bag.warnings) or (console.DONE if fits else console.LOSSES)


def describe(bag: Bag, path: Path) -> tuple[list[str], bool]:
    """Describe a recording: topics, types, rates, frames, plugins and span, then notes, then the command.

    Returns
    -------
    lines : the command is the last
    fits : whether there is one
    """
    suggestion = Suggestion(bag, path)
    recording = suggestion.recording
    lines = [_line(one) for _, one in sorted(recording.topics.items())]
    lines += [f"plugin: {text}" for text in described(CONVERTERS)]
    read = [one for one in recording.topics.values() if one.last_ns]
    if read:
        first, last = min(one.first_ns for one in read), max(one.last_ns for one in read)
        lines.append(f"span {(last - first) * 1e-9:.3f} s, from {first * 1e-9:.3f}")
    if suggestion.trouble:
        return [*lines, f"not ready for replay: {suggestion.trouble}"], False
    for text in suggestion.notes:
        lines += textwrap.wrap(f"note: {text}", 100, subsequent_indent="  ", break_on_hyphens=False)
    for name, why in suggestion.unused.items():
        lines += textwrap.wrap(f"not used: {name}: {why}", 100, subsequent_indent="  ", break_on_hyphens=False)
    return [*lines, suggestion.command()], True


def _line(one: TopicContents) -> str:
    topic, elapsed_s = one.topic, (one.last_ns - one.first_ns) * 1e-9
    rate = f"{(topic.count - 1) / elapsed_s:.1f} Hz" if elapsed_s > 0 else "-"
    frames = " -> ".join(filter(None, (one.frame, one.child)))
    return f"{topic.name:28s} {topic.type:40s} {topic.count:8d}  {rate:>10s}  {one.trouble or frames}".rstrip()
