"""Where the installed commands are: pip puts them beside Python, colcon where `ros2 run` looks for them."""

import os
import sys
from pathlib import Path


def executable(name):
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    folders = [Path(sys.executable).parent, *(Path(prefix, "lib", "graph_slam_ros") for prefix in prefixes)]
    return next((file for folder in folders if (file := folder / name).exists()), folders[0] / name)
