"""Online pose-graph SLAM for robots that bring their own odometry and landmark sightings."""

__version__ = "0.1.0"
