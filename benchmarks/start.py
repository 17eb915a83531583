"""From nothing compiled to the end of the demo: ``python -m benchmarks.start [--kernels]``.

Prints the CPU and wall time to compile what the plane needs and all kernels, each into an empty cache; the wall time of
``graph_slam demo`` with an empty cache, and of a second one; and with ``--kernels`` what each kernel costs: CPU time
without that of kernels it calls, and for how many types of arguments it is compiled.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from numba.core import event

from benchmarks.fresh import ROOT

COMPILE = "from graph_slam_ros.warmup import compile_all; compile_all(dimensions={dimensions})"
_DEMO = "import sys; from graph_slam_ros.cli import main; sys.exit(main(['demo', '--out', {out!r}]))"


class _Costs(event.Listener):
    """CPU time of each kernel, without that of those compiled meanwhile."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.count: Counter[str] = Counter()
        self._inner = [0.0]
        self._began: list[float] = []

    def on_start(self, event: Any) -> None:
        """Note when a kernel is begun."""
        self._began.append(time.process_time())
        self._inner.append(0.0)

    def on_end(self, event: Any) -> None:
        """Add what a kernel took."""
        took, function = time.process_time() - self._began.pop(), event.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__qualname__}".removeprefix("graph_slam_ros.")
        self.seconds[name] += took - self._inner.pop()
        self.count[name] += 1
        self._inner[-1] += took


def run(code: str, cache: Path) -> tuple[float, float, int]:
    """Return CPU and wall time [s] of a process with its children, whose kernels are in a folder, and its exit code."""
    before, since = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = os.environ | {"GRAPH_SLAM_CACHE": str(cache)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - since, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall, done.returncode


def _say(what: str, code: str, cache: Path) -> None:
    """Print what ``run`` returns."""
    cpu, wall, status = run(code, cache)
    print(f"{what}: {cpu:.1f} s of CPU, {wall:.1f} s{f', exit code {status}' if status else ''}", flush=True)


def _table() -> None:
    """Print what each kernel costs, in this process; its cache must be empty."""
    from graph_slam_ros import warmup

    costs = _Costs()
    event.register("numba:compile", costs)
    warmup._load_plane()
    warmup._load_edges(in_space=True)
    print(f"\n{'kernel':64} CPU s  specialisations")
    for name, seconds in costs.seconds.most_common():
        print(f"{name:64} {seconds:5.2f}  {costs.count[name]}")
    print(f"{'all':64} {costs.seconds.total():5.2f}  {costs.count.total()}")


def main() -> None:
    """Measure, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kernels", action="store_true", help="also a table of all kernels")
    parser.add_argument("--table", action="store_true", help=argparse.SUPPRESS)
    if parser.parse_args().table:
        return _table()
    with tempfile.TemporaryDirectory(prefix="start-") as folder:
        place = Path(folder)
        for what, dimensions in (("the plane", 2), ("all kernels", 3)):
            _say(f"compile {what}", COMPILE.format(dimensions=dimensions), place / f"{dimensions}")
        for what in ("demo, nothing compiled", "demo once more"):
            _say(what, _DEMO.format(out=str(place / what)), place / "demo")
        if parser.parse_args().kernels:
            environment = os.environ | {"GRAPH_SLAM_CACHE": str(place / "kernels")}
            command = [sys.executable, "-m", "benchmarks.start", "--table"]
            subprocess.run(command, cwd=ROOT, env=environment, check=True)


if __name__ == "__main__":
    main()
