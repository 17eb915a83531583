"""Before any test: kernels are compiled in a process of their own and loaded in one order, as they are for users."""

from graph_slam_ros.warmup import warmup


def pytest_sessionstart() -> None:
    """Not by the first test that needs one, whose digits would be its own."""
    warmup()
