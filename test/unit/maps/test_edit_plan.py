"""Plans of edits: what is read is what was written; each fault is one line that names the edit and the key.

``PYTHONPATH=test python test/unit/maps/test_edit_plan.py`` writes the tables of docs/edits.md anew.
"""

import json
import re
from functools import partial

import pytest
from places import ROOT
from rows import each

from graph_slam_ros.errors import FormatError
from graph_slam_ros.maps.edit import FORMAT, Plan, plan_text, read_plan
from graph_slam_ros.measurements.edits import ACTIONS, AppliedEdit, aliases, applied_edit, edit_of

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "two aisles look alike"}
VALUES = {"edge": 7, "landmark": "7", "to": "dock", "into": "8", "edges": [3, 9], "from": 2, "until": "7.5"}
VALUES |= {"from_keyframe": 1, "to_keyframe": "1700000000.25", "keyframe": 4, "pose": [1.0, 2, 0.5]}
VALUES |= {"sigma_m": 0.1, "sigma_rad": 0.02}
PAGE = ROOT / "docs/edits.md"


def values_of(do, either=0, /, **change):
    """The values of an edit; a key that is changed to None is left out."""
    action = ACTIONS[do]
    keys = [*action.fields, *(action.either[either] if action.either else ())]
    values = {"name": do, **WHO, "do": do} | {key: VALUES[key] for key in keys} | change
    return {key: value for key, value in values.items() if value is not None}


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


def written(folder, *edits):
    file = folder / "edits.json"
    file.write_text(json.dumps({"format": FORMAT, "version": 1, "source": "sha256:0", "edits": list(edits)}))
    return file


@each("do", ACTIONS)
def test_each_edit_is_read_as_it_was_written(do, tmp_path):
    for either in range(max(1, len(ACTIONS[do].either))):
        values = values_of(do, either)
        plan = Plan("sha256:0", (edit_of(values),))
        assert read_plan(written(tmp_path, values)) == plan
        (tmp_path / "edits.json").write_text(plan_text(plan))
        assert read_plan(tmp_path / "edits.json") == plan
        applied = AppliedEdit(plan.edits[0], 3, (1, 2), (9,))
        assert applied_edit(json.loads(json.dumps(applied.record))) == applied


out, split, closure = (partial(values_of, do) for do in ("remove_edge", "split_landmark", "add_closure"))


@each(
    "values, named",
    [
        (7, "7 is not an object"),
        *((out(edge=edge), f"edge: {edge!r} is not the id of an edge") for edge in (7.0, True, "7", -1, 2**63)),
        *((out() | {key: None}, f"{key}: None is not a text") for key in ("name", "who", "why")),
        *((out(**{key: None}), f"{key}: missing") for key in out()),
        (out(edgee=7), "'edgee': unknown key"),
        (out(do="remove"), "do: 'remove' is none of remove_edge"),
        (out(do=["remove_edge"]), "do: ['remove_edge'] is none of"),
        (out(do="remove_landmark"), "'edge': unknown key; remove_landmark has"),
        (out(who=""), "who: '' is not a text of up to 200 characters"),
        (out(why=" \n"), "is not a text of up to 2000 characters"),
        (out(why="x" * 2001), "is not a text of up to 2000 characters"),
        (out(when="yesterday"), "when: 'yesterday' is not a time with its zone"),
        (out(when="2026-05-04T10:30:00"), "is not a time with its zone"),
        *((split(0, edges=edges), f"edges: {edges} is not a list of ids") for edges in ([], [3, 3], [3, -1], 7)),
        (split(0, edges=None), "edges or from, until: expected one of them"),
        (split(0, **{"from": 2}), "edges or from, until: expected one of them"),
        (split(1, until=None), "until: missing; split_landmark has"),
        (split(0, to="7"), "to: '7' is the landmark itself"),
        (values_of("merge_landmarks", into="7"), "into: '7' is the landmark itself"),
        (split(0, to="x" * 129), "is not a text of up to 128 characters"),
        *(
            (split(1, until=k), f"until: {k!r} is not the number of a keyframe")
            for k in ("soon", 7.5, "-3", "1e9", [1])
        ),
        *(
            (closure(pose=pose), "is not a pose: [x, y, theta], or in space")
            for pose in ([1.0, 2.0], "1 2 3", [1.0, 2.0, 1e300], [1.0, 2.0, None], [1.0, 2.0, True], [0] * 6 + [2])
        ),
        (closure(sigma_m=0.0), "sigma_m: 0.0 is not a standard deviation in metres, above 0"),
        (closure(sigma_rad=-1), "sigma_rad: -1 is not a standard deviation in radians, above 0"),
        (values_of("move_map", sigma_m=-0.1), "sigma_m: -0.1 is not a standard deviation in metres; 0: exact"),
        (out(name="first"), "name: 'first' is the name of another edit"),
    ],
)
def test_a_fault_of_an_edit_is_named(values, named, tmp_path):
    file = written(tmp_path, out(name="first"), values)
    with pytest.raises(FormatError) as raised:
        read_plan(file)
    assert str(raised.value).startswith(f"{file}: edit 2: ")
    assert named in str(raised.value)
    assert "\n" not in str(raised.value)


@each(
    "text, named",
    [
        ("", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("\xff\xfe{", "not JSON"),
        (None, "No such file"),
        ("[]", "not a plan of edits"),
        ('{"format": "other"}', "not a plan of edits"),
        ('{"format": "F", "version": 2, "source": "s", "edits": []}', "version: 2 is not 1"),
        ('{"format": "F", "version": true, "source": "s", "edits": []}', "version: True is not 1"),
        ('{"format": "F", "version": 1, "edits": []}', "source: None is not the hash"),
        ('{"format": "F", "version": 1, "source": "s"}', "edits: None is not a list"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [], "by": 1}', "'by': unknown key"),
        ('{"format": "F", "version": 1, "source": "s", "edits": [{"edge": NaN}]}', "NaN is not a finite number"),
        ('{"format": "F", "version": 1, "version": 1, "source": "s", "edits": []}', "key 'version' is there twice"),
    ],
)
def test_what_is_no_plan_is_refused(text, named, tmp_path):
    file = tmp_path / "edits.json"
    if text is not None:
        file.write_bytes(text.replace('"F"', json.dumps(FORMAT)).encode("latin-1"))
    with pytest.raises(FormatError) as raised:
        read_plan(file)
    assert str(raised.value).startswith(f"{file}: ")
    assert named in str(raised.value)


def test_an_identity_follows_its_landmark_through_mergers_and_new_names():
    def applied(do, **arguments):
        return AppliedEdit(edit_of({"name": "n", **WHO, "do": do, **arguments}), 0, (), ())

    edits = [applied("merge_landmarks", landmark=one, into=other) for one, other in (("3", "2"), ("2", "1"))]
    edits += [applied("rename_landmark", landmark="1", to="dock"), applied("remove_landmark", landmark="dock")]
    assert [aliases(edits[:k]) for k in (2, 3, 4)] == [{"3": "1", "2": "1"}, {"3": "dock", "2": "dock"}, {}]


if __name__ == "__main__":
    page = PAGE.read_text()
    for table in (kinds_table(), keys_table()):
        head = re.escape("\n".join(table.split("\n")[:2]))
        page = re.sub(head + r"\n(\|.*\n)*", lambda _, table=table: table, page)
    PAGE.write_text(page)
