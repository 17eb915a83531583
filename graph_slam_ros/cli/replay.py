"""The commands ``replay`` and ``recover``: recordings through the pipeline, and runs that were cut off."""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.evaluate import draw, suggest_next
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.slam import Config


def replay_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``replay``."""
    arguments.add_inputs(sub, "file or folder of a recording, or a run folder")
    arguments.add_out(sub, required=False)  # not with --ros and --node
    about = "continue in the map of a run, frozen or not, with its parameters"
    sub.add_argument("--map", type=Path, metavar="RUN", help=about)
    sub.add_argument("--ros", action="store_true", help="publish into a live ROS graph: a node of its own with --out")
    about = "with --ros: multiple of real time (default: as fast as possible)"
    sub.add_argument("--rate", type=arguments.positive, metavar="X", help=about)
    sub.add_argument("--node", metavar="NAME", help="with --ros and without --out: name of the running node")


def replay(args: argparse.Namespace) -> int:
    """Run a recording, or an earlier run, through the pipeline, or play it into a live ROS graph."""
    from graph_slam_ros.runs.folder import is_run
    from graph_slam_ros.runs.replay import replay as replayed
    from graph_slam_ros.runs.suggestion import unused_topics
    from graph_slam_ros.slam import Config

    _refuse_idle_options(args, is_run(args.bag))
    config = config_of(args) if is_run(args.bag) else _with_suggestion(args, config_of(args))
    if args.ros:
        return _replay_live(args, config)
    if args.out is None:
        raise GraphSlamError("replay needs --out DIR, the folder for the results")
    own = config if args.config or args.set or not is_run(args.bag) else None
    topics = {"odometry": args.odom, "landmarks": args.landmarks, "map_folder": args.map}
    shown = {"progress": console.progress("replay"), "warn": lambda text: console.warn(text, most=console.SENTENCE)}
    done = replayed(args.bag, args.out, own, **topics, force=args.force, **shown)
    code = console.DONE
    for folder, summary in done.earlier:
        code = max(code, _print_outcome(summary))
        console.show(f"odometry went back in time, and time.on_jump is reset: the run until then is in {folder}")
        draw(folder)
    code = max(code, _print_summary(args.bag, done.summary))
    are_chosen = not done.topics or config.inputs.names != Config().inputs.names
    if unused := [] if are_chosen else unused_topics(args.bag, done.topics):
        console.show(f"not used   {', '.join(unused)}: {console.command('info', args.bag)} prints the command")
    console.show(f"results in {args.out}")
    draw(args.out)
    code = console.report_losses(done.losses, done.warnings) or code
    said = not code and not done.summary.get("check", {}).get("settings", True)  # check would say no more
    same = [word for text in args.set for word in ("--set", text)] + ["--config", str(args.config)] * bool(args.config)
    suggest_next(args.out, None if is_run(args.bag) or said or not (code or done.warnings) else args.bag, *same)
    return code


def _with_suggestion(args: argparse.Namespace, config: "Config") -> "Config":
    """The configuration, with inputs that ``info`` suggests where a recording has no usual odometry or landmarks."""
    from graph_slam_ros.runs.suggestion import suggestion_for_other_types

    if args.config or args.landmarks or args.map or (args.ros and args.out is None):
        return config
    if (found := suggestion_for_other_types(args.bag, config, args.odom)) is None:
        return config
    args.odom, args.landmarks = args.odom or found.topics.get("odom"), found.topics.get("detections")
    what = "is no odometry" if "odom.type" in found.settings else "are no landmarks"
    console.warn(f"there {what} of the usual type, so this is: {found.command()}", most=console.SENTENCE)
    return config_of(args, found.settings)


def _replay_live(args: argparse.Namespace, config: "Config") -> int:
    from graph_slam_ros.formats.files import read_text
    from graph_slam_ros.overview.chosen_inputs import choose_inputs
    from graph_slam_ros.recordings.bag import open_bag

    if not console.has_ros():
        raise GraphSlamError("--ros needs ROS 2 (no rclpy here); without --ros the same replay runs without it")
    bag, code = open_bag(args.bag), console.DONE
    from graph_slam_ros.node.player import config_of as live_config
    from graph_slam_ros.node.player import own_node, play
    from graph_slam_ros.runs.folder import SUMMARY, check_room

    node_name = args.node or "/graph_slam"
    config = live_config(node_name) if args.out is None else config
    inputs = choose_inputs(bag, config, args.odom, args.landmarks)
    options: dict[str, Any] = {"config": config, "rate": args.rate, "progress": console.progress("play")}
    if args.out is None:
        played = play(bag, inputs, node_name=node_name, **options)
    else:
        check_room(args.out, args.bag, force=args.force)
        with own_node(args.out, inputs, config) as own:
            played = play(bag, inputs, own=own, **options)
        summary = json.loads(read_text(args.out / SUMMARY))
        asked = {name: counts for name, counts in summary["inputs"].items() if name in inputs.topics}
        code = _print_summary(args.bag, summary | {"inputs": asked})
        draw(args.out)
    console.show(f"{played.sent} messages sent, {played.lost} lost; results in {played.saved}")
    losses = bag.losses + ([f"{played.lost} messages did not arrive"] if played.lost else [])
    code = console.report_losses(losses, bag.warnings) or code
    suggest_next(Path(played.saved), args.bag if code else None)
    return code


def recover_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``recover``."""
    arguments.add_run(sub)
    arguments.add_out(sub, required=False, default="RUN itself")


def recover(args: argparse.Namespace) -> int:
    """Write the results of a run that never ended, or that ended before everything was processed."""
    from graph_slam_ros.runs.restore import complete
    from graph_slam_ros.runs.restore import recover as recovered

    summary = recovered(args.run_folder, args.out, force=args.force) if args.out else complete(args.run_folder)
    code = _print_summary(args.run_folder, summary)
    console.show(f"results in {args.out or args.run_folder}")
    code = console.report_losses(summary["losses"]) or code
    suggest_next(args.out or args.run_folder)
    return code


def _refuse_idle_options(args: argparse.Namespace, of_run: bool) -> None:
    """Refuse an option that would have no effect, because it is a mistake of the user."""
    idle = {
        "--odom or --landmarks: a run knows its own inputs": of_run and (args.odom or args.landmarks),
        "--ros: the events of a run cannot be played, only its recording": of_run and args.ros,
        "--map: a run is repeated in the map that it began in": of_run and args.map,
        "--map with --ros: the node loads a map by output.load": args.map and args.ros,
        "--rate without --ros": args.rate and not args.ros,
        "--node without --ros, or with --out": args.node and (args.out or not args.ros),
        "--config or --set with --ros and no --out: the running node has its own": args.ros
        and not args.out
        and (args.config or args.set),
    }
    for what, given in idle.items():
        if given:
            raise GraphSlamError(f"replay: no use for {what}")


def config_of(args: argparse.Namespace, suggested: Mapping[str, Any] | None = None) -> "Config":
    """The configuration: defaults, then what is suggested, the run's own or the given file, then single settings."""
    from graph_slam_ros.config.config import flatten
    from graph_slam_ros.formats.parameters import parse_setting, read_parameters
    from graph_slam_ros.runs.folder import is_run
    from graph_slam_ros.slam import Config

    run = getattr(args, "map", None) or (args.bag if is_run(args.bag) else None)
    if run is not None and not is_run(run):
        raise GraphSlamError(f"--map: {run} is not a run folder")
    file = args.config or (run / "config.yaml" if run is not None else None)
    values = dict(flatten(read_parameters(file, follow=file == args.config))) if file else {}
    try:
        asked = dict(parse_setting(text) for text in args.set)
        return Config.from_mapping(dict(suggested or {}) | values | asked)
    except GraphSlamError as error:
        raise GraphSlamError(f"{file}: {error}" if file and not args.set else str(error)) from None


def _print_summary(source: Path, summary: dict[str, Any]) -> int:
    """Print the outcome of a run; returns the exit code. Raises GraphSlamError where there is no keyframe."""
    code = _print_outcome(summary)
    if not summary["keyframes"]:
        why = f": {summary['losses'][0]}" if summary.get("losses") else ", see what was counted; graph_slam check BAG"
        raise GraphSlamError(f"{source}: no odometry of it could be used{why}")
    return code


def _print_outcome(summary: dict[str, Any]) -> int:
    """Print the outcome of a run; returns the exit code, 3 if the result is incomplete."""
    from graph_slam_ros.runs import outcome

    shortcomings = list(outcome.shortcomings(summary)) if summary["keyframes"] else []
    for sentence in shortcomings:
        console.warn(sentence, most=console.SENTENCE)
    console.show(*outcome.text(summary))
    return console.LOSSES if shortcomings else console.DONE
