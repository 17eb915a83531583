"""Before any test: kernels are compiled in a process of their own and loaded in one order, as they are for users."""

import reliability

from graph_slam_ros.warmup import warmup


def pytest_sessionstart() -> None:
    """Not by the first test that needs one, whose digits would be its own."""
    warmup()


def pytest_terminal_summary(terminalreporter) -> None:  # type: ignore[no-untyped-def]
    """How often what was tried."""
    for line in reliability.lines():
        terminalreporter.write_line(line)
