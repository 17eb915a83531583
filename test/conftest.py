"""Before any test: kernels are compiled in a process of their own and loaded in one order, as they are for users."""

import tempfile
from pathlib import Path

import pytest
import reliability

from graph_slam_ros.warmup import warmup


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
