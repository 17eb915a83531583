"""The command ``check``: what is wrong with a recording."""

import argparse
import json
import shlex
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from graph_slam_ros.check.finding import Finding
from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.usage import CODES, CommandParser
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting, read_parameters

_WIDTH = 100


def check_options(sub: CommandParser, *, of_check: bool = True) -> None:
    """Add the options of ``check``; without ``of_check``, those that ``calibrate`` has, too."""
    sub.codes = f"{CODES} 4: something above a note was found."
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording")
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: as info chooses)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: as info chooses)")
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file; its values come before info's")
    about = "set one parameter, before the file's"
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    if of_check:
        sub.add_argument("--quick", action="store_true", help="leave out what needs a replay and a fit")
    arguments.add_json(sub)


def check(args: argparse.Namespace) -> int:
    """Check a recording; returns 4 if there is a finding above a note."""
    from graph_slam_ros.runs.check import check as checked
    from graph_slam_ros.runs.folder import is_run

    if is_run(args.bag):
        raise GraphSlamError(f"{args.bag}: a run folder; check its recording, or graph_slam explain {args.bag}")
    settings = settings_of(args)
    topics = {"odometry": args.odom, "landmarks": args.landmarks}
    done = checked(args.bag, settings, **topics, quick=args.quick, progress=console.progress("check"))
    if args.json:
        console.show(
            json.dumps(
                {"findings": [one.as_dict() for one in done.findings], "command": done.command, "losses": done.losses}
            )
        )
    else:
        for one in done.findings:
            console.show(*lines(one))
        counts = {s: sum(one.severity == s for one in done.findings) for s in ("error", "warning", "note")}
        console.show(", ".join(f"{n} {s}{'' if n == 1 else 's'}" for s, n in counts.items()))
        mend = [text for one in done.findings if one.severity != "note" for text in one.settings]
        last = {parse_setting(text)[0]: text for text in [*args.set, *mend]}  # of several, the last one counts
        own = [f"--config {shlex.quote(str(args.config))}"] if args.config else []
        if any(one.forbids_replay for one in done.findings):
            console.then(f"correct what is an error, then check again: {console.command('check', args.bag)}")
        elif done.command:
            console.then(" ".join([_with(done.command, last), *own]))
        else:
            console.then(console.command("info", args.bag))
    console.report_losses(done.losses, done.warnings)
    return console.DONE if done.is_clean else console.FOUND


def settings_of(args: argparse.Namespace) -> dict[str, Any]:
    """The parameters of ``--config`` and ``--set``, by dotted name.

    Raises
    ------
    GraphSlamError
        The file or a setting cannot be read.
    """
    settings = dict(flatten(read_parameters(args.config, follow=True))) if args.config else {}
    return settings | dict(parse_setting(text) for text in args.set)


def lines(one: Finding) -> Iterator[str]:
    """A finding for a person: its name, its value and limit, and its remedy."""
    first = f"[{one.severity}] {one.code}: {one.text}"
    yield from textwrap.wrap(" ".join(first.splitlines()), _WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    limit = f", limit {_amount(one.limit, one.unit)}" if one.limit else ""
    amount = f"{_amount(one.value, one.unit)}{limit}" if one.value or limit else ""
    where = f"{one.count} in {one.topic}" if one.topic and one.count else ""
    since = f", from {one.first_ns * 1e-9:.3f} s" if where and one.first_ns else ""
    if evidence := "; ".join(filter(None, (amount, where))):
        yield f"    {evidence}{since}"
    if one.settings:
        yield "    remedy: " + " ".join(f"--set {shlex.quote(text)}" for text in one.settings)
    elif one.mend:
        yield f"    remedy: {one.mend}"


def _with(command: str, settings: Mapping[str, str]) -> str:
    """A command with the settings of some parameters, by dotted name, in place of those that it has of these."""
    words = shlex.split(command)
    given = {k: text for k, text in enumerate(words) if k and words[k - 1] == "--set"}
    old = [k for k, text in given.items() if settings.get(parse_setting(text)[0], text) != text]
    kept = [word for k, word in enumerate(words) if k not in old and k + 1 not in old]
    more = [word for text in settings.values() if text not in given.values() for word in ("--set", text)]
    return shlex.join([*kept, *more])


def _amount(value: float, unit: str) -> str:
    if unit == "part":
        return f"{100.0 * value:.3g} %"
    return f"{value:.4g} {unit[:-1] if value == 1 and unit[1:].endswith('s') else unit}"  # 1 topic, but 1 s
