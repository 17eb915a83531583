"""Plans of edits: what is read is what was written; each fault is one line that names the edit and the key."""

import json

import pytest

from graph_slam_ros.errors import FormatError
from graph_slam_ros.maps.edit import FORMAT, Plan, plan_text, read_plan
from graph_slam_ros.measurements.edits import ACTIONS, AppliedEdit, aliases, applied_edit, edit_of
from graph_slam_ros.measurements.types import Control, from_record, to_record

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "two aisles look alike"}
EDGE = {"name": "wrong-closure", **WHO, "do": "remove_edge", "edge": 2114}
VALUES = {"edge": 7, "landmark": "7", "to": "dock", "into": "8"}


def written(folder, *edits, **others):
    file = folder / "edits.json"
    plan = {"format": FORMAT, "version": 1, "source": "sha256:0", "edits": list(edits)} | others
    file.write_text(json.dumps(plan))
    return file


@pytest.mark.parametrize("do", ACTIONS)
def test_each_edit_is_read_as_it_was_written(do, tmp_path):
    values = {"name": do, **WHO, "do": do} | {key: VALUES[key] for key in ACTIONS[do]}
    plan = Plan("sha256:0", (edit_of(values),))
    file = tmp_path / "edits.json"
    file.write_text(plan_text(plan))
    assert read_plan(file) == plan == read_plan(written(tmp_path, values))
    event = Control("edit", tuple(plan.edits[0].values.items()))
    assert from_record(json.loads(json.dumps(to_record(event)))) == event
    applied = AppliedEdit(plan.edits[0], 3, (1, 2), (9,))
    assert applied_edit(json.loads(json.dumps(applied.record))) == applied


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"edge": 7.0}, "edge: 7.0 is not a whole number"),
        ({"edge": True}, "edge: True is not a whole number"),
        ({"edge": "7"}, "edge: '7' is not a whole number"),
        ({"edge": -1}, "edge: -1 is not a whole number"),
        ({"edge": 2**63}, "edge: 9223372036854775808 is not a whole number"),
        ({"edge": None}, "edge: None is not a whole number"),
        ({"edgee": 7}, "'edgee': unknown key"),
        ({"do": "remove"}, "do: 'remove' is none of remove_edge"),
        ({"do": ["remove_edge"]}, "do: ['remove_edge'] is none of"),
        ({"do": "remove_landmark"}, "'edge': unknown key; remove_landmark has"),
        ({"who": ""}, "who: empty"),
        ({"why": " \n"}, "why: empty"),
        ({"who": 3}, "who: 3 is not a text"),
        ({"why": "x" * 2001}, "why: 2001 characters, at most 2000"),
        ({"when": "yesterday"}, "when: 'yesterday' is not a time with its zone"),
        ({"when": "2026-05-04T10:30:00"}, "is not a time with its zone"),
        ({"name": "x" * 81}, "name: 81 characters"),
    ],
)
def test_a_fault_of_an_edit_is_named(change, named, tmp_path):
    file = written(tmp_path, EDGE | {"name": "first"}, EDGE | change)
    with pytest.raises(FormatError) as raised:
        read_plan(file)
    assert str(raised.value).startswith(f"{file}: edit 2: ")
    assert named in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("key", EDGE)
def test_a_key_that_is_missing_is_named(key, tmp_path):
    with pytest.raises(FormatError, match=f"edit 1: {key}: missing"):
        read_plan(written(tmp_path, {name: value for name, value in EDGE.items() if name != key}))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[]", "not a plan of edits"),
        ('{"format": "other"}', "not a plan of edits"),
        ('{"format": "F", "version": 2, "source": "s", "edits": []}', "version: 2 is not 1"),
        ('{"format": "F", "version": true, "source": "s", "edits": []}', "version: True is not 1"),
        ('{"format": "F", "version": 1, "edits": []}', "source: None is not the hash"),
        ('{"format": "F", "version": 1, "source": "s"}', "edits: None is not a list"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [7]}', "edit 1: 7 is not an object"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [], "by": 1}', "'by': unknown key"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [{"edge": NaN}]}', "NaN is not a finite number"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [{"edge": -Infinity}]}', "-Infinity is not a finite"),
        ('{"format": "F", "version": 1, "version": 1, "source": "s", "edits": []}', "key 'version' is there twice"),
    ],
)
def test_what_is_no_plan_is_refused(text, named, tmp_path):
    file = tmp_path / "edits.json"
    file.write_text(text.replace('"F"', json.dumps(FORMAT)))
    with pytest.raises(FormatError) as raised:
        read_plan(file)
    assert str(raised.value).startswith(f"{file}: ")
    assert named in str(raised.value)


def test_bytes_that_are_no_text_and_what_is_not_there_are_refused(tmp_path):
    file = tmp_path / "edits.json"
    with pytest.raises(FormatError, match="No such file"):
        read_plan(file)
    file.write_bytes(b"\xff\xfe{")
    with pytest.raises(FormatError, match="not JSON"):
        read_plan(file)


def test_two_edits_of_one_name_and_a_landmark_with_itself_are_refused(tmp_path):
    with pytest.raises(FormatError, match="edit 2: name: 'wrong-closure' is the name of another edit"):
        read_plan(written(tmp_path, EDGE, EDGE))
    for do, key in (("rename_landmark", "to"), ("merge_landmarks", "into")):
        with pytest.raises(FormatError, match=f"{key}: '7' is the landmark itself"):
            edit_of({"name": do, **WHO, "do": do, "landmark": "7", key: "7"})


def test_an_identity_follows_its_landmark_through_mergers_and_new_names():
    def applied(do, **arguments):
        return AppliedEdit(edit_of({"name": "n", **WHO, "do": do, **arguments}), 0, (), ())

    merged = [
        applied("merge_landmarks", landmark="3", into="2"),
        applied("merge_landmarks", landmark="2", into="1"),
    ]
    assert aliases(merged) == {"3": "1", "2": "1"}
    renamed = [*merged, applied("rename_landmark", landmark="1", to="dock")]
    assert aliases(renamed) == {"3": "dock", "2": "dock"}
    assert aliases([*renamed, applied("remove_landmark", landmark="dock")]) == {}
