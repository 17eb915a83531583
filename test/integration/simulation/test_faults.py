"""Faults: each makes wrong what it says and nothing else, and the table tells what."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros import cli
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.slam import Closure, Config, Counters
from graph_slam_ros.tools.simulation import (
    KINDS,
    Fault,
    faulty_recording,
    measurements,
    options_of,
    simulate,
    with_closures,
    write_bag,
)
from graph_slam_ros.tools.simulation.draft import Draft
from graph_slam_ros.tools.simulation.false_closures import Closures
from graph_slam_ros.tools.simulation.message_faults import MESSAGE_KINDS
from graph_slam_ros.tools.simulation.motion import space_of
from graph_slam_ros.tools.simulation.options import about

WORLDS = {"warehouse": {"aisles": 2, "laps": 2, "aisle_m": 8.0}, "flight": {"laps": 2}}


@pytest.fixture(scope="module", params=WORLDS)
def recording(request):
    return with_closures(simulate(request.param, 7, **WORLDS[request.param]), 30, seed=7)


# -- faults in recordings ----------------------------------------------------------------------------------------------

PUT = {
    "false_closures": {"rate": 0.5, "policy": "group"},
    "wrong_ids": {"rate": 0.2},
    "swapped_ids": {"pairs": 2},
    "moved_landmarks": {"count": 2},
    "outliers": {"rate": 0.1},
    "slip": {"lasting": 0.1},
    "carried": {"distance_m": 3.0},
    "jump": {},
}


def sightings(recording):
    """(stamp, place in the message) to sighting."""
    return {(seen.stamp_ns, k): s for seen in recording.seen for k, s in enumerate(seen.sightings)}


def rows_of(wrong, topic):
    return {(row.stamp_ns, row.index): row for row in wrong if row.topic == topic}


def motions(recording):
    group, poses = space_of(recording.T_odom_base[0]).group, recording.T_odom_base
    return np.stack(group.between(tuple(poses[:-1].T), tuple(poses[1:].T)), axis=1)


def test_the_table_names_what_is_wrong_and_all_else_is_as_it_was(recording):
    """The same seed puts the same faults, and one more changes none of the others."""
    assert KINDS.keys() == PUT.keys()
    for kind, options in PUT.items():
        fault, jump = Fault.named(kind, **options), Fault.named("jump", at=0.1)
        faulty, wrong = faulty_recording(recording, [fault], seed=5)
        assert {row.fault for row in wrong} == {kind}
        before, after = sightings(recording), sightings(faulty)
        table = rows_of(wrong, "/landmarks")
        assert set(before) == set(after)
        assert {key for key in before if before[key] != after[key]} == set(table)
        for key, row in table.items():
            assert (row.id, row.true_id) == (after[key].id, before[key].id)
        moved = np.abs(motions(faulty) - motions(recording)).max(axis=1) > 1e-9
        assert set(recording.stamps_ns[1:][moved]) == {stamp_ns for stamp_ns, _ in rows_of(wrong, "/odom")}
        assert [c for c in faulty.closures if c in recording.closures] == list(recording.closures)
        false = [c for c in faulty.closures if c not in recording.closures]
        assert {(c.stamp_ns, str(c.from_stamp_ns)) for c in false} == {
            (row.stamp_ns, row.id) for row in wrong if row.topic == "/closures"
        }
        assert len(false) == (30 if kind == "false_closures" else 0)
        assert np.array_equal(faulty.T_world_base, recording.T_world_base)
        assert faulty.landmarks == recording.landmarks
        assert faulty_recording(recording, [fault], seed=5)[1] == wrong
        both = faulty_recording(recording, [fault, jump], seed=5)[1]
        assert [r for r in both if "jump" not in r.fault.split("+")] == [r for r in wrong if r.fault != "jump"]
        if kind not in ("slip", "carried", "jump"):  # which draw nothing
            assert faulty_recording(recording, [fault], seed=6)[1] != wrong


def halves(recording, at=0.5):
    return recording.stamps_ns[round(at * (len(recording.stamps_ns) - 1))]


def test_two_landmarks_have_swapped_their_ids_from_then_on(recording):
    _, wrong = faulty_recording(recording, [Fault.named("swapped_ids", at=0.4)], seed=2)
    a, b = {row.true_id for row in wrong}
    assert {(row.true_id, row.id) for row in wrong} == {(a, b), (b, a)}
    table = rows_of(wrong, "/landmarks")
    for key, s in sightings(recording).items():
        assert (key in table) == (s.id in (a, b) and key[0] >= halves(recording, 0.4))


def test_a_wrong_id_is_that_of_a_landmark_elsewhere(recording):
    _, wrong = faulty_recording(recording, [Fault.named("wrong_ids", rate=0.2)], seed=2)
    assert len(wrong) == round(0.2 * len(sightings(recording)))
    known = {s.id for s in sightings(recording).values()}
    beside = {seen.stamp_ns: {s.id for s in seen.sightings} for seen in recording.seen}
    for row in wrong:
        assert row.id in known - beside[row.stamp_ns]
    everywhere = simulate("pythonrobotics", 1)  # all five are in every message
    for row in faulty_recording(everywhere, [Fault.named("wrong_ids", rate=0.2)], seed=2)[1]:
        assert row.id != row.true_id


def test_an_outlier_is_too_far_away_by_one_to_five_metres_on_the_same_ray(recording):
    faulty, wrong = faulty_recording(recording, [Fault.named("outliers", rate=0.3)], seed=2)
    before, after = sightings(recording), sightings(faulty)
    n, longer = space_of(recording.T_world_base[0]).dimensions, []
    for key in rows_of(wrong, "/landmarks"):
        a, b = (np.array(side[key].measured) for side in (before, after))
        longer.append(np.linalg.norm(b[:n]) - np.linalg.norm(a[:n]))
        assert b[:n] / np.linalg.norm(b[:n]) == pytest.approx(a[:n] / np.linalg.norm(a[:n]))
        assert np.array_equal(a[n:], b[n:])
    assert len(longer) == round(0.3 * len(before))
    assert [min(longer), max(longer)] == pytest.approx([1.0, 5.0], abs=0.25)


def test_of_an_outlier_with_a_range_the_range_alone_is_wrong():
    for sensor in ("range", "range_bearing"):
        recording = simulate("flight", 1, laps=1, sensor=sensor)
        faulty, wrong = faulty_recording(recording, [Fault.named("outliers", most_m=1.0)], seed=2)
        before, after = sightings(recording), sightings(faulty)
        for key in rows_of(wrong, "/landmarks"):
            more = np.subtract(after[key].measured, before[key].measured)
            assert 0.2 <= more[0] <= 1.0
            assert not more[1:].any()


@pytest.mark.parametrize("world", WORLDS)
def test_a_moved_landmark_is_seen_where_it_stands_now_with_the_noise_it_had(world):
    for sensor in ("pose", "position", "range_bearing", "bearing", "range"):
        recording = simulate(world, 2, **WORLDS[world] | {"laps": 1}, sensor=sensor)
        space, truth = space_of(recording.T_world_base[0]), recording.T_world_base
        at = {stamp_ns: k for k, stamp_ns in enumerate(recording.stamps_ns.tolist())}
        seen = [(at[one.stamp_ns], s) for one in recording.seen for s in one.sightings][:100]
        none = Closures(np.empty((0, 2), dtype=np.int64), np.empty((0, space.pose.size)), np.empty((0, space.dof, 2)))
        places = np.array([k for k, _ in seen])
        draft = Draft(space, truth, truth, truth, [s for _, s in seen], places, recording.landmarks, none, [])
        displaced = np.array([0.7, -1.1, 0.4])[: space.dimensions]
        edge = space.sightings[sensor]
        for k, (pose, s) in enumerate(seen):
            place = np.array(recording.landmarks[s.id])
            before, now = place[: None if sensor == "pose" else space.dimensions], place.copy()
            now[: space.dimensions] += displaced
            moved = draft.seen_from(k, displaced)
            errors = [
                edge.linearize(
                    np.concatenate([truth[pose], where]),
                    np.array([[0, space.pose.size]]),
                    edge.whole([*sighting.measured, *(sighting.T_base_sensor or ())])[None],
                )[0]
                for where, sighting in ((before, s), (now[: len(before)], moved))
            ]
            if sensor == "pose":  # the same noise, but seen along the axes of what is measured
                assert np.linalg.norm(errors[0]) == pytest.approx(np.linalg.norm(errors[1]))
            else:
                assert errors[0] == pytest.approx(errors[1], abs=1e-9)
            assert replace(moved, measured=s.measured) == s


def test_landmarks_have_moved_by_the_given_distance_from_then_on(recording):
    faulty, wrong = faulty_recording(recording, [Fault.named("moved_landmarks", count=2, distance_m=3.0)], seed=2)
    names = {row.true_id for row in wrong}
    assert len(names) == 2
    table, before, after = rows_of(wrong, "/landmarks"), sightings(recording), sightings(faulty)
    n = space_of(recording.T_world_base[0]).dimensions
    for key, s in before.items():
        assert (key in table) == (s.id in names and key[0] >= halves(recording))
        if key in table:
            assert np.linalg.norm(np.subtract(after[key].measured, s.measured)[:n]) == pytest.approx(3.0)


def test_slipping_odometry_tells_a_longer_way_for_a_while_and_then_goes_on_as_it_would(recording):
    fault = Fault.named("slip", at=0.25, lasting=0.1, factor=1.5)
    faulty, wrong = faulty_recording(recording, [fault], seed=2)
    first, n = round(0.25 * (len(recording.stamps_ns) - 1)), space_of(recording.T_world_base[0]).dimensions
    last = first + round(0.1 * (len(recording.stamps_ns) - 1))
    assert [row.stamp_ns for row in wrong] == recording.stamps_ns[first + 1 : last + 1].tolist()
    told, driven = motions(faulty), motions(recording)
    longer = driven.copy()
    longer[first:last, :n] *= 1.5
    assert told == pytest.approx(longer, abs=1e-9)
    assert np.array_equal(faulty.T_odom_base[: first + 1], recording.T_odom_base[: first + 1])
    twist = recording.twist.copy()
    twist[first + 1 : last + 1, :n] *= 1.5
    assert np.array_equal(faulty.twist, twist)


def test_odometry_stands_still_while_the_robot_is_carried_and_then_goes_on_as_it_would(recording):
    faulty, wrong = faulty_recording(recording, [Fault.named("carried", at=0.25, distance_m=2.0)], seed=2)
    first, n = round(0.25 * (len(recording.stamps_ns) - 1)), space_of(recording.T_world_base[0]).dimensions
    away = np.linalg.norm(recording.T_world_base[first:, :n] - recording.T_world_base[first, :n], axis=1)
    last = first + int(np.argmax(away >= 2.0))
    assert [row.stamp_ns for row in wrong] == recording.stamps_ns[first + 1 : last + 1].tolist()
    assert motions(faulty)[first:last, :n] == pytest.approx(np.zeros((last - first, n)), abs=1e-12)
    assert motions(faulty)[last:] == pytest.approx(motions(recording)[last:], abs=1e-9)
    assert not faulty.twist[first + 1 : last + 1].any()
    assert np.array_equal(faulty.twist[last + 1 :], recording.twist[last + 1 :])


def test_a_jump_is_one_motion_and_the_measured_velocity_knows_nothing_of_it(recording):
    fault = Fault.named("jump", at=0.5, ahead_m=1.0, left_m=-0.5, turn_rad=0.2)
    faulty, (row,) = faulty_recording(recording, [fault], seed=2)
    k, space = round(0.5 * (len(recording.stamps_ns) - 1)), space_of(recording.T_world_base[0])
    assert (row.topic, row.stamp_ns) == ("/odom", recording.stamps_ns[k])
    jump = space.group.local(tuple(motions(faulty)[k - 1]), tuple(motions(recording)[k - 1]))
    assert jump == pytest.approx((1.0, -0.5, 0.2) if space.dof == 3 else (1.0, -0.5, 0.0, 0.0, 0.0, 0.2), abs=1e-9)
    assert np.array_equal(faulty.twist, recording.twist)


def test_a_measurement_that_two_faults_hit_stands_once_with_both_and_with_what_was_seen(recording):
    faults = [Fault.named("swapped_ids"), Fault.named("wrong_ids", rate=1.0)]
    _, wrong = faulty_recording(recording, faults, seed=2)
    before = sightings(recording)
    assert len(wrong) == len(before)
    assert {row.fault for row in wrong} == {"wrong_ids", "swapped_ids+wrong_ids"}
    for row in wrong:
        assert row.true_id == before[row.stamp_ns, row.index].id


def test_a_fault_that_does_not_fit_is_refused_by_name():
    recording = simulate("warehouse", 1, aisles=2, laps=1, sensor="bearing")
    for fault, told in (
        ("fire", "no fault 'fire'; there are false_closures, wrong_ids"),
        ("slip:fast=2", "slip: no option 'fast'; it has at, lasting, factor"),
        ("slip:at=1.5", r"slip: at: 1.5 is not in \[0, 1\]"),
        ("slip:at", "'at' is not key=value"),
        ("slip:at=0.1,factor=2,at=0.2", "slip: at is given twice"),
        ("slip:at=1.0", "nothing is driven any more"),
        ("carried:at=0.9,distance_m=1000", "carried: after 0.9 of the whole it comes no farther than"),
        ("swapped_ids:at=0.0", r"swapped_ids: needs 2 landmarks that are seen often enough; there are 0"),
        ("false_closures", "there is no true one to be like"),
        ("false_closures:policy=odd", "'odd' is not one of random, local"),
        ("outliers", "a bearing has no range"),
    ):
        with pytest.raises(GraphSlamError, match=told):
            faulty_recording(recording, [Fault.parsed(fault)], seed=1)


# -- as files ----------------------------------------------------------------------------------------------------------


def test_closures_of_a_bag_decode_to_those_it_was_made_of_and_the_table_finds_its_messages(recording, tmp_path):
    faults = [Fault.named("false_closures", policy="local-group"), Fault.named("wrong_ids"), Fault.named("jump")]
    faulty, wrong = faulty_recording(recording, faults, seed=4)
    write_bag(faulty, tmp_path / "bag.mcap")
    settings = {
        "world.dimensions": space_of(recording.T_world_base[0]).dimensions,
        "inputs.names": "odom detections loops",
        "loops.type": "vision_msgs/msg/Detection3DArray",
        "loops.use": "closure",
        "loops.topic": "closures",
    }
    counters = Counters()
    border = MessageConverter(Config.from_mapping(settings), counters)
    bag, decoded, messages = open_bag(tmp_path / "bag.mcap"), [], {}
    for record in bag.messages(["/odom", "/landmarks", "/closures"]):
        messages[record.topic, record.log_ns] = typestore().deserialize_cdr(record.cdr, bag.topics[record.topic].type)
        if record.topic == "/closures":
            decoded += border.convert("loops", record.cdr)
    assert counters.as_dict() == {}
    expected = [m for m in measurements(faulty) if isinstance(m, Closure)]
    assert len(decoded) == len(expected) == 30 + round(30 * 0.3 / 0.7)
    for a, b in zip(decoded, expected, strict=True):
        assert (a.stamp_ns, a.from_stamp_ns) == (b.stamp_ns, b.from_stamp_ns)
        assert a.T_from_base == pytest.approx(b.T_from_base, abs=1e-9)
        assert a.covariance == pytest.approx(b.covariance, abs=1e-9)
    for row in wrong:
        message = messages[row.topic, row.stamp_ns]
        assert row.topic == "/odom" or message.detections[row.index].id == row.id


def test_landmarks_that_go_by_numbers_in_a_bag_go_by_them_in_the_table(tmp_path):
    recording = simulate("warehouse", 1, aisles=2, laps=1, sensor="range_bearing")
    faulty, wrong = faulty_recording(recording, [Fault.named("wrong_ids")], seed=4)
    write_bag(faulty, tmp_path / "bag.mcap")
    bag = open_bag(tmp_path / "bag.mcap")
    clouds = {
        r.log_ns: typestore().deserialize_cdr(r.cdr, bag.topics[r.topic].type) for r in bag.messages(["/landmarks"])
    }
    names = list(recording.landmarks)
    for row in wrong:
        cloud = clouds[row.stamp_ns]
        points = np.frombuffer(bytes(cloud.data), np.dtype([(f.name, "<f8") for f in cloud.fields]))
        assert int(points["id"][row.index]) == int(row.id)
        assert names[int(row.true_id)] == sightings(recording)[row.stamp_ns, row.index].id


def run(capsys, *words):
    code = cli.main([str(word) for word in words])
    return code, *capsys.readouterr()


def test_in_a_graph_the_table_names_the_lines_that_are_more_and_no_others(tmp_path, capsys):
    clean, faulty = tmp_path / "clean.g2o", tmp_path / "faulty.g2o"
    assert run(capsys, "simulate", "city", "--poses", 800, "--set", "blocks=8", "--out", clean)[0] == 0
    assert (tmp_path / "clean.truth.tum").is_file()
    faults = "--fault", "false_closures:policy=aliased", "--fault", "false_closures:count=7"
    code, out, err = run(capsys, "simulate", clean, "--out", faulty, "--seed", 3, *faults)
    assert (code, err) == (0, "")
    with (tmp_path / "faulty.faults.csv").open() as stream:
        table = {int(row["line"]): row for row in csv.DictReader(stream)}
    assert f"{len(table)} edges are wrong" in out
    true, lines = read_g2o(clean).graph.edge_count, faulty.read_text().splitlines()
    closures = true - 799
    assert len(table) == round(closures * 0.3 / 0.7) + 7
    left = [line.split()[:3] for n, line in enumerate(lines, 1) if n not in table and line[0] != "#"]
    assert left == [line.split()[:3] for line in clean.read_text().splitlines() if line[0] != "#"]
    for n, row in table.items():
        assert lines[n - 1].split()[:3] == [row["tag"], row["first"], row["second"]]
    assert read_g2o(faulty).graph.edge_count == true + len(table)


def test_a_recording_with_faults_has_their_table_beside_it(tmp_path, capsys):
    bag, table = tmp_path / "a.world.mcap", tmp_path / "a.world.faults.csv"
    hall = "simulate", "warehouse", "--set", "aisles=2", "--set", "aisle_m=6", "--out", bag
    faults = "--fault", "false_closures:rate=0.5,group=5", "--fault", "swapped_ids:at=0.6"
    code, out, err = run(capsys, *hall, "--closures", 10, *faults)
    assert (code, err) == (0, "")
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert f"wrote {table}: {len(rows)} measurements are wrong" in out
    assert list(rows[0]) == ["topic", "stamp_ns", "index", "id", "fault", "true_id"]
    assert [row["fault"] for row in rows].count("false_closures") == 10
    assert open_bag(bag).topics["/closures"].count > 10
    table.unlink()
    assert run(capsys, *hall, "--force")[0] == 0
    assert not table.exists()
    assert "/closures" not in open_bag(bag).topics


def test_a_command_that_cannot_be_done_is_refused_in_one_line(tmp_path, capsys):
    graph, out = tmp_path / "city.g2o", tmp_path / "out"
    assert run(capsys, "simulate", "city", "--poses", 60, "--set", "blocks=3", "--out", graph)[0] == 0
    for words, told in (
        (["city", "--out", f"{out}.mcap"], "city is a graph: --out FILE.g2o"),
        (["manhattan", "--out", f"{out}.g2o"], "manhattan is a recording: --out FILE.mcap"),
        (["city", "--closures", "5", "--out", f"{out}.g2o"], "city: no use for --closures"),
        (["city", "--seed", "-1", "--out", f"{out}.g2o"], "seed -1 is negative"),
        (["sphere", "--set", "laps=5", "--out", f"{out}.g2o"], "sphere: no option 'laps'; it has poses, sigma_m"),
        (["spere", "--out", f"{out}.g2o"], "did you mean 'sphere'"),
        ([graph, "--set", "blocks=4", "--out", f"{out}.g2o"], "no use for --set: it is no world"),
        ([graph, "--out", graph], "cannot be read from and written to at once"),
        ([graph, "--fault", "slip", "--out", f"{out}.g2o"], "slip: a graph has no messages"),
        (["none.g2o", "--out", f"{out}.g2o"], "no world 'none.g2o'"),
    ):
        code, _, err = run(capsys, "simulate", *words)
        assert (code, err.count("\n")) == (2, 1), words
        assert told in err
    said = run(capsys, "simulate", "sphere", "--poses", 40, "--out", tmp_path / "s.g2o")[1]
    assert "sphere: with 40 poses nothing is closed: a larger --poses" in said


def test_the_help_tells_every_fault_and_all_that_can_be_set(capsys):
    with pytest.raises(SystemExit):
        cli.main(["simulate", "--help"])
    out = capsys.readouterr().out
    assert "gnss_outage_s=0.0 [s]" in out and "aisle_m=12.0 [m]" in out
    for name, kind in (KINDS | MESSAGE_KINDS).items():
        assert f"  {name}: {about(kind)}" in out
        for option in options_of(kind):
            unit = f" [{option.unit}]" if option.unit else ""
            assert f"    {option.name}={option.default}{unit}  {option.meaning}" in out
