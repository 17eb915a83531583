"""CPU time of a replay beside that of merely reading its recording: ``python -m benchmarks.replay [BAG ...]``.

Reading is what ``rosbags`` needs to open the recording and to deserialise all its messages, without its start. The
replay is the whole command, its start included. The two take turns, and their medians are compared. With ``--command``
another command is compared, e.g. ``check`` or ``calibrate``. Without a recording, robot 5 of MR.CLAM 7 is converted
first.
"""

import argparse
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import datasets, table
from benchmarks.fresh import ROOT, children_s
from graph_slam_ros.cli import arguments as values

_READ = """
import sys, time
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
store, began_s, count = get_typestore(Stores.ROS2_JAZZY), time.process_time(), 0
with AnyReader([Path(sys.argv[1])], default_typestore=store) as reader:
    for connection, _, data in reader.messages():
        reader.deserialize(data, connection.msgtype)
        count += 1
print(count, time.process_time() - began_s)
"""
_ROBOT = 5


def read(bag: Path) -> tuple[int, float]:
    """Return the number of messages in a recording, and the CPU time to read and deserialise them [s]."""
    done = subprocess.run([sys.executable, "-c", _READ, bag], check=True, capture_output=True, text=True)
    count, cpu_s = done.stdout.split()
    return int(count), float(cpu_s)


def commanded(words: list[str], **environment: str) -> tuple[float, float]:
    """Run a command of ``graph_slam``; return its CPU and wall time [s]. Raises SystemExit where it is refused."""
    before_s, since_s = children_s(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "graph_slam_ros.cli", *words],
        cwd=ROOT,
        env=os.environ | environment,
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode not in (0, 3, 4):  # 4: check or calibrate has found something
        raise SystemExit(f"graph_slam {shlex.join(words)}: exit code {done.returncode}\n{done.stderr}")
    return children_s() - before_s, time.perf_counter() - since_s


def times(bag: Path, command: str, options: list[str], reps: int) -> tuple[int, list[float], list[float]]:
    """Let the command and reading take turns; return the number of messages, and the CPU times of both [s]."""
    reading_s, command_s, count = list[float](), list[float](), 0
    with tempfile.TemporaryDirectory(prefix="replay-") as folder:
        out = ["--out", f"{folder}/run", "--force"] if command == "replay" else []
        commanded(["warmup"])
        for _ in range(reps):
            count, cpu_s = read(bag)
            reading_s.append(cpu_s)
            command_s.append(commanded([command, str(bag.resolve()), *out, *options])[0])
    return count, command_s, reading_s


def main() -> None:
    """Compare, and print a line for each recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG", help="recordings (default: MR.CLAM 7, robot 5)")
    parser.add_argument("--reps", type=values.count, default=3, metavar="N", help="repetitions (default: 3)")
    parser.add_argument("--command", default="replay", metavar="NAME", help="of graph_slam (default: replay)")
    parser.add_argument("--options", default="", metavar="TEXT", help="more options of the command, in one word")
    table.add_write(parser)
    args = parser.parse_args()
    rows = list[table.Row]()
    with tempfile.TemporaryDirectory(prefix="recording-") as folder:
        for bag in args.bags or [datasets.mrclam(_ROBOT, Path(folder) / f"mrclam7_{_ROBOT}")]:
            count, command_s, reading_s = times(bag, args.command, shlex.split(args.options), args.reps)
            reading, whole = statistics.median(reading_s), statistics.median(command_s)
            rows.append(
                {
                    "recording": bag.stem.replace("mrclam7_", "MR.CLAM 7, robot "),
                    "graph_slam": args.command,
                    "messages": count,
                    "CPU (s)": whole,
                    "of reading": f"{whole / reading:.1f}",
                }
            )
    table.finish("replay", rows, write=args.write, keys=2)


if __name__ == "__main__":
    main()
