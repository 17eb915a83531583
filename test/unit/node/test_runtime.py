"""The runtime of the node: what the log says when it is stopped before all is processed."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from graph_slam_ros.node.runtime import Runtime

REST = "all are in the journal; the next start completes the results, or graph_slam recover run"


@pytest.mark.parametrize(
    "waiting, processed, line",
    [
        (3, 9, f"stopped while 3 measurements waited: {REST}"),
        (0, 9, f"stopped before the last solve had ended: {REST}"),
        (0, 0, ""),
    ],
)
def test_where_it_is_stopped_too_early_the_log_says_whether_measurements_waited(waiting, processed, line):
    lines = []
    node = SimpleNamespace(
        config=SimpleNamespace(output=SimpleNamespace(folder="run")),
        get_logger=lambda: SimpleNamespace(warn=lines.append, error=lines.append),
    )
    session = SimpleNamespace(leave=lambda: (waiting, 0), slam=SimpleNamespace(processed=processed))
    Runtime._leave(SimpleNamespace(_session=session, _node=node))
    assert lines == [line] * bool(line)
