"""Parameters: each with its default, range, unit and help, checked when a configuration is made."""

from graph_slam_ros.config.config import Config

__all__ = ["Config"]
