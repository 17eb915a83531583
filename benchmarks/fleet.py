"""What a fleet costs beside its replays, how it scales, and what faults change.

``python -m benchmarks.fleet [speedup|overhead|faults|resumed]...`` with the extra ``fleet``; nothing else may run.
"""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

from graph_slam_ros import cli
from graph_slam_ros.tools.fleet.engine import Workers, connected, run_jobs
from graph_slam_ros.tools.fleet.isolation import run_isolated
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.replay import Fleet, replay_all

RECORDINGS, NOTHING, DAMAGED = 200, 5000, 5
HASHED = ("graph.g2o", "ledger.csv", "path.tum", "landmarks.csv", "map.mcap")


def recordings(folder: Path, count: int) -> Path:
    """Simulate recordings of some 40 s."""
    folder.mkdir(exist_ok=True)
    for seed in range(count):
        file = folder / f"{seed:03d}.mcap"
        if not file.exists():
            with contextlib.redirect_stdout(None):
                cli.main(["simulate", "pythonrobotics", "--out", str(file), "--seed", str(seed)])
    return folder


def speedup(scratch: Path) -> None:
    """Recordings a minute with two workers and with one."""
    bags, seconds = recordings(scratch / "bags", int(os.environ.get("FLEET_RECORDINGS", RECORDINGS))), {}
    for count in (1, 2):
        begun = time.perf_counter()
        done = replay_all(Fleet([str(bags)], scratch / f"w{count}"), Workers(count=count))
        seconds[count] = time.perf_counter() - begun
        print(f"{count} worker: {len(done.rows)} recordings in {seconds[count]:.1f} s")
    print(f"{seconds[1] / seconds[2]:.2f} times as many a minute with two workers (asked 1.8)")


def overhead(scratch: Path) -> None:
    """CPU of scheduler, client and workers for jobs of no work."""
    jobs = [Job(f"{k}", "", f"{k}", "", {}, "", str(scratch), 1.0, 0, with_report=False) for k in range(NOTHING)]
    begun, cpu = time.perf_counter(), _cpu_s()
    with connected(Workers(count=2)) as client:
        rows = list(run_jobs(client, jobs, lambda items, _: items, partial(run_isolated, task="nothing")))
    spent, took = _cpu_s() - cpu, time.perf_counter() - begun
    print(
        f"{len(rows)} jobs of no work: {took:.0f} s (asked 300), "
        f"{1e3 * spent / len(rows):.1f} ms of CPU each (asked 50)"
    )


def _cpu_s() -> float:
    """CPU of this process and of its children that have ended."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


def faults(scratch: Path, *, count: int = 60, workers: int = 16, period_s: float = 20.0) -> None:
    """Results of a scheduler with workers over TCP, one killed every 20 s, are those of a serial run."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "test"))
    import threading

    from distributed import Client
    from fleet_nodes import scheduler

    bags = recordings(scratch / "sixty", count)
    for seed in range(DAMAGED):
        file = bags / f"{seed * 11:03d}.mcap"
        file.write_bytes(file.read_bytes()[:200] if seed % 2 else b"nothing %d" % seed)
    serial = replay_all(Fleet([str(bags)], scratch / "serial"), Workers(count=1))
    killed, over = [], threading.Event()
    with scheduler(scratch, workers) as address, Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=300)

        def kill() -> None:
            while not over.wait(period_s):
                pid = random.choice(list(client.run(os.getpid).values()))
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        killer = threading.Thread(target=kill)
        killer.start()
        done = replay_all(Fleet([str(bags)], scratch / "faulty"), Workers(address))
        over.set()
        killer.join()
    _compare(scratch, serial.rows, done.rows)
    print(
        f"{len(killed)} workers of {workers} were killed; "
        f"most attempts: {max(row['attempts'] for row in done.rows)} (asked 3)"
    )


def _compare(scratch: Path, serial: list, rows: list) -> None:
    runs = {row["recording"]: scratch / "serial/jobs" / row["key"] / "run" for row in serial if row["state"] == "done"}
    equal = 0
    for row in rows:
        if row["state"] == "done":
            run = scratch / "faulty/jobs" / row["key"] / "run"
            equal += all((run / n).read_bytes() == (runs[row["recording"]] / n).read_bytes() for n in HASHED)
    failed = sorted(row["recording"] for row in rows if row["state"] == "failed")
    print(f"{equal} of {len(runs)} results have the bytes of a serial run; failed: {', '.join(failed)}")


def resumed(scratch: Path, *, count: int = 40, stops: int = 10) -> None:
    """A fleet that is stopped at random gives the same table."""
    bags = recordings(scratch / "forty", count)
    command = [
        sys.executable,
        "-m",
        "graph_slam_ros.cli",
        "fleet",
        "replay",
        str(bags),
        "--out",
        str(scratch / "resumed"),
    ]
    for k in range(stops):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(random.uniform(2.0, 6.0))
        process.send_signal(signal.SIGINT if k % 2 else signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=False, capture_output=True)
    whole = replay_all(Fleet([str(bags)], scratch / "at_once"), Workers())
    hashes = {row["recording"]: row["map_hash"] for row in whole.rows}
    rows = [json.loads(file.read_text()) for file in (scratch / "resumed/jobs").glob("*/row.json")]
    print(f"stopped {stops} times: the same table: {hashes == {row['recording']: row['map_hash'] for row in rows}}")


PARTS = {"speedup": speedup, "overhead": overhead, "faults": faults, "resumed": resumed}

if __name__ == "__main__":
    for name in sys.argv[1:] or PARTS:
        with tempfile.TemporaryDirectory(prefix="fleet_") as folder:
            PARTS[name](Path(folder))
