"""Edges of a plugin in the running pipeline: the example of the page, its run folder, and plugins that fail."""

import re
import sys
from collections import Counter

import numpy as np
import pytest
from differences import (
    BEACONS,
    EDGES,
    ENTRIES,
    EXAMPLE,
    SETTINGS,
    STEPS,
    TAG,
    TYPE,
    WRONG,
    example_installer,
    recording,
    truths,
)

from graph_slam_ros import CustomEdge, GraphSlam, Odometry, Sighting, Sightings, edge_tags, load_run
from graph_slam_ros.cli import main
from graph_slam_ros.edge_tags import map_edge_of, tag_of
from graph_slam_ros.errors import ConfigError, GraphSlamError
from graph_slam_ros.graph import check_edge
from graph_slam_ros.lie import se2
from graph_slam_ros.maps.merge import merge
from graph_slam_ros.messages.inputs import converters, plugins
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Config, Control
from graph_slam_ros.slam.robust.ledger import Reason, Verdict

SHORT, MEDIUM = 25, 65  # steps


@pytest.fixture
def install(tmp_path, monkeypatch):
    with example_installer(tmp_path, monkeypatch) as installed:
        yield installed


def replayed(folder, steps=STEPS, **settings):
    return replay(recording(folder / "a.mcap", steps=steps), folder / "run", Config.from_mapping(SETTINGS | settings))


def test_the_example_of_the_page_corrects_odometry_and_its_outliers_are_rejected(install, tmp_path):
    assert ENTRIES.count(" = ") == 2
    install()
    done = replayed(tmp_path)
    slam = done.slam
    truth, said = (np.array(poses) for poses in zip(*truths(), strict=True))
    at = ((slam.keyframes.stamps_ns - slam.keyframes.stamps_ns[0]) / 1e8).round().astype(int)
    keyframes = np.isclose((slam.keyframes.stamps_ns - slam.keyframes.stamps_ns[0]) % 10**8, 0)
    off = np.linalg.norm(slam.trajectory()[keyframes, :2] - truth[at[keyframes], :2], axis=1)
    assert np.linalg.norm(said[:, :2] - truth[:, :2], axis=1).max() > 0.8
    assert off.max() < 0.12
    assert set(slam.landmarks) == set(BEACONS)
    edges = slam.graph.edges_of("custom")
    assert len(edges) == done.summary["inputs"]["tdoa"]["used"] == STEPS - 1  # the last is after all odometry
    assert {tag_of(slam.graph.edge(int(edge)).type) for edge in edges} == {TAG}
    rejected = [int(e) for e in edges if not slam.ledger.is_inside(int(e))]
    wrong = [int(edges[k]) for k in WRONG]
    assert set(wrong) <= set(rejected)
    assert len(rejected) <= len(wrong) + 3
    moved = [slam.graph.edge(int(edge)).measured[1:] for edge in edges]
    assert sum(map(np.any, moved)) > 50, "most are measured between keyframes"


def test_every_command_reads_the_run_and_a_repetition_has_the_same_bytes(install, tmp_path, capsys):
    install()
    replayed(tmp_path, MEDIUM)
    run, again = str(tmp_path / "run"), str(tmp_path / "again")
    assert main(["replay", run, "--out", again]) == 0
    names = ("graph.g2o", "path.tum", "landmarks.csv", "ledger.csv", "map.mcap")
    for name in names:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    capsys.readouterr()
    assert main(["recover", run, "--out", str(tmp_path / "recovered")]) == 0
    assert "of the map as it was read, solved once" in capsys.readouterr().out
    assert main(["map", "diff", run, str(tmp_path / "recovered")]) == 0
    assert "no difference" in capsys.readouterr().out
    entries = load_run(run).edges
    (wrong, *_) = [e for e in entries if e.label == "custom" and not e.is_in]
    assert main(["explain", run, str(wrong.edge)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert re.search(rf"edge {wrong.edge}: an edge of a plugin \({TAG}\) of (\w+) and (?!\1)\w+ by tdoa: ", text)
    assert "what if it were in with its full weight" in text
    assert main(["explain", run, "east"]) == 0
    assert f"landmark east: {1 + MEDIUM // 2} edges" in capsys.readouterr().out
    assert main(["explain", run, "--without", str(wrong.edge - 1)]) == 0
    assert main(["optimize", f"{run}/graph.g2o", "--out", str(tmp_path / "solved.g2o")]) == 0
    assert "unknown" not in capsys.readouterr().err
    lines = (tmp_path / "run" / "graph.g2o").read_text().splitlines()
    assert sum(line.startswith(TAG) for line in lines) == sum(e.is_in for e in entries if e.label == "custom")
    assert main(["map", "export", run, "--out", str(tmp_path / "exported.g2o")]) == 0


def test_a_map_of_such_edges_is_gone_on_in_and_solves_to_the_same(install, tmp_path):
    install()
    first = replayed(tmp_path, MEDIUM).slam
    config = Config.from_mapping(SETTINGS)
    second = replay(tmp_path / "a.mcap", tmp_path / "second", config, map_folder=tmp_path / "run").slam
    assert len(second.graph.edges_of("custom")) == 2 * len(first.graph.edges_of("custom"))
    poses = second.trajectory()[: len(first.keyframes)]
    assert np.abs(poses - first.trajectory())[:, :2].max() < 0.1


@pytest.mark.parametrize(
    "command", ["explain RUN", "recover RUN --out OUT", "replay RUN --out OUT", "map diff RUN RUN"]
)
def test_without_the_plugin_a_map_or_journal_is_refused_in_one_line_that_names_it(
    command, install, tmp_path, monkeypatch, capsys
):
    site = install()
    replayed(tmp_path, SHORT)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(site)])
    monkeypatch.setattr(plugins, "_loaded", {})
    monkeypatch.setattr(edge_tags, "_loaded", {})
    monkeypatch.setattr(edge_tags, "_tags", {})
    capsys.readouterr()
    with pytest.raises(GraphSlamError, match=f"ledger.csv:[0-9]+: tag '{TAG}' is none of a graph: {TAG}: no plugin"):
        _ = load_run(tmp_path / "run").edges
    words = command.replace("RUN", str(tmp_path / "run")).replace("OUT", str(tmp_path / "out")).split()
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{TAG}: no plugin has an edge of this tag: install the package that has the entry point {TAG}" in line
    assert "graph_slam_ros.edges" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ((' edges=("EDGE_TDOA",)', ""), "it has a converter of edges without the tags of these"),
        (("DEFINITION, edges", "DEFINITION, edges=['EDGE_TDOA']) # "), "its edges are not a tuple of tags"),
        (('EDGE_TDOA",))', 'EDGE_SE2",))'), "EDGE_SE2: a built-in edge type: choose another tag"),
        (('EDGE_TDOA",))', 'EDGE_TOA",))'), "EDGE_TOA: no plugin has an edge of this tag"),
        (
            ("tdoa = edge", "tdoa = 3 or edge"),
            f"{TAG}: plugin my_tdoa:tdoa of my-tdoa 1.0: it is a int, not an EdgeType",
        ),
        (
            ("1, 1, difference_of_ranges)", "1, 1, difference_of_ranges, lambda v, z: np.ones((1, 7)))"),
            f"{TAG}: plugin my_tdoa:tdoa of my-tdoa 1.0: Jacobian[0, ",
        ),
    ],
)
def test_a_mistake_in_a_plugin_is_refused_at_the_start_in_one_line(change, line, install):
    assert change[0] in EXAMPLE
    install(EXAMPLE.replace(*change))
    with pytest.raises(ConfigError) as refused:
        converters(TYPE)
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_of_two_plugins_with_one_tag_neither_is_used(install):
    install()
    install(module="my_other", edges=EDGES.replace("my_tdoa", "my_other"))
    with pytest.raises(ConfigError, match=f"{TAG}: plugins of my-other 1.0 and my-tdoa 1.0 have it: uninstall one"):
        map_edge_of(TAG)


@pytest.mark.parametrize(
    ("change", "line", "count"),
    [
        (
            ("(message.difference,)", "(message.difference, 0.0)"),
            f"FormatError: {TAG}: measured has 2 numbers, not 1",
            SHORT,
        ),
        (("(message.difference,)", "(float('nan'),)"), rf"FormatError: {TAG}: measured \[nan\] is not finite", SHORT),
        (("source.sigma_m() ** 2,", "0.0,"), f"FormatError: {TAG}: covariance 0 is not positive definite", SHORT),
        (("source.sigma_m() ** 2,", "1.0, 0.0,"), f"FormatError: {TAG}: covariance has 2 numbers, not 1", SHORT),
        (("message.one, message.other)", "message.one)"), f"FormatError: {TAG}: 2 ends, not 3", SHORT),
        (("message.one, message", "stamp_ns, message"), rf"FormatError: {TAG}: the stamp \d+ where a vertex R2", SHORT),
        (
            ("pose, one, other = values", "1 / 0"),
            "edge 'difference of ranges', plugin .*ZeroDivisionError: ",
            SHORT - 1,
        ),
        (("    return [np", "    return [np.nan * np"), "edge 'difference of ranges', plugin .*not finite", SHORT - 1),
        (("    return [np", "    return [0.0, np"), "edge 'difference of ranges', plugin .*ValueError: ", SHORT - 1),
    ],
)
def test_what_a_plugin_fails_at_is_counted_and_named_once_and_the_run_goes_on(change, line, count, install, tmp_path):
    assert change[0] in EXAMPLE
    install(EXAMPLE.replace(*change))
    done = replayed(tmp_path, SHORT)
    assert done.summary["counters"]["tdoa"]["plugin_failed"] == count
    assert not len(done.slam.graph.edges_of("custom"))
    assert len(done.slam.keyframes) >= 5
    (said,) = [text for text in done.warnings if "plugin my_tdoa" in text]
    assert re.match(f"tdoa: (plugin my_tdoa:DIFFERENCES of my-tdoa 1.0: )?{line}", said)
    assert "\n" not in said


TURN = """from graph_slam_ros.graph import R2, SE2, edge_from_residual
from graph_slam_ros.lie import se2

calls = []


def turned(values, measured):
    return [se2.wrap(values[1][2] - values[0][2] - measured[0])]


def ahead(values, measured):
    if measured[1] == 1.0:
        calls.append(1)
        if len(calls) > 60:
            raise OverflowError("too often")
    return [se2.act(se2.inverse(tuple(values[0])), tuple(values[1]))[0] - measured[0]]


wall = edge_from_residual("wall", ((SE2,),), 1, 1, lambda values, measured: [values[0][1] - measured[0]])
turn = edge_from_residual("turn", ((SE2,), (SE2,)), 1, 1, turned)
ahead = edge_from_residual("ahead", ((SE2,), (R2,)), 2, 1, ahead)
"""
POINTS = "[graph_slam_ros.edges]\nEDGE_TURN = my_turn:turn\nEDGE_AHEAD = my_turn:ahead\n"
SPARSE = {"keyframes.min_distance_m": 0.45, "keyframes.min_angle_rad": 1.0}
POST, STEP = (4.0, 1.5), 100_000_000


@pytest.fixture
def drive(install):
    """A function that drives a circle with odometry that turns too far, and hands over what a function yields."""
    install(TURN, edges=POINTS, module="my_turn")

    def driven(made, steps=120, **settings):
        slam = GraphSlam(Config.from_mapping(settings))
        truth = said = se2.IDENTITY
        for k in range(steps):
            slam.process(Odometry(k * STEP + STEP, said))
            for m in made(k, k * STEP + STEP, truth):
                slam.process(m)
            truth, said = se2.compose(truth, (0.1, 0.0, 0.03)), se2.compose(said, (0.1, 0.0, 0.034))
        slam.process(Control("end"))
        slam.process(Control("optimize"))
        return slam, truth

    return driven


def turn(stamp_ns, before_ns, angle, sigma=1e-3):
    return CustomEdge(stamp_ns, "wheels", "EDGE_TURN", (before_ns, stamp_ns), (angle,), (sigma**2,))


def ahead(stamp_ns, truth, name="post", fails=0.0, wrong=0.0):
    far = se2.act(se2.inverse(truth), POST)[0] + wrong
    return CustomEdge(stamp_ns, "mast", "EDGE_AHEAD", (stamp_ns, name), (far, fails), (1e-4,))


def seen(stamp_ns, truth):
    return Sightings(
        stamp_ns, "tags", (Sighting("post", "position", se2.act(se2.inverse(truth), POST), (0.04, 0, 0, 0.04)),)
    )


def heading_error(slam):
    """The error [rad] of the last keyframe's heading."""
    return abs(se2.wrap(slam.trajectory()[-1, 2] - 0.03 * (slam.keyframes[-1].stamp_ns / STEP - 1)))


def test_an_edge_of_two_poses_corrects_the_motion_between_them(drive):
    def wheels(k, stamp_ns, truth):
        if k and k % 7 == 0:
            yield turn(stamp_ns, stamp_ns - 7 * STEP, 0.21, 0.05)

    slam, _ = drive(wheels, **SPARSE)
    alone, _ = drive(lambda *_: (), **SPARSE)
    off, off_alone = (heading_error(one) for one in (slam, alone))
    assert off < 0.8 * off_alone
    assert slam.counters.used["wheels"] == 17


def test_an_edge_that_cannot_be_used_is_counted_with_the_reason(drive):
    def odd(k, stamp_ns, truth):
        if k == 62:
            yield turn(stamp_ns, stamp_ns - 1, 0.0, 1.0)
            yield turn(stamp_ns, 1, 0.0)
            yield ahead(stamp_ns, truth, "nobody")

    slam, _ = drive(odd, **SPARSE)
    counted = slam.counters.as_dict()
    assert counted["wheels"] == {"within_one_keyframe": 1, "from_where_there_was_no_odometry": 1}
    assert counted["mast"] == {"landmark_unknown": 1}
    in_space = GraphSlam(Config.from_mapping({"world.dimensions": 3}))
    for k in range(5):
        in_space.process(Odometry(k * STEP + STEP, (0.2 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    in_space.process(turn(4 * STEP, STEP, 0.0))
    in_space.process(Control("flush"))
    assert in_space.counters.as_dict()["wheels"] == {"not_in_this_space": 1}


def test_a_program_is_told_what_is_wrong_with_an_edge_and_one_that_cannot_be_is_never_made(drive):
    slam, _ = drive(lambda *_: (), 5)
    edges = slam.graph.edge_count
    for wrong, line in (
        (CustomEdge(STEP, "a", "EDGE_TURN", (STEP, STEP + 0), (0.0,), (1.0,)), "one of its ends is there twice"),
        (CustomEdge(STEP, "a", "EDGE_NONE", (STEP,), (0.0,), (1.0,)), "no plugin has an edge of this tag"),
        (CustomEdge(STEP, "a", "EDGE_SE2", (STEP,), (0.0,), (1.0,)), "a built-in edge type"),
    ):
        with pytest.raises(GraphSlamError, match=line):
            slam.process(wrong)
            slam.process(Control("flush"))
    for ends in ((), (0,), (True, 2), (2.0,), (2 * STEP,)):
        with pytest.raises(GraphSlamError, match="CustomEdge: "):
            CustomEdge(STEP, "a", "EDGE_TURN", ends, (0.0,), (1.0,))
    assert slam.graph.edge_count == edges


def test_an_edge_at_which_its_plugin_fails_during_a_solve_is_withdrawn_and_all_else_stays(drive):
    def mast(k, stamp_ns, truth):
        yield seen(stamp_ns, truth)
        if k % 5 == 4:
            yield ahead(stamp_ns, truth, fails=float(k == 24))

    slam, _ = drive(mast)
    edges = slam.graph.edges_of("custom").tolist()
    (failed,) = [edge for edge in edges if not slam.ledger.is_inside(edge)]
    assert Reason(int(slam.ledger.reason.values[failed])) is Reason.FAILED
    assert slam.ledger.verdict_of(failed) is Verdict.REJECTED
    assert slam.graph.edge(failed).weight == 0.0
    assert slam.graph.edge(failed).measured[1] == 1.0
    assert slam.counters.as_dict()["mast"] == {"plugin_failed": 1}
    assert slam.counters.used["mast"] == len(edges) - 1
    assert slam.counters.faults["mast"].endswith("OverflowError: too often")
    assert slam.is_solved
    assert not slam.failing


def test_a_landmark_is_removed_with_its_custom_edges_and_with_the_last_that_determines_it(drive):
    def mast(k, stamp_ns, truth):
        if k in (20, 40):
            yield seen(stamp_ns, truth)
        if k > 40 and k % 5 == 0:
            yield ahead(stamp_ns, truth)

    slam, _ = drive(mast)
    first, second = slam.graph.edges_of("landmarks").tolist()
    custom = slam.graph.edges_of("custom").tolist()
    slam.process(Control("remove", (("edge", custom[0]),)))
    slam.process(Control("remove", (("edge", first),)))
    assert slam.is_solved
    assert list(slam.landmarks) == ["post"]
    slam.process(Control("remove", (("edge", second),)))
    assert slam.is_solved
    assert not slam.landmarks
    assert all(slam.ledger.is_withdrawn(edge) for edge in custom)


def test_the_noise_of_the_motion_since_the_keyframe_is_added(drive):
    """Compared with differences of the residual over the motion."""

    def wheels(k, stamp_ns, truth):
        yield from [seen(stamp_ns, truth)] if k == 3 else []
        yield from [turn(stamp_ns, stamp_ns - 3 * STEP, 0.102, 0.02)] if k == 17 else []
        later = se2.compose(truth, (0.025, 0.0, 0.0075))
        yield from [ahead(stamp_ns + STEP // 4, later)] if k == 17 else []

    slam, _ = drive(wheels, 20, **{"keyframes.min_distance_m": 0.45, "keyframes.shared_noise": 1e9})
    cases = {"EDGE_TURN": (4e-4, 1, (15 * STEP, 18 * STEP)), "EDGE_AHEAD": (1e-4, 2, (18 * STEP + STEP // 4,))}
    for edge in map(slam.graph.edge, slam.graph.edges_of("custom").tolist()):
        own, size, stamps = cases.pop(tag_of(edge.type))
        z, due = edge.measured, own
        for k, stamp_ns in enumerate(stamps):
            where, here = slam._frontend.path.where(stamp_ns), slice(size + 3 * k, size + 3 * k + 3)
            assert z[here] == pytest.approx(where.T_keyframe_base)
            j = [(_at(slam, edge, z, here, d) - _at(slam, edge, z, here, -d)) / 2e-5 for d in 1e-5 * np.eye(3)]
            due += np.array(j) @ where.covariance @ np.array(j)
        assert due > 1.4 * own
        assert 1.0 / edge.sqrt_information[0, 0] ** 2 == pytest.approx(due, rel=0.1)  # the estimate has moved since
    assert not cases


def _at(slam, edge, z, here, d):
    moved = z.copy()
    moved[here] = se2.compose(tuple(z[here]), se2.exp(tuple(d)))
    at = np.array([[slam.graph.vertex(v).stored.start for v in edge.vertices]])
    return edge.type.linearize(slam.solver.values, at, moved[None])[0][0, 0]


def test_two_maps_are_merged_unless_only_the_second_has_edges_that_say_where_it_lies(install, tmp_path):
    install(TURN, edges=POINTS + "EDGE_WALL = my_turn:wall\n", module="my_turn")

    def run(name, later_ns, *extra):
        measured = [Odometry(later_ns + k * STEP, (0.1 * k, 0.0, 0.0)) for k in range(1, 40)]
        for k in range(1, 40, 2):
            pose = (0.1 * k, 0.0, 0.0)
            for landmark, at in (("post", POST), ("rock", (1.0, -2.0)), ("tree", (2.0, 3.0))):
                there = se2.act(se2.inverse(pose), at)
                one = Sighting(landmark, "position", there, (0.01, 0, 0, 0.01))
                measured.append(Sightings(later_ns + k * STEP, "tags", (one,)))
            measured.append(ahead(later_ns + k * STEP, pose))
        measured += [
            CustomEdge(later_ns + 9 * STEP, "wall", "EDGE_WALL", (later_ns + 9 * STEP,), (0.0,), (0.01,))
        ] * len(extra)
        record_run(tmp_path / name, Config(), [*measured, Control("end"), Control("optimize")], [])
        return tmp_path / name

    a, b = run("a", 0), run("b", 10**12)
    merged = merge(a, b, tmp_path / "ab")
    assert merged.summary["edges"] == sum(load_run(one).summary["edges"] for one in (a, b))
    wall = run("wall", 2 * 10**12, "wall")
    assert merge(wall, a, tmp_path / "wall_a").shared == 3
    with pytest.raises(GraphSlamError, match=r"wall has custom, which say where its map is, and .* has none: merge "):
        merge(a, wall, tmp_path / "a_wall")


def test_info_lists_edge_types_of_plugins_usable_or_not(install, tmp_path, capsys):
    install()
    install(
        "wrong = 3",
        edges="[graph_slam_ros.edges]\nEDGE_WRONG = my_wrong:wrong\nEDGE_SE2 = my_wrong:wrong\n",
        module="my_wrong",
        name="my_msgs.msg.Wrong",
    )
    assert main(["info", str(recording(tmp_path / "a.mcap", steps=5))]) == 0
    out = capsys.readouterr().out
    assert f"plugin: {TYPE}: read by my-tdoa 1.0 as edges\n" in out
    assert f"plugin: {TAG}: 'difference of ranges', an edge type of my-tdoa 1.0\n" in out
    assert "plugin: EDGE_WRONG: plugin my_wrong:wrong of my-wrong 1.0: it is a int, not an EdgeType\n" in out
    assert "plugin: EDGE_SE2: the plugin of my-wrong 1.0 is not used: the tag is built in\n" in out


def test_a_resting_robot_thins_edges_and_a_survey_without_a_place_of_the_map_begins_no_landmark(install):
    install()
    settings = {name: value for name, value in SETTINGS.items() if not name.startswith("anchor")}
    slam, anchored = (GraphSlam(Config.from_mapping(one)) for one in (settings, SETTINGS))
    for k in range(1, 60):
        at_ns = k * STEP
        for one in (slam, anchored):
            one.process(Odometry(at_ns, (0.0, 0.0, 0.0)))
            for ends in ((at_ns, "north", "south"), (at_ns, "south", "east")):
                one.process(CustomEdge(at_ns, "tdoa", TAG, ends, (0.0,), (25.0,)))
    for one in (slam, anchored):
        one.process(Control("end"))
        one.process(Control("optimize"))
    refused, thinned = slam.counters["tdoa", "landmark_unknown"], anchored.counters["tdoa", "thinned"]
    assert not slam.landmarks
    assert refused + slam.counters["tdoa", "thinned"] == 118
    assert set(anchored.landmarks) == {"north", "south", "east"}
    assert anchored.counters.used["tdoa"] + thinned == 118
    assert thinned > 70
    ends = Counter(anchored.graph.edge(int(edge)).vertices[1:] for edge in anchored.graph.edges_of("custom"))
    assert len(ends) == 2
    assert len(set(ends.values())) == 1, "both edges of a message, or none"


def test_edges_of_a_map_at_which_another_version_of_the_plugin_fails_are_withdrawn_and_named(
    install, tmp_path, monkeypatch, capsys
):
    site = install()
    replayed(tmp_path, SHORT)
    (site / "my_tdoa.py").write_text(EXAMPLE.replace("pose, one, other = values", "raise RuntimeError('gone')"))
    monkeypatch.delitem(sys.modules, "my_tdoa")
    monkeypatch.setattr(edge_tags, "_loaded", {})
    monkeypatch.setattr(edge_tags, "_tags", {})
    capsys.readouterr()
    main(["explain", str(tmp_path / "run")])
    said = capsys.readouterr()
    (line,) = [text for text in said.err.splitlines() if "plugin my_tdoa" in text]
    assert line.endswith("tdoa: edge 'difference of ranges', plugin my_tdoa:tdoa of my-tdoa 1.0: RuntimeError: gone")
    assert re.search(rf"rejected: plugin failed\n  custom +{SHORT - 1}\n", said.out)
    again = replay(tmp_path / "a.mcap", tmp_path / "b", Config.from_mapping(SETTINGS), map_folder=tmp_path / "run")
    assert again.summary["counters"]["tdoa"]["plugin_failed"] == 2 * (SHORT - 1)
    assert again.slam.is_solved


def test_a_barometer_in_space_corrects_the_height(install):
    """Odometry climbs where the robot does not; the sensor is 0.2 m above the base."""
    install(
        "from graph_slam_ros.graph import SE3, edge_from_residual\nfrom graph_slam_ros.lie import se3\n\n\n"
        "def height(values, measured):\n"
        "    return [se3.act(tuple(values[0]), (0.0, 0.0, 0.2))[2] - measured[0]]\n\n\n"
        'height = edge_from_residual("height", ((SE3,),), 1, 1, height)\n',
        edges="[graph_slam_ros.edges]\nEDGE_HEIGHT = my_air:height\n",
        module="my_air",
    )
    off = []
    for measures in (False, True):
        slam = GraphSlam(Config.from_mapping({"world.dimensions": 3}))
        for k in range(60):
            at_ns = (k + 1) * STEP
            slam.process(Odometry(at_ns, (0.1 * k, 0.0, 0.01 * k, 0.0, 0.0, 0.0, 1.0)))
            if measures:
                later_ns = at_ns + 40_000_000
                slam.process(CustomEdge(later_ns, "air", "EDGE_HEIGHT", (later_ns,), (0.2,), (0.01,)))
        slam.process(Control("end"))
        slam.process(Control("optimize"))
        off.append(abs(slam.trajectory()[-1, 2]))
    assert slam.counters.used["air"] == 59  # the last is after all odometry
    assert off[0] > 0.5
    assert off[1] < 0.2 * off[0]


KERNEL = """import numba
import numpy as np

from graph_slam_ros.graph import EdgeType


@numba.njit
def linearize(x, at, measured):
    n = len(at)
    residual, jacobian = np.empty((n, 1)), np.zeros((n, 1, 7))
    for e in range(n):
        residual[e, 0] = -measured[e, 0]
        c, s = np.cos(x[at[e, 0] + 2]), np.sin(x[at[e, 0] + 2])
        for slot, sign in ((1, 1.0), (2, -1.0)):
            dx, dy = x[at[e, slot]] - x[at[e, 0]], x[at[e, slot] + 1] - x[at[e, 0] + 1]
            far = np.hypot(dx, dy)
            residual[e, 0] += sign * far
            jacobian[e, 0, 0] -= sign * (c * dx + s * dy) / far
            jacobian[e, 0, 1] -= sign * (c * dy - s * dx) / far
            jacobian[e, 0, 1 + 2 * slot], jacobian[e, 0, 2 + 2 * slot] = sign * dx / far, sign * dy / far
    return residual, jacobian


"""


def test_a_compiled_edge_type_is_compiled_at_the_start_once_and_gives_the_same_map(install, tmp_path):
    made = re.search(r"^tdoa = edge_from_residual.*$", EXAMPLE, re.MULTILINE)[0]
    compiled = made.replace("edge_from_residual", "EdgeType").replace("difference_of_ranges)", "linearize)")
    install(KERNEL + EXAMPLE.replace(made, compiled.replace("difference of ranges", "compiled")))
    converters(TYPE)
    import my_tdoa

    before = my_tdoa.linearize.signatures
    assert len(before) == 1
    fast = replayed(tmp_path, SHORT).slam
    assert my_tdoa.linearize.signatures == before
    path = fast.trajectory()
    assert len(fast.graph.edges_of("custom")) == SHORT - 1
    assert fast.ledger.outside_count == 0
    check_edge(map_edge_of(TAG), lambda rng: [*rng.standard_normal(1), *se2.exp(rng.standard_normal(3))])
    *_, (truth, _) = truths(SHORT)
    assert np.abs(path[-1, :2] - truth[:2]).max() < 0.15
