"""The robust loss of one input: what it does to the estimate, and what is refused."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.graph import POINT_PRIOR, R1, Gaussian, Graph, Loss
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.slam import Control, Fix, GraphSlam, Odometry
from graph_slam_ros.solver import Settings, Solver

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
    return slam.trajectory()


def test_the_loss_of_an_input_keeps_its_outliers_from_the_estimate():
    assert np.abs(estimate()[:, 1]).max() > 0.5, "without a loss they pull"
    assert np.abs(estimate(bad__loss="dcs", robust__loss_scale=1.0)[:, 1]).max() < 0.1
    assert np.abs(estimate(good__loss="dcs", robust__loss_scale=1.0)[:, 1]).max() > 0.5, "of the other input"


def test_inputs_that_all_have_one_loss_give_the_estimate_of_that_loss_for_their_class():
    by_class = estimate(robust__loss="cauchy", robust__loss_scale=1.5)
    by_input = estimate(good__loss="cauchy", bad__loss="cauchy", robust__loss_scale=1.5)
    np.testing.assert_array_equal(by_input, by_class)


@pytest.mark.parametrize("first", ["a", "b"])
def test_the_minimum_is_that_of_the_sum_of_both_losses(first):
    """The order in which sources came into the graph says nothing."""
    graph, measured = Graph(), {"a": 0.0, "b": 2.0}
    vertex = graph.add_vertex(R1, [0.3])
    for source in sorted(measured, key=lambda one: one != first):
        graph.add_edge(POINT_PRIOR[R1], [vertex], [measured[source]], Gaussian.from_sigmas(1.0), "fixes", source)
    loss = Loss.named("cauchy", 0.5)
    solver = Solver(graph, Settings(losses={"fixes": [Loss()], ("fixes", "b"): [loss]}, cost_tolerance=1e-14))
    solver.add([vertex], np.arange(2))
    report = solver.optimize()

    def cost(x):
        return x**2 + 0.25 * np.log1p((x - 2.0) ** 2 / 0.25)

    best = minimize_scalar(cost, bracket=(0.0, 0.5), options={"xtol": 1e-12})
    assert solver.values[0] == pytest.approx(best.x, abs=1e-5)
    assert report.cost_final == pytest.approx(best.fun, rel=1e-9)
    assert cost(2.0) > best.fun


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
