"""What kind of test a file has, and before any test: kernels are compiled and loaded in one order, as for users."""

import functools
import os
import re
import sys
import tempfile
from pathlib import Path

import pytest
import reliability

from graph_slam_ros.warmup import warmup

# Where Python is asked to keep no bytecode, each worker and each process would compile all sources and tests anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

INTEGRATION = """anchor any_measurement any_message bag certificate consistency convert damaged_runs
    data displacement evaluation explain false_closures faults graph_cases graph_slam info
    initialization inputs_replay instruments life localize map_log maps message_cases nav2 nees
    noise_and_losses odd_files online_graphs pipeline_kinds rates reach run_folder sessions simulation soak
    timing_cases unnamed views what_if world_graphs"""
"""Files, without ``test_`` and ``.py``."""
STARTS_ONE = re.compile(
    r"^ *(import|from) (confined|fuzzing|multiprocessing|rclpy|subprocess)\b|\b(live_nodes\b|os\.fork\(|mrclam\()",
    re.MULTILINE,
)
"""What a file has that starts processes."""
TRIES = re.compile(r"\b(often|times)\(")
"""What it has that tries more in ``make soak``."""
_running = []
STARTS = {"os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "subprocess.Popen"}


INTEGRATES = {Path(__file__).with_name(f"test_{name}.py") for name in INTEGRATION.split()}
assert all(file.is_file() for file in INTEGRATES), [file.name for file in INTEGRATES if not file.is_file()]


@functools.cache
def kind(file):  # type: ignore[no-untyped-def]
    """Of the tests in a file."""
    if STARTS_ONE.search(file.read_text(encoding="utf-8")):
        return "process"
    return "integration" if file in INTEGRATES else "unit"


@functools.cache
def is_soaked(file):  # type: ignore[no-untyped-def]
    """Whether ``make soak`` tries more of it."""
    return bool(TRIES.search(file.read_text(encoding="utf-8")))


def pytest_ignore_collect(collection_path, config):  # type: ignore[no-untyped-def]
    """For unit tests alone the others are not even imported: ROS, with which half of them begin, takes a second."""
    is_other = collection_path.match("test_*.py") and kind(collection_path) != "unit"
    return True if is_other and config.option.markexpr == "unit" else None


def pytest_itemcollected(item) -> None:  # type: ignore[no-untyped-def]
    """Its kind is that of its file."""
    item.add_marker(kind(item.path))
    if is_soaked(item.path):
        item.add_marker("soak")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):  # type: ignore[no-untyped-def]
    """What is of another kind may start no process."""
    _running[:] = [item.path]
    try:
        return (yield)
    finally:
        _running.clear()


def _no_process(event: str, arguments: tuple) -> None:
    if event in STARTS and _running and kind(_running[0]) != "process":
        raise RuntimeError(f"{_running[0].name} starts a process, and nothing in it says so: STARTS_ONE in conftest.py")


sys.addaudithook(_no_process)


def pytest_sessionstart() -> None:
    """Not by the first test that needs one, whose digits would be its own."""
    warmup()


@pytest.fixture
def memory():  # type: ignore[no-untyped-def]
    """A folder in memory, where there is one: what kills a process leaves the same there, and syncing takes no time."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        yield Path(folder)


def pytest_sessionfinish(session) -> None:  # type: ignore[no-untyped-def]
    """One of several processes hands over what was tried in it."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["reliability"] = reliability.told()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:  # type: ignore[no-untyped-def]
    """And the first takes it."""
    reliability.add(getattr(node, "workeroutput", {}).get("reliability", ()))


def pytest_terminal_summary(terminalreporter) -> None:  # type: ignore[no-untyped-def]
    """How often what was tried."""
    for line in reliability.lines():
        terminalreporter.write_line(line)
