"""A Dask scheduler and workers of it, as processes that talk over TCP on the loopback; drives and their results."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from graph_slam_ros import cli

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
    """Start both, yield the scheduler's address and what starts a worker more, and end them."""
    file = folder / "scheduler.json"
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2"}
    begun = []

    def start(name, *options):
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--scheduler-file", str(file)]
        command += ["--no-dashboard", "--host", "127.0.0.1", *options]
        begun.append(subprocess.Popen(command, env=environment, **common))

    def start_worker():
        start("worker", "--nthreads", "1", "--local-directory", str(folder))

    try:
        start("scheduler", "--port", "0")
        wait_for(file.exists)
        for _ in range(workers):
            start_worker()
        yield json.loads(file.read_text())["address"], start_worker
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
    for seed in range(1, count + 1):
        name, out = f"{seed}.mcap", folder.with_name("serial") / str(seed)
        sensor = "range_bearing" if seed == 2 else "position"  # whose topic is that of no usual input
        words = ["simulate", "pythonrobotics", "--seed", str(seed), "--set", f"sensor={sensor}"]
        assert cli.main([*words, "--out", str(folder / name)]) == 0
        assert cli.main(["replay", str(folder / name), "--out", str(out)]) == 0
        serial[name] = contents(out)
    for k, content in enumerate(damaged):
        (folder / f"damaged{k}.mcap").write_bytes(content)
    return serial


def contents(run: Path):
    """Return what is the same wherever a recording was replayed."""
    return {name: (run / name).read_bytes() for name in HASHED}
