"""The command ``advise``: the weak parts of a run, and what would make them better known."""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from graph_slam_ros.cli import arguments, console

if TYPE_CHECKING:
    from graph_slam_ros.tools.advise.advice import Advice, Advisor
    from graph_slam_ros.tools.advise.weakness import Stretch, Weakness


def advise_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``advise``."""
    arguments.add_run(sub)
    sub.add_argument("--count", type=arguments.count, default=1, metavar="N", help="additions of a kind (default: 1)")
    about = "sigma of each coordinate of a surveyed landmark [m] (default: 0.02)"
    sub.add_argument("--survey-sigma", type=arguments.positive, default=0.02, metavar="M", help=about)
    arguments.add_json(sub)


def advise(args: argparse.Namespace) -> int:
    """Print what is weak in a run, and which single addition would help most."""
    from graph_slam_ros.analysis.what_if import SavedGraph
    from graph_slam_ros.tools.advise.advice import Advisor
    from graph_slam_ros.tools.advise.weakness import Weakness

    losses: list[str] = []
    run = SavedGraph(args.run_folder, losses)
    weakness = Weakness(run)
    advisor = Advisor(weakness, args.survey_sigma)
    everything = advisor.advise()
    found = [_best(some, args.count) for some in everything]
    of_path = min((one for some in everything for one in some), key=lambda one: one.path_m, default=None)
    if args.json:
        console.show(json.dumps(_as_dict(weakness, advisor, found, of_path)))
    else:
        console.show(*_weak_text(weakness, advisor), *_advice_text(advisor, found, of_path))
        first = "measure the first of these, and replay with it; a survey goes into landmarks.surveyed_file"
        explain = f"{console.command('explain', args.run_folder)} (what was believed, and what not)"
        console.then(first if any(found) else explain)
    return console.report_losses(losses)


def _best(some: "list[Advice]", count: int) -> "list[Advice]":
    kinds: dict[str, int] = {}
    out = []
    for one in some:
        kinds[one.addition.kind] = kinds.get(one.addition.kind, 0) + 1
        if kinds[one.addition.kind] <= count:
            out.append(one)
    return out


# -- text --------------------------------------------------------------------------------------------------------------


def _weak_text(weakness: "Weakness", advisor: "Advisor") -> Iterator[str]:
    run = weakness.run
    yield (
        f"{len(run.view.keyframes)} keyframes, {len(run.landmarks)} landmarks; all sigmas are relative to what holds"
        f" the map: {weakness.held_by()}"
    )
    yield "weakest"
    for one in advisor.weakest:
        where = ""
        if one.about.startswith("keyframe"):
            stamp_s, driven_m = run.stamps_ns[one.keyframe] * 1e-9, weakness.travelled_m[one.keyframe]
            where = f" ({stamp_s:.3f} s, {driven_m:.1f} m driven)"
        sigma, usual = (_sigma(one.what, x) for x in (one.direction.sigma, one.usual))
        words = "" if one.direction.words == one.what else f" {one.direction.words}"
        yield f"  {one.what:9s} {one.about}{where}: {sigma}{words} (median {usual})"
    stretches = [*weakness.stretches()]
    unseen = weakness.longest_unseen()
    yield "weak stretches" if stretches or unseen else "weak stretches: none"
    for stretch in stretches:
        sigma, usual = (_sigma(stretch.what, x or 0.0) for x in (stretch.sigma, stretch.usual))
        yield f"  {stretch.what} weak for {_span(stretch)}: {stretch.reason}; sigma up to {sigma}, median {usual}"
    if unseen:
        yield f"  {unseen.reason} for {_span(unseen)}: the longest part of the path without one"


def _span(one: "Stretch") -> str:
    (first, last), (begins_s, ends_s) = one.keyframes, (stamp_ns * 1e-9 for stamp_ns in one.stamps_ns)
    return (
        f"{one.length_m:.1f} m (keyframes {first} to {last}, {begins_s:.3f} to {ends_s:.3f} s,"
        f" {one.begins_m:.1f} to {one.begins_m + one.length_m:.1f} m driven)"
    )


def _sigma(what: str, sigma: float) -> str:
    return f"{np.degrees(sigma):.2f} deg" if what == "heading" else f"{sigma:.3f} m"


def _advice_text(advisor: "Advisor", found: "list[list[Advice]]", of_path: "Advice | None") -> Iterator[str]:
    yield "what would help most, each alone: the sigma it leaves, and the path error (rms, not aligned as in evaluate)"
    for one, some in zip(advisor.weakest, found, strict=True):
        what = "heading" if one.what == "heading" else f"position, {one.direction.words},"
        yield f"  {what} of {one.about}: {_sigma(one.what, one.direction.sigma)} now"
        for advice in some:
            yield f"    {_sigma(one.what, advice.predicted):>10s}   {_path(advice)}   {advice.addition.about}"
        if not some:
            yield f"    nothing that was tried helps by 2 % or more: {advisor.why_nothing()}"
    if of_path:
        yield f"  of these, most for the whole path: {of_path.addition.about}, {_path(of_path)}"


def _path(one: "Advice") -> str:
    return f"path {one.path_now_m:.3f} -> {one.path_m:.3f} m"


# -- JSON --------------------------------------------------------------------------------------------------------------


def _as_dict(
    weakness: "Weakness", advisor: "Advisor", found: "list[list[Advice]]", of_path: "Advice | None"
) -> dict[str, Any]:
    stretches, unseen = [*weakness.stretches()], weakness.longest_unseen()
    return {
        "keyframes": len(weakness.run.view.keyframes),
        "landmarks": len(weakness.run.landmarks),
        "held_by": weakness.held_by(),
        "weakest": [
            {
                "what": one.what,
                "about": one.about,
                "keyframe": weakness.run.numbers[one.keyframe],
                "direction": one.direction.words,
                "axis": one.direction.axis.tolist(),
                "sigma": one.direction.sigma,
                "usual": one.usual,
                "advice": [_advice_as_dict(advice) | {"predicted": advice.predicted} for advice in some],
            }
            for one, some in zip(advisor.weakest, found, strict=True)
        ],
        "best_for_path": _advice_as_dict(of_path) if of_path else None,
        "stretches": [asdict(one) for one in (*stretches, *([unseen] if unseen else []))],
    }


def _advice_as_dict(one: "Advice") -> dict[str, Any]:
    kind, about = one.addition.kind, one.addition.about
    return {"kind": kind, "about": about, "path_now_m": one.path_now_m, "path_m": one.path_m}
