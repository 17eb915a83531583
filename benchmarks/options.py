"""What the programmes that race have in common: command lines, graphs, turns, and how costs are told."""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks import fresh, table
from benchmarks.contenders import Solved
from benchmarks.datasets import DATASETS
from benchmarks.problem import Problem, chain_problem, read_problem, sphere_problem
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.errors import GraphSlamError

_SLOW_S = 60.0  # who takes longer is not asked again
_SIMULATED = {"sphere": sphere_problem, "chain": chain_problem}
_OF_GTSAM = ("w10000.graph", "sphere_smallnoise.graph")
# The lowest cost that anybody has found, in our error map with the information matrices of the file.
_BEST_KNOWN = {
    "input_INTEL": 215.83,
    "intel_943": 546.461,
    "M3500": 137.913,
    "manhattanOlson3500": 146.077,
    "sphere2500": 1351.36,
    "parking-garage": 1.26838,
    "torus3D": 24234.71,
    "smallGrid3D": 1033.894,
    "tinyGrid3D": 18.61616,
    "ring": 11.1631,
    "victoria_park": 6184.12,
    "w10000": 289.7259,
}


def parser(about: str | None) -> argparse.ArgumentParser:
    """Options of a programme that races on graphs."""
    options = argparse.ArgumentParser(description=(about or "").splitlines()[0])
    about = "graphs; sphere and chain are simulated (default: all that are at hand, and the sphere)"
    options.add_argument("files", nargs="*", type=Path, metavar="FILE", help=about)
    options.add_argument("--poses", type=values.count, metavar="N", help="the first N poses of each graph only")
    table.add_write(options)
    return options


def add_repetitions(options: argparse.ArgumentParser) -> None:
    """How often."""
    options.add_argument("--reps", type=values.count, default=3, metavar="N", help="medians of so many are told (3)")


def add_peers(options: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """Whom to race against."""
    about = f"of {', '.join(names)} (default: all)"
    options.add_argument(
        "--peers", type=lambda text: chosen(text, names), default=names, metavar="NAME,...", help=about
    )


def chosen(text: str, known: Sequence[str]) -> list[str]:
    """Names in a list. Raises ArgumentTypeError."""
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"{name} is none of {', '.join(known)}")
    return names


def problems(args: argparse.Namespace) -> Iterator[Problem]:
    """The graphs asked for, one after the other; what cannot be raced is said and skipped."""
    for path in args.files or [*_usual_files(), Path("sphere")]:
        try:
            problem = _SIMULATED[path.name]() if path.name in _SIMULATED else read_problem(path)
        except GraphSlamError as error:
            say(f"skipped: {error}")
            continue
        if problem.left_out:
            say(f"{problem.name}: {problem.left_out} lines left out")
        yield problem.prefix(args.poses) if args.poses else problem


def _usual_files() -> list[Path]:
    """All public graphs at hand: those of the data folder, and two that come with GTSAM."""
    folder = DATASETS / "pose_graphs"
    found = sorted(path for path in folder.glob("*") if path.suffix in (".g2o", ".gz", ".txt", ".graph"))
    if not found:
        say(f"no graphs in {folder}: set GRAPH_SLAM_DATASETS; going on with those that come with GTSAM")
    gtsam = find_spec("gtsam")
    if gtsam is not None and gtsam.origin is not None:
        found += [Path(gtsam.origin).parent / "Data" / name for name in _OF_GTSAM]
    return found


def in_turn(names: Sequence[str], reps: int, solve: Callable[[str], Solved]) -> dict[str, list[Solved]]:
    """Answers of contenders that take turns, each in a fresh process; who is slow is asked once."""
    found: dict[str, list[Solved]] = {name: [] for name in names}
    for _ in range(reps):
        for name, answers in found.items():
            if not answers or answers[0].cpu_s < _SLOW_S:
                try:
                    answers.append(solve(name))
                except fresh.Crashed as error:
                    answers.append(Solved(fault=f"crashes: {error}"))
                say(f"{name}: {answers[-1].cpu_s:.3f} s")
    return found


def told(cpu_s: float, fault: str, cost: float | None) -> str:
    """CPU time, or why there is none; what was reached and is no optimum is said."""
    return fault if cost is None else ", ".join(filter(None, (f"{cpu_s:.3f}", fault)))


def of_best(problem: Problem, costs: Sequence[float | None]) -> list[str]:
    """Costs as multiples of the lowest that is known."""
    known = [cost for cost in costs if cost is not None]
    if problem.whole and problem.name in _BEST_KNOWN:
        known.append(_BEST_KNOWN[problem.name])
    return ["" if cost is None else f"{cost / min(known):.4f}" for cost in costs]


def say(text: str) -> None:
    """Progress, on standard error."""
    print(f"benchmarks: {text}", file=sys.stderr, flush=True)
