"""Coverage-guided fuzzing of g2o, parameter files and the decoding of messages.

``python test/guided_fuzzing.py g2o|yaml|cdr SECONDS`` with atheris (``make .venv-fuzz/stamp``: it is for this alone)
begins with ``test/corpus`` and adds to it what takes a new way through the code. An input that ends in anything but
data or one of our errors is written to the present folder, and the exit code is not 0. The tests run the corpus through
the same functions without atheris.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

CORPUS = Path(__file__).resolve().parent / "corpus"
TARGETS = ("g2o", "yaml", "cdr")
LIMITS = ["-timeout=5", "-rss_limit_mb=512", "-max_len=4096"]
INPUTS = {
    "odom": "nav_msgs/msg/Odometry",
    "detections": "vision_msgs/msg/Detection3DArray",
    "gps": "sensor_msgs/msg/NavSatFix",
    "imu": "sensor_msgs/msg/Imu",
    "cloud": "sensor_msgs/msg/PointCloud2",
    "markers": "visualization_msgs/msg/MarkerArray",
    "poses": "geometry_msgs/msg/PoseStamped",
    "tf": "tf2_msgs/msg/TFMessage",
    "initialpose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}
OF_THE_NODE = ("tf", "initialpose")


def target(name, file):
    """What takes the bytes of one input; the file is where those are put that a reader wants in one."""
    from graph_slam_ros.errors import GraphSlamError
    from graph_slam_ros.formats.g2o import read_g2o
    from graph_slam_ros.formats.parameters import read_parameters
    from graph_slam_ros.ros.from_msg import Border
    from graph_slam_ros.slam import Config, Counters

    def g2o(data):
        file.write_bytes(data)
        read_g2o(file, lenient=len(data) % 2 == 0)

    def yaml(data):
        file.write_bytes(data)
        Config.from_mapping(read_parameters(file))

    own = {f"{key}.type": kind for key, kind in INPUTS.items() if key not in OF_THE_NODE}
    config = Config.from_mapping({"inputs.names": " ".join(key for key in INPUTS if key not in OF_THE_NODE), **own})

    def cdr(data):
        """The first byte is the input's; the message is told twice, since the second meets what the first left."""
        if data:
            border = Border(config, Counters())
            for _ in range(2):
                border.take(tuple(INPUTS)[data[0] % len(INPUTS)], data[1:])

    of_name = {"g2o": g2o, "yaml": yaml, "cdr": cdr}[name]

    def run(data):
        with contextlib.suppress(GraphSlamError):
            of_name(data)

    return run


def main(name, seconds):
    import atheris

    with atheris.instrument_imports(include=["graph_slam_ros", "yaml"]):
        import graph_slam_ros.formats.g2o
        import graph_slam_ros.formats.parameters
        import graph_slam_ros.ros.from_msg  # noqa: F401
    with tempfile.TemporaryDirectory() as folder:
        run = target(name, Path(folder) / f"input.{name}")
        atheris.Setup([sys.argv[0], f"-max_total_time={seconds}", *LIMITS, str(CORPUS / name)], run)
        atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
