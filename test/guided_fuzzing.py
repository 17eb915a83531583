"""Coverage-guided fuzzing of g2o, parameter files, the journal and the decoding of messages.

``python test/guided_fuzzing.py g2o|yaml|cdr|journal SECONDS`` with atheris (``make .venv-fuzz/stamp``: for this alone)
begins with ``test/corpus`` and adds to it what takes a new way through the code. An input that ends in anything but
data or one of our errors is written to the present folder, and the exit code is not 0. The tests run the corpus through
the same functions without atheris.
"""

import contextlib
import json
import sys
import tempfile
from pathlib import Path

CORPUS = Path(__file__).resolve().parent / "corpus"
TARGETS = ("g2o", "yaml", "cdr", "journal")
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
FOLDERS = ("formats", "runs.map_journal", "messages", "recordings", "node")
INSTRUMENTED = [*(f"graph_slam_ros.{name}" for name in FOLDERS), "yaml"]
"""Without what is compiled."""
OF_THE_NODE = ("tf", "initialpose")


def target(name, file):
    """What takes the bytes of one input; the file is where those are put that a reader wants in one."""
    from graph_slam_ros.errors import GraphSlamError
    from graph_slam_ros.formats.g2o import read_g2o
    from graph_slam_ros.formats.parameters import read_parameters
    from graph_slam_ros.measurements.types import from_record
    from graph_slam_ros.messages.from_msg import MessageConverter
    from graph_slam_ros.runs.journal import INGEST, RecordWriter, read_ingest
    from graph_slam_ros.runs.map_journal import MAP, read_map
    from graph_slam_ros.slam import Config, Counters, GraphSlam

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
            border = MessageConverter(config, Counters())
            for _ in range(2):
                border.convert(tuple(INPUTS)[data[0] % len(INPUTS)], data[1:])

    def journal(data):
        """The lines as records of both files; beginning with mcap's magic, as the files themselves."""
        for part in (INGEST, MAP):
            path = file.with_name(f"{part}.mcap")
            path.unlink(missing_ok=True)  # of the input before
            if data.startswith(b"\x89"):
                path.write_bytes(data)
                continue
            writer = RecordWriter(path)
            for record in data.splitlines():
                with contextlib.suppress(ValueError, RecursionError):  # what our own writer could not have written
                    told = json.loads(record)
                    if isinstance(told, dict) and isinstance(told.get("type"), str):
                        writer.write([told | {"stamp_ns": 0}])
            writer.close()
        with contextlib.suppress(GraphSlamError):
            state = read_map(file.parent, [])
            if state is not None:
                GraphSlam(start=state)
        slam = GraphSlam()
        for record in read_ingest(file.parent, []):
            slam.process(from_record(record))

    of_name = {"g2o": g2o, "yaml": yaml, "cdr": cdr, "journal": journal}[name]

    def run(data):
        with contextlib.suppress(GraphSlamError):
            of_name(data)

    return run


def main(name, seconds):
    import atheris

    from graph_slam_ros.warmup import warmup

    warmup()
    with tempfile.TemporaryDirectory() as folder:
        with atheris.instrument_imports(include=INSTRUMENTED):
            run = target(name, Path(folder) / f"input.{name}")
        atheris.Setup([sys.argv[0], f"-max_total_time={seconds}", *LIMITS, str(CORPUS / name)], run)
        atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
