"""The settings that ``info`` prints for poses that may be fixes work as they are pasted."""

import shlex

from recordings import short_drive

from graph_slam_ros.cli import main
from graph_slam_ros.tools.simulation import Drive


def test_poses_are_fixes_with_the_settings_that_info_prints(tmp_path, capsys):
    drive, file = Drive(short_drive(tmp_path / "drive.mcap")), tmp_path / "poses.mcap"
    for m in drive.messages:
        m.topic = "/total_station" if m.topic == "/ground_truth" else m.topic
    drive.write(file)
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    told = " ".join(out.split()).partition("a pose may be an estimate or the truth; as a fix: ")[2]
    words = shlex.split(told)
    settings = [word for word, before in zip(words[1:], words[:-1], strict=True) if before == "--set"][:5]
    assert settings[0] == "inputs.names=odom detections pose"
    command = shlex.split(next(line for line in out.splitlines() if line.startswith("graph_slam replay")))[1:]
    chosen = [word for setting in settings for word in ("--set", setting)]
    assert main([*command[:-1], str(tmp_path / "run"), *chosen]) == 0
    (used,) = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("pose "))
    assert int(used[2]) > 50 and used[-1] == "0"
