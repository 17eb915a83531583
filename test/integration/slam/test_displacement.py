"""The robot is elsewhere than odometry says: it slipped, was carried, or somebody gave a wrong pose."""

from dataclasses import replace

import numpy as np
import pytest
from reliability import tell, times

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import InitialPose, Odometry
from graph_slam_ros.runs.outcome import doubts
from graph_slam_ros.runs.restore import map_of, record_run
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.doubt.record import ELSEWHERE
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.tools.simulation import Fault, faulty_recording, measurements, simulate

DISPLACED, SLIP = ("odometry", "displaced"), ("odometry", "slip")
SOAKED = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


@pytest.fixture(scope="module")
def recording():
    return simulate("warehouse", seed=1, aisle_m=10.0)


def carried(recording, at=0.7, metres=10.0):
    """A recording of a robot that is carried in no time while its odometry notices nothing; and the stamp of that."""
    truth, stamps = recording.T_world_base, recording.stamps_ns
    a = int(at * len(stamps))
    b = a + int(np.argmax(np.linalg.norm(truth[a:, :2] - truth[a, :2], axis=1) >= metres))
    assert np.linalg.norm(truth[b, :2] - truth[a, :2]) >= metres
    shift = int(stamps[b] - stamps[a + 1])
    odometry = recording.T_odom_base.copy()
    back = se2.compose(tuple(odometry[a]), se2.inverse(tuple(odometry[b])))
    odometry[b:] = [se2.compose(back, tuple(pose)) for pose in odometry[b:]]
    kept, later = np.r_[: a + 1, b : len(stamps)], stamps.copy()
    later[b:] -= shift
    before = [one for one in recording.seen if one.stamp_ns <= stamps[a]]
    after = [replace(one, stamp_ns=one.stamp_ns - shift) for one in recording.seen if one.stamp_ns >= stamps[b]]
    parts = {"twist": recording.twist, "odom_covariance": recording.odom_covariance, "T_world_base": truth}
    parts |= {"stamps_ns": later, "T_odom_base": odometry}
    kept_parts = {name: part[kept] for name, part in parts.items()}
    return replace(recording, seen=(*before, *after), **kept_parts), int(stamps[a])


def errors(view, recording):
    """Distances of all keyframes from the truth, in the frame of the first pose."""
    first = se2.compose(tuple(recording.T_odom_base[0]), se2.inverse(tuple(recording.T_world_base[0])))
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns, side="right") - 1
    true = np.array([se2.compose(first, tuple(pose)) for pose in recording.T_world_base[at]])
    return np.linalg.norm((view.trajectory() - true)[:, :2], axis=1)


class Driven:
    """A pipeline after a drive: how far the path before an event moved until it was decided; when the alarm came."""

    def __init__(self, recording, event_ns, given=None, config=None):
        self.slam, self.moved_m, self.alarmed_s = GraphSlam(config or Config()), 0.0, None
        reference = None
        for m in measurements(recording):
            if given is not None and m.stamp_ns > event_ns:
                self.slam.process(given)
                given = None
            is_new = bool(self.slam.process(m))
            alarm = self.slam.view.displaced
            if alarm is not None:
                self.alarmed_s = self.alarmed_s or (alarm.began_ns - event_ns) * 1e-9
            is_decided = (alarm and alarm.segment) or self.slam.counters[DISPLACED] or self.slam.counters[SLIP]
            if is_new and m.stamp_ns > event_ns > 0 and not is_decided:
                before = self.slam.view.trajectory()[self.slam.view.keyframes.stamps_ns <= event_ns, :2]
                reference = before if reference is None else reference
                self.moved_m = max(self.moved_m, float(np.linalg.norm(before - reference, axis=1).max()))
        self.slam.process(Control("end"))


def test_G23_a_robot_that_was_carried_is_found_and_the_path_before_stays(recording):
    faulty, event_ns = carried(recording)
    clean = errors(Driven(recording, 0).slam.view, recording)
    driven = Driven(faulty, event_ns)
    slam = driven.slam
    assert 0.0 < driven.alarmed_s < 5.0
    assert driven.moved_m < 0.05
    (alarm,) = slam.view.alarms
    assert alarm.distance_m == pytest.approx(10.0, abs=0.6)
    assert slam.view.segments == [0, alarm.segment]
    assert slam.counters[DISPLACED] == 1
    assert not slam.counters[SLIP]
    found, was_before = errors(slam.view, faulty), slam.view.keyframes.stamps_ns <= event_ns
    assert found[was_before].max() < clean.max() + 0.1
    assert found[~was_before].max() < clean.max() + 0.1
    slam.process(Control("optimize"))
    assert errors(slam.view, faulty).max() < clean.max() + 0.1
    edges = slam.view.graph.edges_of("odometry")
    out = [edge for edge in edges.tolist() if slam.view.ledger.reason.values[edge] == Reason.DISPLACED]
    assert len(out) == 1
    assert slam.view.ledger.verdict_of(out[0]) is Verdict.REJECTED


@pytest.mark.parametrize("sensor", times(["bearing"], ["range", "bearing"]))
def test_G23_ranges_or_bearings_alone_raise_the_alarm_and_a_given_pose_ends_it(sensor):
    faulty, event_ns = carried(simulate("warehouse", seed=1, aisle_m=10.0, sensor=sensor), metres=8.0)
    until = faulty.stamps_ns <= event_ns + 15 * 10**9
    names = ("stamps_ns", "T_odom_base", "twist", "odom_covariance", "T_world_base")
    driven = Driven(replace(faulty, **{name: getattr(faulty, name)[until] for name in names}), event_ns)
    slam, odometry = driven.slam, list(measurements(faulty))
    assert 0.0 < driven.alarmed_s < 5.0  # and none in the drive before
    assert driven.moved_m < 0.05
    assert "do not determine the pose: give initialpose" in str(slam.view.displaced)
    assert slam.view.segments == [0]
    slam.process(InitialPose((0.0, 0.0, 0.0), tuple((0.01 * np.eye(3)).ravel().tolist())))
    for m in [m for m in odometry if m.stamp_ns > faulty.stamps_ns[until][-1]][:20]:
        slam.process(m)
    assert slam.view.displaced is None
    assert "then a segment began" in str(slam.view.alarms[0])


@pytest.mark.parametrize("away_m, sigma_m", times([(3.0, 0.05)], [(3.0, 0.05), (48.0, 0.5), (1e6, 0.5)]))
def test_G24_a_wrong_pose_that_somebody_gives_is_found_out_by_the_landmarks(recording, away_m, sigma_m):
    event_ns = int(recording.stamps_ns[int(0.7 * len(recording.stamps_ns))])
    covariance = tuple(np.diag([sigma_m**2, sigma_m**2, 0.0025]).ravel().tolist())
    driven = Driven(recording, event_ns, InitialPose((away_m, 0.0, 0.0), covariance))
    slam = driven.slam
    (given,) = slam.view.graph.edges_of("initialpose").tolist()
    assert slam.view.ledger.verdict_of(given) is Verdict.REJECTED
    assert errors(slam.view, recording).max() < 0.5
    assert driven.moved_m < 0.05


def test_G24_a_true_pose_that_somebody_gives_is_believed(recording):
    event_ns = int(recording.stamps_ns[int(0.7 * len(recording.stamps_ns))])
    true = (tuple(recording.T_world_base[k]) for k in (0, np.searchsorted(recording.stamps_ns, event_ns)))
    said = InitialPose(se2.between(*true), tuple((0.01 * np.eye(3)).ravel().tolist()))
    slam = Driven(recording, event_ns, said).slam
    assert slam.view.ledger.verdict_of(int(slam.view.graph.edges_of("initialpose")[0])) is Verdict.ACCEPTED
    assert not slam.view.alarms
    assert errors(slam.view, recording).max() < 0.5


@SOAKED
def test_a_displacement_that_later_sightings_contradict_is_taken_back(recording):
    """For some seconds the robot sees copies of tags, as they would be seen from 4.5 m away; then unique ones."""
    rng, stamps = np.random.default_rng(1), recording.stamps_ns
    begin_ns, end_ns = (int(stamps[int(part * len(stamps))]) for part in (0.7, 0.76))
    known = {s.id for one in recording.seen if one.stamp_ns < begin_ns for s in one.sightings}
    true = dict(zip(stamps.tolist(), recording.T_world_base.tolist(), strict=True))

    def copies(one):
        if not begin_ns <= one.stamp_ns < end_ns:
            return one
        x, y, heading = true[one.stamp_ns]
        seen = []
        for name in sorted(known):
            at = np.array(se2.between((x - 4.0, y + 2.0, heading), recording.landmarks[name]))
            if 0.5 < np.hypot(*at[:2]) < 5.0:
                measured = tuple((at + 0.03 * rng.standard_normal(3)).tolist())
                covariance = tuple((0.03**2 * np.eye(3)).ravel().tolist())
                seen.append(replace(one.sightings[0], id=name, measured=measured, covariance=covariance))
        return replace(one, sightings=tuple(seen[:3]))

    faulty = replace(recording, seen=tuple(copies(one) for one in recording.seen if one.sightings))
    slam = Driven(faulty, begin_ns).slam
    assert slam.counters[DISPLACED] == 1
    assert slam.counters["odometry", "displacement_taken_back"] == 1
    assert slam.view.segments == [0]
    assert "taken back: later sightings contradict it" in str(slam.view.alarms[0])
    edges = slam.view.graph.edges_of("odometry").tolist()
    reasons = {Reason(int(slam.view.ledger.reason.values[edge])) for edge in edges}
    assert reasons == {Reason.NONE, Reason.REVOKED}
    assert errors(slam.view, recording).max() < 0.5


LONG = times(False, True)
TAKEN_BACK = ("odometry", "slip_taken_back")


def world(seed, **options):
    return simulate("warehouse", seed=seed, **({"aisle_m": 10.0, "aisles": 2} | options))


def slipping(recording, at=0.7, seconds=10.0, loss=0.3):
    """A recording in which so much of the way is lost for so long, and the stamp at which that begins."""
    count = len(recording.stamps_ns)
    lasting = seconds * 1e9 / float(recording.stamps_ns[-1] - recording.stamps_ns[0])
    fault = Fault.named("slip", at=at, lasting=lasting, factor=1.0 / (1.0 - loss))
    return faulty_recording(recording, [fault], seed=1)[0], int(recording.stamps_ns[round(at * (count - 1))])


def driven(recording):
    slam = GraphSlam(Config())
    for m in (*measurements(recording), Control("end")):
        slam.process(m)
    return slam


@pytest.mark.parametrize("seed", times([1], range(1, 21)))
def test_a_slip_is_found_ends_and_leaves_the_map_as_good_as_without(seed, tmp_path):
    clean = world(seed, **({"aisle_m": 40.0, "aisles": 3} if LONG else {}))
    seconds = 20.0 if LONG else 10.0
    recording, begin_ns = slipping(clean, seconds=seconds)
    slam, summary = record_run(tmp_path / "run", Config(), [*measurements(recording), Control("end")], [])
    slips = [one for one in slam.view.alarms if one.kind != ELSEWHERE]
    assert slam.view.alarms[0].began_ns >= begin_ns - 10**9
    assert slips
    assert {one.kind for one in slips} == {"translation"}
    assert (slips[0].decided_ns - begin_ns) * 1e-9 < 5.0
    assert slam.view.displaced is None  # it has ended
    assert slam.view.segments == [0]
    assert (slips[-1].ended_ns - begin_ns) * 1e-9 < seconds + 5.0
    without = driven(clean)
    assert not without.view.alarms
    after_ns = begin_ns + (seconds + 5.0) * 1e9
    for is_part in (lambda stamps_ns: stamps_ns > after_ns, lambda stamps_ns: stamps_ns <= begin_ns):
        each = (errors(one.view, clean)[is_part(one.view.keyframes.stamps_ns)] for one in (without, slam))
        good, found = (float(np.sqrt(np.mean(np.square(one)))) for one in each)
        assert found < 1.2 * good + 0.05
    assert_replaced(slam.view, slips, tmp_path)
    assert [one["text"] for one in summary["displacements"]] == [str(one) for one in slam.view.alarms]
    edges = sum(one.edges for one in slips)
    slam.process(Control("optimize"))
    assert sum(one.edges for one in slam.view.alarms) == edges, "nor is it taken back when everything is solved"
    assert slam.counters[TAKEN_BACK] == 0


def assert_replaced(view, slips, tmp_path):
    """The ledger has each edge of the stretch and that in its place, and a map that is read has the same."""
    edges, ledger, graph = view.graph.edges_of("odometry"), view.ledger, view.graph
    out = edges[ledger.reason.values[edges] == Reason.SLIP].tolist()
    assert len(out) == sum(one.edges for one in slips)
    for edge in out:
        own = graph.edge(edge)
        assert ledger.verdict_of(edge) is Verdict.REJECTED
        assert ledger.statistic.values[edge] > ledger.threshold.values[edge] > 0.0
        (wider,) = [
            other
            for other in edges.tolist()
            if other != edge
            and graph.edge(other).vertices == own.vertices
            and ledger.verdict_of(other) is Verdict.NOT_EVALUATED
        ]
        assert np.array_equal(graph.edge(wider).measured, own.measured)
        assert np.linalg.det(graph.edge(wider).sqrt_information) < np.linalg.det(own.sqrt_information)
    assert map_of(tmp_path / "run", []).ledger.reason.values.tolist() == ledger.reason.values.tolist()


@SOAKED
@pytest.mark.parametrize("seed", times([0], range(100)))
def test_clean_drives_of_ten_minutes_have_no_slip(seed):
    kind = ("warehouse", "manhattan")[seed % 2]
    options = {"aisles": 3, "aisle_m": 40.0, "laps": 4} if kind == "warehouse" else {"poses": 500, "blocks": 8}
    slam = driven(simulate(kind, seed=seed, **options))
    tell("slips on clean drives", drives=1, alarms=slam.counters[SLIP])
    assert slam.counters[SLIP] == 0


def test_a_burst_of_wrong_identities_and_a_moved_landmark_are_no_slip():
    recording = world(2)
    moved, _ = faulty_recording(recording, [Fault.named("moved_landmarks", at=0.6, distance_m=0.7)], seed=2)
    names, rng = sorted(recording.landmarks), np.random.default_rng(2)
    begin_ns = int(recording.stamps_ns[int(0.75 * len(recording.stamps_ns))])

    def spoiled(one):
        is_in = begin_ns <= one.stamp_ns < begin_ns + 5 * 10**9
        wrong = [replace(s, id=str(rng.choice(names))) if is_in and rng.random() < 0.5 else s for s in one.sightings]
        return replace(one, sightings=tuple({s.id: s for s in wrong}.values()))

    slam = driven(replace(moved, seen=tuple(map(spoiled, moved.seen))))
    assert (slam.counters[SLIP], slam.view.segments) == (0, [0])
    assert [line.partition(":")[0] for line in doubts(summarize(slam)) if "did it move" in line] == ["rack2w0"]


def test_a_slip_that_was_none_is_taken_back_by_what_is_seen_next_and_leaves_no_trace():
    recording = world(3, laps=1)
    half = int(recording.stamps_ns[len(recording.stamps_ns) // 2])
    plain, doubted, links = GraphSlam(Config()), GraphSlam(Config()), None
    window = doubted._doubt._window
    for m in measurements(recording):
        for slam in (plain, doubted):
            slam.process(m)
        if links is None and isinstance(m, Odometry) and m.stamp_ns > half:
            links = list(window.links.values())[-3:]
            doubted._doubt._begin_slip("translation", links, 20.0, 2, m.stamp_ns)
            assert "odometry in doubt since" in str(doubted.view.displaced)
            assert all(link.edge != link.own for link in links)
        if links is not None and doubted.view.displaced is None:
            break
    edges = doubted.view.graph.edges_of("odometry")
    reasons = doubted.view.ledger.reason.values[edges]
    own = set(edges[reasons != Reason.REVOKED].tolist())
    assert {link.edge for link in window.links.values()} <= own
    for slam in (plain, doubted):
        slam.process(Control("optimize"))
        slam.view.solver.optimize(slam.view.solver.settings.until_still())
    assert doubted.counters[TAKEN_BACK] == 1
    (slip,) = doubted.view.alarms
    assert (slip.edges, "taken back" in str(slip)) == (0, True)
    assert np.abs(plain.view.trajectory() - doubted.view.trajectory()).max() < 1e-6
    reasons = doubted.view.ledger.reason.values[doubted.view.graph.edges_of("odometry")].tolist()
    assert set(reasons) == {Reason.NONE, Reason.REVOKED}
    assert reasons.count(Reason.REVOKED) >= 3
