"""Conversion between ROS messages and measurements, both ways. Nothing here needs an installed ROS."""
