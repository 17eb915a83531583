"""The twist of odometry that comes once a second says nothing of the motion in between."""

from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import Drive, simulate, write_bag


def test_the_twist_of_slow_odometry_has_no_scale_of_its_own(tmp_path):
    write_bag(simulate("warehouse", 3), tmp_path / "drive.mcap")
    drive = Drive(tmp_path / "drive.mcap")
    drive.drop([m for k, m in enumerate(drive.odometry) if (k + 1) % 50])
    drive.write(tmp_path / "slow.mcap")
    found = {one.code for one in check(tmp_path / "slow.mcap", quick=True).findings}
    assert "slow_odometry" in found
    assert "twist_scale" not in found
