"""The node and who is around it, each a process: started, asked what it costs, and ended by its id."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from benchmarks.fresh import ROOT
from benchmarks.live.streams import LANDMARKS, ODOMETRY

PATIENCE_S = 10.0
HELPERS = "benchmarks.live.robot"
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_DOMAIN = str(random.randint(1, 100))
ENVIRONMENT = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": _DOMAIN}


class Process:
    """A Python module in a process of its own; what it prints is JSON, one value a line."""

    def __init__(self, module: str, *words: object, name: str = "") -> None:
        self.name = name or module
        self._popen = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, words)],
            cwd=ROOT,
            env=ENVIRONMENT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    @property
    def cpu_s(self) -> float:
        """CPU seconds so far, of all threads, as the kernel counts them: in hundredths."""
        fields = Path(f"/proc/{self._popen.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) * _TICK_S

    @property
    def memory_mib(self) -> float:
        """Resident memory."""
        status = Path(f"/proc/{self._popen.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024.0

    def ask(self, **question: Any) -> Any:
        """Send a question as a line of JSON and wait for the answer."""
        self.tell(**question)
        return self.answer()

    def tell(self, **order: Any) -> None:
        """Send a line of JSON."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(json.dumps(order) + "\n")
        self._popen.stdin.flush()

    def answer(self) -> Any:
        """The next line that it prints."""
        assert self._popen.stdout is not None
        line = self._popen.stdout.readline()
        if not line:
            raise SystemExit(f"{self.name} ended with code {self._popen.wait()}")
        return json.loads(line)

    def stop(self) -> None:
        """Ask it to end; after a while, end it."""
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.communicate(timeout=6 * PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.communicate()


class Node(Process):
    """Our node, recording into a folder."""

    def __init__(self, folder: Path, parameters: dict[str, Any]) -> None:
        self._folder = folder
        given = {"output.folder": folder} | parameters
        words = [word for key, value in given.items() for word in ("-p", f"{key}:={_text(value)}")]
        super().__init__("graph_slam_ros.node.node", "--ros-args", "--log-level", "error", *words, name="the node")

    def finished(self) -> dict[str, Any]:
        """What it tells of its run, once it has ended."""
        self.stop()
        told: dict[str, Any] = json.loads((self._folder / "run.json").read_text(encoding="utf-8"))
        return told


def sender(stream: str, *topics: str, **values: Any) -> Process:
    """Who sends a stream, see ``benchmarks.live.streams``."""
    names = ",".join(topics or (ODOMETRY, LANDMARKS))
    return Process(HELPERS, "send", stream, json.dumps(values), names, name="the sender")


def listener(*names: str) -> Process:
    """Who listens to outputs of the node."""
    return Process(HELPERS, "listen", *names, name="the listener")


@contextlib.contextmanager
def running(*processes: Process) -> Iterator[None]:
    """Whatever happens, they end."""
    try:
        yield
    finally:
        for process in processes:
            process.stop()


@contextlib.contextmanager
def node(parameters: dict[str, Any], *others: Process) -> Iterator[Node]:
    """A node for as long as the context lasts; the others end with it."""
    with tempfile.TemporaryDirectory() as folder:
        ours = Node(Path(folder) / "run", parameters)
        with running(*others, ours):
            yield ours


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def until(condition: Callable[[], bool], rest: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> None:
    """Poll for what must come to be."""
    deadline = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"no {what} in {patience_s:g} s")
        rest()


@contextlib.contextmanager
def ros() -> Iterator[None]:
    """Of a process that is started: ROS until it is told to stop."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where whoever started us ignores it
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        rclpy.try_shutdown()


def asked() -> Any:
    """Of a process that is started: the next line that it is told."""
    line = sys.stdin.readline()
    if not line:
        raise KeyboardInterrupt  # nobody asks any more
    return json.loads(line)


def reply(value: Any) -> None:
    """Of a process that is started: print an answer."""
    print(json.dumps(value), flush=True)


def percentile(values: Sequence[float], share: float) -> float:
    """A value that this share of the values does not exceed; NaN of none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")
