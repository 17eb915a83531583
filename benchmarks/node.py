"""The node as a robot has it: what it costs, how much it takes, and how soon it answers.

``python -m benchmarks.node [NAME ...]``, where ROS 2 is installed; without names everything, which takes an hour.
The node is a process of its own, and this process sends to it and listens, on this machine's loopback. CPU time is what
the kernel counts for a process, with the middleware's threads.
"""

import argparse
import json
import time
from collections.abc import Callable
from statistics import median

import numpy as np

from benchmarks import options, table
from benchmarks.live.robot import BARE, Process, Robot, node, ros
from benchmarks.live.streams import AFTER_NS, BEFORE_NS, CITY_SIGMA_M, CITY_SIGMA_RAD, CLOSURES, LANDMARKS, ODOMETRY
from benchmarks.table import Row
from graph_slam_ros.warmup import warmup

_WARM_S = 5.0
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
    """CPU time with odometry at 50 Hz and landmarks at 10 Hz, against a bare node that subscribes to the same."""
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
    driven = {"seconds": seconds + 2 * _WARM_S, "odometry_hz": 50, "landmarks_hz": 10}
    if who == "a bare node":
        with Process(BARE, ODOMETRY, LANDMARKS) as bare, Robot("warehouse", **driven) as robot:
            return _spent(bare, robot, seconds)
    with node({}) as (ours, _), Robot("warehouse", "path", "pose", "odometry", "tf", **driven) as robot:
        return _spent(ours, robot, seconds)


def _spent(who: Process, robot: Robot, seconds: float) -> float:
    """CPU seconds per second."""
    robot.play(_WARM_S)
    begin_s, start_s = who.cpu_s, time.monotonic()
    robot.play(seconds)
    return (who.cpu_s - begin_s) / (time.monotonic() - start_s)


def rate(short: bool) -> list[Row]:
    """Odometry at 1 kHz; late is from its sending to the arrival of the node's own of that stamp."""
    seconds = 5.0 if short else 60.0
    driven = {"seconds": seconds, "odometry_hz": 1000, "landmarks_hz": 10}
    with node({}) as (ours, _), Robot("warehouse", "odometry", **driven) as robot:
        begin_s, start_s = ours.cpu_s, time.monotonic()
        sent = robot.play(seconds)
        share = (ours.cpu_s - begin_s) / (time.monotonic() - start_s)
        received = robot.received()
        sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
        late_ms = [1e-6 * (at - sent_at[stamp]) for at, stamp in robot.heard["odometry"] if stamp in sent_at]
    counts = {"sent": robot.sent, "received": received, "% of a core": 100.0 * share, "~/odometry": len(late_ms)}
    return [counts | _quantiles(late_ms, "late, median ms")]


def latency(short: bool) -> list[Row]:
    """From the odometry that releases a closure to the corrected pose, while a city becomes large."""
    sizes, measured = ((300, 600), 100) if short else ((3_500, 20_000), 900)
    rows, driven = list[Row](), 0
    with node(_CITY), Robot("city", "pose", poses=sizes[-1] + measured + 1) as robot:
        for size in sizes:
            robot.play(size - driven, pace=0)
            robot.heard["pose"].clear()
            sent = robot.play(measured, pace=10.0)
            driven = size + measured
            robot.received()  # until all of it has been taken
            rows.append({"keyframes": size, **_answered(sent, robot.heard["pose"])})
            options.say(f"latency: {rows[-1]}")
    return rows


def _answered(sent: list[tuple[str, int, int]], heard: list[tuple[int, int]]) -> Row:
    """When the first pose came that is dated by a closure: by the keyframe that it got."""
    sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
    first: dict[int, int] = {}
    for at, stamp in heard:
        first.setdefault(stamp, at)
    closures = [stamp for topic, stamp, _ in sent if topic == CLOSURES]
    took_ms = []
    for stamp in closures:
        released_at = sent_at.get(stamp + BEFORE_NS + AFTER_NS)
        if stamp in first and released_at is not None:
            took_ms.append(1e-6 * (first[stamp] - released_at))
    return {"closures": len(closures), "answered": len(took_ms), **_quantiles(took_ms, "median ms")}


def _quantiles(values: list[float], middle: str) -> Row:
    names, shares = (middle, "p99 ms", "max ms"), (0.5, 0.99, 1.0)
    found = np.quantile(values, shares).tolist() if values else [None] * len(shares)
    return dict(zip(names, found, strict=True))


def idle(short: bool) -> list[Row]:
    """A robot that stands for eight hours."""
    rows, hours = list[Row](), 0.2 if short else 8.0
    for jitter_m in (0.0, 2e-5, 2e-4):
        with node({"inputs.reliable": True}) as (ours, run):
            with Robot("standing", hours=hours, jitter_m=jitter_m) as robot:
                robot.play(3600 * hours / 8, pace=0)
                memory_mib = [ours.memory_mib]
                robot.play(pace=0)
                memory_mib.append(ours.memory_mib)
            ours.stop()
            keyframes = json.loads((run / "run.json").read_text(encoding="utf-8"))["keyframes"]
        rows.append({"jitter mm": 1e3 * jitter_m, "hours": hours, "keyframes": keyframes})
        rows[-1] |= dict(zip(("RSS MiB after an eighth", "at the end"), memory_mib, strict=True))
        options.say(f"idle: {rows[-1]}")
    return rows


FIGURES: dict[str, Callable[[bool], list[Row]]] = {
    "cpu": cpu,
    "rate": rate,
    "latency": latency,
    "idle": idle,
}


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FIGURES)} (default: all)")
    parser.add_argument("--short", action="store_true", help="a short look: seconds instead of minutes")
    table.add_write(parser)
    args = parser.parse_args()
    for name in args.names:
        if name not in FIGURES:
            parser.error(f"{name} is none of {', '.join(FIGURES)}")
    warmup()  # so that nobody waits for compilers
    for name in args.names or FIGURES:
        options.say(f"{name}{', a short look' if args.short else ''}")
        with ros():
            rows = FIGURES[name](args.short)
        table.finish(f"node-{name}", rows, write=args.write, note="a short look" if args.short else "")


if __name__ == "__main__":
    main()
