"""The command ``simulate``: worlds as recordings or graphs, and faults in them, in a recording or in a graph."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError, did_you_mean, similar_file
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.formats.strict import ending
from graph_slam_ros.formats.tum import write_trajectory
from graph_slam_ros.optimization import optimize
from graph_slam_ros.tools import simulation
from graph_slam_ros.tools.simulation import GRAPH_WORLDS, WORLDS, Fault, WrongLine, WrongMessage
from graph_slam_ros.tools.simulation.options import lines_about


def simulate_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``simulate``."""
    sub.more = options_of_worlds
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


def simulate(args: argparse.Namespace) -> int:
    """Record a synthetic world, or write it as a graph; put faults into it."""
    source, is_world = Path(args.scenario), args.scenario in (*WORLDS, *GRAPH_WORLDS)
    faults = [Fault.parsed(text) for text in args.fault]
    as_graph = ending(args.out) == ".g2o"
    is_recording = not is_world and (source.is_dir() or source.suffix in (".mcap", ".db3", ".bag"))
    if not is_world and not source.exists():
        there = [*WORLDS, *GRAPH_WORLDS]
        near = did_you_mean(args.scenario, there) or similar_file(source)
        raise GraphSlamError(f"no world {args.scenario!r}; there are {', '.join(there)}, and no such file{near}")
    for what in ("set", "closures", "poses"):
        if not is_world and getattr(args, what):
            raise GraphSlamError(f"{source}: no use for --{what}: it is no world")
    is_graph = args.scenario in GRAPH_WORLDS or not (is_world or is_recording)
    if is_graph != as_graph:
        fitting = "a graph: --out FILE.g2o" if is_graph else "a recording: --out FILE.mcap"
        raise GraphSlamError(f"{args.out}: {args.scenario} is {fitting}")
    table, truth = _companion(args.out, ".faults.csv"), _companion(args.out, ".truth.tum")
    companions = [table] * (bool(faults) and not is_recording) + [truth] * (is_graph and is_world)
    console.check_file(args.out, *companions, force=args.force, source=None if is_world else source)
    try:
        if is_recording:
            _spoil_recording(args, faults)
        elif is_graph:
            _write_graph(args, faults, truth)
        else:
            _write_bag(args, faults)
    except OSError as error:
        raise GraphSlamError(f"{args.out}: {error.strerror}") from None
    console.then(console.command("optimize" if is_graph else "check" if is_recording else "info", args.out))
    return console.DONE


def _spoil_recording(args: argparse.Namespace, faults: list[Fault]) -> None:
    for fault in faults:
        if not fault.is_of_messages:
            raise GraphSlamError(f"{fault.kind}: needs the truth of a world, which {args.scenario} is not")
    if not faults:
        raise GraphSlamError(f"{args.scenario}: no --fault, so nothing to do")
    simulation.spoil_bag(Path(args.scenario), args.out, faults, args.seed)
    console.show(f"wrote {args.out}")


def _write_bag(args: argparse.Namespace, faults: list[Fault]) -> None:
    recording = simulation.simulate(args.scenario, args.seed, **_options(args))
    if args.closures is not None:
        recording = simulation.with_closures(recording, args.closures, args.seed)
    wrong = simulation.write_faulty_bag(recording, args.out, faults, args.seed)
    console.show(f"wrote {args.out}")
    if faults:
        whole = ", ".join(fault.kind for fault in faults if fault.is_of_messages)
        _write_table(args.out, WrongMessage, wrong, "measurements", f"; of whole topics: {whole}" if whole else "")


def _write_graph(args: argparse.Namespace, faults: list[Fault], truth_file: Path) -> None:
    """The graph of a world, or of a file, whose optimum is taken as the truth, with faults."""
    world = GRAPH_WORLDS.get(args.scenario)
    if world:
        if args.closures is not None:
            raise GraphSlamError(f"{args.scenario}: no use for --closures: it has them")
        graph, poses = world(args.seed, **_options(args))
        file, truth = G2oFile(graph, list(range(graph.vertex_count)), [0]), poses.ravel()
        if "closures" not in graph.labels:
            console.show(f"{args.scenario}: with {len(poses)} poses nothing is closed: a larger --poses")
    else:
        file = read_g2o(Path(args.scenario))
        solver = optimize(file).solver
        truth = solver.values
    out, wrong = simulation.faulty_graph(file, truth, faults, args.seed) if faults else (file, [])
    write_g2o(args.out, out)
    console.show(f"wrote {args.out}")
    if faults:
        _write_table(args.out, WrongLine, wrong, "edges")
    if world:
        write_trajectory(truth_file, file, lambda vertices: poses[vertices])
        console.show(f"wrote {truth_file}: the true poses")


def _write_table(out: Path, of: type, wrong: list[Any], what: str, more: str = "") -> None:
    simulation.write_table(_companion(out, ".faults.csv"), of, wrong)
    console.show(f"wrote {_companion(out, '.faults.csv')}: {len(wrong)} {what} are wrong{more}")


def _options(args: argparse.Namespace) -> dict[str, Any]:
    options = dict(parse_setting(text) for text in args.set)
    if "seed" in options:
        raise GraphSlamError("--set seed: no option of a world; --seed N")
    if args.poses is not None:
        options["poses"] = args.poses
    return options


def _companion(out: Path, ending: str) -> Path:
    """The name of the table of faults: ``world.mcap`` and ``world.g2o.gz`` have ``world.faults.csv``."""
    whole = out.with_suffix("") if out.suffix.lower() == ".gz" else out
    return whole.with_suffix(ending)


def options_of_worlds() -> str:
    """Every option of the worlds and every kind of fault, with defaults."""
    parts: dict[str, dict[str, Callable[..., Any]]] = {
        "options of the worlds, for --set:": {**WORLDS, "every world": simulation.with_instruments}
        | {f"{name}, a graph": world for name, world in GRAPH_WORLDS.items()},
        "faults for --fault with their options; OUT.faults.csv lists what is wrong:": simulation.KINDS,
        "faults of drivers, clocks and frames, in a world or in a recording of yours:": simulation.MESSAGE_KINDS,
    }
    lines = []
    for title, of in parts.items():
        lines += [title, *(line for name, what in of.items() for line in lines_about(name, what)), ""]
    return "\n".join([*lines, "example: graph_slam simulate warehouse --out world.mcap --set gnss=5 --set imu=100"])
