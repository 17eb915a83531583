"""Where things are: the repository, its tests and commands, and public recordings outside it (GRAPH_SLAM_DATASETS)."""

import gzip
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATASETS = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT / "../shared/datasets"))
CONVERTER = DATASETS.parent / "tools" / "mrclam_to_mcap.py"
SET_7 = DATASETS / "recorded" / "mrclam7"
HAS_MRCLAM = CONVERTER.exists() and SET_7.exists()
WITHOUT_MRCLAM = f"no MR.CLAM set 7 under {DATASETS}"


def mrclam(robot, bag, *options, seconds=None):
    """Write the recording of a robot of UTIAS MR.CLAM set 7 with the truth, or its beginning; returns its folder."""
    with tempfile.TemporaryDirectory() as folder:
        of = SET_7 if seconds is None else _beginning(robot, Path(folder), seconds)
        written = [sys.executable, CONVERTER, of, str(robot), bag, "--map", *options]
        subprocess.run(written, check=True, stdout=subprocess.DEVNULL)
    return bag


def _beginning(robot, folder, seconds):
    """The files of a robot, without what was recorded later."""
    for table in ("Barcodes.dat", "Landmark_Groundtruth.dat"):
        shutil.copy(SET_7 / table, folder)
    end_s = None
    for name in ("Odometry", "Measurement", "Groundtruth"):
        with gzip.open(SET_7 / f"Robot{robot}_{name}.dat.gz", "rt") as whole:
            lines = [line for line in whole if not line.startswith("#")]
        end_s = end_s or float(lines[0].split()[0]) + seconds
        kept = [line for line in lines if float(line.split()[0]) < end_s]
        (folder / f"Robot{robot}_{name}.dat").write_text("".join(kept))
    return folder


def executable(name):
    """Return an installed command: pip puts it beside Python, colcon where ``ros2 run`` looks for it."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    folders = [Path(sys.executable).parent, *(Path(prefix, "lib", "graph_slam_ros") for prefix in prefixes)]
    return next((file for folder in folders if (file := folder / name).exists()), folders[0] / name)


def test_path(name):
    """Return the path from the root of a test, ``test_solver.py`` or ``test_solver.py::test_a_report_adds_up``."""
    file, *test = name.split("::")
    (path,) = (ROOT / "test").rglob(file)
    return "::".join([str(path.relative_to(ROOT)), *test])


test_path.__test__ = False
