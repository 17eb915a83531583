"""``python -m graph_slam_ros.cli`` is ``graph_slam``."""

import sys

from graph_slam_ros.cli import main

if __name__ == "__main__":
    sys.exit(main())
