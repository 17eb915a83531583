"""A long drive through a city: how soon the node answers when the graph is large, and what it remembers."""

from collections.abc import Callable
from typing import Any

from benchmarks import options
from benchmarks.live.processes import Process, percentile
from benchmarks.live.started import listener, node, sender
from benchmarks.live.streams import AFTER_NS, BEFORE_NS, CITY_SIGMA_M, CITY_SIGMA_RAD, CLOSURES, ODOMETRY
from benchmarks.table import Row

_SIZES, _MEASURED, _PACE = (3_500, 20_000), 900, 10.0  # poses, and of these so many a second
_MIB = 2**20


def latency(short: bool) -> list[Row]:
    """From the odometry that releases a closure to the corrected pose."""
    sizes, measured = ((300, 600), 100) if short else (_SIZES, _MEASURED)
    robot, ears = _robot(sizes[-1] + measured + 1, 2), listener("pose")
    rows, driven = [], 0
    with node(_parameters(2), robot, ears):
        robot.answer()
        for size in sizes:
            filled = robot.ask(seconds=size - driven, pace=0)
            ears.ask()
            told = robot.ask(seconds=measured, pace=_PACE, tell=True)
            driven = size + measured
            robot.ask()  # until all of it has been taken
            rows.append({"keyframes": size, **_answered(told["when"], ears.ask()["pose"])})
            options.say(f"latency: filled in {filled['took_s']:.0f} s; {rows[-1]}")
    return rows


def _answered(sent: list[Any], heard: list[Any]) -> Row:
    """When the first pose came that is dated by a closure: by the keyframe that it got."""
    sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
    first: dict[int, int] = {}
    for at, stamp, _ in heard:
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


def memory(short: bool) -> list[Row]:
    """Resident memory of the node, by keyframes."""
    rows = []
    for dimensions, parts in ((2, (10_000, 10_000)), (3, (5_000, 5_000))):
        sizes = tuple(size // 20 for size in parts) if short else parts
        robot = _robot(sum(sizes) + 1, dimensions)
        with node(_parameters(dimensions), robot) as ours:
            robot.answer()
            robot.ask(seconds=100, pace=0)
            driven, before = 100, ours.memory_bytes()
            for size in sizes:
                told = robot.ask(seconds=size - (100 if driven == 100 else 0), pace=0)
                driven = size if driven == 100 else driven + size
                now = ours.memory_bytes()
                rows.append(
                    {
                        "world": "in the plane" if dimensions == 2 else "in space",
                        "keyframes": driven,
                        "RSS MiB": now / _MIB,
                        "MiB per 10,000 since the row before": (now - before) / _MIB / size * 1e4,
                        "seconds": told["took_s"],
                    }
                )
                before = now
                options.say(f"memory: {rows[-1]}")
    return rows


def idle(short: bool) -> list[Row]:
    """A robot that stands for eight hours."""
    rows = []
    for jitter_m in (0.0, 2e-5, 2e-4):
        hours = 0.2 if short else 8.0
        robot = sender("standing", ODOMETRY, hours=hours, jitter_m=jitter_m)
        with node({"inputs.reliable": True}, robot) as ours:
            robot.answer()
            first = robot.ask(seconds=3600 * hours / 8, pace=0)
            after_one = ours.memory_bytes()
            rest = robot.ask(pace=0)
            at_the_end = ours.memory_bytes()
            run = ours.finished()
        rows.append(
            {
                "jitter mm": 1e3 * jitter_m,
                "hours": hours,
                "messages": first["sent"] + rest["sent"],
                "messages per s": rest["sent"] / rest["took_s"],
                "keyframes": run["keyframes"],
                "RSS MiB after an eighth": after_one / _MIB,
                "RSS MiB at the end": at_the_end / _MIB,
            }
        )
        options.say(f"idle: {rows[-1]}")
    return rows


def _robot(poses: int, dimensions: int) -> Process:
    return sender("city", ODOMETRY, CLOSURES, poses=poses, dimensions=dimensions)


def _parameters(dimensions: int) -> dict[str, Any]:
    """A keyframe for each pose, and the noise that the world has."""
    along = dict.fromkeys(("translation", "lateral", "vertical"), CITY_SIGMA_M)
    about = dict.fromkeys(("rotation", "tilt"), CITY_SIGMA_RAD)
    return {
        "world.dimensions": dimensions,
        "inputs.names": "odom closings",
        "inputs.reliable": True,
        "closings.type": "vision_msgs/msg/Detection3DArray",
        "closings.topic": CLOSURES,
        "closings.use": "closure",
        "keyframes.min_distance_m": 0.8,
        "odometry.noise": "density",
        **{f"odometry.{name}_density": value for name, value in (along | about).items()},
    }


FIGURES: dict[str, Callable[[bool], list[Row]]] = {"latency": latency, "memory": memory, "idle": idle}
