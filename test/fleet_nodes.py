"""A Dask scheduler and workers of it, as processes that talk over TCP on the loopback; drives and their results."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from graph_slam_ros import cli
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

HASHED = ("graph.g2o", "ledger.csv", "path.tum", "landmarks.csv", "map.mcap")
PATIENCE_S = 60.0


def wait_for(what, patience_s=PATIENCE_S):
    """Poll until it holds."""
    until = time.monotonic() + patience_s
    while not what():
        assert time.monotonic() < until, what
        time.sleep(0.05)


@contextlib.contextmanager
def scheduler(folder: Path, workers: int):
    """Start both, yield the scheduler's address, and end them."""
    file = folder / "scheduler.json"
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2"}
    begun = []

    def start(name, *options):
        command = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{name}",
            "--scheduler-file",
            str(file),
            "--no-dashboard",
        ]
        begun.append(subprocess.Popen([*command, *options], env=environment, **common))

    try:
        start("scheduler", "--host", "127.0.0.1", "--port", "0")
        wait_for(file.exists)
        for _ in range(workers):
            start("worker", "--nthreads", "1", "--host", "127.0.0.1", "--local-directory", str(folder))
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(begun):
            process.terminate()
        for process in begun:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
            process.wait()


def children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    with contextlib.suppress(FileNotFoundError):
        return [int(one) for file in Path(f"/proc/{pid}/task").glob("*/children") for one in file.read_text().split()]
    return []


def drives(folder: Path, count: int, *damaged: bytes):
    """Recordings with truth and damaged ones in a folder, and the bytes of the results of a serial run, by name."""
    serial = {}
    for name in (f"{seed}.mcap" for seed in range(1, count + 1)):
        words = ["simulate", "pythonrobotics", "--out", str(folder / name), "--seed", name.partition(".")[0]]
        assert cli.main(words) == 0
        replay(folder / name, folder.with_name("serial") / name, Config())
        serial[name] = contents(folder.with_name("serial") / name)
    for k, content in enumerate(damaged):
        (folder / f"damaged{k}.mcap").write_bytes(content)
    return serial


def contents(run: Path):
    """Return what is the same wherever a recording was replayed."""
    return {name: (run / name).read_bytes() for name in HASHED}
