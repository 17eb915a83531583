"""The command ``graph_slam``.

Exit codes: 0 done, 1 a fault of ours, 2 refused (one line names the culprit), 3 done but something was lost.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small dense blocks: threads only cost, and reorder sums

import argparse
import importlib.util
import json
import signal
import sys
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from graph_slam_ros import __version__
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.formats.g2o import G2oFile
    from graph_slam_ros.graph import Graph, Loss
    from graph_slam_ros.slam import Config
    from graph_slam_ros.solver import Report, Solver

DONE, FAULT, REFUSED, LOSSES = 0, 1, 2, 3
_CODES = "Exit codes: 0 done, 1 a fault of ours, 2 refused, 3 done but something was lost."
_LOSS_SCALE = 3.0  # [standard deviations], as for landmarks of a robot


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    args = _parser().parse_args(arguments)
    try:
        return int(args.run(args))
    except GraphSlamError as error:
        print(f"graph_slam: {error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        return REFUSED
    except BrokenPipeError:
        sys.stderr.close()
        return DONE
    except OSError as error:
        print(f"graph_slam: {error.filename or 'writing'}: {error.strerror}", file=sys.stderr)
        return REFUSED
    except Exception as error:
        if os.environ.get("GRAPH_SLAM_TRACEBACK"):
            traceback.print_exc()
        what = " ".join(str(error).split())
        print(
            f"graph_slam: a fault of ours, {type(error).__name__}: {what} (GRAPH_SLAM_TRACEBACK=1 shows where)",
            file=sys.stderr,
        )
        return FAULT


def node_main() -> int:
    """Run the ROS node; without ROS, say so."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing to tell or save while modules are imported
    if not _has_ros():
        print("graph_slam_node: ROS 2 is not installed here (no rclpy); replay works without it", file=sys.stderr)
        return REFUSED
    from graph_slam_ros.ros.node import main as run

    return run()


# -- commands --------------------------------------------------------------------------------------------------------


def _replay(args: argparse.Namespace) -> int:
    from graph_slam_ros.replay import replay
    from graph_slam_ros.run import is_run

    _refuse_idle_options(args, is_run(args.bag))
    config = _config(args)
    if args.ros:
        return _replay_live(args, config)
    if args.out is None:
        raise GraphSlamError("replay needs --out DIR, the folder for the results")
    own = config if args.config or args.set or not is_run(args.bag) else None
    done = replay(args.bag, args.out, own, odometry=args.odom, landmarks=args.landmarks, progress=_progress("replay"))
    _say_run(args.bag, done.summary)
    _say(f"results in {args.out}")
    return _told(done.losses)


def _replay_live(args: argparse.Namespace, config: "Config") -> int:
    from graph_slam_ros.replay import choose_inputs
    from graph_slam_ros.ros.bag import open_bag

    if not _has_ros():
        raise GraphSlamError("--ros needs ROS 2 (no rclpy here); without --ros the same replay runs without it")
    bag = open_bag(args.bag)
    inputs = choose_inputs(bag, args.odom, args.landmarks)
    from graph_slam_ros.ros.player import own_node, play
    from graph_slam_ros.run import check_room

    options: dict[str, Any] = {"rate": args.rate, "progress": _progress("play")}
    if args.out is None:
        played = play(bag, inputs, node_name=args.node or "/graph_slam", **options)
    else:
        check_room(args.out, args.bag)
        with own_node(args.out, inputs, config) as own:
            played = play(bag, inputs, own=own, window_s=config.ordering.window_s, **options)
        _say_run(args.bag, json.loads((args.out / "run.json").read_text()))
    _say(f"{played.sent} messages sent, {played.lost} lost; results in {played.saved}")
    return _told(bag.losses + ([f"{played.lost} messages did not arrive"] if played.lost else []))


def _refuse_idle_options(args: argparse.Namespace, of_run: bool) -> None:
    """An option that would have no effect is a mistake of the caller's: say so."""
    idle = {
        "--odom or --landmarks: a run knows its own inputs": of_run and (args.odom or args.landmarks),
        "--ros: the events of a run cannot be played, only its recording": of_run and args.ros,
        "--rate without --ros": args.rate and not args.ros,
        "--node without --ros, or with --out": args.node and (args.out or not args.ros),
        "--config or --set with --ros and no --out: the running node has its own": args.ros
        and not args.out
        and (args.config or args.set),
    }
    for what, given in idle.items():
        if given:
            raise GraphSlamError(f"replay: no use for {what}")


def _info(args: argparse.Namespace) -> int:
    from graph_slam_ros.replay import describe
    from graph_slam_ros.ros.bag import open_bag
    from graph_slam_ros.run import is_run

    if is_run(args.bag):
        _say(f"an earlier run: graph_slam replay {args.bag} --out again")
        return DONE
    bag = open_bag(args.bag)
    _say(*describe(bag, args.bag))
    return _told(bag.losses)


def _optimize(args: argparse.Namespace) -> int:
    from graph_slam_ros.batch import started, take_whole
    from graph_slam_ros.formats.g2o import write_g2o
    from graph_slam_ros.solver import Settings

    file = _read_graph(args, error_map=args.error_map)
    graph = file.graph
    solver, start = started(file, args.init)
    settings = Settings(
        method=args.method,
        max_iterations=args.max_iterations,
        cost_tolerance=args.tolerance,
        losses={label: [args.loss] for label in graph.labels if label != "odometry"},
    )
    take_whole(solver, file)
    before = _positions(graph, solver) if args.plot else None
    report = solver.optimize(settings)
    if args.json:
        answer = {
            "chi2_initial": report.chi2_initial,
            "chi2_final": report.chi2_final,
            "cost_initial": report.cost_initial,
            "cost_final": report.cost_final,
            "iterations": len(report.iterations),
            "converged": report.converged,
            "stop": report.stop,
            "method": report.method,
            "loss": _loss_text(args.loss),
            "start": start,
            "error_map": args.error_map,
            "classes": {name: {"edges": c.edges, "chi2": c.chi2} for name, c in report.classes.items()},
        }
        _say(json.dumps(answer))
    else:
        _say(*_optimize_text(report, _START[start] + ("" if file.has_values else f": {_NO_VALUES}"), args.loss))
    if args.out:
        write_g2o(args.out, file, solver.estimate)
    if args.plot:
        _plot_graph(args.plot, graph, before, _positions(graph, solver))
    _tell_unknown(file)
    return _told(file.skipped)


def _convert(args: argparse.Namespace) -> int:
    from graph_slam_ros.batch import started
    from graph_slam_ros.formats.convert import NAMES, format_of, write_graph

    target = args.to or format_of(args.out)
    if args.graph.suffix == ".tum" and not args.source:
        raise GraphSlamError(f"{args.graph}: a trajectory has no edges, and so is no graph: TUM is only written")
    if args.out.exists() and args.graph.exists() and args.out.samefile(args.graph):
        raise GraphSlamError(f"{args.out}: cannot be read from and written to at once")
    file = _read_graph(args, dialect=args.source)
    if file.has_values or target != "gtsam":  # which alone needs no vertex lines
        solver, start = started(file, "file")
        written = write_graph(args.out, file, solver.estimate, target)
        if not file.has_values:
            _say(f"{_NO_VALUES}: those of {_START[start]} are written")
    else:
        written = write_graph(args.out, file, None, target)
    vertices = f"{written.vertices} of {file.graph.vertex_count} vertices"
    _say(f"wrote {args.out} as {NAMES[target]}: {vertices}, {written.edges} of {file.graph.edge_count} edges")
    if target == "g2o":
        _tell_unknown(file)
    return _told(file.skipped + written.lost)


def _simulate(args: argparse.Namespace) -> int:
    from graph_slam_ros.formats.parameters import parse_setting
    from graph_slam_ros.simulation import simulate, write_bag

    options = dict(parse_setting(text) for text in args.set)
    if args.as_original:
        options["as_original"] = True
    if args.poses is not None:
        options["poses"] = args.poses
    recording = simulate(args.scenario, args.seed, **options)
    try:
        write_bag(recording, args.out)
    except OSError as error:
        raise GraphSlamError(f"{args.out}: {error.strerror}") from None
    _say(f"wrote {args.out}")
    return DONE


def _evaluate(args: argparse.Namespace) -> int:
    from graph_slam_ros.evaluation import evaluate
    from graph_slam_ros.report import draw_run

    scores = evaluate(args.run_folder, args.truth, estimate=args.estimate)
    _say(json.dumps(scores.as_dict()) if args.json else str(scores))
    picture = args.plot or args.run_folder / "path.png"
    draw_run(args.run_folder, args.truth, picture)
    if not args.json:
        _say(f"picture in {picture}")
    return _told(scores.losses)


def _warmup(args: argparse.Namespace) -> int:
    print("graph_slam: compiling kernels, once per installation", file=sys.stderr)
    from graph_slam_ros.warmup import warmup

    print(f"graph_slam: kernels ready after {warmup():.1f} s", file=sys.stderr)
    return DONE


def _demo(args: argparse.Namespace) -> int:
    from graph_slam_ros.demo import demo

    return demo(args.out, live=_has_ros(), progress=_progress, say=_say)


# -- graphs ----------------------------------------------------------------------------------------------------------

_START = {"file": "the file", "tree": "the spanning tree", "chordal": "the chordal relaxation"}
_NO_VALUES = "the file has no vertex lines"


def _read_graph(args: argparse.Namespace, **options: Any) -> "G2oFile":
    from graph_slam_ros.formats.g2o import read_g2o

    return read_g2o(args.graph, lenient=args.lenient, raw=args.information == "raw", **options)


def _tell_unknown(file: "G2oFile") -> None:
    tags = sorted({line.split()[0] for line in file.unknown})
    if tags:
        print(
            f"graph_slam: {len(file.unknown)} lines with unknown tags kept as they are: {', '.join(tags)}",
            file=sys.stderr,
        )


def _optimize_text(report: "Report", start: str, loss: "Loss") -> Iterable[str]:
    """The cost stands beside chi2 where a loss makes it another number."""
    robust = _loss_text(loss)

    def both(chi2: float, cost: float) -> str:
        return f"chi2 {chi2:16.6f}" + (f"   cost {cost:16.6f}" if robust != "none" else "")

    yield f"start    {both(report.chi2_initial, report.cost_initial)}   from {start}"
    for k, step in enumerate(report.iterations, start=1):
        damping = f"   damping {step.damping:.0e}" if step.damping else ""
        yield f"{k:5d}    {both(step.chi2, step.cost)}   largest step {step.step:.2e}{damping}"
    state = "converged" if report.converged else "NOT converged"
    yield f"{state} ({report.stop}), method {report.method}" + (f", loss {robust}" if robust != "none" else "")
    for name, part in report.classes.items():
        yield f"  {name:12s}{part.edges:7d} edges   chi2 {part.chi2:14.6f}"


def _loss_text(loss: "Loss") -> str:
    from graph_slam_ros.graph import CAUCHY, HUBER

    return {HUBER: f"huber:{loss.scale:g}", CAUCHY: f"cauchy:{loss.scale:g}"}.get(loss.kind, "none")


def _positions(graph: "Graph", solver: "Solver") -> Any:
    import numpy as np

    return np.array([solver.estimate([v])[0][:2] for v in range(graph.vertex_count)])


def _plot_graph(out: Path, graph: "Graph", initial: Any, final: Any) -> None:
    import numpy as np

    from graph_slam_ros.report import draw_graph

    edges: dict[str, list[Any]] = {}
    for table in graph.tables.values():
        if len(table.type.accepts) == 2:
            for code, label in enumerate(graph.labels):
                edges.setdefault(label, []).extend(table.vertices.values[table.label.values == code].tolist())
    points: Any = np.flatnonzero([graph.kind_of(v).name[0] == "R" for v in range(graph.vertex_count)])
    draw_graph(out, initial, final, {k: np.array(v) for k, v in edges.items() if v}, points if len(points) else None)


# -- options and output ----------------------------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        self.exit(REFUSED, f"{self.prog}: {message} (--help shows what there is)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="graph_slam",
        description="Online pose-graph SLAM: replay recordings, optimise and convert graphs, simulate, evaluate.",
        epilog=_CODES,
    )
    parser.add_argument("--version", action="version", version=f"graph_slam_ros {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, run: Any, about: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=about, description=about)
        sub.set_defaults(run=run)
        return sub

    sub = command("replay", _replay, "run a recording (mcap, db3, ROS 1) or an earlier run through the pipeline")
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording, or a run folder")
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder for the results")
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: the only one, or /odom)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: the only one, or /landmarks)")
    _add_config(sub)
    sub.add_argument("--ros", action="store_true", help="publish into a live ROS graph: a node of its own with --out")
    sub.add_argument("--rate", type=_positive, metavar="X", help="with --ros: times real time (default: all it takes)")
    sub.add_argument("--node", metavar="NAME", help="with --ros and no --out: the running node")

    sub = command("info", _info, "topics, types, rates, frames and span of a recording, and how to replay it")
    sub.add_argument("bag", type=Path, metavar="BAG")

    sub = command("optimize", _optimize, "solve a graph: g2o, TORO, iSAM or GTSAM text")
    sub.add_argument("graph", type=Path, metavar="GRAPH")
    sub.add_argument(
        "--method",
        type=_method,
        default="gn",
        metavar="gn|lm|dogleg",
        help="gn (default) is damped only if it does not converge",
    )
    sub.add_argument("--max-iterations", type=_count, default=100, metavar="N", help="default: 100")
    sub.add_argument(
        "--tolerance", type=_positive, default=1e-6, metavar="X", help="relative decrease of cost at the end (1e-6)"
    )
    sub.add_argument(
        "--loss",
        type=_loss,
        default="none",
        metavar="none|huber|cauchy[:SCALE]",
        help=f"robust loss of all edges but odometry; scale in standard deviations of an edge ({_LOSS_SCALE:g})",
    )
    sub.add_argument(
        "--init",
        choices=("file", "tree", "chordal"),
        default="file",
        help="where to start (file; tree without vertices)",
    )
    sub.add_argument("--error-map", choices=("relative", "seed"), default="relative", help="seed: of the inverse")
    _add_reading(sub)
    sub.add_argument("--json", action="store_true", help="the answer as one line")
    sub.add_argument("--out", type=Path, metavar="FILE.g2o", help="the solved graph")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="start and result")

    sub = command("convert", _convert, "write a graph in another format: g2o, TORO, GTSAM text; its poses as TUM")
    sub.epilog = f"What the format of B cannot say is left out, told in a line, and ends with 3. {_CODES}"
    sub.add_argument("graph", type=Path, metavar="A", help="g2o, TORO, iSAM or GTSAM text")
    sub.add_argument(
        "out", type=Path, metavar="B", help="by its ending: .g2o; .toro, .graph; .gtsam; .tum (poses, id as stamp)"
    )
    sub.add_argument(
        "--from", dest="source", choices=("g2o", "toro", "gtsam"), help="refuse other lines (default: each by its tag)"
    )
    sub.add_argument("--to", choices=("g2o", "toro", "gtsam", "tum"), help="whatever the ending of B")
    _add_reading(sub)

    sub = command("simulate", _simulate, "record a synthetic world with truth: pythonrobotics, manhattan, warehouse")
    sub.add_argument("scenario", metavar="SCENARIO")
    sub.add_argument("--out", type=Path, required=True, metavar="BAG.mcap")
    sub.add_argument("--seed", type=int, default=0, metavar="N")
    sub.add_argument("--as-original", action="store_true", help="pythonrobotics: its own, squared noise")
    sub.add_argument("--poses", type=_count, metavar="N", help="length of the drive, where the world has it")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the world")

    sub = command("evaluate", _evaluate, "position, heading and map error of a run, and a picture")
    sub.add_argument("run_folder", type=Path, metavar="RUN")
    sub.add_argument("--truth", required=True, metavar="BAG[:TOPIC]|FILE.tum")
    sub.add_argument("--estimate", default="sightings.tum", metavar="FILE", help="which trajectory of the run")
    sub.add_argument("--json", action="store_true", help="the numbers as one line")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="default: path.png in the run folder")

    command("warmup", _warmup, "compile the kernels")
    sub = command("demo", _demo, "replay the recording that comes with the source through a live ROS graph")
    sub.add_argument("--out", type=Path, default=Path("runs/demo"), metavar="DIR")
    return parser


def _add_config(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one parameter")


def _add_reading(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--information", choices=("g2o", "raw"), default="g2o", help="of rotations in space in g2o; raw: unscaled"
    )
    sub.add_argument("--lenient", action="store_true", help="leave out bad lines, list them, exit with 3")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive integer")
    return int(text)


def _method(text: str) -> str:
    """Of those that the solver has."""
    from graph_slam_ros.solver import Settings

    try:
        return Settings(method=text).method
    except GraphSlamError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _loss(text: str) -> "Loss":
    from graph_slam_ros.graph import Loss

    name, separator, scale = text.partition(":")
    if separator and name == "none":
        raise argparse.ArgumentTypeError("none has no scale")
    try:
        return Loss.named(name, _positive(scale) if separator else _LOSS_SCALE)
    except GraphSlamError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _config(args: argparse.Namespace) -> "Config":
    """Defaults, then the run's own or the given file, then single settings."""
    from graph_slam_ros.formats.parameters import parse_setting, read_parameters
    from graph_slam_ros.run import is_run
    from graph_slam_ros.slam import Config
    from graph_slam_ros.slam.config import flatten

    file = args.config or (args.bag / "config.yaml" if is_run(args.bag) else None)
    values = dict(flatten(read_parameters(file))) if file else {}
    try:
        return Config.from_mapping(values | dict(parse_setting(text) for text in args.set))
    except GraphSlamError as error:
        raise GraphSlamError(f"{file}: {error}" if file and not args.set else str(error)) from None


def _progress(label: str) -> Any:
    from tqdm import tqdm

    def bar(items: Iterable[Any], total: int) -> Iterable[Any]:
        quiet = None if os.environ.get("GRAPH_SLAM_PROGRESS") is None else False
        return tqdm(items, desc=label, total=total or None, unit="msg", leave=False, disable=quiet, file=sys.stderr)

    return bar


def _say_run(source: Path, summary: dict[str, Any]) -> None:
    _say(_run_text(summary))
    if not summary["keyframes"]:
        raise GraphSlamError(f"{source}: no odometry of it could be used, see what was counted and graph_slam info")


def _run_text(summary: dict[str, Any]) -> str:
    counters = [f"{source}: {reason} {n}" for source, by in summary["counters"].items() for reason, n in by.items()]
    lines = [
        f"keyframes  {summary['keyframes']:8d}   over {summary['span_s']:.1f} s",
        f"landmarks  {summary['landmarks']:8d}   from {summary['sightings']} sightings",
        f"edges      {summary['edges']:8d}",
        f"chi2       {summary['chi2']:12.3f}   after {summary['solves']} solves",
    ]
    if "time_s" in summary:
        lines.append(f"time       {summary['time_s']:10.1f} s")
    return "\n".join(lines + [f"counted    {text}" for text in counters])


def _say(*lines: str) -> None:
    for line in lines:
        print(line)


def _told(losses: Sequence[str]) -> int:
    for loss in losses:
        print(f"graph_slam: lost: {loss}", file=sys.stderr)
    return LOSSES if losses else DONE


def _has_ros() -> bool:
    names = ("rclpy", "tf2_msgs", "vision_msgs")
    return all(getattr(importlib.util.find_spec(name), "origin", None) for name in names)


if __name__ == "__main__":
    sys.exit(main())
