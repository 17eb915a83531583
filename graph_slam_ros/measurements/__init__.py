"""Measurements (metres, radians, stamps in nanoseconds), and counters by input and reason."""

from graph_slam_ros.measurements.types import (
    AngularVelocity,
    Closure,
    Control,
    Fix,
    InitialPose,
    Measured,
    Measurement,
    Odometry,
    Sighting,
    Sightings,
)

__all__ = [
    "AngularVelocity",
    "Closure",
    "Control",
    "Fix",
    "InitialPose",
    "Measured",
    "Measurement",
    "Odometry",
    "Sighting",
    "Sightings",
]
