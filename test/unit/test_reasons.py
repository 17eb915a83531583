"""Every reason that the sources count has a row in the table, and every row is counted somewhere."""

import re
from pathlib import Path

import graph_slam_ros
from graph_slam_ros.config.config import parameters
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.findings.table import COUNTED, TABLE, Effect, explain, remedy

PACKAGE = Path(graph_slam_ros.__file__).parent
COUNTS = re.compile(
    r"(?:[Cc]ounters\.count|self\._count)\([^()]*?, \"(\w+)\"|(?:ource\.count|Error|_linked|efuse)\(\"(\w+)\""
)


def test_every_counted_reason_has_a_row_and_every_row_is_counted():
    text = "\n".join(file.read_text() for file in PACKAGE.rglob("*.py") if file.parent.name != "findings")
    found = {one or other for one, other in COUNTS.findall(text)}
    assert len(found) > 60
    assert found - COUNTED.keys() == set()
    assert [name for name in TABLE if f'"{name}"' not in text] == [], "nobody finds these any more"


def test_what_is_refused_has_a_remedy_and_remedies_name_parameters_that_exist():
    names = {p.name for p in parameters()}
    keys = {f"INPUT.{key}" for key in InputConfig.__slots__}
    sections = {name.partition(".")[0] for name in names} - {"odom", "detections"}
    without = {name for name, row in COUNTED.items() if row.effect is Effect.REFUSED and not row.remedy}
    assert without == {"before_jump", "within_one_keyframe"}
    for name, row in TABLE.items():
        for section, key in re.findall(r"\b([A-Za-z_]+)\.([a-z_]+)\b", f"{row.meaning} {row.remedy}"):
            if section in {*sections, "INPUT"} and key != "md":
                assert f"{section}.{key}" in names | keys, f"{name}: {section}.{key}"


def test_a_remedy_names_the_input_and_what_mends_a_transform_without_frames_is_no_parameter():
    assert remedy("imu", "noise_unknown").startswith("imu.sigma_m, imu.sigma_rad")
    assert explain("KeyError") is COUNTED["fault"]
    assert "header.frame_id" in remedy("tf", "frame_empty") and "tf." not in remedy("tf", "frame_empty")
    assert "detections.frame" in remedy("detections", "frame_empty")
