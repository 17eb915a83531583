"""The command line of ``graph_slam``: commands, options, and what their values may be."""

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from graph_slam_ros import __version__
from graph_slam_ros.cli import decided, graphs, maps, recordings, worlds
from graph_slam_ros.cli.console import REFUSED
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.graph import Loss

_CODES = "Exit codes: 0 done, 1 a fault of ours, 2 refused, 3 done but something was lost."
_LOSS_SCALE = 3.0  # [standard deviations], as for landmarks of a robot


def parser() -> argparse.ArgumentParser:
    """The whole command line; the arguments' ``run`` is the command's function."""
    whole = _Parser(
        prog="graph_slam",
        description="Online pose-graph SLAM: replay recordings, optimise and convert graphs, simulate, evaluate.",
        epilog=_CODES,
    )
    whole.add_argument("--version", action="version", version=f"graph_slam_ros {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, run: Callable[[argparse.Namespace], int], about: str) -> "_Parser":
        sub: _Parser = commands.add_parser(name, help=about, description=about)
        sub.set_defaults(run=run)
        return sub

    _replay(
        command(
            "replay", recordings.replay, "run a recording (mcap, db3, ROS 1) or an earlier run through the pipeline"
        )
    )
    _recover(
        command("recover", recordings.recover, "the results of a run that was cut off, without repeating the drive")
    )
    _export(command("export", maps.export, "a run's path as TUM, its graph as g2o, or both as an mcap of ROS messages"))
    _diff(command("diff", maps.diff, "what differs between two runs' maps: keyframes, landmarks, verdicts, chi2"))
    _merge(command("merge", maps.merge, "one map of two runs, laid on one another by the landmarks of both"))
    _freeze(command("freeze", maps.freeze, "a run's map as one that stays as it is: load it to be located in it"))
    _info(
        command("info", recordings.info, "topics, types, rates, frames and span of a recording, and how to replay it")
    )
    _optimize(command("optimize", graphs.optimize, "solve a graph: g2o, TORO, iSAM or GTSAM text"))
    _convert(
        command("convert", graphs.convert, "write a graph in another format: g2o, TORO, GTSAM text; its poses as TUM")
    )
    _simulate(
        command(
            "simulate",
            worlds.simulate,
            "record a synthetic world with truth: pythonrobotics, manhattan, warehouse, flight; put faults into it",
        )
    )
    _plot(command("plot", recordings.plot, "a picture of a run: path, landmarks, and the truth where there is one"))
    _evaluate(command("evaluate", recordings.evaluate, "errors of a run, and whether it knows them; a picture"))
    _explain(command("explain", decided.explain, "why: what a run believed and what not, or all about one edge of it"))
    _solve(
        command("solve", decided.solve, "what if: a run's graph without some edges, with others, under another loss")
    )
    _influence(command("influence", decided.influence, "the edges of a run that its last pose hangs on most"))
    command("warmup", recordings.warmup, "compile the kernels")
    _demo(command("demo", recordings.demo, "replay the recording that comes with the source through a live ROS graph"))
    return whole


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    more: Callable[[], str] | None = None  # what the help ends with, where it takes imports to know it

    def format_help(self) -> str:
        """The help."""
        if self.more is not None:
            self.epilog = f"{self.more()}\n\n{_CODES}"
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        self.exit(REFUSED, f"{self.prog}: {message} (--help shows what there is)\n")


# -- options of each command -------------------------------------------------------------------------------------------


def _replay(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording, or a run folder")
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder for the results")
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: the only one, or /odom)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: the only one, or /landmarks)")
    _add_config(sub)
    sub.add_argument("--ros", action="store_true", help="publish into a live ROS graph: a node of its own with --out")
    sub.add_argument("--rate", type=_positive, metavar="X", help="with --ros: times real time (default: all it takes)")
    sub.add_argument("--node", metavar="NAME", help="with --ros and no --out: the running node")


def _recover(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN")
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: RUN itself)")


def _export(sub: argparse.ArgumentParser) -> None:
    _of_run(sub)
    sub.add_argument("--to", choices=("tum", "g2o", "mcap"), required=True, help="g2o: stamps and names beside it")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")


def _diff(sub: argparse.ArgumentParser) -> None:
    sub.epilog = f"{_CODES} 4: they differ."
    sub.add_argument("a", type=Path, metavar="A", help="run folder")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    sub.add_argument("--json", action="store_true", help="all of it as one line")


def _merge(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("a", type=Path, metavar="A", help="run folder, in whose map frame and configuration the result is")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    sub.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder for the results")


def _freeze(sub: argparse.ArgumentParser) -> None:
    _of_run(sub)
    sub.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder for the results")


def _info(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("bag", type=Path, metavar="BAG")


def _optimize(sub: argparse.ArgumentParser) -> None:
    sub.epilog = f"{_CODES} With --certify: 4 not certified, 5 the certificate does not apply."
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
        choices=("auto", "file", "tree", "chordal", "online"),
        default="auto",
        help="where to start; auto: the file (tree without vertices), and where the result is suspicious chordal and"
        " then online (pose after pose) as well, of which the best is taken",
    )
    sub.add_argument("--error-map", choices=("relative", "seed"), default="relative", help="seed: of the inverse")
    sub.add_argument(
        "--certify", action="store_true", help="prove that it is the global optimum, where poses alone are its unknowns"
    )
    _add_reading(sub)
    sub.add_argument("--json", action="store_true", help="the answer as one line")
    sub.add_argument("--out", type=Path, metavar="FILE.g2o", help="the solved graph")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="start and result")


def _convert(sub: argparse.ArgumentParser) -> None:
    sub.epilog = f"What the format of B cannot say is left out, told in a line, and ends with 3. {_CODES}"
    sub.add_argument("graph", type=Path, metavar="A", help="g2o, TORO, iSAM or GTSAM text")
    sub.add_argument(
        "out", type=Path, metavar="B", help="by its ending: .g2o; .toro, .graph; .gtsam; .tum (poses, id as stamp)"
    )
    sub.add_argument("--to", choices=("g2o", "toro", "gtsam", "tum"), help="whatever the ending of B")
    _add_reading(sub)


def _simulate(sub: "_Parser") -> None:
    sub.formatter_class = argparse.RawDescriptionHelpFormatter
    sub.more = _world_options
    sub.add_argument("scenario", metavar="SCENARIO", help="a world, city (a graph), or the file of a graph")
    sub.add_argument(
        "--out", type=Path, required=True, metavar="BAG.mcap|GRAPH.g2o", help="a recording, or by its ending a graph"
    )
    sub.add_argument("--seed", type=int, default=0, metavar="N")
    sub.add_argument("--as-original", action="store_true", help="pythonrobotics: its own, squared noise")
    sub.add_argument("--poses", type=_count, metavar="N", help="length of the drive, where the world has it")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the world")
    sub.add_argument("--closures", type=_count, metavar="N", help="so many true loop closures besides, on /closures")
    sub.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND[:KEY=VALUE,...]",
        help="see below; several are put in turn",
    )


def _world_options() -> str:
    """Every option of the worlds and every kind of fault, with defaults."""
    from graph_slam_ros.simulation import WORLDS, Instruments
    from graph_slam_ros.simulation.faults import KINDS
    from graph_slam_ros.simulation.options import options_of

    def told(cls: type) -> list[str]:
        lines = []
        for o in options_of(cls):
            choices = f": {', '.join(o.choices)}" if o.choices else ""
            default = str(o.default).lower() if isinstance(o.default, bool) else o.default
            lines.append(f"    {o.name}={default}{f' [{o.unit}]' if o.unit else ''}  {o.meaning}{choices}")
        return lines

    lines = ["options of the worlds, for --set:"]
    for name, world in WORLDS.items():
        lines += [f"  {name}: {world.about}", *told(world.options)]
    lines += ["  every world: a satellite receiver and an IMU besides", *told(Instruments)]
    lines += ["", "faults, and what of them can be set; what is wrong then is in OUT.faults.csv:"]
    for name, kind in KINDS.items():
        lines += [f"  {name}: {kind.about}", *told(kind.options)]
    lines += ["", "example: graph_slam simulate warehouse --out world.mcap --set gnss=5 --set imu=100"]
    return "\n".join(lines)


def _evaluate(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN")
    _add_truth(sub, required=True)
    sub.add_argument(
        "--estimate",
        default="",
        metavar="FILE",
        help="which trajectory of the run (default: sightings.tum; path.tum where nothing was seen)",
    )
    sub.add_argument("--json", action="store_true", help="the numbers as one line")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="default: path.png in the run folder")


def _plot(sub: argparse.ArgumentParser) -> None:
    _of_run(sub)
    sub.add_argument("--out", type=Path, metavar="PNG", help="default: path.png in the run folder")
    _add_truth(sub, required=False)


def _add_truth(sub: argparse.ArgumentParser, *, required: bool) -> None:
    sub.add_argument("--truth", required=required, metavar="BAG|FILE.tum", help="a recording, or a TUM file")
    sub.add_argument(
        "--topic",
        default="",
        metavar="TOPIC",
        help="topic of the truth: poses, odometry, NavSatFix or PointStamped; of transforms /tf:PARENT:CHILD"
        " (default: /ground_truth, or the only one that may be it)",
    )
    sub.add_argument("--no-align", action="store_true", help="the map is in the frame of the truth already")


def _explain(sub: argparse.ArgumentParser) -> None:
    _of_run(sub)
    sub.add_argument(
        "edge",
        nargs="?",
        metavar="EDGE",
        help="id of an edge, or the name of a landmark (landmark:7 where that is a number); default: the whole",
    )


def _solve(sub: argparse.ArgumentParser) -> None:
    sub.epilog = f"Edges have the ids of explain and of the run's ledger. {_CODES}"
    _of_run(sub)
    sub.add_argument("--without", nargs="+", action="extend", type=_edge, default=[], metavar="EDGE", help="taken out")
    sub.add_argument(
        "--with",
        dest="let_in",
        nargs="+",
        action="extend",
        type=_edge,
        default=[],
        metavar="EDGE",
        help="let in, and fully believed: no loss lets go of it",
    )
    sub.add_argument(
        "--loss",
        type=_loss,
        metavar="none|huber|cauchy|geman_mcclure|dcs[:SCALE]",
        help=f"of all that may be wrong, instead of the run's; scale in standard deviations ({_LOSS_SCALE:g})",
    )


def _influence(sub: argparse.ArgumentParser) -> None:
    _of_run(sub)
    sub.add_argument("--count", type=_count, default=10, metavar="N", help="edges that are solved without (10)")


def _demo(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--out", type=Path, default=Path("runs/demo"), metavar="DIR")


# -- what they share ---------------------------------------------------------------------------------------------------


def _of_run(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")


def _add_config(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one parameter")


def _add_reading(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--from",
        dest="source",
        choices=("g2o", "toro", "gtsam", "isam", "rows"),
        help="refuse other lines (default: each by its tag); isam: square roots of the information; rows: information"
        " of EDGE2 in rows of its upper triangle",
    )
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
    if not re.fullmatch(r"0*[1-9]\d{0,8}", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text} is not a positive integer")
    return int(text)


def _edge(text: str) -> int:
    from graph_slam_ros.formats.strict import integer

    try:
        return integer(text)
    except GraphSlamError:
        raise argparse.ArgumentTypeError(f"{text} is not the id of an edge") from None


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
