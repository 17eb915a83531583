"""Names of the node's topics and services, except its inputs."""

from dataclasses import dataclass
from functools import partial


@dataclass(frozen=True, slots=True)
class Interface:
    """A topic or service; ``~`` is the node's own name, a relative name is in the node's namespace.

    ``latched`` means reliable and transient local with depth 1: a late subscriber gets the last message.
    """

    name: str
    type: str
    meaning: str
    latched: bool = False

    def resolved(self, node: str = "/graph_slam") -> str:
        """The name on a node with this fully qualified name."""
        if self.name.startswith("~/"):
            return node + self.name[1:]
        return self.name if self.name.startswith("/") else f"{node.rpartition('/')[0]}/{self.name}"


_latched = partial(Interface, latched=True)

PUBLICATIONS = (
    _latched("~/path", "nav_msgs/msg/Path", "the corrected path: every keyframe at its own stamp"),
    Interface("~/path_updates", "nav_msgs/msg/Path", "the keyframes that are new or have moved"),
    _latched(
        "~/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", "the newest keyframe in the map, with covariance"
    ),
    Interface("~/odometry", "nav_msgs/msg/Odometry", "the robot in the map, at each odometry message"),
    _latched("~/landmarks", "visualization_msgs/msg/MarkerArray", "landmarks as 2-sigma ellipses"),
    _latched(
        "~/landmarks_estimate",
        "vision_msgs/msg/Detection3DArray",
        "landmarks with identity, position or pose, covariance",
    ),
    _latched("~/graph", "visualization_msgs/msg/MarkerArray", "vertices and edges of the graph"),
    Interface("~/events", "diagnostic_msgs/msg/DiagnosticArray", "events: new keyframes, verdicts, corrections"),
    _latched("~/received", "std_msgs/msg/UInt64", "messages received, for the player's pace"),
    Interface("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", "state, counters, chi2, times"),
    Interface("/tf", "tf2_msgs/msg/TFMessage", "map -> odom"),
)

# Beside the inputs (inputs.names); odom and detections are the default ones.
SUBSCRIPTIONS = (
    Interface("odom", "nav_msgs/msg/Odometry", "odometry"),
    Interface("landmarks", "vision_msgs/msg/Detection3DArray", "observations of landmarks"),
    Interface("initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped", "pose of the robot in the map"),
    Interface("~/remove", "std_msgs/msg/String", "remove one edge or landmark: `edge 231` or `landmark dock`"),
    Interface("/tf", "tf2_msgs/msg/TFMessage", "sensors on moving joints, inputs on TF"),
    _latched("/tf_static", "tf2_msgs/msg/TFMessage", "poses of sensors on the robot"),
    Interface("/clock", "rosgraph_msgs/msg/Clock", "time, with use_sim_time"),
)

SERVICES = (
    Interface("~/save", "std_srvs/srv/Trigger", "solve everything and write the run folder"),
    Interface("~/load", "std_srvs/srv/Trigger", "save the run and load the map of another"),
    Interface("~/reset", "std_srvs/srv/Trigger", "save the run and begin a new one"),
    Interface("~/pause", "std_srvs/srv/Trigger", "refuse measurements until `~/resume`"),
    Interface("~/resume", "std_srvs/srv/Trigger", "process measurements again"),
    Interface("~/optimize", "std_srvs/srv/Trigger", "solve everything until converged"),
    Interface("~/clear_closures", "std_srvs/srv/Trigger", "remove all loop closures from the graph"),
)
