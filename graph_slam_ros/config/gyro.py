"""Parameters of a gyro that measures the turns of the robot besides odometry."""

from dataclasses import dataclass

from graph_slam_ros.config.parameter import setting


@dataclass(frozen=True, slots=True)
class GyroConfig:
    """A gyro as part of odometry: an input with use: gyro."""

    density: float = setting(
        1e-3,
        "random walk of the heading by the gyro, where its messages have no covariance",
        "rad/sqrt(s)",
        low=1e-7,
        high=1.0,
    )
    turn_per_rad: float = setting(
        5e-5,
        "variance of the heading for each radian turned: errors of the gyro's scale",
        "rad^2/rad",
        low=0.0,
        high=1.0,
    )
    bias_sigma: float = setting(
        0.02, "standard deviation of the gyro's bias before the robot has stood", "rad/s", low=0.0, high=1.0
    )
    timeout_s: float = setting(
        0.1,
        "longest gap between messages of the gyro that is bridged; in a longer one odometry is used alone",
        "s",
        low=1e-3,
    )
