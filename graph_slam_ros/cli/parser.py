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
            name, help=about, description=about, examples=[f"graph_slam {name} {one}".rstrip() for one in examples]
        )
        sub.set_defaults(run=run)
        options(sub)
    return whole


def _commands() -> "dict[str, tuple[Run, Options, str, *tuple[str, ...]]]":
    """By name: the function, the options, what it is for, and examples of its arguments."""
    return {
        "info": (
            recordings.info,
            _info,
            "topics, types, rates, frames and span of a recording, and how to replay it",
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
            "errors of a run, and whether it knows them; a picture",
            "drive_run --truth drive.mcap:/ground_truth",
        ),
        "recover": (
            recordings.recover,
            _recover,
            "the results of a run that was cut off, without repeating the drive",
            "runs/latest --out recovered",
        ),
        "export": (
            maps.export,
            _export,
            "a run's path as TUM, its graph as g2o, or both as an mcap of ROS messages",
            "drive_run --to tum --out path.tum",
        ),
        "diff": (
            maps.diff,
            _diff,
            "what differs between two runs' maps: keyframes, landmarks, verdicts, chi2",
            "monday_run tuesday_run",
        ),
        "merge": (
            maps.merge,
            _merge,
            "one map of two runs, laid on one another by the landmarks of both",
            "monday_run tuesday_run --out site",
        ),
        "freeze": (
            maps.freeze,
            _freeze,
            "a run's map as one that stays as it is: load it to be located in it",
            "drive_run --out site",
        ),
        "plot": (
            recordings.plot,
            _plot,
            "a picture of a run: path, landmarks, and the truth where there is one",
            "drive_run",
            "drive_run --truth drive.mcap:/ground_truth --out drive.png",
            "drive_run --animate drive.gif",
        ),
        "explain": (
            audit.explain,
            _explain,
            "why: what a run believed and what not, or all about one edge of it",
            "drive_run",
            "drive_run 142",
        ),
        "solve": (
            audit.solve,
            _solve,
            "what if: a run's graph without some edges, with others, under another loss",
            "drive_run --without 142 143",
        ),
        "influence": (
            audit.influence,
            _influence,
            "the edges of a run that its last pose hangs on most",
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
            "record a synthetic world with truth: pythonrobotics, manhattan, warehouse, flight; put faults into it",
            "warehouse --out world.mcap --seed 7",
        ),
        "params": (
            _later("params"),
            _params,
            "parameters with default, unit, bounds and meaning",
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
            "a script that completes commands and options in a shell: eval it in ~/.bashrc or ~/.zshrc",
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
        "--map", type=Path, metavar="RUN", help="go on in the map of a run, frozen or not, and in its parameters"
    )
    sub.add_argument("--ros", action="store_true", help="publish into a live ROS graph: a node of its own with --out")
    sub.add_argument(
        "--rate", type=values.positive, metavar="X", help="with --ros: times real time (default: all it takes)"
    )
    sub.add_argument("--node", metavar="NAME", help="with --ros and no --out: the running node")


def _recover(sub: "CommandParser") -> None:
    sub.add_argument("run_folder", type=Path, metavar="RUN")
    _to_folder(sub, required=False, default="RUN itself")


def _export(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument("--to", choices=("tum", "g2o", "mcap"), required=True, help="g2o: stamps and names beside it")
    sub.add_argument("--last-drive", action="store_true", help="tum: only the last drive, not those of the loaded map")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")
    _add_force(sub)


def _diff(sub: "CommandParser") -> None:
    sub.codes = f"{CODES} 4: they differ."
    sub.add_argument("a", type=Path, metavar="A", help="run folder")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    sub.add_argument("--json", action="store_true", help="all of it as one line")


def _merge(sub: "CommandParser") -> None:
    sub.add_argument("a", type=Path, metavar="A", help="run folder, in whose map frame and configuration the result is")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    _to_folder(sub)


def _freeze(sub: "CommandParser") -> None:
    _of_run(sub)
    _to_folder(sub)


def _info(sub: "CommandParser") -> None:
    sub.add_argument("bag", type=Path, metavar="BAG")


def _optimize(sub: "CommandParser") -> None:
    sub.codes = f"{CODES} With --certify: 4 not certified, 5 the certificate does not apply."
    sub.add_argument("graph", type=Path, metavar="GRAPH")
    sub.add_argument(
        "--method",
        type=values.method,
        default="gn",
        metavar="gn|lm|dogleg",
        help="gn (default) is damped only if it does not converge",
    )
    sub.add_argument("--max-iterations", type=values.count, default=100, metavar="N", help="default: 100")
    sub.add_argument(
        "--tolerance",
        type=values.positive,
        default=1e-6,
        metavar="X",
        help="relative decrease of cost at the end (1e-6)",
    )
    sub.add_argument(
        "--loss",
        type=values.loss,
        default="none",
        metavar="none|huber|cauchy[:SCALE]",
        help=f"robust loss of all edges but odometry; scale in standard deviations of an edge ({values.LOSS_SCALE:g})",
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
    _add_force(sub)


def _convert(sub: "CommandParser") -> None:
    sub.codes = f"What the format of B cannot say is left out, told in a line, and ends with 3. {CODES}"
    sub.add_argument("graph", type=Path, metavar="A", help="g2o, TORO, iSAM or GTSAM text")
    sub.add_argument(
        "out", type=Path, metavar="B", help="by its ending: .g2o; .toro, .graph; .gtsam; .tum (poses, id as stamp)"
    )
    sub.add_argument("--to", choices=("g2o", "toro", "gtsam", "tum"), help="whatever the ending of B")
    _add_force(sub)
    _add_reading(sub)


def _simulate(sub: "CommandParser") -> None:
    sub.more = _world_options
    sub.add_argument("scenario", metavar="SCENARIO", help="a world, city (a graph), or the file of a graph")
    sub.add_argument(
        "--out", type=Path, required=True, metavar="BAG.mcap|GRAPH.g2o", help="a recording, or by its ending a graph"
    )
    _add_force(sub)
    sub.add_argument("--seed", type=int, default=0, metavar="N")
    sub.add_argument("--as-original", action="store_true", help="pythonrobotics: its own, squared noise")
    sub.add_argument("--poses", type=values.count, metavar="N", help="length of the drive, where the world has it")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the world")
    sub.add_argument(
        "--closures", type=values.count, metavar="N", help="so many true loop closures besides, on /closures"
    )
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
    lines += ["  every world: a satellite receiver and an IMU besides", *option_lines(Instruments)]
    lines += ["", "faults, and what of them can be set; what is wrong then is in OUT.faults.csv:"]
    for name, kind in KINDS.items():
        lines += [f"  {name}: {kind.about}", *option_lines(kind.options)]
    lines += ["", "example: graph_slam simulate warehouse --out world.mcap --set gnss=5 --set imu=100"]
    return "\n".join(lines)


def _evaluate(sub: "CommandParser") -> None:
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
    _add_force(sub)


def _plot(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument("--out", type=Path, metavar="PNG", help="default: path.png in the run folder")
    sub.add_argument("--animate", type=Path, metavar="GIF", help="instead: the drive and its correction, as it went on")
    _add_truth(sub, required=False)
    _add_force(sub)


def _add_truth(sub: "CommandParser", *, required: bool) -> None:
    sub.add_argument("--truth", required=required, metavar="BAG|FILE.tum", help="a recording, or a TUM file")
    sub.add_argument(
        "--topic",
        default="",
        metavar="TOPIC",
        help="topic of the truth: poses, odometry, NavSatFix or PointStamped; of transforms /tf:PARENT:CHILD"
        " (default: /ground_truth, or the only one that may be it)",
    )
    sub.add_argument("--no-align", action="store_true", help="the map is in the frame of the truth already")


def _explain(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument(
        "edge",
        nargs="?",
        metavar="EDGE",
        help="id of an edge, or the name of a landmark (landmark:7 where that is a number); default: the whole",
    )


def _solve(sub: "CommandParser") -> None:
    sub.codes = f"Edges have the ids of explain and of the run's ledger. {CODES}"
    _of_run(sub)
    sub.add_argument(
        "--without", nargs="+", action="extend", type=values.edge, default=[], metavar="EDGE", help="taken out"
    )
    sub.add_argument(
        "--with",
        dest="let_in",
        nargs="+",
        action="extend",
        type=values.edge,
        default=[],
        metavar="EDGE",
        help="let in, and fully believed: no loss lets go of it",
    )
    sub.add_argument(
        "--loss",
        type=values.loss,
        metavar="none|huber|cauchy|geman_mcclure|dcs[:SCALE]",
        help=f"of all that may be wrong, instead of the run's; scale in standard deviations ({values.LOSS_SCALE:g})",
    )


def _influence(sub: "CommandParser") -> None:
    _of_run(sub)
    sub.add_argument("--count", type=values.count, default=10, metavar="N", help="edges that are solved without (10)")


def _demo(sub: "CommandParser") -> None:
    sub.add_argument("--out", type=Path, default=Path("runs/demo"), metavar="DIR", help="default: runs/demo")
    _add_force(sub)


def _params(sub: "CommandParser") -> None:
    sub.add_argument(
        "pattern", nargs="?", default="", metavar="PATTERN", help="part of a name or meaning, or a name with * (all)"
    )


def _completion(sub: "CommandParser") -> None:
    sub.add_argument("shell", choices=("bash", "zsh"), help='eval "$(graph_slam completion bash)"')
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
    sub.add_argument("--force", action="store_true", help="replace a run or a file that is there; nothing else")


def _add_config(sub: "CommandParser") -> None:
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one parameter")


def _add_reading(sub: "CommandParser") -> None:
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
