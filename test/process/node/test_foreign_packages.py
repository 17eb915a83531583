"""An input whose message package is not among the wheels, in a live graph where that package is installed."""

import subprocess
from types import SimpleNamespace

import built_packages
import numpy as np
from executables import executable
from foreign import DEFINITIONS, parts
from live_nodes import ENVIRONMENT
from messages import STAMP_NS, odometry, part, pose, quaternion, sent
from recordings import definition, write_mcap

from graph_slam_ros.messages.to_msg import header, make, vector

FIDUCIALS = "fiducial_msgs/msg/FiducialTransformArray"
SETTINGS = ("inputs.names=odom tags", f"tags.type={FIDUCIALS}", "tags.topic=/fiducial_transforms", "tags.sigma_m=0.1")


def seen_at(x, y):
    return make("geometry_msgs/msg/Transform", translation=vector(x, y, 0.0), rotation=quaternion())


def record(file):
    """A robot on a line that sees two fiducials."""
    kept = []
    for k in range(30):
        stamp_ns, x = STAMP_NS + k * 10**8, 0.1 * k
        found = [
            part("fiducial_msgs/msg/FiducialTransform", fiducial_id=number, transform=seen_at(5.0 - x, y))
            for number, y in ((7, 1.0), (8, -1.0))
        ]
        kept.append(("/odom", stamp_ns, odometry(pose(x), stamp_ns=stamp_ns)))
        cdr = sent(FIDUCIALS, header=header(stamp_ns, "base_link"), image_seq=k, transforms=found)
        kept.append(("/fiducial_transforms", stamp_ns, cdr))
    return write_mcap(
        file,
        [SimpleNamespace(topic=topic, log_ns=stamp_ns, cdr=cdr) for topic, stamp_ns, cdr in kept],
        types={"/odom": "nav_msgs/msg/Odometry", "/fiducial_transforms": FIDUCIALS},
        text=lambda name: DEFINITIONS.get(name) or definition(name),
    )


def test_a_node_subscribes_to_a_type_whose_package_is_installed(request, tmp_path, tmp_path_factory, monkeypatch):
    built_packages.use("fiducial_msgs", parts(FIDUCIALS), request, tmp_path_factory, monkeypatch)
    bag, settings = record(tmp_path / "drive.mcap"), [word for one in SETTINGS for word in ("--set", one)]
    for name, options in (("live", ["--ros"]), ("offline", [])):
        words = [executable("graph_slam"), "replay", bag, *options, *settings, "--out", tmp_path / name]
        done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
    for name in ("graph.g2o", "path.tum", "landmarks.csv"):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "offline" / name).read_bytes()
    landmarks = np.genfromtxt(tmp_path / "live" / "landmarks.csv", delimiter=",", names=True)
    assert sorted(landmarks["id"]) == [7, 8]
