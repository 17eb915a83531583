"""The command line of ``graph_slam``: a table of the commands, and the parser that it makes."""

from collections.abc import Mapping, Sequence
from importlib import import_module

from graph_slam_ros import __version__
from graph_slam_ros.cli.arguments import CommandParser


class Command:
    """A command: where its code is, its purpose, and examples of its arguments.

    Parameters
    ----------
    code : ``module:name``: the module of the package, which is imported when the command is called, has the function
        ``name`` and, for its options, ``name_options``
    """

    def __init__(self, code: str, about: str, *examples: str) -> None:
        self._module, _, self._name = code.partition(":")
        self.about = about
        self.examples = examples

    def add_to(self, sub: CommandParser) -> None:
        """Add the options, and the function as ``run``."""
        module = import_module(f"graph_slam_ros.{self._module}")
        getattr(module, f"{self._name}_options")(sub)
        sub.set_defaults(run=getattr(module, self._name))


class Group:
    """Commands on one thing."""

    def __init__(self, about: str, commands: Mapping[str, Command]) -> None:
        self.about = about
        self.commands = commands
        self.examples = tuple(f"{name} {one.examples[0]}" for name, one in commands.items())


COMMANDS: dict[str, Command | Group] = {
    "info": Command(
        "cli.info:info", "show topics, types, rates, frames and span of a recording, and how to replay it", "drive.mcap"
    ),
    "check": Command(
        "cli.check:check",
        "find what is wrong with a recording, by how much, and the setting that mends it",
        "drive.mcap",
        "drive.mcap --set detections.offset_s=-0.096",
    ),
    "calibrate": Command(
        "cli.check:calibrate",
        "estimate odometry's scale, clocks and mounts from a recording, and print the settings",
        "drive.mcap",
        "drive.mcap --groups 'factors clock'",
    ),
    "replay": Command(
        "cli.replay:replay",
        "run a recording (mcap, db3, ROS 1) or an earlier run through the pipeline",
        "drive.mcap --out drive_run",
        "drive.mcap --out drive_run --force --set keyframes.min_distance_m=0.3",
    ),
    "recover": Command(
        "cli.replay:recover",
        "write the results of a run that was cut off, without repeating the drive",
        "runs/latest --out recovered",
    ),
    "evaluate": Command(
        "cli.evaluate:evaluate",
        "compute the errors of a run against the truth, test its covariances, draw a picture",
        "drive_run --truth drive.mcap:/ground_truth",
    ),
    "explain": Command(
        "cli.explain:explain",
        "show which measurements a run accepted or rejected and why, which matter, and what would be without some",
        "drive_run",
        "drive_run 142",
        "drive_run --influence 5",
        "drive_run --without 142 143",
    ),
    "report": Command(
        "tools.report.command:report",
        "write one HTML file on a run: map, edges with their reasons, charts and tables",
        "drive_run",
        "drive_run --truth drive.mcap:/ground_truth --out drive.html",
    ),
    "view": Command(
        "tools.view.command:view",
        "show the report in a browser, solve what-ifs at once, edit the map and save it as another run",
        "drive_run",
        "drive_run --port 8080 --no-browser",
    ),
    "advise": Command(
        "tools.advise.command:advise",
        "find the weakest directions of a run's map, and what to measure to make them better known",
        "drive_run",
        "drive_run --json",
    ),
    "map": Group(
        "compare, merge, edit, freeze or export the maps of runs",
        {
            "diff": Command(
                "cli.maps:diff",
                "compare the maps of two runs: keyframes, landmarks, verdicts, chi2",
                "monday_run tuesday_run",
            ),
            "merge": Command(
                "cli.maps:merge",
                "merge the maps of two runs, aligned by the landmarks that both have",
                "monday_run tuesday_run --out site",
            ),
            "edit": Command(
                "cli.maps:edit",
                "edit a run's map by hand with a plan: edges, closures, landmarks, where it lies",
                "drive_run --new-plan edits.json",
                "drive_run --plan edits.json --dry-run",
                "drive_run --plan edits.json --out drive_edited",
            ),
            "freeze": Command(
                "cli.maps:freeze",
                "write a run's map as a frozen one: it stays fixed when it is loaded for localization",
                "drive_run --out site",
            ),
            "export": Command(
                "cli.maps:export",
                "write a run's path as TUM, its graph as g2o, both as an mcap of ROS messages, or a picture of it",
                "drive_run --out path.tum",
                "drive_run --out drive.png --truth drive.mcap:/ground_truth",
                "drive_run --out drive.gif",
            ),
        },
    ),
    "optimize": Command(
        "cli.optimize:optimize",
        "solve a graph: g2o, TORO, iSAM or GTSAM text",
        "graph.g2o --out solved.g2o --plot graph.png",
    ),
    "simulate": Command(
        "tools.simulation.command:simulate",
        "simulate a recording with truth and, if asked, faults: pythonrobotics, manhattan, warehouse, flight",
        "warehouse --out world.mcap --seed 7",
    ),
    "fleet": Group(
        "replay many recordings at once, and compare two such fleets, on all cores or many machines",
        {
            "replay": Command(
                "tools.fleet.command:replay",
                "replay many recordings with one or more configurations; what is done is not done again",
                "drives/ --out fleet",
                "drives/ --out fleet --truth '{path}:/ground_truth' --set robust.noise_scale=configured,estimated",
            ),
            "compare": Command(
                "tools.fleet.command:compare",
                "compare two fleets recording by recording, and fail where the new one is worse",
                "last_week fleet",
                "last_week fleet --fail 'rmse>1.02x' --fail 'cpu>1.2x'",
            ),
        },
    ),
    "params": Command(
        "cli.installation:params",
        "list the parameters with default, unit, bounds and meaning",
        "keyframes",
        "'odometry.*'",
    ),
    "warmup": Command("cli.installation:warmup", "compile the kernels, once per installation", ""),
    "demo": Command(
        "tools.demo:demo", "replay the recording that comes with the source through a live ROS graph", "--force"
    ),
    "completion": Command(
        "cli.installation:completion", "print a script for shell completion: eval it in ~/.bashrc or ~/.zshrc", "bash"
    ),
}

_ELSEWHERE = {
    **{name: f"map {name}" for name in ("diff", "merge", "edit", "freeze", "export")},
    "plot": "map export RUN --out FILE.png",
    "solve": "explain RUN --without EDGE",
    "influence": "explain RUN --influence",
    "convert": "optimize GRAPH --out FILE.g2o",
}
"""Words that are no commands, and what does the same."""


def parser(words: Sequence[str] | None = None) -> CommandParser:
    """The whole command line; the arguments' ``run`` is the command's function.

    Parameters
    ----------
    words : the command line: only the command that it calls is imported and gets its options; None: all are
    """
    whole = CommandParser(
        prog="graph_slam",
        description="Online pose-graph SLAM: replay recordings, optimise graphs, simulate, evaluate.",
        examples=("graph_slam info drive.mcap", "graph_slam replay drive.mcap --out drive_run"),
    )
    whole.elsewhere = _ELSEWHERE
    whole.add_argument("--version", action="version", version=f"graph_slam_ros {__version__}")
    _add(whole, COMMANDS, None if words is None else [word for word in words if word[:1] != "-"])
    return whole


def _add(parent: CommandParser, rows: Mapping[str, Command | Group], called: Sequence[str] | None) -> None:
    commands = parent.add_subparsers(required=True, metavar="COMMAND", parser_class=CommandParser)
    for name, row in rows.items():
        sub: CommandParser = commands.add_parser(
            name,
            help=row.about,
            description=f"{row.about[0].upper()}{row.about[1:]}.",
            examples=[f"{parent.prog} {name} {one}".rstrip() for one in row.examples],
        )
        if called is not None and called[:1] != [name]:
            continue
        if isinstance(row, Group):
            _add(sub, row.commands, None if called is None else called[1:])
        else:
            row.add_to(sub)
