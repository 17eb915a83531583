"""The running node that calibrates: it corrects, says so, and a replay of its journal gives the same bytes."""

import numpy as np
import pytest
from live_drive import TAGS, Drive
from live_nodes import ENVIRONMENT, finish, node, own_domain, replayed, results, robot, until
from messages import detection, detections, pose

from graph_slam_ros.lie import se2

YAW = 0.15  # by which the sensor is turned, and nobody has configured it


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


class Turned(Drive):
    """A robot whose sensor is turned."""

    def seen(self, frame=None):
        """Of now."""
        to_sensor = se2.inverse(se2.compose(self.truth, (0.0, 0.0, YAW)))
        points = {name: se2.act(to_sensor, at) for name, at in TAGS.items()}
        found = [detection(pose(*map(float, at)), np.eye(2) * 0.01, name) for name, at in points.items()]
        return detections(*found, frame=frame or "base_link", stamp_ns=self.stamp_ns)


def test_a_sensor_that_is_turned_is_corrected_while_the_robot_drives(tmp_path):
    drive = Turned()
    parameters = (
        f"output.folder:={tmp_path / 'run'}",
        "calibrate.groups:=auto",
        "inputs.reliable:=true",
    )
    with node(*parameters) as n, robot(hears=("/diagnostics", "path", "events")) as r:
        r.wait_for_node()
        drive.go(r, 500)
        until(
            lambda: "corrected detections.mount_correction" in corrected(r),
            drive.pace(r),
            "a correction",
            patience_s=20,
        )
        heard = [s for m in r.heard["events"] for s in m.status if s.name.endswith("calibration")]
        assert any(s.message.startswith("corrected yaw of detections") for s in heard)
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def corrected(r):
    """What the last of /diagnostics says of calibration."""
    said = r.said("calibration")
    return said[-1][1] if said else {}
