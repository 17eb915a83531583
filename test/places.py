"""Where things are: the repository, its tests, and public recordings outside it (GRAPH_SLAM_DATASETS)."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATASETS = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT / "../shared/datasets"))
CONVERTER = DATASETS.parent / "tools" / "mrclam_to_mcap.py"
SET_7 = DATASETS / "recorded" / "mrclam7"
HAS_MRCLAM = CONVERTER.exists() and SET_7.exists()
WITHOUT_MRCLAM = f"no MR.CLAM set 7 under {DATASETS}"


def mrclam(robot, bag, *options):
    """Write the recording of a robot of UTIAS MR.CLAM set 7 with the truth; returns its folder."""
    written = [sys.executable, CONVERTER, SET_7, str(robot), bag, "--map", *options]
    subprocess.run(written, check=True, stdout=subprocess.DEVNULL)
    return bag


def test_path(name):
    """Return the path from the root of a test, ``test_solver.py`` or ``test_solver.py::test_a_report_adds_up``."""
    file, *test = name.split("::")
    (path,) = (ROOT / "test").rglob(file)
    return "::".join([str(path.relative_to(ROOT)), *test])


test_path.__test__ = False
