"""Other people's recordings, which are not in this repository: GRAPH_SLAM_DATASETS says where they are."""

import os
import subprocess
import sys
from pathlib import Path

DATASETS = Path(os.environ.get("GRAPH_SLAM_DATASETS", Path(__file__).resolve().parents[1] / "../shared/datasets"))
CONVERTER = DATASETS.parent / "tools" / "mrclam_to_mcap.py"
SET_7 = DATASETS / "recorded" / "mrclam7"
HAS_MRCLAM = CONVERTER.exists() and SET_7.exists()
WITHOUT_MRCLAM = f"no MR.CLAM set 7 under {DATASETS}"


def mrclam(robot, bag):
    """Write the recording of a robot of UTIAS MR.CLAM set 7 with the truth; returns its folder."""
    subprocess.run([sys.executable, CONVERTER, SET_7, str(robot), bag, "--map"], check=True, stdout=subprocess.DEVNULL)
    return bag
