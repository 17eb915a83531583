"""docs/troubleshooting.md says what the code says: every counter, every reason of a state; its recipes are read.

``PYTHONPATH=test python test/process/test_troubleshooting.py`` writes the table of counters anew.
"""

import json
import re
import subprocess
import sys
import time

import pytest
from places import ROOT
from rows import each

from graph_slam_ros.findings.table import COUNTED, OF_NODE
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.runs.tables import INPUT_COLUMNS
from graph_slam_ros.slam import Config

PAGE = ROOT / "docs/troubleshooting.md"
USED = INPUT_COLUMNS["used"]
REASONS, HOLE = "| reason | what to do |\n|---|---|\n", re.compile(r"\{0\.(\w+)[^}]*\}")
HOLES = {"topic": "TOPIC", "text": "WHAT"}
HEAD = "| counter | effect | what it means | remedy |\n|---|---|---|---|\n"


def table():
    rows = (f"| `{name}` | {row.effect.value} | {row.meaning} | {row.remedy} |" for name, row in COUNTED.items())
    return HEAD + "\n".join(rows) + "\n"


def reasons():
    rows = ((row.meaning, row.remedy) for name, row in OF_NODE.items() if name not in ("preparing", "unconnected"))
    return REASONS + "\n".join(HOLE.sub(lambda m: HOLES.get(m[1], "N"), f"| {a} | {b} |") for a, b in rows) + "\n"


def blocks(kind, text=None):
    return re.findall(rf"```{kind}\n(.*?)```", text or PAGE.read_text(), re.DOTALL)


def test_every_counter_is_on_the_page():
    assert f"\n\n{table()}\n" in PAGE.read_text(), (
        "PYTHONPATH=test python test/process/test_troubleshooting.py writes it"
    )


def test_every_reason_of_a_state_is_on_the_page():
    assert f"\n\n{reasons()}\n" in PAGE.read_text()


@each("block", blocks("yaml"))
def test_a_recipe_is_a_parameter_file_and_its_input_can_be_used_so(block, tmp_path):
    file = tmp_path / "recipe.yaml"
    file.write_text(block)
    config = Config.from_mapping(read_parameters(file))
    used = uses(config)
    assert used.pop("odom") == "odometry"
    assert set(used.values()) == {"landmarks"}


def test_the_publisher_of_detections_works_with_a_node_as_it_stands(tmp_path):
    live = pytest.importorskip("live_nodes")
    from messages import odometry, pose

    (script,) = blocks("python")
    (tmp_path / "detector.py").write_text(script)
    detector = subprocess.Popen([sys.executable, "detector.py"], cwd=tmp_path, env=live.ENVIRONMENT)
    try:
        with live.node(f"output.folder:={tmp_path / 'run'}") as n, live.robot(hears=("/diagnostics",)) as r:
            r.wait_for_node()

            def stand(seconds):
                r.send("/odom", odometry(pose(1.0, 0.0), stamp_ns=time.time_ns()))
                r.spin(seconds)

            def used(status):
                said = r.said(status)
                return int(said[-1][1][USED]) if said else 0

            live.until(
                lambda: used("input detections") > 1 and used("input odom") > 10, stand, "detections that are used"
            )
            assert r.save().success
            assert n.stop()[0] == 0
    finally:
        detector.kill()
        detector.wait()
    for one in json.loads((tmp_path / "run/run.json").read_text())["inputs"].values():
        assert one["received"] >= one["used"] >= 1, "a live run tells it as a replay does"
    (line,) = [line for line in (tmp_path / "run/landmarks.csv").read_text().splitlines() if line.startswith("dock")]
    assert line.split(",")[2:4] == ["3.0", "0.5"]


if __name__ == "__main__":
    text = re.sub(re.escape(HEAD) + r"(\|.*\n)*", lambda _: table(), PAGE.read_text())
    PAGE.write_text(re.sub(re.escape(REASONS) + r"(\|.*\n)*", lambda _: reasons(), text))
