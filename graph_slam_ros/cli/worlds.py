"""The command ``simulate``: worlds as recordings or as graphs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError

if TYPE_CHECKING:
    from graph_slam_ros.simulation import Recording

CITY = "city"  # a world that is a graph from the first


def simulate(args: argparse.Namespace) -> int:
    """Record a synthetic world, or write it as a graph."""
    from graph_slam_ros.formats.strict import ending

    as_graph = ending(args.out) == ".g2o"
    if args.scenario == CITY and not as_graph:
        raise GraphSlamError(f"{args.out}: {CITY} is a graph: --out FILE.g2o")
    try:
        if as_graph:
            _write_graph(args)
        else:
            _write_bag(args)
    except OSError as error:
        raise GraphSlamError(f"{args.out}: {error.strerror}") from None
    return console.DONE


def _write_bag(args: argparse.Namespace) -> None:
    from graph_slam_ros.simulation import write_bag

    write_bag(_recorded(args), args.out)
    console.say(f"wrote {args.out}")


def _write_graph(args: argparse.Namespace) -> None:
    from graph_slam_ros.formats.convert import write_graph
    from graph_slam_ros.formats.g2o_writer import write_g2o
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.simulation import city_graph, landmark_graph
    from graph_slam_ros.simulation.pose_graph import truth_of, values_of

    if args.scenario == CITY:
        if args.closures is not None:
            raise GraphSlamError("city: no use for --closures: it has them")
        graph, poses = city_graph(args.seed, **_options(args))
        truth = poses.ravel()
    else:
        recording = _recorded(args)
        graph = landmark_graph(recording)
        truth = truth_of(recording, graph)
    file = G2oFile(graph, list(range(graph.vertex_count)), [0])
    write_g2o(args.out, file, values_of(graph, graph.initial.values))
    console.say(f"wrote {args.out}")
    path = _beside(args.out, ".truth.tum")
    write_graph(path, file, values_of(graph, truth), "tum")
    console.say(f"wrote {path}: the true poses")


def _recorded(args: argparse.Namespace) -> "Recording":
    from graph_slam_ros.simulation import simulate as recorded
    from graph_slam_ros.simulation import with_closures

    recording = recorded(args.scenario, args.seed, **_options(args))
    return recording if args.closures is None else with_closures(recording, args.closures, args.seed)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    from graph_slam_ros.formats.parameters import parse_setting

    options = dict(parse_setting(text) for text in args.set)
    if "seed" in options:
        raise GraphSlamError("--set seed: no option of a world; --seed N")
    if args.as_original:
        options["as_original"] = True
    if args.poses is not None:
        options["poses"] = args.poses
    return options


def _beside(out: Path, ending: str) -> Path:
    """``world.mcap`` and ``world.g2o.gz`` have a ``world.truth.tum``."""
    whole = out.with_suffix("") if out.suffix.lower() == ".gz" else out
    return whole.with_suffix(ending)
