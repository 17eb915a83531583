"""What the programmes' command lines have in common, and where the graphs come from."""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks.fresh import ROOT
from benchmarks.problem import Problem, read_problem, sphere_problem
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.errors import GraphSlamError

PATIENCE_S = 600.0
SLOW_S = 60.0  # who takes longer is not asked again
_SPHERE = Path("sphere")  # no file: simulated
_OF_GTSAM = ("w10000.graph", "sphere_smallnoise.graph")


def parser(about: str | None, peers: Sequence[str], usual: Sequence[str]) -> argparse.ArgumentParser:
    """Options of a programme that races ours against peers."""
    options = argparse.ArgumentParser(description=(about or "").splitlines()[0])
    options.add_argument(
        "--peers",
        type=lambda text: _names(text, peers),
        default=list(usual),
        metavar="NAME,...",
        help=f"of {', '.join(peers)} (default: {','.join(usual)})",
    )
    options.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    return options


def _names(text: str, known: Sequence[str]) -> list[str]:
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"{name} is none of {', '.join(known)}")
    return names


def add_files(options: argparse.ArgumentParser) -> None:
    """Graphs to race on, and how often."""
    about = "graphs, or sphere: simulated, with 0.1 rad of noise (default: all that are at hand)"
    options.add_argument("files", nargs="*", type=Path, metavar="FILE", help=about)
    options.add_argument(
        "--reps", type=values.count, default=3, metavar="N", help="repetitions; their medians are told"
    )
    options.add_argument("--poses", type=values.count, metavar="N", help="the first N poses of each graph only")


def add_patience(options: argparse.ArgumentParser) -> None:
    """When to call a drive off."""
    options.add_argument(
        "--patience", type=values.positive, default=PATIENCE_S, metavar="S", help="CPU seconds for a drive"
    )


def problems(args: argparse.Namespace) -> Iterator[Problem]:
    """The graphs asked for, one after the other; what cannot be raced is said and skipped."""
    for path in args.files or [*usual_files(), _SPHERE]:
        try:
            problem = sphere_problem() if path == _SPHERE else read_problem(path)
        except GraphSlamError as error:
            say(f"skipped: {error}")
            continue
        if problem.left_out:
            say(f"{problem.name}: {problem.left_out} lines left out")
        yield problem.prefix(args.poses) if args.poses else problem


def usual_files() -> list[Path]:
    """All public graphs at hand: those of the data folder, and two that come with GTSAM."""
    folder = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT.parent / "shared/datasets")) / "pose_graphs"
    found = sorted(path for path in folder.glob("*") if path.suffix in (".g2o", ".gz", ".txt", ".graph"))
    if not found:
        say(f"no graphs in {folder}: set GRAPH_SLAM_DATASETS; going on with those that come with GTSAM")
    gtsam = find_spec("gtsam")
    if gtsam is not None and gtsam.origin is not None:
        found += [Path(gtsam.origin).parent / "Data" / name for name in _OF_GTSAM]
    return found


def say(text: str) -> None:
    """Progress, on standard error."""
    print(f"benchmarks: {text}", file=sys.stderr, flush=True)
