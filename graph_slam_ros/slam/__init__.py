"""What the robot does: measurements in order of stamp become keyframes, edges and updates."""

from graph_slam_ros.slam.config import Config
from graph_slam_ros.slam.counters import Counters
from graph_slam_ros.slam.graph_slam import GraphSlam, Update
from graph_slam_ros.slam.landmarks import Landmark
from graph_slam_ros.slam.measurements import Closure, Control, Fix, Measurement, Odometry, Sighting, Sightings
from graph_slam_ros.slam.trail import Keyframe

__all__ = [
    "Closure",
    "Config",
    "Control",
    "Counters",
    "Fix",
    "GraphSlam",
    "Keyframe",
    "Landmark",
    "Measurement",
    "Odometry",
    "Sighting",
    "Sightings",
    "Update",
]
