"""The command line of ``graph_slam``: a table of the commands, and the parser that it makes."""

import argparse
from collections.abc import Callable

from graph_slam_ros import __version__
from graph_slam_ros.cli import audit, edit, graphs, maps, options, recordings
from graph_slam_ros.cli.usage import CommandParser, later


class Command:
    """A command: its function, its options, its purpose, and examples of its arguments."""

    def __init__(
        self,
        run: Callable[[argparse.Namespace], int],
        add_options: Callable[[CommandParser], None],
        about: str,
        *examples: str,
    ) -> None:
        self.run = run
        self.add_options = add_options
        self.about = about
        self.examples = examples


COMMANDS = {
    "info": Command(
        recordings.info,
        options.info,
        "show topics, types, rates, frames and span of a recording, and how to replay it",
        "drive.mcap",
    ),
    "check": Command(
        later("cli.check", "check"),
        options.check,
        "find what is wrong with a recording, by how much, and the setting that mends it",
        "drive.mcap",
        "drive.mcap --set detections.offset_s=-0.096",
    ),
    "calibrate": Command(
        later("cli.calibrate", "calibrate"),
        options.calibrate,
        "estimate odometry's scale, clocks and mounts from a recording, and print the settings",
        "drive.mcap",
        "drive.mcap --set calibrate.groups='factors clock'",
    ),
    "replay": Command(
        recordings.replay,
        options.replay,
        "run a recording (mcap, db3, ROS 1) or an earlier run through the pipeline",
        "drive.mcap --out drive_run",
        "drive.mcap --out drive_run --force --set keyframes.min_distance_m=0.3",
    ),
    "evaluate": Command(
        recordings.evaluate,
        options.evaluate,
        "compute the errors of a run against the truth, test its covariances, draw a picture",
        "drive_run --truth drive.mcap:/ground_truth",
    ),
    "recover": Command(
        recordings.recover,
        options.recover,
        "write the results of a run that was cut off, without repeating the drive",
        "runs/latest --out recovered",
    ),
    "export": Command(
        maps.export,
        options.export,
        "write a run's path as TUM, its graph as g2o, or both as an mcap of ROS messages",
        "drive_run --to tum --out path.tum",
    ),
    "diff": Command(
        maps.diff,
        options.diff,
        "compare the maps of two runs: keyframes, landmarks, verdicts, chi2",
        "monday_run tuesday_run",
    ),
    "merge": Command(
        maps.merge,
        options.merge,
        "merge the maps of two runs, aligned by the landmarks that both have",
        "monday_run tuesday_run --out site",
    ),
    "freeze": Command(
        maps.freeze,
        options.freeze,
        "write a run's map as a frozen one: it stays fixed when it is loaded for localization",
        "drive_run --out site",
    ),
    "edit": Command(
        edit.edit,
        edit.add_options,
        "edit a run's map by hand with a plan: edges, closures, landmarks, where the map lies, parts of the drive",
        "drive_run --new-plan edits.json",
        "drive_run --plan edits.json --dry-run",
        "drive_run --plan edits.json --out drive_edited",
        "drive_edited --undo wrong-aisle --out drive_mended",
    ),
    "plot": Command(
        recordings.plot,
        options.plot,
        "draw a run: path, landmarks, and the truth if there is one",
        "drive_run",
        "drive_run --truth drive.mcap:/ground_truth --out drive.png",
        "drive_run --animate drive.gif",
    ),
    "report": Command(
        later("tools.report.command", "report"),
        options.report,
        "write one HTML file on a run: map, edges with their reasons, charts and tables",
        "drive_run",
        "drive_run --truth drive.mcap:/ground_truth --out drive.html",
    ),
    "view": Command(
        later("tools.view.command", "view"),
        later("tools.view.command", "add_options"),
        "show the report in a browser, solve what-ifs at once, edit the map and save it as another run",
        "drive_run",
        "drive_run --port 8080 --no-browser",
    ),
    "explain": Command(
        audit.explain,
        options.explain,
        "show which measurements a run accepted or rejected and why, or all about one edge",
        "drive_run",
        "drive_run 142",
    ),
    "solve": Command(
        audit.solve,
        options.solve,
        "solve a run's graph again without some edges, with others, or with another loss",
        "drive_run --without 142 143",
    ),
    "influence": Command(
        audit.influence,
        options.influence,
        "list the edges of a run that its last pose depends on most",
        "drive_run --count 5",
    ),
    "advise": Command(
        later("tools.advise.command", "advise"),
        options.advise,
        "find the weakest directions of a run's map, and what to measure to make them better known",
        "drive_run",
        "drive_run --json",
    ),
    "optimize": Command(
        graphs.optimize,
        options.optimize,
        "solve a graph: g2o, TORO, iSAM or GTSAM text",
        "graph.g2o --out solved.g2o --plot graph.png",
    ),
    "simulate": Command(
        later("tools.simulation.command", "simulate"),
        options.simulate,
        "simulate a recording with truth and, if asked, faults: pythonrobotics, manhattan, warehouse, flight",
        "warehouse --out world.mcap --seed 7",
    ),
    "fleet": Command(
        later("tools.fleet.command", "fleet"),
        later("tools.fleet.command", "add_options"),
        "replay many recordings at once, and compare two such fleets, on all cores or many machines",
        "replay drives/ --out fleet",
        "compare last_week fleet --fail 'rmse>1.02x'",
    ),
    "params": Command(
        later("cli.params", "params"),
        options.params,
        "list the parameters with default, unit, bounds and meaning",
        "keyframes",
        "'odometry.*'",
    ),
    "warmup": Command(
        recordings.warmup,
        options.nothing,
        "compile the kernels, once per installation",
        "",
    ),
    "demo": Command(
        later("tools.demo", "demo"),
        options.demo,
        "replay the recording that comes with the source through a live ROS graph",
        "--force",
    ),
    "completion": Command(
        later("cli.completion", "completion"),
        options.completion,
        "print a script for shell completion: eval it in ~/.bashrc or ~/.zshrc",
        "bash",
    ),
}


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The whole command line; the arguments' ``run`` is the command's function.

    Parameters
    ----------
    command : the only command whose options are needed; None: all have theirs, which takes more imports
    """
    whole = CommandParser(
        prog="graph_slam",
        description="Online pose-graph SLAM: replay recordings, optimise graphs, simulate, evaluate.",
        examples=("graph_slam info drive.mcap", "graph_slam replay drive.mcap --out drive_run"),
    )
    whole.add_argument("--version", action="version", version=f"graph_slam_ros {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", parser_class=CommandParser)
    for name, row in COMMANDS.items():
        sub: CommandParser = commands.add_parser(
            name,
            help=row.about,
            description=f"{row.about[0].upper()}{row.about[1:]}.",
            examples=[f"graph_slam {name} {one}".rstrip() for one in row.examples],
        )
        sub.set_defaults(run=row.run)
        if command in (None, name):
            row.add_options(sub)
    return whole
