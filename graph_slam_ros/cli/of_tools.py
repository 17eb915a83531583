"""Options of commands whose code is in ``tools``, which are not imported for them."""

from pathlib import Path

from graph_slam_ros.cli import arguments
from graph_slam_ros.cli.usage import CommandParser, later


def report_options(sub: CommandParser) -> None:
    """Add the options of ``report``."""
    arguments.add_run(sub)
    sub.add_argument("--out", type=Path, metavar="FILE.html", help="file of the report (default: RUN.html)")
    arguments.add_shown(sub)
    arguments.add_force(sub)


def advise_options(sub: CommandParser) -> None:
    """Add the options of ``advise``."""
    arguments.add_run(sub)
    sub.add_argument("--count", type=arguments.count, default=1, metavar="N", help="additions of a kind (default: 1)")
    about = "sigma of each coordinate of a surveyed landmark [m] (default: 0.02)"
    sub.add_argument("--survey-sigma", type=arguments.positive, default=0.02, metavar="M", help=about)
    arguments.add_json(sub)


def simulate_options(sub: CommandParser) -> None:
    """Add the options of ``simulate``."""
    sub.more = later("tools.simulation.command", "options_of_worlds")
    about = "name of a world (city, sphere: a graph), or the file of a graph or recording"
    sub.add_argument("scenario", metavar="SCENARIO", help=about)
    about = "output file; by its ending a recording or a graph"
    sub.add_argument("--out", type=Path, required=True, metavar="BAG.mcap|GRAPH.g2o", help=about)
    arguments.add_force(sub)
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default: 0)")
    about = "number of poses of the drive, if the world has that option"
    sub.add_argument("--poses", type=arguments.count, metavar="N", help=about)
    about = "option of the world, listed below"
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "number of true loop closures to add, on /closures"
    sub.add_argument("--closures", type=arguments.count, metavar="N", help=about)
    about = "fault to add, listed below; several are added in order"
    sub.add_argument("--fault", action="append", default=[], metavar="KIND[:KEY=VALUE,...]", help=about)
