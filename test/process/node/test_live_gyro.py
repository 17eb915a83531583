"""The running node with a gyro: its bias is known, also after the node was killed."""

import math
import signal

from live_drive import Drive
from live_nodes import finish, node, replayed, results, robot
from messages import imu, quaternion
from sensor_msgs.msg import Imu

BIAS, RATE = 0.013, 0.2  # [rad/s] of the gyro; true turn while it drives
GYRO = (
    "inputs.names:=odom detections imu",
    "imu.type:=sensor_msgs/msg/Imu",
    "imu.topic:=imu",
    "imu.use:=gyro",
    "gyro.timeout_s:=0.25",
    "inputs.reliable:=true",
)


def go(r, drive, gyro, steps, *, stands=False):
    """So many steps with the gyro's message at each."""
    for k in range(steps):
        rate = BIAS + (0.0 if stands else RATE)
        gyro.publish(imu(quaternion(), (0.0,) * 9, stamp_ns=drive.stamp_ns, rate=(0.0, 0.0, rate)))
        if stands:
            r.send("/odom", drive.odometry())
            drive.stamp_ns += 100_000_000
        else:
            drive.step(r)
        if k % 5 == 0:
            r.spin(0.005)


def told(r):
    """State and bias of the gyro by the last of /diagnostics."""
    said = r.said("gyro")
    return said[-1][1]["gyro"] if said else ""


def test_the_gyro_is_used_and_its_bias_is_gone_on_with_after_a_kill(tmp_path):
    parameters = f"output.folder:={tmp_path / 'run'}", *GYRO
    drive = Drive()
    with node(*parameters) as n, robot(hears=("/diagnostics", "path")) as r:
        gyro = r.publisher("imu", Imu)
        r.wait_for_node()
        go(r, drive, gyro, 60, stands=True)
        go(r, drive, gyro, 60)
        r.until_it_says("OK", spin=lambda s: (go(r, drive, gyro, 1), r.spin(s)))
        before = told(r)
        assert before.startswith("used; bias 0.01"), before
    assert n.process.returncode == -signal.SIGKILL
    drive.stamp_ns += 2_000_000_000
    with node(*parameters) as n, robot(hears=("/diagnostics",)) as r:
        gyro = r.publisher("imu", Imu)
        r.wait_for_node()
        r.until_it_says("OK", spin=lambda s: (go(r, drive, gyro, 1), r.spin(s)))
        after = told(r)
        finish(n, r)
    assert "the last run was never ended: going on in its map" in n.said
    (b0, s0), (b1, s1) = (map(float, text.split()[2:5:2]) for text in (before, after))
    assert math.isclose(b1, b0, abs_tol=3.0 * s0), (before, after)
    assert s1 < 2.0 * s0 < 0.004, "not learnt anew: it never stood"
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
