"""The SLAM pipeline: measurements in order of stamp become keyframes, edges and updates."""

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import (
    AngularVelocity,
    Closure,
    Control,
    Fix,
    Measurement,
    Odometry,
    Sighting,
    Sightings,
)
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.graph_slam import GraphSlam
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.map_view import MapView
from graph_slam_ros.slam.update import Update

__all__ = [
    "AngularVelocity",
    "Closure",
    "Config",
    "Control",
    "Counters",
    "Fix",
    "GraphSlam",
    "Keyframe",
    "Landmark",
    "MapView",
    "Measurement",
    "Odometry",
    "Sighting",
    "Sightings",
    "Update",
]
