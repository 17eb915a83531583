"""Options of each command of ``graph_slam``."""

from pathlib import Path

from graph_slam_ros.cli import values
from graph_slam_ros.cli.usage import CODES, CommandParser, later


def replay(sub: CommandParser) -> None:
    """Add the options of ``replay``."""
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording, or a run folder")
    _add_out(sub, required=False)  # not with --ros and --node
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


def recover(sub: CommandParser) -> None:
    """Add the options of ``recover``."""
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")
    _add_out(sub, required=False, default="RUN itself")


def export(sub: CommandParser) -> None:
    """Add the options of ``export``."""
    add_run(sub)
    sub.add_argument(
        "--to",
        choices=("tum", "g2o", "mcap"),
        required=True,
        help="format; g2o: stamps and names go into a second file",
    )
    sub.add_argument("--last-drive", action="store_true", help="tum: only the last drive, not those of the loaded map")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help="output file")
    _add_force(sub)


def diff(sub: CommandParser) -> None:
    """Add the options of ``diff``."""
    sub.codes = f"{CODES} 4: they differ."
    sub.add_argument("a", type=Path, metavar="A", help="run folder")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    _add_json(sub)


def merge(sub: CommandParser) -> None:
    """Add the options of ``merge``."""
    sub.add_argument("a", type=Path, metavar="A", help="run folder; the result has its map frame and configuration")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    _add_out(sub)


def freeze(sub: CommandParser) -> None:
    """Add the options of ``freeze``."""
    add_run(sub)
    _add_out(sub)


def info(sub: CommandParser) -> None:
    """Add the options of ``info``."""
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording")


def check(sub: CommandParser, *, of_check: bool = True) -> None:
    """Add the options of ``check``."""
    sub.codes = f"{CODES} 4: something above a note was found."
    sub.add_argument("bag", type=Path, metavar="BAG", help="file or folder of a recording")
    sub.add_argument("--odom", metavar="TOPIC", help="odometry topic (default: as info chooses)")
    sub.add_argument("--landmarks", metavar="TOPIC", help="landmark topic (default: as info chooses)")
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file; its values come before info's")
    sub.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="set one parameter, before the file's"
    )
    if of_check:
        sub.add_argument("--quick", action="store_true", help="leave out what needs a replay and a fit")
    _add_json(sub)


def calibrate(sub: CommandParser) -> None:
    """Add the options of ``calibrate``."""
    check(sub, of_check=False)
    sub.codes = f"{CODES} 4: something is to be corrected."
    sub.add_argument("--out", type=Path, metavar="FILE", help="write the settings as a parameter file, too")
    sub.add_argument("--force", action="store_true", help="replace an existing file")


def optimize(sub: CommandParser) -> None:
    """Add the options of ``optimize``."""
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
        help="initial estimate; auto: the values of the file (without vertices: tree); if the result is suspicious,"
        " chordal and then online (pose by pose) are tried, and the best result is used",
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
    _add_json(sub, "the answer")
    sub.add_argument("--out", type=Path, metavar="FILE.g2o|FILE.tum", help="write the solved graph, or its poses")
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the initial estimate and the result")
    _add_force(sub)


def simulate(sub: CommandParser) -> None:
    """Add the options of ``simulate``."""
    sub.more = later("tools.simulation.command", "options_of_worlds")
    sub.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="name of a world (city, sphere: a graph), or the file of a graph or recording",
    )
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


def evaluate(sub: CommandParser) -> None:
    """Add the options of ``evaluate``."""
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")
    _add_truth(sub, required=True)
    sub.add_argument(
        "--estimate",
        default="",
        metavar="FILE",
        help="trajectory to evaluate (default: sightings.tum; path.tum without observations)",
    )
    _add_json(sub, "the numbers")
    sub.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="file of the picture (default: path.png in the run folder)"
    )
    _add_force(sub)


def plot(sub: CommandParser) -> None:
    """Add the options of ``plot``."""
    add_run(sub)
    sub.add_argument(
        "--out", type=Path, metavar="PNG", help="file of the picture (default: path.png in the run folder)"
    )
    sub.add_argument(
        "--animate", type=Path, metavar="GIF", help="write an animation of the drive and its correction instead"
    )
    _add_truth(sub, required=False)
    _add_force(sub)


def report(sub: CommandParser) -> None:
    """Add the options of ``report``."""
    add_run(sub)
    sub.add_argument("--out", type=Path, metavar="FILE.html", help="file of the report (default: RUN.html)")
    add_shown(sub)
    _add_force(sub)


def add_shown(sub: CommandParser) -> None:
    """Add what a page on a run shows of other files."""
    _add_truth(sub, required=False)
    sub.add_argument("--compare", type=Path, metavar="RUN2", help="another run: draw its path and list what differs")
    sub.add_argument("--plan", type=Path, metavar="MAP.yaml", help="floor plan to draw below: a map.yaml of Nav2")


def _add_truth(sub: CommandParser, *, required: bool) -> None:
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


def explain(sub: CommandParser) -> None:
    """Add the options of ``explain``."""
    add_run(sub)
    sub.add_argument(
        "edge",
        nargs="?",
        metavar="EDGE",
        help="id of an edge or name of a landmark (landmark:7 if the name is a number); default: the whole run",
    )


def solve(sub: CommandParser) -> None:
    """Add the options of ``solve``."""
    sub.codes = f"Edges have the ids of explain and of the run's ledger. {CODES}"
    add_run(sub)
    for name, dest, about in (
        ("--without", "without", "ids of edges to remove"),
        ("--with", "let_in", "ids of edges to include with full weight, without a robust loss"),
    ):
        sub.add_argument(
            name, dest=dest, nargs="+", action="extend", type=values.edge, default=[], metavar="EDGE", help=about
        )
    sub.add_argument(
        "--loss",
        type=values.loss,
        metavar="none|huber|cauchy|geman_mcclure|dcs[:SCALE]",
        help=f"robust loss of all candidates, instead of the run's; SCALE in sigmas ({values.LOSS_SCALE:g})",
    )


def influence(sub: CommandParser) -> None:
    """Add the options of ``influence``."""
    add_run(sub)
    _add_count(sub, 10, "number of edges that are left out in turn")


def advise(sub: CommandParser) -> None:
    """Add the options of ``advise``."""
    add_run(sub)
    _add_count(sub, 1, "additions of each kind that are listed for each weakest direction")
    sub.add_argument(
        "--survey-sigma",
        type=values.positive,
        default=0.02,
        metavar="M",
        help="sigma of each coordinate of a surveyed landmark [m] (default: 0.02)",
    )
    _add_json(sub)


def demo(sub: CommandParser) -> None:
    """Add the options of ``demo``."""
    sub.add_argument(
        "--out", type=Path, default=Path("runs/demo"), metavar="DIR", help="folder for the results (default: runs/demo)"
    )
    _add_force(sub)


def params(sub: CommandParser) -> None:
    """Add the options of ``params``."""
    sub.add_argument(
        "pattern",
        nargs="?",
        default="",
        metavar="PATTERN",
        help="part of a name or of its help, or a name with * (default: all)",
    )


def completion(sub: CommandParser) -> None:
    """Add the options of ``completion``."""
    sub.add_argument("shell", choices=("bash", "zsh"), help='shell; use: eval "$(graph_slam completion bash)"')


def nothing(sub: CommandParser) -> None:
    """Add no option."""


# -- options that commands share ---------------------------------------------------------------------------------------


def add_run(sub: CommandParser) -> None:
    """Add the run folder."""
    sub.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")


def _add_out(sub: CommandParser, *, required: bool = True, default: str = "") -> None:
    about = f"folder for the results{f' (default: {default})' if default else ''}"
    sub.add_argument("--out", type=Path, metavar="DIR", required=required, help=about)
    _add_force(sub)


def _add_json(sub: CommandParser, what: str = "all of it") -> None:
    sub.add_argument("--json", action="store_true", help=f"print {what} as one line of JSON")


def _add_count(sub: CommandParser, default: int, about: str) -> None:
    sub.add_argument("--count", type=values.count, default=default, metavar="N", help=f"{about} (default: {default})")


def _add_force(sub: CommandParser) -> None:
    sub.add_argument(
        "--force", action="store_true", help="replace an existing run or file; nothing else is overwritten"
    )


def _add_config(sub: CommandParser) -> None:
    sub.add_argument("--config", type=Path, metavar="FILE", help="parameter file, as for the node")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="set one parameter")


def _add_reading(sub: CommandParser) -> None:
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
