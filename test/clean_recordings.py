"""Recordings with nothing wrong, and what ``graph_slam check`` says of them: nothing above a note.

``PYTHONPATH=test python test/clean_recordings.py [--seeds N] [BAG ...]`` prints a line for each world and seed, and for
each recording that is given. Warnings of recorded robots may be true: docs/check.md has those of the public ones.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from graph_slam_ros.runs.check import check
from graph_slam_ros.simulation import simulate, write_bag

WORLDS = {
    "warehouse, tags": ("warehouse", {"aisles": 2}),
    "warehouse, range and bearing": ("warehouse", {"aisles": 2, "sensor": "range_bearing"}),
    "warehouse, bearings": ("warehouse", {"aisles": 2, "sensor": "bearing"}),
    "warehouse, positions, GNSS, IMU": ("warehouse", {"aisles": 2, "sensor": "position", "gnss": 5, "imu": 50}),
    "manhattan, positions": ("manhattan", {"poses": 300, "blocks": 10}),
    "manhattan, ranges": ("manhattan", {"poses": 300, "blocks": 10, "sensor": "range"}),
    "pythonrobotics": ("pythonrobotics", {}),
    "flight, tags in space": ("flight", {}),
}


def said(file):
    """Errors and warnings of a recording, and the time it took."""
    start_s = time.process_time()
    found = [one for one in check(file).findings if one.severity != "note"]
    return found, time.process_time() - start_s


def show(name, found, took_s):
    print(
        f"{'; '.join(f'[{f.severity}] {f.code}: {f.text}' for f in found) or 'nothing':60s} {name} {took_s:.1f} s",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG")
    parser.add_argument("--seeds", type=int, default=0, metavar="N", help="of each world")
    args = parser.parse_args()
    total, alarms = 0, Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.seeds):
            for name, (world, options) in WORLDS.items():
                file = Path(folder) / "world.mcap"
                write_bag(simulate(world, 100 + seed, **options), file)
                found, took_s = said(file)
                show(f"{name}, seed {100 + seed}", found, took_s)
                total, _ = total + 1, alarms.update(f.code for f in found)
    for bag in args.bags:
        show(bag.name, *said(bag))
    print(f"RELIABILITY clean_recordings tried={total} alarms={sum(alarms.values())} {dict(alarms)}", flush=True)
    return 1 if alarms else 0


if __name__ == "__main__":
    sys.exit(main())
