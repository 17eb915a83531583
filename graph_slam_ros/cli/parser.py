"""The command line of ``graph_slam``: commands and their options."""

import argparse
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from graph_slam_ros import __version__
from graph_slam_ros.cli import audit, graphs, maps, recordings, simulate, values
from graph_slam_ros.cli.usage import CODES, CommandParser

Run = Callable[[argparse.Namespace], int]
Options = Callable[["CommandParser"], None]


def parser() -> argparse.ArgumentParser:
    """The whole command line; the arguments' ``run`` is the command's function."""
    whole = CommandParser(
        prog="graph_slam",
        description="Online pose-graph SLAM: replay recordings, optimise and convert graphs, simulate, evaluate.",
        examples=("graph_slam info drive.mcap", "graph_slam replay drive.mcap --out drive_run"),
    )
    whole.add_argument("--version", action="version", version=f"graph_slam_ros {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", parser_class=CommandParser)
    for name, (run, options, about, *examples) in _commands().items():
        sub: CommandParser = commands.add_parser(
            name,
            help=about,
            description=f"{about[0].upper()}{about[1:]}.",
            examples=[f"graph_slam {name} {one}".rstrip() for one in examples],
        )
        sub.set_defaults(run=run)
        options(sub)
    return whole


def _commands() -> "dict[str, tuple[Run, Options, str, *tuple[str, ...]]]":
    """The commands by name: the function, the options, what it is for, and examples of its arguments."""
    return {
        "info": (
            recordings.info,
            _info,
            "show topics, types, rates, frames and span of a recording, and how to replay it",
            "drive.mcap",
        ),
        "replay": (
            recordings.replay,
            _replay,
            "run a recording (mcap, db3, ROS 1) or an earlier run through the pipeline",
            "drive.mcap --out drive_run",
            "drive.mcap --out drive_run --force --set keyframes.min_distance_m=0.3",
        ),
        "evaluate": (
            recordings.evaluate,
            _evaluate,
            "compute the errors of a run against the truth, test its covariances, draw a picture",
            "drive_run --truth drive.mcap:/ground_truth",
        ),
        "recover": (
            recordings.recover,
            _recover,
            "write the results of a run that was cut off, without repeating the drive",
            "runs/latest --out recovered",
        ),
        "export": (
            maps.export,
            _export,
            "write a run's path as TUM, its graph as g2o, or both as an mcap of ROS messages",
            "drive_run --to tum --out path.tum",
        ),
        "diff": (
            maps.diff,
            _diff,
            "compare the maps of two runs: keyframes, landmarks, verdicts, chi2",
            "monday_run tuesday_run",
        ),
        "merge": (
            maps.merge,
            _merge,
            "merge the maps of two runs, aligned by the landmarks that both have",
            "monday_run tuesday_run --out site",
        ),
        "freeze": (
            maps.freeze,
            _freeze,
            "write a run's map as a frozen one: it stays fixed when it is loaded for localization",
            "drive_run --out site",
        ),
        "plot": (
            recordings.plot,
            _plot,
            "draw a run: path, landmarks, and the truth if there is one",
            "drive_run",
            "drive_run --truth drive.mcap:/ground_truth --out drive.png",
            "drive_run --animate drive.gif",
        ),
        "explain": (
            audit.explain,
            _explain,
            "show which measurements a run accepted or rejected and why, or all about one edge",
            "drive_run",
            "drive_run 142",
        ),
        "solve": (
            audit.solve,
            _solve,
            "solve a run's graph again without some edges, with others, or with another loss",
            "drive_run --without 142 143",
        ),
        "influence": (
            audit.influence,
            _influence,
            "list the edges of a run that its last pose depends on most",
            "drive_run --count 5",
        ),
        "optimize": (
            graphs.optimize,
            _optimize,
            "solve a graph: g2o, TORO, iSAM or GTSAM text",
            "graph.g2o --out solved.g2o --plot graph.png",
        ),
        "convert": (
            graphs.convert,
            _convert,
            "write a graph in another format: g2o, TORO, GTSAM text; its poses as TUM",
            "graph.g2o graph.toro",
        ),
        "simulate": (
            simulate.simulate,
            _simulate,
            "simulate a recording with truth and, if asked, faults: pythonrobotics, manhattan, warehouse, flight",
            "warehouse --out world.mcap --seed 7",
        ),
        "params": (
            _later("params"),
            _params,
            "list the parameters with default, unit, bounds and meaning",
            "keyframes",
            "'odometry.*'",
        ),
        "warmup": (recordings.warmup, _nothing, "compile the kernels, once per installation", ""),
        "demo": (
            recordings.demo,
            _demo,
            "replay the recording that comes with the source through a live ROS graph",
            "--force",
        ),
        "completion": (
            _later("completion"),
            _completion,
            "print a script for shell completion: eval it in ~/.bashrc or ~/.zshrc",
            "bash",
        ),
    }


def _later(name: str) -> Run:
    """The function of a command whose module has its name: imported when it is run."""

    def run(args: argparse.Namespace) -> int:
        return int(getattr(import_module(f"graph_slam_ros.cli.{name}"), name)(args))

    return run


# -- options of each command -------------------------------------------------------------------------------------------


def _replay(sub: "CommandParser") -> None:
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording, or a run folder")
    _to_folder(sub, required=False)  # not with --ros and --node
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: the only one, or /odom)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: the only one, or /landmarks)")
    _add_config(sub)
    sub.add_argument(
        "--map", type=Path, metavar="RUN", help="continue in the map of a run, frozen or not, with its parameters"
    )
    sub.add_argument("--ros", action="store_true", help="publish into a live ROS graph: a node of its own with --out")
    sub.add_argument(
        "--rate",
        type=values.positive,
        metavar="X",
        help="with --ros: multiple of real time (default: as fast as possible)",
    )
    sub.add_argument("--node", metavar="NAME", help="with --ros and without --out: name of the running node")


def _recover(sub: "CommandParser") -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")
    _to_folder(sub, required=False, default="RUN itself")


def _export(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument(
        "--to",
        choices=("tum", "g2o", "mcap"),
        required=True,
        help="format; g2o: stamps and names go into a second file",
    )
    sub.add_argument("--last-drive", action="store_true", help="tum: only the last drive, not those of the loaded map")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help="output file")
    _add_force(sub)


def _diff(sub: "CommandParser") -> None:
    sub.codes = f"{CODES} 4: they differ."
    sub.add_argument("a", type=Path, metavar="A", help="run folder")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    sub.add_argument("--json", action="store_true", help="print all of it as one line of JSON")


def _merge(sub: "CommandParser") -> None:
    sub.add_argument("a", type=Path, metavar="A", help="run folder; the result has its map frame and configuration")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    _to_folder(sub)


def _freeze(sub: "CommandParser") -> None:
    _of_run(sub)
    _to_folder(sub)


def _info(sub: "CommandParser") -> None:
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording")


def _optimize(sub: "CommandParser") -> None:
    sub.codes = f"{CODES} With --certify: 4 not certified, 5 the certificate does not apply."
    sub.add_argument("graph", type=Path, metavar="GRAPH", help="file of a graph")
    sub.add_argument(
        "--method",
        type=values.method,
        default="gn",
        metavar="gn|lm|dogleg",
        help="method of optimisation; gn (default) is damped only if it does not converge",
    )
    sub.add_argument(
        "--max-iterations", type=values.count, default=100, metavar="N", help="most iterations (default: 100)"
    )
    sub.add_argument(
        "--tolerance",
        type=values.positive,
        default=1e-6,
        metavar="X",
        help="converged when the cost decreases by a smaller fraction (default: 1e-6)",
    )
    sub.add_argument(
        "--loss",
        type=values.loss,
        default="none",
        metavar="none|huber|cauchy[:SCALE]",
        help=f"robust loss of all edges but odometry; SCALE in sigmas (default: {values.LOSS_SCALE:g})",
    )
    sub.add_argument(
        "--init",
        choices=("auto", "file", "tree", "chordal", "online"),
        default="auto",
        help="initial estimate; auto: the file (tree without vertices), and if the result is suspicious chordal and"
        " then online (pose after pose) as well, of which the best is taken",
    )
    sub.add_argument(
        "--error-map",
        choices=("relative", "seed"),
        default="relative",
        help="error of relative poses; seed: of the inverse",
    )
    sub.add_argument(
        "--certify", action="store_true", help="prove that the result is the global optimum; for graphs of poses only"
    )
    _add_reading(sub)
    sub.add_argument("--json", action="store_true", help="print the answer as one line of JSON")
    sub.add_argument("--out", type=Path, metavar="FILE.g2o", help="write the solved graph")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the initial estimate and the result")
    _add_force(sub)


def _convert(sub: "CommandParser") -> None:
    sub.codes = f"What the format of B cannot express is left out and reported; the exit code is 3. {CODES}"
    sub.add_argument("graph", type=Path, metavar="A", help="g2o, TORO, iSAM or GTSAM text")
    sub.add_argument(
        "out",
        type=Path,
        metavar="B",
        help="output file; format by its ending: .g2o; .toro, .graph; .gtsam; .tum (poses, id as stamp)",
    )
    sub.add_argument(
        "--to", choices=("g2o", "toro", "gtsam", "tum"), help="format of B, instead of the one of its ending"
    )
    _add_force(sub)
    _add_reading(sub)


def _simulate(sub: "CommandParser") -> None:
    sub.more = _world_options
    sub.add_argument("scenario", metavar="SCENARIO", help="name of a world, city (a graph), or the file of a graph")
    sub.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="BAG.mcap|GRAPH.g2o",
        help="output file; by its ending a recording or a graph",
    )
    _add_force(sub)
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default: 0)")
    sub.add_argument(
        "--as-original", action="store_true", help="pythonrobotics: with the squared noise of the original"
    )
    sub.add_argument(
        "--poses", type=values.count, metavar="N", help="number of poses of the drive, if the world has that option"
    )
    sub.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="option of the world, listed below"
    )
    sub.add_argument(
        "--closures", type=values.count, metavar="N", help="number of true loop closures to add, on /closures"
    )
    sub.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND[:KEY=VALUE,...]",
        help="fault to add, listed below; several are added in order",
    )


def _world_options() -> str:
    """Every option of the worlds and every kind of fault, with defaults."""
    from graph_slam_ros.simulation import WORLDS, Instruments
    from graph_slam_ros.simulation.faults import KINDS
    from graph_slam_ros.simulation.options import options_of

    def option_lines(cls: type) -> list[str]:
        lines = []
        for o in options_of(cls):
            choices = f": {', '.join(o.choices)}" if o.choices else ""
            default = str(o.default).lower() if isinstance(o.default, bool) else o.default
            lines.append(f"    {o.name}={default}{f' [{o.unit}]' if o.unit else ''}  {o.meaning}{choices}")
        return lines

    lines = ["options of the worlds, for --set:"]
    for name, world in WORLDS.items():
        lines += [f"  {name}: {world.about}", *option_lines(world.options)]
    lines += ["  every world: with a satellite receiver and an IMU", *option_lines(Instruments)]
    lines += ["", "faults for --fault with their options; OUT.faults.csv lists what is wrong:"]
    for name, kind in KINDS.items():
        lines += [f"  {name}: {kind.about}", *option_lines(kind.options)]
    lines += ["", "example: graph_slam simulate warehouse --out world.mcap --set gnss=5 --set imu=100"]
    return "\n".join(lines)


def _evaluate(sub: "CommandParser") -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")
    _add_truth(sub, required=True)
    sub.add_argument(
        "--estimate",
        default="",
        metavar="FILE",
        help="trajectory to evaluate (default: sightings.tum; path.tum without observations)",
    )
    sub.add_argument("--json", action="store_true", help="print the numbers as one line of JSON")
    sub.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="file of the picture (default: path.png in the run folder)"
    )
    _add_force(sub)


def _plot(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument(
        "--out", type=Path, metavar="PNG", help="file of the picture (default: path.png in the run folder)"
    )
    sub.add_argument(
        "--animate", type=Path, metavar="GIF", help="write an animation of the drive and its correction instead"
    )
    _add_truth(sub, required=False)
    _add_force(sub)


def _add_truth(sub: "CommandParser", *, required: bool) -> None:
    sub.add_argument("--truth", required=required, metavar="BAG|FILE.tum", help="the truth: a recording, or a TUM file")
    sub.add_argument(
        "--topic",
        default="",
        metavar="TOPIC",
        help="topic of the truth: poses, odometry, NavSatFix or PointStamped; of transforms /tf:PARENT:CHILD"
        " (default: /ground_truth, or the only one that may be it)",
    )
    sub.add_argument(
        "--no-align", action="store_true", help="do not align: the map is in the frame of the truth already"
    )


def _explain(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument(
        "edge",
        nargs="?",
        metavar="EDGE",
        help="id of an edge or name of a landmark (landmark:7 if the name is a number); default: the whole run",
    )


def _solve(sub: "CommandParser") -> None:
    sub.codes = f"Edges have the ids of explain and of the run's ledger. {CODES}"
    _of_run(sub)
    sub.add_argument(
        "--without",
        nargs="+",
        action="extend",
        type=values.edge,
        default=[],
        metavar="EDGE",
        help="ids of edges to remove",
    )
    sub.add_argument(
        "--with",
        dest="let_in",
        nargs="+",
        action="extend",
        type=values.edge,
        default=[],
        metavar="EDGE",
        help="ids of edges to include with full weight, without a robust loss",
    )
    sub.add_argument(
        "--loss",
        type=values.loss,
        metavar="none|huber|cauchy|geman_mcclure|dcs[:SCALE]",
        help=f"robust loss of all candidates, instead of the run's; SCALE in sigmas ({values.LOSS_SCALE:g})",
    )


def _influence(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument(
        "--count",
        type=values.count,
        default=10,
        metavar="N",
        help="number of edges that are left out in turn (default: 10)",
    )


def _demo(sub: "CommandParser") -> None:
    sub.add_argument(
        "--out", type=Path, default=Path("runs/demo"), metavar="DIR", help="folder for the results (default: runs/demo)"
    )
    _add_force(sub)


def _params(sub: "CommandParser") -> None:
    sub.add_argument(
        "pattern",
        nargs="?",
        default="",
        metavar="PATTERN",
        help="part of a name or of its help, or a name with * (default: all)",
    )


def _completion(sub: "CommandParser") -> None:
    sub.add_argument("shell", choices=("bash", "zsh"), help='shell; use: eval "$(graph_slam completion bash)"')
    sub.set_defaults(parser=parser)


def _nothing(sub: "CommandParser") -> None:
    """No options."""


# -- what they share ---------------------------------------------------------------------------------------------------


def _of_run(sub: "CommandParser") -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")


def _to_folder(sub: "CommandParser", *, required: bool = True, default: str = "") -> None:
    about = f"folder for the results{f' (default: {default})' if default else ''}"
    sub.add_argument("--out", type=Path, metavar="DIR", required=required, help=about)
    _add_force(sub)


def _add_force(sub: "CommandParser") -> None:
    sub.add_argument(
        "--force", action="store_true", help="replace an existing run or file; nothing else is overwritten"
    )


def _add_config(sub: "CommandParser") -> None:
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="set one parameter")


def _add_reading(sub: "CommandParser") -> None:
    sub.add_argument(
        "--from",
        dest="source",
        choices=("g2o", "toro", "gtsam", "isam", "rows"),
        help="format of the lines; others are refused (default: each by its tag); isam: square roots of the"
        " information; rows: information of EDGE2 in rows of its upper triangle",
    )
    sub.add_argument(
        "--information",
        choices=("g2o", "raw"),
        default="g2o",
        help="scale of the information of 3D rotations; raw: unscaled",
    )
    sub.add_argument("--lenient", action="store_true", help="leave out bad lines, list them, exit with 3")
