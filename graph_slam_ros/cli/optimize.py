"""The command ``optimize``: solves the graph of a file."""

import argparse
import json
import shlex
import time
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.graph import Graph, Loss
    from graph_slam_ros.optimization import Solution
    from graph_slam_ros.solver import Settings, Solver

STARTS = {"file": "the file", "tree": "the spanning tree", "chordal": "the chordal relaxation"}
STARTS["online"] = "the drive, pose after pose"
_MOST_TRIAL_S = 10.0
_RIGHT = "? "  # ends the question of a doubt that one mistake explains
_OTHER_TAG = "give what is lost a tag that is read, and its information (docs/graphs.md)"


def optimize_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``optimize``."""
    sub.codes = f"{arguments.CODES} With --certify: 4 not certified, 5 it does not apply; 3 goes first."
    sub.add_argument("graph", type=Path, metavar="GRAPH", help="file of a graph")
    about = "method of optimisation; gn (default) is damped only if it does not converge"
    sub.add_argument("--method", choices=("gn", "lm", "dogleg"), default="gn", help=about)
    about = "most iterations (default: 100)"
    sub.add_argument("--max-iterations", type=arguments.count, default=100, metavar="N", help=about)
    about = "converged when the cost decreases by a smaller fraction (default: 1e-6)"
    sub.add_argument("--tolerance", type=arguments.positive, default=1e-6, metavar="X", help=about)
    about = f"robust loss of all edges but odometry; SCALE in sigmas (default: {arguments.LOSS_SCALE:g})"
    sub.add_argument("--loss", type=arguments.loss, default="none", metavar="none|huber|cauchy[:SCALE]", help=about)
    about = "initial estimate; auto: the values of the file (without vertices: tree); if the result is suspicious,"
    about += " chordal and then online (pose by pose) are tried, and the best result is used"
    sub.add_argument("--init", choices=("auto", "file", "tree", "chordal", "online"), default="auto", help=about)
    about = "error of relative poses; seed: of the inverse"
    sub.add_argument("--error-map", choices=("relative", "seed"), default="relative", help=about)
    about = "prove that the result is the global optimum; for graphs of poses only"
    sub.add_argument("--certify", action="store_true", help=about)
    about = "format of the lines; others are refused (default: each by its tag); isam: square roots of the"
    about += " information; rows: information of EDGE2 in rows of its upper triangle"
    sub.add_argument("--from", dest="source", choices=("g2o", "toro", "gtsam", "isam", "rows"), help=about)
    about = "scale of the information of 3D rotations; raw: unscaled"
    sub.add_argument("--information", choices=("g2o", "raw"), default="g2o", help=about)
    sub.add_argument("--lenient", action="store_true", help="leave out bad lines, list them, exit with 3")
    arguments.add_json(sub, "the answer")
    about = "write the solved graph, or its poses; another name: a run folder, for report, explain and map"
    sub.add_argument("--out", type=Path, metavar="FILE.g2o|FILE.tum|RUN", help=about)
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the initial estimate and the result")
    arguments.add_force(sub)


def optimize(args: argparse.Namespace) -> int:
    """Solve a graph, print the outcome, write it and draw it."""
    from graph_slam_ros.formats.g2o import read_g2o
    from graph_slam_ros.formats.g2o_writer import write_g2o
    from graph_slam_ros.formats.strict import ending
    from graph_slam_ros.formats.tum import write_trajectory
    from graph_slam_ros.optimization import optimize as solve
    from graph_slam_ros.optimization import started
    from graph_slam_ros.runs.folder import GRAPH, check_room, is_run
    from graph_slam_ros.warmup import compile_all

    compile_all()
    makes_run = _is_folder(args.out)
    if makes_run:
        check_room(args.out, args.graph, force=args.force)
    console.check_file(None if makes_run else args.out, args.plot, force=args.force, source=args.graph)
    if is_run(args.graph):
        raise GraphSlamError(f"{args.graph}: a run folder; its graph is {args.graph / GRAPH}")
    how: dict[str, Any] = {"lenient": args.lenient, "raw": args.information == "raw", "dialect": args.source}
    file = read_g2o(args.graph, error_map=args.error_map, **how)
    graph, settings = file.graph, _settings(args, file.graph)
    solution = solve(file, settings, init=args.init)
    solver, report, start = solution.solver, solution.report, solution.start
    proof, code, told = None, console.DONE, ""
    if args.certify:
        proof, code, told = import_module("graph_slam_ros.tools.certificate.certify").certified(solution)
    if args.json:
        proved = {"certificate": proof.as_dict()} if proof else {}
        console.show(json.dumps(_answer(solution, args) | proved))
    else:
        start_text = STARTS[start] + ("" if file.has_values else ": the file has no vertex lines")
        console.show(*_optimize_text(solution, start_text, args.loss), *_starts_text(solution), *told.splitlines())
    after = "" if args.json else _after(args, solution)
    if args.plot:
        from graph_slam_ros.analysis.plots import draw_graph

        draw_graph(args.plot, graph, _positions(graph, started(file, start)[0]), _positions(graph, solver))
    if makes_run:
        from graph_slam_ros.runs.graph_run import write_graph_run

        out, judged = write_graph_run(solution, args.out, args.graph.name, force=args.force)
        if not args.json:
            console.show(f"results in {args.out}: {out} of {judged} measurements are not in the map")
    elif args.out:
        (write_trajectory if ending(args.out) == ".tum" else write_g2o)(args.out, file, solver.estimate)
    for note in file.notes:
        console.warn(note)
    is_open = report.converged and _loss_text(args.loss) == "none" and not (makes_run or _RIGHT in solution.doubt)
    beware = [solution.doubt + _why(after) * is_open] if solution.doubt else []
    lost = console.report_losses(file.losses, beware)
    if after:
        console.then(after)
    return lost or (console.LOSSES if beware else code)


def _settings(args: argparse.Namespace, graph: "Graph") -> "Settings":
    from graph_slam_ros.solver import Settings

    losses = {label: [args.loss] for label in graph.labels if label != "odometry"}
    return Settings(args.method, args.max_iterations, cost_tolerance=args.tolerance, losses=losses)


def _why(after: str) -> str:
    """The cause of a doubt that names none, by the command that comes next; without that, all that may be."""
    wrong, tight = ": wrong edges, which --loss cauchy lets go of", "too little noise in the information"
    if "all edges fit" in after:
        return ": a local minimum"
    return wrong if "--loss" in after else f": wrong edges, or {tight}" if after else f"{wrong}, or {tight}"


def _after(args: argparse.Namespace, solution: "Solution") -> str:
    from graph_slam_ros.formats.strict import ending

    right = solution.doubt.partition(_RIGHT)[2]
    if right or (solution.file.losses and not args.lenient):
        what = right.replace("g2o has", "write") or _OTHER_TAG
        return f"{what}, then {console.command('optimize', args.graph, *_options(args))}"
    if _is_folder(args.out):
        return f"{console.command('report', args.out)} (one page: the map, and why each edge is in or out)"
    if not solution.report.converged and args.init != "auto":  # which tries all of them
        start = "online" if args.init == "chordal" else "chordal"
        words = _options(argparse.Namespace(**vars(args) | {"init": start}))
        return f"{console.command('optimize', args.graph, *words)} (another start)"
    if solution.doubt:
        return _remedy(args, solution)
    if args.out is not None and ending(args.out) == ".tum":
        return f"evo_traj tum {shlex.quote(str(args.out))} --plot, or any reader of TUM trajectories"
    name, what = ("POSES.tum", "as a trajectory") if args.out else ("SOLVED.g2o", "and write it")
    return f"{console.command('optimize', args.graph, *_options(args), '--out', _unused_name(name))} (the same, {what})"


def _is_folder(out: Path | None) -> bool:
    """Whether a run is written there: the name has no ending of a graph or of poses."""
    return out is not None and not out.name.lower().removesuffix(".gz").endswith((".g2o", ".tum"))


def _unused_name(name: str) -> str:
    stem, _, suffix = name.partition(".")
    return next(one for k in range(1, 10_000) if not Path(one := f"{stem}{k if k > 1 else ''}.{suffix}").exists())


def _remedy(args: argparse.Namespace, solution: "Solution") -> str:
    """The command whose answer is not in doubt, if one of some that are tried is; else what to look at."""
    from graph_slam_ros.optimization import optimize as solve

    robust, began = {"loss": arguments.loss("cauchy")}, time.perf_counter()
    for change in ({"init": "auto"}, robust | {"init": "file"}, robust | {"init": "auto"}):
        other = argparse.Namespace(**vars(args) | change)
        if list(_options(other)) == list(_options(args)) or time.perf_counter() - began > _MOST_TRIAL_S:
            continue
        with suppress(GraphSlamError):
            tried = solve(solution.file, _settings(other, solution.file.graph), init=other.init)
            if not tried.doubt:
                words = console.command("optimize", args.graph, *_options(other), "--out", _unused_name("SOLVED.g2o"))
                told = f"the loss lets go of {tried.let_go} edges" if tried.let_go else "all edges fit"
                return f"{words} (tried: {told})"
    if solution.report.stop == "max_iterations":
        more = _options(argparse.Namespace(**vars(args) | {"max_iterations": 10 * args.max_iterations}))
        return f"{console.command('optimize', args.graph, *more)} (more iterations)"
    ratio = (solution.report.chi2_final / max(1, solution.solver.degrees_of_freedom)) ** 0.5
    told = f"; if all fit alike, noise is {ratio:.3g} times what the information says" * solution.report.converged
    return f"the worst edges{told} (no loss helps)"


def _options(args: argparse.Namespace) -> Iterable[str]:
    from graph_slam_ros.cli.parser import parser

    usual = parser(["optimize"]).parse_args(["optimize", "GRAPH"])
    for option in ("method", "loss", "init", "from", "max-iterations", "tolerance", "error-map", "information"):
        name = {"from": "source"}.get(option, option.replace("-", "_"))
        value = getattr(args, name)
        if value != getattr(usual, name):
            yield from (f"--{option}", _loss_text(value) if name == "loss" else str(value))
    if args.lenient:
        yield "--lenient"


def _starts_text(solution: "Solution") -> Iterable[str]:
    """The text on a suspicious first result: the reason, the results of other starts, and the one that is used."""
    if not solution.suspicion:
        return
    first, *others = solution.attempts
    yield f"suspicious from {STARTS[first.start]}: {solution.suspicion}"
    for one in others:
        found = f"fails: {one.failure[:120]}" if one.failure else f"comes to chi2 {one.chi2:.6f}"
        yield f"  another start, {STARTS[one.start]}, {found}"
    if solution.start != first.start:
        yield f"  the answer is from {STARTS[solution.start]}: chi2 {first.chi2:.6f} was a local minimum"
    elif others and not all(one.failure for one in others):
        yield "  no start is better: a local minimum is unlikely"
    elif others:
        yield "  no other start could be solved: this may be a local minimum"


def _answer(solution: "Solution", args: argparse.Namespace) -> dict[str, Any]:
    report, tried = solution.report, solution.attempts
    names = "chi2_initial", "chi2_final", "cost_initial", "cost_final", "converged", "stop", "method"
    return {name: getattr(report, name) for name in names} | {
        "iterations": len(report.iterations),
        "loss": _loss_text(args.loss),
        "start": solution.start,
        "error_map": args.error_map,
        "classes": {name: {"edges": part.edges, "chi2": part.chi2} for name, part in report.classes.items()},
        "degrees_of_freedom": solution.solver.degrees_of_freedom,
        "let_go": solution.let_go,
        "suspicion": solution.suspicion,
        "doubt": solution.doubt,
        "worst": [{"edge": edge, "chi2": chi2} for edge, chi2 in solution.worst()] if solution.doubt else [],
        "starts": [
            {"start": one.start, "chi2": None if one.failure else one.chi2, "failure": one.failure} for one in tried
        ],
        "losses": solution.file.losses,
        "notes": solution.file.notes,
    }


def _optimize_text(solution: "Solution", start: str, loss: "Loss") -> Iterable[str]:
    """The result as text. The cost is given in addition to chi2 if a loss makes them differ."""
    robust, report = _loss_text(loss), solution.report

    def both(chi2: float, cost: float) -> str:
        return f"chi2 {chi2:16.6f}" + (f"   cost {cost:16.6f}" if robust != "none" else "")

    yield f"start    {both(report.chi2_initial, report.cost_initial)}   from {start}"
    for k, step in enumerate(report.iterations, start=1):
        damping = f"   damping {step.damping:.0e}" if step.damping else ""
        yield f"{k:5d}    {both(step.chi2, step.cost)}   largest step {step.step:.2e}{damping}"
    state = "converged" if report.converged else "NOT converged"
    told = f"{state} ({report.stop}), method {report.method}" + (f", loss {robust}" if robust != "none" else "")
    yield f"{told}, {solution.solver.degrees_of_freedom} degrees of freedom"
    for name, part in report.classes.items():
        yield f"  {name:12s}{part.edges:7d} edges   chi2 {part.chi2:14.6f}"
    if solution.let_go:
        yield f"  the loss lets go of {solution.let_go} edges"
    if solution.doubt or solution.let_go:
        yield from (f"  worst: {edge}, chi2 {chi2:.4g}" for edge, chi2 in solution.worst())


def _loss_text(loss: "Loss") -> str:
    from graph_slam_ros.graph import CAUCHY, HUBER

    return {HUBER: f"huber:{loss.scale:g}", CAUCHY: f"cauchy:{loss.scale:g}"}.get(loss.kind, "none")


def _positions(graph: "Graph", solver: "Solver") -> Any:
    import numpy as np

    return np.array([solver.estimate([v])[0][:2] for v in graph.vertex_ids.since().tolist()])
