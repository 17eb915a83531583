"""The command ``explain``: what a run has decided, which edges matter, and what would be without some of them."""

import argparse
import math
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.analysis.what_if import MovedVertex, SavedGraph

_SHOWN = 10  # edges that fit worse
_NO_SOLUTION = "not a solution: the solver did not converge. What was let in contradicts all else"


def explain_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``explain``."""
    sub.codes = f"Edges have the ids of the run's ledger. {arguments.CODES}"
    arguments.add_run(sub)
    about = "id of an edge or name of a landmark (landmark:7 if the name is a number); default: the whole run"
    sub.add_argument("edge", nargs="?", metavar="EDGE", help=about)
    about = "list the N edges (default: 10) that the last pose depends on most, each left out in turn"
    sub.add_argument("--influence", type=arguments.count, nargs="?", const=10, metavar="N", help=about)
    edges: dict[str, Any] = {"nargs": "+", "action": "extend", "type": arguments.edge, "default": []}
    sub.add_argument("--without", **edges, metavar="EDGE", help="ids of edges to remove")
    about = "ids of edges to include with full weight, without a robust loss"
    sub.add_argument("--with", dest="let_in", **edges, metavar="EDGE", help=about)
    names, scale = "none|huber|cauchy|geman_mcclure|dcs[:SCALE]", f"SCALE in sigmas ({arguments.LOSS_SCALE:g})"
    about = f"robust loss of all candidates, instead of the run's; {scale}"
    sub.add_argument("--loss", type=arguments.loss, metavar=names, help=about)


def explain(args: argparse.Namespace) -> int:
    """Print why measurements are in or out, which matter most, or what moves without some of them."""
    what_if = bool(args.without or args.let_in or args.loss)
    if bool(args.edge) + (args.influence is not None) + what_if > 1:
        raise GraphSlamError("explain: one of EDGE, --influence, and --without, --with and --loss together")
    from graph_slam_ros.analysis.explain import explain_edge, explain_run
    from graph_slam_ros.analysis.what_if import SavedGraph
    from graph_slam_ros.warmup import compile_all

    if what_if or args.influence is not None:
        compile_all()
    losses: list[str] = []
    run = SavedGraph(args.run_folder, losses)
    if what_if:
        return _solve(args, run, losses)
    if args.influence is not None:
        return _influence(args, run, losses)
    console.show(*(explain_edge(run, args.edge) if args.edge else explain_run(run)))
    if args.edge:
        console.then(f"{console.command('explain', args.run_folder, '--without', 'EDGE')} (the drive without an edge)")
    else:
        console.then(f"{console.command('explain', args.run_folder, 'EDGE')} (all about one edge or landmark)")
    return console.report_losses(losses)


def _solve(args: argparse.Namespace, run: "SavedGraph", losses: list[str]) -> int:
    start = time.process_time()
    solver = run.problem(args.without, args.let_in, args.loss)
    report = solver.optimize()
    elapsed_s = time.process_time() - start
    state = "solved in" if report.converged else f"NOT converged ({report.stop}) after"
    console.show(*_moved_text(run, run.moved(solver)), f"{state} {1e3 * elapsed_s:.0f} ms of CPU time")
    console.then(f"{console.command('explain', args.run_folder, 'EDGE')} (why the run judged an edge as it did)")
    code = console.report_losses(losses, () if report.converged else (_NO_SOLUTION,))
    return code if report.converged else console.LOSSES


def _influence(args: argparse.Namespace, run: "SavedGraph", losses: list[str]) -> int:
    console.show(
        f"the last pose without each edge, the {args.influence} of most influence to first order",
        f"  {'edge':<8s} {'':24s} {'first order':>12s} {'solved again':>12s}",
    )
    for one in run.influences(args.influence):
        failed = "not converged" if math.isnan(one.exact_m) else "undetermined"
        exact = f"{one.exact_m:10.4f} m" if math.isfinite(one.exact_m) else failed
        text = f"{one.first_order_m:10.4f} m {exact}"
        console.show(f"  {one.edge:<8d} {run.edge(one.edge).about:24s} {text}")
    console.then(f"{console.command('explain', args.run_folder, 'EDGE')} (all about one of them)")
    return console.report_losses(losses)


def _moved_text(run: "SavedGraph", moved: "MovedVertex") -> Iterable[str]:
    (final_m, final_rad), (most, most_m) = moved.final, moved.most
    yield f"chi2       {moved.before.chi2_final:14.4f}  ->  {moved.after.chi2_final:14.4f}"
    yield f"cost       {moved.before.cost_final:14.4f}  ->  {moved.after.cost_final:14.4f}"
    for name in dict.fromkeys((*moved.before.classes, *moved.after.classes)):
        parts = [report.classes.get(name) for report in (moved.before, moved.after)]
        numbers = [f"{part.chi2:14.4f}" if part else f"{'-':>14s}" for part in parts]
        yield f"  {name:8s} {'  ->  '.join(numbers)}"
    yield f"last pose  moves by {final_m:.4f} m, {math.degrees(final_rad):.3f} deg"
    yield f"most       keyframe {run.keyframe(most)}, by {most_m:.4f} m"
    for edge, before, after in moved.worse[:_SHOWN]:
        yield f"worse      edge {edge} ({run.edge(edge).about}): chi2 {before:.4g} -> {after:.4g}"
