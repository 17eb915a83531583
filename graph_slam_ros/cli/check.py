"""The command ``check``: what is wrong with a recording."""

import argparse
import json
import shlex
import textwrap
from collections.abc import Iterator

from graph_slam_ros.check.finding import Finding
from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError

_WIDTH = 100


def check(args: argparse.Namespace) -> int:
    """Check a recording; returns 4 if there is a finding above a note."""
    from graph_slam_ros.formats.parameters import parse_setting
    from graph_slam_ros.runs.check import check as checked
    from graph_slam_ros.runs.folder import is_run

    if is_run(args.bag):
        raise GraphSlamError(f"{args.bag}: a run folder; check its recording, or graph_slam explain {args.bag}")
    settings = dict(parse_setting(text) for text in args.set)
    topics = {"odometry": args.odom, "landmarks": args.landmarks}
    own = [f"--set {shlex.quote(text)}" for text in args.set]
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
        mend = [
            f"--set {shlex.quote(text)}" for one in done.findings if one.severity != "note" for text in one.settings
        ]
        console.then(" ".join([done.command, *own, *mend]) if done.command else console.command("info", args.bag))
    console.report_losses(done.losses, done.warnings)
    return console.DONE if done.is_clean else console.FOUND


def lines(one: Finding) -> Iterator[str]:
    """A finding for a person: its name, its value and limit, and its remedy."""
    first = f"[{one.severity}] {one.code}: {one.text}"
    yield from textwrap.wrap(" ".join(first.splitlines()), _WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    where = f"; {one.count} in {one.topic}" if one.topic and one.count else ""
    since = f", from {one.first_ns * 1e-9:.3f} s" if where and one.first_ns else ""
    yield f"    {_amount(one.value, one.unit)}, limit {_amount(one.limit, one.unit)}{where}{since}"
    if one.settings:
        yield "    remedy: " + " ".join(f"--set {shlex.quote(text)}" for text in one.settings)
    else:
        from graph_slam_ros.check.finding import KINDS

        if one.code in KINDS and KINDS[one.code].mend:
            yield f"    remedy: {KINDS[one.code].mend.replace('INPUT', 'the input')}"


def _amount(value: float, unit: str) -> str:
    return f"{100.0 * value:.3g} %" if unit == "part" else f"{value:.4g} {unit}"
