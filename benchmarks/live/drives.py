"""A robot that drives: what the node costs, what it takes, and what becomes of it when that is too much."""

import itertools
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from benchmarks import options
from benchmarks.live.processes import Process, percentile, running
from benchmarks.live.robot import HERE
from benchmarks.live.started import listener, node, sender
from benchmarks.live.streams import LANDMARKS, ODOMETRY
from benchmarks.table import Row
from graph_slam_ros.runs.tables import INPUT_COLUMNS

_OUTPUTS = ("path", "pose", "odometry", "tf")
_WARM_S = 5.0
_DIAGNOSED_S = 2.5  # diagnostics come once a second


def cpu(short: bool) -> list[Row]:
    """CPU time with odometry at 100 Hz and landmarks at 10 Hz, against a bare node that subscribes to the same."""
    seconds, reps = (5.0, 1) if short else (30.0, 3)
    spent: dict[str, list[float]] = {"the node": [], "a bare node": []}
    outputs: dict[str, float] = {}
    for _ in range(reps):
        for who in spent:
            share, heard = _cpu_of(who, seconds)
            spent[who].append(share)
            outputs |= heard
            options.say(f"cpu: {who} {100.0 * share:.1f} % of a core; {heard}")
    shares = {who: median(values) for who, values in spent.items()}
    return [
        {
            "who": who,
            "% of a core": 100.0 * shares[who],
            "ratio": shares[who] / shares["a bare node"],
            "runs": ", ".join(f"{100.0 * value:.1f}" for value in spent[who]),
            **({f"{name} Hz": rate for name, rate in outputs.items()} if who == "the node" else {}),
        }
        for who in spent
    ]


def _cpu_of(who: str, seconds: float) -> tuple[float, dict[str, float]]:
    robot = sender("warehouse", seconds=seconds + 2 * _WARM_S, odometry_hz=100, landmarks_hz=10)
    if who == "a bare node":
        bare = Process(HERE, "bare", ODOMETRY, LANDMARKS)
        with running(robot, bare):
            return _spent(bare, robot, seconds), {}
    ears = listener(*_OUTPUTS)
    with node({}, robot, ears) as ours:
        share = _spent(ours, robot, seconds, ears)
        heard = ears.ask()
        return share, {name: len(heard[name]) / seconds for name in _OUTPUTS}


def _spent(who: Process, robot: Process, seconds: float, ears: Process | None = None) -> float:
    """CPU seconds per second."""
    robot.answer()
    robot.ask(seconds=_WARM_S)
    robot.tell(seconds=seconds)
    if ears:
        ears.ask()
    begin, start = who.cpu_s, time.monotonic()
    robot.answer()
    return (who.cpu_s - begin) / (time.monotonic() - start)


def rate(short: bool) -> list[Row]:
    """Odometry at 1 kHz."""
    seconds = 5.0 if short else 60.0
    robot, ears = sender("warehouse", seconds=seconds, odometry_hz=1000, landmarks_hz=10), listener("odometry")
    with node({}, robot, ears) as ours:
        robot.answer()
        begin = ours.cpu_s
        told = robot.ask(seconds=seconds, tell=True)
        cpu_s = ours.cpu_s - begin
        received = robot.ask()
        late = _late(told["when"], ears.ask()["odometry"])
    parts = [late[k * len(late) // 4 : (k + 1) * len(late) // 4] for k in (0, 3)]
    return [
        {
            "sent": told["sent"],
            "received": received,
            "seconds": told["took_s"],
            "% of a core": 100.0 * cpu_s / told["took_s"],
            "~/odometry": len(late),
            "late, median ms": 1e3 * percentile(late, 0.5),
            "p99 ms": 1e3 * percentile(late, 0.99),
            "max ms": 1e3 * percentile(late, 1.0),
            "p99 of the first and last quarter, ms": " and ".join(f"{1e3 * percentile(p, 0.99):.1f}" for p in parts),
        }
    ]


def _late(sent: list[Any], heard: list[Any]) -> list[float]:
    """Seconds from the sending of odometry to the arrival of the node's own of that stamp."""
    sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
    return [1e-9 * (at - sent_at[stamp]) for at, stamp, _ in heard if stamp in sent_at]


def overload(short: bool) -> list[Row]:
    """Ten times the usual load for a while, and then the usual again."""
    before_s, during_s, after_s = (3.0, 5.0, 5.0) if short else (15.0, 60.0, 20.0)
    total_s = before_s + during_s + after_s
    robot = sender("warehouse", seconds=total_s, odometry_hz=1000, landmarks_hz=100)
    ears = listener(*_OUTPUTS, "service", "diagnostics")
    phases = (("usual", before_s, 10), ("ten times", during_s, 1), ("usual again", after_s, 10))
    rows: list[Row] = []
    with node({}, robot, ears) as ours:
        robot.answer()
        usual_s = float("inf")
        sent = 0
        for name, seconds, every in phases:
            ears.ask()
            begin, start_ns = ours.cpu_s, time.monotonic_ns()
            told = robot.ask(seconds=seconds, every=every, tell=True)
            sent += told["sent"]
            heard = ears.ask()
            late = _late(told["when"], heard["odometry"])
            poses = _pose_late(told["when"], heard["pose"])
            usual_s = min(usual_s, percentile(late, 0.99))
            answers = [1e-9 * took for _, took in heard["service"]]
            gaps = [1e-9 * (b[0] - a[0]) for a, b in itertools.pairwise(heard["tf"])]
            rows.append(
                {
                    "load": name,
                    "sent": told["sent"],
                    "% of a core": 100.0 * (ours.cpu_s - begin) / told["took_s"],
                    "odometry, p99 ms late": 1e3 * percentile(late, 0.99),
                    "pose, p99 ms late": 1e3 * percentile(poses, 0.99),
                    "service, p99 ms": 1e3 * percentile(answers, 0.99),
                    "between TFs, p99 ms": 1e3 * percentile(gaps, 0.99),
                    "solver behind, at most s": max(_told(heard["diagnostics"], "lag [s]"), default=None),
                    "normal after s": None,
                }
            )
            if name == "usual again":
                rows[-1]["normal after s"] = _normal_after(told["when"], heard["odometry"], start_ns, usual_s)
        received = robot.ask()
        time.sleep(_DIAGNOSED_S)
        used = _told(ears.ask()["diagnostics"][-1:], INPUT_COLUMNS["used"])
    rows.append({"load": "in all", "sent": sent, "received": received, "used": int(sum(used))})
    return rows


def _told(diagnostics: list[Any], key: str) -> list[float]:
    """What the node says of itself, wherever it has that key."""
    return [float(status[key]) for _, told in diagnostics for status in told.values() if key in status]


def _pose_late(sent: list[Any], heard: list[Any]) -> list[float]:
    """Seconds from the sending of odometry to the arrival of the first pose of that stamp."""
    first: dict[int, int] = {}
    for at, stamp, _ in heard:
        first.setdefault(stamp, at)
    sent_at = {stamp: at for _, stamp, at in sent}
    return [1e-9 * (at - sent_at[stamp]) for stamp, at in first.items() if stamp in sent_at]


def _normal_after(sent: list[Any], heard: list[Any], start_ns: int, usual_s: float) -> float:
    """Seconds to the end of the last half second in which most odometry was later than it usually is at most."""
    sent_at = {stamp: at for topic, stamp, at in sent if topic == ODOMETRY}
    parts: dict[int, list[float]] = {}
    for at, stamp, _ in heard:
        if stamp in sent_at:
            parts.setdefault((sent_at[stamp] - start_ns) // 500_000_000, []).append(1e-9 * (at - sent_at[stamp]))
    return 0.5 * max((part + 1 for part, late in parts.items() if median(late) > usual_s), default=0)


FIGURES: dict[str, Callable[[bool], list[Row]]] = {"cpu": cpu, "rate": rate, "overload": overload}
