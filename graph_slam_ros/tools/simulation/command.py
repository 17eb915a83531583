"""The command ``simulate``: worlds as recordings or graphs, and faults in them, or in the graph of a file."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError, did_you_mean, similar_file

if TYPE_CHECKING:
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.tools.simulation import Fault, Recording


def simulate(args: argparse.Namespace) -> int:
    """Record a synthetic world, or write it as a graph; put faults into it."""
    from graph_slam_ros.formats.strict import ending
    from graph_slam_ros.tools.simulation import GRAPH_WORLDS, WORLDS, Fault

    is_world = args.scenario in (*WORLDS, *GRAPH_WORLDS)
    faults = [Fault.parsed(text) for text in args.fault]
    as_graph = ending(args.out) == ".g2o"
    if as_graph and (wrong := [fault.kind for fault in faults if fault.is_of_messages]):
        raise GraphSlamError(f"{wrong[0]}: a graph has no messages: --out FILE.mcap")
    if not is_world and _is_recording(Path(args.scenario)) and not as_graph:
        return _spoil_recording(args, faults)
    if not is_world and not Path(args.scenario).exists():
        there = [*WORLDS, *GRAPH_WORLDS]
        near = did_you_mean(args.scenario, there) or similar_file(Path(args.scenario))
        raise GraphSlamError(f"no world {args.scenario!r}; there are {', '.join(there)}, and no such file{near}")
    of_file = not is_world and Path(args.scenario).is_file()
    if (of_file or args.scenario in GRAPH_WORLDS) and not as_graph:
        raise GraphSlamError(f"{args.out}: {args.scenario} is a graph: --out FILE.g2o")
    companions = [".faults.csv"] * bool(faults) + [".truth.tum"] * (as_graph and not of_file)
    written, source = [_companion(args.out, ending) for ending in companions], Path(args.scenario) if of_file else None
    console.check_file(args.out, *written, force=args.force, source=source)
    if of_file:
        return _spoil(args, faults)
    try:
        if as_graph:
            _write_graph(args, faults)
        else:
            _write_bag(args, faults)
    except OSError as error:
        raise GraphSlamError(f"{args.out}: {error.strerror}") from None
    console.then(console.command("optimize" if as_graph else "info", args.out))
    return console.DONE


def _write_bag(args: argparse.Namespace, faults: "list[Fault]") -> None:
    from graph_slam_ros.tools.simulation import WrongMessage, write_faulty_bag, write_table

    wrong = write_faulty_bag(_recorded(args), args.out, faults, args.seed)
    console.show(f"wrote {args.out}")
    if faults:
        write_table(_companion(args.out, ".faults.csv"), WrongMessage, wrong)
        console.show(f"wrote {_companion(args.out, '.faults.csv')}: {len(wrong)} measurements are wrong")


def _is_recording(path: Path) -> bool:
    return path.is_dir() or (path.is_file() and path.suffix in (".mcap", ".db3", ".bag"))


def _spoil_recording(args: argparse.Namespace, faults: "list[Fault]") -> int:
    """A recording of the user with faults in its messages."""
    from graph_slam_ros.tools.simulation import spoil_bag

    for what, given in (("--set", args.set), ("--closures", args.closures), ("--poses", args.poses)):
        if given:
            raise GraphSlamError(f"{args.scenario}: no use for {what}: it is no world")
    for fault in faults:
        if not fault.is_of_messages:
            raise GraphSlamError(f"{fault.kind}: needs the truth of a world, which {args.scenario} is not")
    if not faults:
        raise GraphSlamError(f"{args.scenario}: no --fault, so nothing to do")
    console.check_file(args.out, force=args.force, source=Path(args.scenario))
    spoil_bag(Path(args.scenario), args.out, faults, args.seed)
    console.show(f"wrote {args.out}")
    console.then(console.command("check", args.out))
    return console.DONE


def _write_graph(args: argparse.Namespace, faults: "list[Fault]") -> None:
    from graph_slam_ros.formats.graph_file import G2oFile
    from graph_slam_ros.formats.tum import write_trajectory
    from graph_slam_ros.tools.simulation import GRAPH_WORLDS, landmark_graph, options_of
    from graph_slam_ros.tools.simulation.pose_graph import truth_of, values_of

    if world := GRAPH_WORLDS.get(args.scenario):
        if args.closures is not None:
            more = ": --set closures=N" if any(o.name == "closures" for o in options_of(world.options)) else ""
            raise GraphSlamError(f"{args.scenario}: no use for --closures: it has them{more}")
        graph, poses = world.measure(args.seed, **_options(args))
        truth = poses.ravel()
        if "closures" not in graph.labels:
            console.show(f"{args.scenario}: with {len(poses)} poses nothing is closed: a larger --poses")
    else:
        recording = _recorded(args)
        if recording.gnss or recording.imu:
            raise GraphSlamError(f"{args.out}: a graph has no use for gnss or imu: --out FILE.mcap")
        graph = landmark_graph(recording)
        truth = truth_of(recording, graph)
    file = G2oFile(graph, list(range(graph.vertex_count)), [0])
    _write_faulty(args, file, truth, faults)
    path = _companion(args.out, ".truth.tum")
    write_trajectory(path, file, values_of(graph, truth))
    console.show(f"wrote {path}: the true poses")


def _spoil(args: argparse.Namespace, faults: "list[Fault]") -> int:
    """The graph of a file with faults. Its optimum is taken as the truth."""
    from graph_slam_ros.formats.g2o import read_g2o
    from graph_slam_ros.optimization import optimize

    source = Path(args.scenario)
    for what, given in (("--set", args.set), ("--closures", args.closures), ("--poses", args.poses)):
        if given:
            raise GraphSlamError(f"{source}: no use for {what}: it is no world")
    file = read_g2o(source)
    solver = optimize(file).solver
    truth = np.concatenate([solver.estimate([v])[0] for v in range(file.graph.vertex_count)])
    _write_faulty(args, file, truth, faults)
    console.then(console.command("optimize", args.out))
    return console.DONE


def _write_faulty(args: argparse.Namespace, file: "G2oFile", truth: Any, faults: "list[Fault]") -> None:
    from graph_slam_ros.formats.g2o_writer import write_g2o
    from graph_slam_ros.tools.simulation import WrongLine, faulty_graph, write_table
    from graph_slam_ros.tools.simulation.pose_graph import values_of

    out, wrong = faulty_graph(file, truth, faults, args.seed)
    write_g2o(args.out, out, values_of(out.graph, out.graph.initial.values))
    console.show(f"wrote {args.out}")
    if faults:
        write_table(_companion(args.out, ".faults.csv"), WrongLine, wrong)
        console.show(f"wrote {_companion(args.out, '.faults.csv')}: {len(wrong)} edges are wrong")


def _recorded(args: argparse.Namespace) -> "Recording":
    from graph_slam_ros.tools.simulation import simulate as recorded
    from graph_slam_ros.tools.simulation import with_closures

    recording = recorded(args.scenario, args.seed, **_options(args))
    return recording if args.closures is None else with_closures(recording, args.closures, args.seed)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    from graph_slam_ros.formats.parameters import parse_setting

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
    from graph_slam_ros.tools.simulation import GRAPH_WORLDS, WORLDS, Instruments
    from graph_slam_ros.tools.simulation.faults import KINDS
    from graph_slam_ros.tools.simulation.message_faults import MESSAGE_KINDS
    from graph_slam_ros.tools.simulation.options import options_of

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
    for name, graph_world in GRAPH_WORLDS.items():
        lines += [f"  {name}, a graph: {graph_world.about}", *option_lines(graph_world.options)]
    lines += ["", "faults for --fault with their options; OUT.faults.csv lists what is wrong:"]
    for name, kind in KINDS.items():
        lines += [f"  {name}: {kind.about}", *option_lines(kind.options)]
    lines += ["", "faults of drivers, clocks and frames, in a world or in a recording of yours:"]
    for name, of_messages in MESSAGE_KINDS.items():
        lines += [f"  {name}: {of_messages.about}", *option_lines(of_messages.options)]
    lines += ["", "example: graph_slam simulate warehouse --out world.mcap --set gnss=5 --set imu=100"]
    return "\n".join(lines)
