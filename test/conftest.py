"""What kind of test a file has, and before any test: kernels are compiled and loaded in one order, as for users."""

import functools
import gc
import os
import re
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands do, before NumPy comes in

import pytest
import reliability

from graph_slam_ros.cli import main
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.warmup import compile_all, warmup

# Where Python is asked to keep no bytecode, each worker and each process would compile all sources and tests anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

KINDS = "unit", "integration", "process"
"""The folders of test/, each with the folders of the package in it."""
LONGEST = {f"test_{name}.py" for name in ("live_packages", "stack_control", "stack", "recordings_of_others", "view")}
TRIES = re.compile(r"\b(often|times)\(")
"""What it has that tries more in ``make soak``."""
_running = []
STARTS = {"os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "subprocess.Popen"}


def kind(file):  # type: ignore[no-untyped-def]
    """Return the kind of the tests in a file, by its folder."""
    return file.relative_to(Path(__file__).parent).parts[0]


@functools.cache
def is_soaked(file):  # type: ignore[no-untyped-def]
    """Return whether ``make soak`` tries more of a file."""
    return bool(TRIES.search(file.read_text(encoding="utf-8")))


@pytest.fixture(autouse=True)
def undrawn(request, monkeypatch):  # type: ignore[no-untyped-def]
    """What a picture shows is told in test/process."""
    if kind(request.path) == "integration":
        monkeypatch.setattr("graph_slam_ros.cli.replay.draw", lambda *_: None)


@pytest.fixture
def told(capsys):  # type: ignore[no-untyped-def]
    """Run a command: its exit code, and what it says on standard output and error."""

    def run(*words):  # type: ignore[no-untyped-def]
        capsys.readouterr()
        try:
            code = main([*map(str, words)])
        except SystemExit as end:  # of the options
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def laps(tmp_path_factory):  # type: ignore[no-untyped-def]
    """A recording that is long enough for a fit."""
    file = tmp_path_factory.mktemp("laps") / "laps.mcap"
    write_bag(simulate("warehouse", 3, aisles=2, aisle_m=6.0, laps=2), file)
    return file


def pytest_ignore_collect(collection_path, config):  # type: ignore[no-untyped-def]
    """For unit tests alone the others are not even imported: ROS, with which half of them begin, takes a second."""
    is_other = collection_path.match("test_*.py") and kind(collection_path) != "unit"
    return True if is_other and config.option.markexpr == "unit" else None


def pytest_collection_modifyitems(items) -> None:  # type: ignore[no-untyped-def]
    """Begin with the longest: where they came last, one process would work while the others wait for it."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_collection_finish() -> None:
    """Modules and tests live to the end: no collection of garbage looks at them again."""
    gc.collect()
    gc.freeze()


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
        raise RuntimeError(f"{_running[0].name} starts a process: it belongs into test/process")


sys.addaudithook(_no_process)


def pytest_sessionstart(session) -> None:  # type: ignore[no-untyped-def]
    """Not by the first test that needs one, whose digits would be its own; what hands tests to others needs none."""
    is_alone = hasattr(session.config, "workerinput") or not getattr(session.config.option, "numprocesses", None)
    (warmup if is_alone else compile_all)()


@pytest.fixture(autouse=True)
def domain(request, monkeypatch):  # type: ignore[no-untyped-def]
    """Nodes of a test are alone in a DDS domain: what is left of others says nothing there."""
    if not request.path.match("process/node/*.py") or find_spec("rclpy") is None:
        yield
        return
    import live_nodes

    with live_nodes.own_domain() as number:
        monkeypatch.setitem(live_nodes.ENVIRONMENT, "ROS_DOMAIN_ID", number)
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture
def memory():  # type: ignore[no-untyped-def]
    """A folder in memory, where there is one: what kills a process leaves the same there, and syncing takes no time."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        yield Path(folder)


def pytest_sessionfinish(session) -> None:  # type: ignore[no-untyped-def]
    """One of several processes hands over what was tried in it. Without unfreezing, DuckDB reports leaks at the end."""
    gc.unfreeze()
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
