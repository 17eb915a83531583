"""Every reason that the sources count has a row in the table, and every row is counted somewhere."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import graph_slam_ros
from graph_slam_ros.config.config import parameters
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.measurements.reasons import REASONS, Effect, explain, remedy

PACKAGE = Path(graph_slam_ros.__file__).parent
VARIABLES = {"repair", "reason", "why", "broken", "str(reason)", "type(error).__name__"}  # what else is counted


def _argument(call: ast.Call) -> ast.expr | None:
    """The reason that a call counts, if it is one that counts."""
    name = ast.unparse(call.func)
    at = None
    if name.endswith("ounters.count") or name == "self._count":
        at = 1
    elif name in ("source.count", "self.count", "MessageError", "self._not_linked", "self._refuse", "self.refuse"):
        at = 0
    elif name == "partial" and ast.unparse(call.args[0]) == "self._refuse":
        at = 1
    return None if at is None else call.args[at]


def _texts(node: ast.AST) -> Iterator[str]:
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str) and inner.value:
            yield inner.value


def counted(tree: ast.AST) -> Iterator[str]:
    """Reasons in the text of a module; what is counted by a variable must be one of those followed here."""
    for node in ast.walk(tree):
        match node:
            case ast.Call() if (argument := _argument(node)) is not None and ast.unparse(argument) != "1":
                assert not isinstance(argument, ast.JoinedStr), f"{ast.unparse(node)}: reasons are plain names"
                texts = [*_texts(argument)]
                assert texts or ast.unparse(argument) in VARIABLES | {"-1"}, ast.unparse(node)
                yield from texts
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if name == "reason":
                yield from _texts(value)
            case ast.keyword(arg="broken", value=value):
                yield from _texts(value)
            case ast.Constant(value=str(text)) if re.fullmatch(r"covariance_[a-z_]+", text):
                yield text  # repairs are handed on as a list


def test_every_counted_reason_has_a_row_and_every_row_is_counted():
    found: dict[str, set[str]] = {}
    for file in PACKAGE.rglob("*.py"):
        text = file.read_text()
        if file.parent.name == "check":  # its findings are not counted
            continue
        if file.name != "reasons.py" and re.search("[Cc]ounters|MessageError|def admit|class OdometryJumps", text):
            for reason in counted(ast.parse(text)):
                found.setdefault(reason, set()).add(file.name)
    assert {reason: files for reason, files in found.items() if reason not in REASONS} == {}
    assert REASONS.keys() - found.keys() - {"fault"} == set(), "nobody counts these any more"


def test_what_is_refused_has_a_remedy_and_remedies_name_parameters_that_exist():
    names = {p.name for p in parameters()}
    keys = {f"INPUT.{key}" for key in InputConfig.__slots__}
    sections = {name.partition(".")[0] for name in names} - {"odom", "detections"}
    without = {name for name, row in REASONS.items() if row.effect is Effect.REFUSED and not row.remedy}
    assert without == {"before_jump", "within_one_keyframe"}
    for name, row in REASONS.items():
        assert row.meaning and not row.meaning.endswith("."), name
        for section, key in re.findall(r"\b([A-Za-z_]+)\.([a-z_]+)\b", f"{row.meaning} {row.remedy}"):
            if section in {*sections, "INPUT"} and key != "md":
                assert f"{section}.{key}" in names | keys, f"{name}: {section}.{key}"


def test_a_remedy_names_the_input_and_an_exception_has_the_row_of_faults():
    assert remedy("imu", "noise_unknown").startswith("imu.sigma_m, imu.sigma_rad")
    assert remedy("odom", "duplicate") == ""
    assert explain("SingularError") is REASONS["fault"]


def test_what_mends_a_transform_without_frames_is_no_parameter():
    for source in ("tf", "tf_static"):
        assert "header.frame_id" in remedy(source, "frame_empty")
        assert f"{source}." not in remedy(source, "frame_empty")
    assert "detections.frame" in remedy("detections", "frame_empty")
