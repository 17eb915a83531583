"""Plans of edits: what is read is what was written; each fault is one line that names the edit and the key.

``PYTHONPATH=test python test/unit/maps/test_edit_plan.py`` writes the tables of docs/edits.md anew.
"""

import json
import re

import pytest
from places import ROOT

from graph_slam_ros.cli.parser import parser
from graph_slam_ros.errors import FormatError
from graph_slam_ros.maps.edit import FORMAT, Plan, plan_text, read_plan
from graph_slam_ros.measurements.edit_actions import ACTIONS
from graph_slam_ros.measurements.edits import AppliedEdit, aliases, applied_edit, edit_of
from graph_slam_ros.measurements.types import Control, from_record, to_record

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "two aisles look alike"}
EDGE = {"name": "wrong-closure", **WHO, "do": "remove_edge", "edge": 2114}
VALUES = {"edge": 7, "landmark": "7", "to": "dock", "into": "8", "edges": [3, 9], "from": 2, "until": "7.5"}
VALUES |= {"from_keyframe": 1, "to_keyframe": "1700000000.25", "keyframe": 4, "pose": [1.0, 2, 0.5]}
VALUES |= {"sigma_m": 0.1, "sigma_rad": 0.02}


def values_of(do, either=0):
    action = ACTIONS[do]
    keys = [*action.fields, *(action.either[either] if action.either else ())]
    return {"name": do, **WHO, "do": do} | {key: VALUES[key] for key in keys}


PAGE = ROOT / "docs/edits.md"


def kinds_table():
    rows = (f"| `{do}` | {keys_of(action)} | {action.help} |" for do, action in ACTIONS.items())
    return "\n".join(["| `do` | keys | what it does |", "|---|---|---|", *rows, ""])


def keys_of(action):
    return re.sub(r"(?<![\w`])(?!either\b|or\b)(\w+)", r"`\1`", action.keys_text)


def keys_table():
    uses = [(field.text, key, do) for do, action in ACTIONS.items() for key, field in action.known.items()]
    rows = []
    for text in dict.fromkeys(text for text, _, _ in uses):
        keys = dict.fromkeys(key for other, key, _ in uses if other == text)
        is_one_of_two = any(key in keys and other != text for other, key, _ in uses)
        dos = ", ".join(dict.fromkeys(f"`{do}`" for other, _, do in uses if other == text))
        rows.append(f"| {', '.join(f'`{key}`' for key in keys)} | {text}{f' ({dos})' if is_one_of_two else ''} |")
    return "\n".join(["| key | what it is |", "|---|---|", *rows, ""])


def test_the_page_has_every_kind_and_every_key():
    for table in (kinds_table(), keys_table()):
        assert f"\n\n{table}\n" in PAGE.read_text(), "PYTHONPATH=test python test/unit/maps/test_edit_plan.py writes it"


def test_the_help_of_the_command_has_every_kind(capsys):
    with pytest.raises(SystemExit):
        parser().parse_args(["map", "edit", "--help"])
    text = capsys.readouterr().out
    for do, action in ACTIONS.items():
        assert f"  {do:16s} {action.keys_text}" in text


def written(folder, *edits, **others):
    file = folder / "edits.json"
    plan = {"format": FORMAT, "version": 1, "source": "sha256:0", "edits": list(edits)} | others
    file.write_text(json.dumps(plan))
    return file


@pytest.mark.parametrize(
    ("do", "either"), [(do, k) for do, action in ACTIONS.items() for k in range(max(1, len(action.either)))]
)
def test_each_edit_is_read_as_it_was_written(do, either, tmp_path):
    values = values_of(do, either)
    plan = Plan("sha256:0", (edit_of(values),))
    file = tmp_path / "edits.json"
    file.write_text(plan_text(plan))
    assert read_plan(file) == plan == read_plan(written(tmp_path, values))
    event = Control("edit", tuple(plan.edits[0].values.items()))
    assert from_record(json.loads(json.dumps(to_record(event)))) == event
    applied = AppliedEdit(plan.edits[0], 3, (1, 2), (9,))
    assert applied_edit(json.loads(json.dumps(applied.record))) == applied


def without_edge(do, **others):
    return {"do": do, "edge": None} | others


def split(**others):
    return without_edge("split_landmark", **{"landmark": "7", "to": "dock", **others})


def cut(**others):
    return without_edge("cut", **{"from": 2, "until": 7, **others})


def closure(**others):
    keys = ("from_keyframe", "to_keyframe", "pose", "sigma_m", "sigma_rad")
    return without_edge("add_closure", **{key: VALUES[key] for key in keys} | others)


def moved(**others):
    return without_edge("move_map", **{key: VALUES[key] for key in ("pose", "sigma_m", "sigma_rad")} | others)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"edge": 7.0}, "edge: 7.0 is not the id of an edge: a whole number"),
        ({"edge": True}, "edge: True is not the id of an edge: a whole number"),
        ({"edge": "7"}, "edge: '7' is not the id of an edge: a whole number"),
        ({"edge": -1}, "edge: -1 is not the id of an edge: a whole number"),
        ({"edge": 2**63}, "edge: 9223372036854775808 is not the id of an edge: a whole number"),
        ({"edge": None}, "edge: None is not the id of an edge: a whole number"),
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
        (split(edges=[]), "edges: [] is not a list of ids of edges, each once"),
        (split(edges=[3, 3]), "edges: [3, 3] is not a list of ids of edges, each once"),
        (split(edges=[3, -1]), "edges: [3, -1] is not a list of ids"),
        (split(edges=7), "edges: 7 is not a list of ids"),
        (split(), "edges or from, until: expected one of them"),
        (split(**{"edges": [3], "from": 2}), "edges or from, until: expected one of them"),
        (split(**{"from": 2}), "until: missing; split_landmark has"),
        (split(to="7", edges=[3]), "to: '7' is the landmark itself"),
        (split(to="x" * 129, edges=[3]), "is not a text of up to 128 characters"),
        (cut(until="yesterday"), "until: 'yesterday' is not the number of a keyframe, or a stamp"),
        (cut(until=7.5), "until: 7.5 is not the number of a keyframe"),
        (cut(until="-3"), "until: '-3' is not the number of a keyframe"),
        (cut(until="1e9"), "until: '1e9' is not the number of a keyframe"),
        (cut(until=[1]), "until: [1] is not the number of a keyframe"),
        (closure(pose=[1.0, 2.0]), "pose: [1.0, 2.0] is not a pose: [x, y, theta], or in space"),
        (closure(pose="1 2 3"), "pose: '1 2 3' is not a pose"),
        (closure(pose=[1.0, 2.0, 1e300]), "pose: [1.0, 2.0, 1e+300] is not a pose"),
        (closure(pose=[1.0, 2.0, None]), "pose: [1.0, 2.0, None] is not a pose"),
        (closure(pose=[1.0, 2.0, True]), "pose: [1.0, 2.0, True] is not a pose"),
        (closure(pose=[0, 0, 0, 0, 0, 0, 2]), "is not a pose"),
        (closure(sigma_m=0.0), "sigma_m: 0.0 is not a standard deviation in metres, above 0"),
        (closure(sigma_rad=-1), "sigma_rad: -1 is not a standard deviation in radians, above 0"),
        (closure(sigma_rad="small"), "sigma_rad: 'small' is not a standard deviation"),
        (moved(sigma_m=-0.1), "sigma_m: -0.1 is not a standard deviation in metres; 0: exact"),
    ],
)
def test_a_fault_of_an_edit_is_named(change, named, tmp_path):
    values = EDGE | change
    if change.get("do", "remove_edge") != "remove_edge" and values["edge"] is None:
        del values["edge"]
    file = written(tmp_path, EDGE | {"name": "first"}, values)
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


if __name__ == "__main__":
    page = PAGE.read_text()
    for table in (kinds_table(), keys_table()):
        head = re.escape("\n".join(table.split("\n")[:2]))
        page = re.sub(head + r"\n(\|.*\n)*", lambda _, table=table: table, page)
    PAGE.write_text(page)
