"""Whether odometry is what it says, from which keyframe on it is not, and what it is instead."""
