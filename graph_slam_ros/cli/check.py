"""The commands ``check`` and ``calibrate``: what is wrong with a recording, and the settings that correct it."""

import argparse
import json
import shlex
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.parameters import parameters_text, parse_setting, read_parameters
from graph_slam_ros.slam.calibration.parameters import AUTO, GROUPS

if TYPE_CHECKING:
    from graph_slam_ros.runs.calibrate import Calibrated

_WIDTH = 100


def check_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``check``."""
    sub.codes = f"{arguments.CODES} 4: something above a note was found."
    arguments.add_inputs(sub)
    sub.add_argument("--quick", action="store_true", help="leave out what needs a replay and a fit")
    arguments.add_json(sub)


def check(args: argparse.Namespace) -> int:
    """Check a recording; returns 4 if there is a finding above a note."""
    from graph_slam_ros.runs.check import check as checked

    settings, topics = _asked(args, f"check its recording, or graph_slam explain {args.bag}")
    done = checked(args.bag, settings, **topics, quick=args.quick, progress=console.progress("check"))
    if args.json:
        found = [one.as_dict() for one in done.findings]
        command = done.suggestion.command() if done.suggestion else ""
        console.show(json.dumps({"findings": found, "command": command, "losses": done.losses}))
    else:
        for one in done.findings:
            console.show(*lines(one))
        counts = {s: sum(one.severity == s for one in done.findings) for s in ("error", "warning", "note")}
        console.show(", ".join(f"{n} {s}{'' if n == 1 else 's'}" for s, n in counts.items()))
        mend = [text for one in done.findings if one.severity != "note" for text in one.settings]
        mended = dict(map(parse_setting, [*args.set, *mend]))  # of several, the last one counts
        own = [f"--config {shlex.quote(str(args.config))}"] if args.config else []
        if any(one.severity == "error" and not one.settings for one in done.findings):
            console.then(f"correct what is an error, then check again: {console.command('check', args.bag)}")
        elif done.suggestion:
            console.then(" ".join([done.suggestion.command(mended), *own]))
        else:
            console.then(console.command("info", args.bag))
    console.report_losses(done.losses, done.warnings)
    return console.DONE if done.is_clean else console.FOUND


def _asked(args: argparse.Namespace, instead: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The parameters of ``--config`` and ``--set``, and the topics. Raises GraphSlamError, too, for a run folder."""
    from graph_slam_ros.runs.folder import is_run

    if is_run(args.bag):
        raise GraphSlamError(f"{args.bag}: a run folder; {instead}")
    settings = dict(flatten(read_parameters(args.config, follow=True))) if args.config else {}
    topics = {"odometry": args.odom, "landmarks": args.landmarks}
    return settings | dict(parse_setting(text) for text in args.set), topics


def lines(one: Finding) -> Iterator[str]:
    """A finding for a person: its name, its value and limit, and its remedy."""
    first = f"[{one.severity}] {one.code}: {one.text}"
    yield from textwrap.wrap(" ".join(first.splitlines()), _WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    word = "at least" if abs(one.value) < one.limit else "limit"
    limit = f", {word} {_amount(one.limit, one.unit)}" if one.limit and (one.limit >= 1 or one.unit != "times") else ""
    amount = f"{_amount(one.value, one.unit)}{limit}" if one.value or limit else ""
    where = f"{one.count} in {one.topic}" if one.topic and one.count else ""
    since = f", from {one.first_ns * 1e-9:.3f} s" if where and one.first_ns else ""
    if evidence := "; ".join(filter(None, (amount, where))):
        yield f"    {evidence}{since}"
    if one.settings:
        yield "    remedy: " + " ".join(f"--set {shlex.quote(text)}" for text in one.settings)
    elif one.mend:
        yield f"    remedy: {one.mend}"


def _amount(value: float, unit: str) -> str:
    if unit == "part":
        return f"{100.0 * value:.3g} %"
    return f"{value:.4g} {unit[:-1] if value == 1 and unit[1:].endswith('s') else unit}"  # 1 topic, but 1 s


# -- calibrate ---------------------------------------------------------------------------------------------------------


def calibrate_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``calibrate``."""
    arguments.add_inputs(sub)
    arguments.add_json(sub)
    sub.codes = f"{arguments.CODES} 4: something is to be corrected."
    about = "auto (default: odometry's factors, clocks, yaws; of ranges alone their factor and offset), or some of "
    about += f"{', '.join(GROUPS)}: what is estimated"
    sub.add_argument("--groups", default=AUTO, help=about)
    sub.add_argument("--out", type=Path, metavar="FILE", help="write the settings as a parameter file, too")
    arguments.add_force(sub)


def calibrate(args: argparse.Namespace) -> int:
    """Calibrate a recording; returns 4 if something is to be corrected, 3 if the data determine nothing."""
    from graph_slam_ros.runs.calibrate import calibrate as calibrated

    settings, topics = _asked(args, "calibrate its recording")
    console.check_file(args.out, force=args.force)
    done = calibrated(args.bag, settings, groups=args.groups, **topics, progress=console.progress("calibrate"))
    if args.out:
        write_whole(args.out, _as_yaml(done).encode())
    if args.json:
        answer = {"settings": done.settings, "parameters": done.parameters, "rounds": done.rounds}
        console.show(json.dumps(answer | {"refused": done.refused, "fault": done.fault and done.fault.as_dict()}))
    else:
        _show(done, args.bag)
    lost = console.report_losses(done.losses, done.warnings)
    if lost or not done.is_complete or not _is_determined(done):
        return console.LOSSES
    return console.FOUND if done.settings else console.DONE


def _show(done: "Calibrated", bag: Path) -> None:
    for name, value in done.settings.items():
        console.show(f"{name}={value}")
    for one in done.parameters:
        console.show(*textwrap.wrap(one["text"], _WIDTH, initial_indent="  ", subsequent_indent="    "))
    if done.fault:
        console.show(*lines(done.fault))
    if done.refused:
        console.warn(done.refused, most=console.SENTENCE)
    elif not _is_determined(done):
        console.warn("this recording determines none of these parameters")
    elif not done.settings:
        console.show("nothing to correct")
    elif not done.is_complete:
        console.warn(f"after {done.rounds} replays something is still left: run it again with these settings")
    is_wrong = done.fault is not None and done.fault.severity == "error"
    console.then(console.command("check", bag) if is_wrong else done.command)


def _is_determined(done: "Calibrated") -> bool:
    """Return whether anything is known of any parameter, be it that it is right."""
    return any(one["verdict"] in ("admitted", "nothing_to_correct") for one in done.parameters)


def _as_yaml(done: "Calibrated") -> str:
    sections: dict[str, dict[str, float | str]] = {}
    for name, value in done.settings.items():
        section, key = name.split(".")
        sections.setdefault(section, {})[key] = value
    return parameters_text(sections)
