"""Recordings with nothing wrong, and what ``graph_slam check`` says of them: nothing above a note that is untrue.

``PYTHONPATH=test python test/clean_recordings.py [--seeds N] [--public] [BAG ...]`` prints a line for each world and
seed, each public recording at hand, and each recording that is given. Of the public ones, ``TRUE`` is what is right.
"""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

import public_recordings

from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import simulate, write_bag

WORLDS = {
    "warehouse, tags": ("warehouse", {"aisles": 2}),
    "warehouse, tags, 12 laps": ("warehouse", {"laps": 12}),
    "warehouse, range and bearing": ("warehouse", {"aisles": 2, "sensor": "range_bearing"}),
    "warehouse, bearings": ("warehouse", {"aisles": 2, "sensor": "bearing"}),
    "warehouse, positions, GNSS, IMU": ("warehouse", {"aisles": 2, "sensor": "position", "gnss": 5, "imu": 50}),
    "manhattan, positions": ("manhattan", {"poses": 300, "blocks": 10}),
    "manhattan, ranges": ("manhattan", {"poses": 300, "blocks": 10, "sensor": "range"}),
    "pythonrobotics": ("pythonrobotics", {}),
    "flight, tags in space": ("flight", {}),
}
TRUE = {  # docs/check.md says why
    "plaza2": {"range_scale"},
    "reference": {"odometry_in_map", "no_odometry"},
    "tag_detections": {"twist_frame", "no_landmarks"},
    "nav2_turtlebot": {"no_landmarks"},
    **{f"mrclam7_{robot}": {"clock_offset", "odometry_scale"} for robot in range(1, 6)},
}


def recordings(folder, args):
    """Name and file of each."""
    for seed in range(args.first, args.first + args.seeds):
        for name, (world, options) in WORLDS.items():
            write_bag(simulate(world, seed, **options), folder / "world.mcap")
            yield f"{name}, seed {seed}", folder / "world.mcap"
    for file in (*(public_recordings.recordings(folder) if args.public else ()), *args.bags):
        yield file.stem, file


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG")
    parser.add_argument("--seeds", type=int, default=0, metavar="N", help="of each world")
    parser.add_argument("--first", type=int, default=100, metavar="SEED", help="the first of them (default: 100)")
    parser.add_argument("--public", action="store_true", help="the public recordings of GRAPH_SLAM_DATASETS, too")
    args, total, alarms = parser.parse_args(), 0, Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name, file in recordings(Path(folder), args):
            found = [one for one in check(file).findings if one.severity != "note"]
            print(name, *(f"[{f.severity}] {f.code}: {f.text}" for f in found), flush=True)
            total, _ = total + 1, alarms.update(f.code for f in found if f.code not in TRUE.get(name, ()))
    print(f"RELIABILITY clean_recordings tried={total} untrue={sum(alarms.values())} {dict(alarms)}", flush=True)
    return 1 if alarms else 0


if __name__ == "__main__":
    sys.exit(main())
