"""The node as a robot has it: what it costs, how much it takes, and how soon it answers.

``python -m benchmarks.node [NAME ...]``, where ROS 2 is installed; without names everything, which takes an hour.
Publishers, subscribers and the node are processes of their own on this machine's loopback. CPU time is what the kernel
counts for a process, with the middleware's threads.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import options, table
from benchmarks.live.processes import HELPERS, Process, listener, node, percentile, running, sender
from benchmarks.live.streams import (
    AFTER_NS,
    BEFORE_NS,
    CITY_SIGMA_M,
    CITY_SIGMA_RAD,
    CLOSURES,
    LANDMARKS,
    ODOMETRY,
)
from benchmarks.table import Row
from graph_slam_ros.warmup import warmup

_OUTPUTS = ("path", "pose", "odometry", "tf")
_WARM_S = 5.0
_TRANSITIONS = ("configure", "activate", "deactivate", "cleanup")
_CITY = {  # a keyframe for each pose, and the noise that the world has
    "inputs.names": "odom closings",
    "inputs.reliable": True,
    "closings.type": "vision_msgs/msg/Detection3DArray",
    "closings.topic": CLOSURES,
    "closings.use": "closure",
    "keyframes.min_distance_m": 0.8,
    "odometry.noise": "density",
    "odometry.translation_density": CITY_SIGMA_M,
    "odometry.lateral_density": CITY_SIGMA_M,
    "odometry.rotation_density": CITY_SIGMA_RAD,
}


def cpu(short: bool) -> list[Row]:
    """CPU time with odometry at 100 Hz and landmarks at 10 Hz, against a bare node that subscribes to the same."""
    seconds, reps = (5.0, 1) if short else (30.0, 3)
    spent: dict[str, list[float]] = {"the node": [], "a bare node": []}
    for _ in range(reps):
        for who in spent:
            spent[who].append(_cpu_of(who, seconds))
            options.say(f"cpu: {who} {100.0 * spent[who][-1]:.1f} % of a core")
    shares = {who: median(values) for who, values in spent.items()}
    return [
        {
            "who": who,
            "% of a core": 100.0 * shares[who],
            "ratio": shares[who] / shares["a bare node"],
            "runs": ", ".join(f"{100.0 * value:.1f}" for value in spent[who]),
        }
        for who in spent
    ]


def _cpu_of(who: str, seconds: float) -> float:
    robot = sender("warehouse", seconds=seconds + 2 * _WARM_S, odometry_hz=100, landmarks_hz=10)
    if who == "a bare node":
        bare = Process(HELPERS, "bare", ODOMETRY, LANDMARKS)
        with running(robot, bare):
            return _spent(bare, robot, seconds)
    with node({}, robot, listener(*_OUTPUTS)) as ours:
        return _spent(ours, robot, seconds)


def _spent(who: Process, robot: Process, seconds: float) -> float:
    """CPU seconds per second."""
    robot.answer()
    robot.ask(seconds=_WARM_S)
    begin, start = who.cpu_s, time.monotonic()
    robot.ask(seconds=seconds)
    return (who.cpu_s - begin) / (time.monotonic() - start)


def rate(short: bool) -> list[Row]:
    """Odometry at 1 kHz; late is from its sending to the arrival of the node's own of that stamp."""
    seconds = 5.0 if short else 60.0
    robot, ears = sender("warehouse", seconds=seconds, odometry_hz=1000, landmarks_hz=10), listener("odometry")
    with node({}, robot, ears) as ours:
        robot.answer()
        begin = ours.cpu_s
        told = robot.ask(seconds=seconds, tell=True)
        cpu_s = ours.cpu_s - begin
        received = robot.ask()
        sent_at = {stamp: at for topic, stamp, at in told["when"] if topic == ODOMETRY}
        late = [1e-6 * (at - sent_at[stamp]) for at, stamp in ears.ask()["odometry"] if stamp in sent_at]
    return [
        {
            "sent": told["sent"],
            "received": received,
            "% of a core": 100.0 * cpu_s / told["took_s"],
            "~/odometry": len(late),
            "late, median ms": percentile(late, 0.5),
            "p99 ms": percentile(late, 0.99),
            "max ms": percentile(late, 1.0),
        }
    ]


def latency(short: bool) -> list[Row]:
    """From the odometry that releases a closure to the corrected pose, while a city becomes large."""
    sizes, measured = ((300, 600), 100) if short else ((3_500, 20_000), 900)
    robot = sender("city", ODOMETRY, CLOSURES, poses=sizes[-1] + measured + 1)
    ears, rows, driven = listener("pose"), list[Row](), 0
    with node(_CITY, robot, ears):
        robot.answer()
        for size in sizes:
            filled = robot.ask(seconds=size - driven, pace=0)
            ears.ask()
            told = robot.ask(seconds=measured, pace=10.0, tell=True)
            driven = size + measured
            robot.ask()  # until all of it has been taken
            rows.append({"keyframes": size, **_answered(told["when"], ears.ask()["pose"])})
            options.say(f"latency: filled in {filled['took_s']:.0f} s; {rows[-1]}")
    return rows


def _answered(sent: list[Any], heard: list[Any]) -> Row:
    """When the first pose came that is dated by a closure: by the keyframe that it got."""
    sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
    first: dict[int, int] = {}
    for at, stamp in heard:
        first.setdefault(stamp, at)
    closures = [stamp for topic, stamp, _ in sent if topic == CLOSURES]
    took = []
    for stamp in closures:
        released_at = sent_at.get(stamp + BEFORE_NS + AFTER_NS)
        if stamp in first and released_at is not None:
            took.append(1e-6 * (first[stamp] - released_at))
    return {
        "closures": len(closures),
        "answered": len(took),
        "median ms": percentile(took, 0.5),
        "p99 ms": percentile(took, 0.99),
        "max ms": percentile(took, 1.0),
    }


def idle(short: bool) -> list[Row]:
    """A robot that stands for eight hours."""
    rows, hours = list[Row](), 0.2 if short else 8.0
    for jitter_m in (0.0, 2e-5, 2e-4):
        robot = sender("standing", ODOMETRY, hours=hours, jitter_m=jitter_m)
        with node({"inputs.reliable": True}, robot) as ours:
            robot.answer()
            robot.ask(seconds=3600 * hours / 8, pace=0)
            after_an_eighth = ours.memory_mib
            robot.ask(pace=0)
            at_the_end = ours.memory_mib
            keyframes = ours.finished()["keyframes"]
        rows.append(
            {
                "jitter mm": 1e3 * jitter_m,
                "hours": hours,
                "keyframes": keyframes,
                "RSS MiB after an eighth": after_an_eighth,
                "at the end": at_the_end,
            }
        )
        options.say(f"idle: {rows[-1]}")
    return rows


def lifecycle(short: bool) -> list[Row]:
    """How long a lifecycle manager waits for each transition: Nav2's gives up after 5 s."""
    took: dict[str, list[float]] = {name: [] for name in _TRANSITIONS}
    for _ in range(3 if short else 10):
        manager = Process(HELPERS, "manage")
        with node({"node.autostart": False}, manager):
            manager.answer()
            for name in _TRANSITIONS:
                took[name].append(manager.ask(transition=name))
    return [
        {"transition": name, "starts": len(of), "median s": median(of), "longest s": max(of)}
        for name, of in took.items()
    ]


FIGURES: dict[str, Callable[[bool], list[Row]]] = {
    "cpu": cpu,
    "rate": rate,
    "latency": latency,
    "idle": idle,
    "lifecycle": lifecycle,
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
