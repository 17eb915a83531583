"""The node as a robot has it: what it costs, how much it takes, and how soon it answers.

``python -m benchmarks.node [NAME ...]``, where ROS 2 is installed; without names everything, which takes an hour.
Publishers, subscribers and the node are processes of their own on this machine's loopback. CPU time is what the kernel
counts for a process, with the middleware's threads.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import options, table
from benchmarks.live import cities, drives, lifecycle, paths
from graph_slam_ros.warmup import warmup

FIGURES: dict[str, Callable[[bool], Sequence[table.Row]]] = {
    **drives.FIGURES,
    "path": paths.measure,
    **cities.FIGURES,
    "lifecycle": lifecycle.measure,
}


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FIGURES)} (default: all)")
    parser.add_argument("--short", action="store_true", help="a short look: seconds instead of minutes")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    args = parser.parse_args()
    for name in args.names:
        if name not in FIGURES:
            parser.error(f"{name} is none of {', '.join(FIGURES)}")
    warmup()  # so that nobody waits for compilers
    measured = []
    for name in args.names or FIGURES:
        options.say(f"{name}{', a short look' if args.short else ''}")
        measured.append(table.results(f"node-{name}", FIGURES[name](args.short), "a short look" if args.short else ""))
        print(f"{name}\n\n{table.markdown(measured[-1])}\n", flush=True)
        if args.json is not None:
            args.json.parent.mkdir(parents=True, exist_ok=True)
            args.json.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
