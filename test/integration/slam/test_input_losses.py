"""The robust loss of one input: what it does to the estimate, and what is refused."""

import numpy as np
import pytest

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.slam import Control, Fix, GraphSlam, Odometry

S = 1_000_000_000
INPUTS = {
    "inputs.names": "odom good bad",
    "good.type": "sensor_msgs/msg/NavSatFix",
    "bad.type": "sensor_msgs/msg/NavSatFix",
}
COVARIANCE = (0.01, 0.0, 0.0, 0.01)


def estimate(**settings):
    """Path (n, 3) of a straight drive with two receivers, one of which is 3 m to the left now and then."""
    values = {"robust.decide": False, "odometry.noise": "density", "ordering.window_s": 0.0, "robust.loss": "none"}
    values |= {k.replace("__", "."): v for k, v in settings.items()}
    slam = GraphSlam(Config.from_mapping(INPUTS | values))
    for k in range(30):
        slam.process(Odometry(k * S + S, (0.5 * k, 0.0, 0.0), None, "odom"))
        slam.process(Fix(k * S + S, "good", "position", (0.5 * k, 0.0), COVARIANCE))
        slam.process(Fix(k * S + S, "bad", "position", (0.5 * k, 3.0 if k % 3 == 0 and k else 0.0), COVARIANCE))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    assert slam.counters.used["bad"] > 5
    return slam.view.trajectory()


def test_the_loss_of_an_input_keeps_its_outliers_from_the_estimate():
    assert np.abs(estimate()[:, 1]).max() > 0.5, "without a loss they pull"
    assert np.abs(estimate(bad__loss="dcs", robust__loss_scale=1.0)[:, 1]).max() < 0.1
    assert np.abs(estimate(good__loss="dcs", robust__loss_scale=1.0)[:, 1]).max() > 0.5, "of the other input"


def test_a_wrong_value_of_an_input_is_named():
    for values, complaint in (
        ({"good.loss": "tukey"}, "good.loss: 'tukey' is not one of auto, none, huber, cauchy"),
        ({"good.loss_scale": 1.5}, "'good.loss_scale' was removed"),
        ({"good.reliability": "yes"}, "good.reliability: 'yes' is not one of auto, reliable, best_effort"),
        ({"good.durability": "latched"}, "good.durability: 'latched' is not one of volatile, transient_local"),
        ({"odom.loss": "huber"}, "odom.loss: odom is used as odometry, which has no robust loss"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            uses(Config.from_mapping(INPUTS | values))
