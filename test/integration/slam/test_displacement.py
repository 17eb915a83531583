"""The robot is elsewhere than odometry says: it slipped, was carried, or somebody gave a wrong pose."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from imperfect import START_NS, Faults, driven, imperfect_drive
from reliability import times

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import InitialPose
from graph_slam_ros.runs.restore import complete, map_of, record_run, recover
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.slam.alarm import Alarm
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.tools.simulation import Fault, faulty_recording, measurements, simulate

DISPLACED, SLIP = ("odometry", "displaced"), ("odometry", "slip")


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


def errors(slam, recording):
    """Distances of all keyframes from the truth, in the frame of the first pose."""
    first = se2.compose(tuple(recording.T_odom_base[0]), se2.inverse(tuple(recording.T_world_base[0])))
    at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns, side="right") - 1
    true = np.array([se2.compose(first, tuple(pose)) for pose in recording.T_world_base[at]])
    return np.linalg.norm((slam.trajectory() - true)[:, :2], axis=1)


class Driven:
    """A pipeline that has been driven through a recording.

    Attributes
    ----------
    moved_m : how far the path before an event has moved at most, from then until it was decided
    alarmed_s : from the event to the alarm
    """

    def __init__(self, recording, event_ns, given=None, config=None):
        self.slam, self.moved_m, self.alarmed_s = GraphSlam(config or Config()), 0.0, None
        reference = None
        for m in measurements(recording):
            if given is not None and m.stamp_ns > event_ns:
                self.slam.process(given)
                given = None
            is_new = bool(self.slam.process(m))
            alarm = self.slam.displaced
            if alarm is not None:
                self.alarmed_s = self.alarmed_s or (alarm.began_ns - event_ns) * 1e-9
            is_decided = (alarm and alarm.segment) or self.slam.counters[DISPLACED] or self.slam.counters[SLIP]
            if is_new and m.stamp_ns > event_ns > 0 and not is_decided:
                before = self.slam.trajectory()[self.slam.keyframes.stamps_ns <= event_ns, :2]
                reference = before if reference is None else reference
                self.moved_m = max(self.moved_m, float(np.linalg.norm(before - reference, axis=1).max()))
        self.slam.process(Control("end"))


def test_G23_a_robot_that_was_carried_is_found_and_the_path_before_stays(recording):
    faulty, event_ns = carried(recording)
    clean = errors(Driven(recording, event_ns).slam, recording)
    driven = Driven(faulty, event_ns)
    slam = driven.slam
    assert 0.0 < driven.alarmed_s < 5.0
    assert driven.moved_m < 0.05
    (alarm,) = slam.alarms
    assert alarm.distance_m == pytest.approx(10.0, abs=0.6)
    assert slam.segments == [0, alarm.segment]
    assert slam.counters[DISPLACED] == 1
    assert not slam.counters[SLIP]
    found, was_before = errors(slam, faulty), slam.keyframes.stamps_ns <= event_ns
    assert found[was_before].max() < clean.max() + 0.1
    assert found[~was_before].max() < clean.max() + 0.1
    slam.process(Control("optimize"))
    assert errors(slam, faulty).max() < clean.max() + 0.1
    edges = slam.graph.edges_of("odometry")
    out = [edge for edge in edges.tolist() if slam.ledger.reason.values[edge] == Reason.DISPLACED]
    assert len(out) == 1
    assert slam.ledger.verdict_of(out[0]) is Verdict.REJECTED


@pytest.mark.skipif(not times(0, 1), reason="only in make soak")
@pytest.mark.parametrize("seed", [3, 5])
def test_G23_a_robot_that_was_carried_to_new_ground_is_found_where_it_was_carried(seed):
    """Landmarks were begun at wrong places before it sees known ground again: they move with it."""
    recording = simulate("manhattan", seed=seed)
    faulty, event_ns = carried(recording, at=0.3, metres=25.0)
    slam = Driven(faulty, event_ns).slam
    assert (slam.counters[DISPLACED], slam.counters["odometry", "displacement_taken_back"]) == (1, 0)
    (_, segment) = slam.segments
    begin_ns = int(slam.keyframes.stamps_ns[segment])
    assert abs(begin_ns - event_ns) < 2 * 10**9
    clean = errors(Driven(recording, 0).slam, recording)
    assert errors(slam, faulty).max() < 1.5 * clean.max()


def test_what_was_condensed_meanwhile_hides_no_displacement_in_the_window():
    """The graph is compacted more than once between the displacement and the sightings that show it."""
    faulty, event_ns = carried(simulate("manhattan", seed=3), at=0.3, metres=25.0)
    config, condensed = Config(), 0
    slam = GraphSlam(replace(config, map=replace(config.map, window_keyframes=700)))
    for m in measurements(faulty):
        condensed += slam.process(m).condensed is not None
        if slam.counters[DISPLACED]:
            break
    (_, segment) = slam.segments
    assert condensed >= 2
    begin_ns = int(slam.keyframes.stamps_ns[segment - slam.keyframes.first])
    assert abs(begin_ns - event_ns) < 2 * 10**9


def test_G23_slipping_wheels_are_found_and_the_path_before_stays(recording):
    fault = Fault.named("slip", at=0.7, lasting=0.14, factor=1.5)
    faulty, _ = faulty_recording(recording, [fault], seed=1)
    event_ns = int(recording.stamps_ns[int(0.7 * len(recording.stamps_ns))])
    driven = Driven(faulty, event_ns)
    assert 0.0 < driven.alarmed_s < 5.0
    assert driven.moved_m < 0.05
    assert driven.slam.counters[SLIP]
    assert driven.slam.segments == [0]  # nobody carried it
    found, was_before = errors(driven.slam, faulty), driven.slam.keyframes.stamps_ns <= event_ns
    assert found[was_before].max() < 0.6  # more than a metre where nobody doubts odometry
    assert found.max() < 3.0


def test_G23_a_robot_that_is_carried_while_it_looks_is_found_and_the_path_before_stays(recording):
    faulty, _ = faulty_recording(recording, [Fault.named("carried", at=0.7, distance_m=4.0)], seed=1)
    first = round(0.7 * (len(recording.stamps_ns) - 1))
    event_ns, truth = int(recording.stamps_ns[first]), recording.T_world_base[:, :2]
    away = np.linalg.norm(truth[first:] - truth[first], axis=1)
    down_ns = int(recording.stamps_ns[first + np.argmax(away >= 4.0)])
    blind = range(down_ns, down_ns + 10**9)  # it has driven on before it sees something
    faulty = replace(faulty, seen=tuple(one for one in faulty.seen if one.stamp_ns not in blind))
    driven = Driven(faulty, event_ns)
    assert 0.0 < driven.alarmed_s < 5.0  # while odometry stands still
    assert driven.moved_m < 0.05
    assert errors(driven.slam, faulty)[driven.slam.keyframes.stamps_ns > down_ns].max() < 0.5
    assert driven.slam.counters[DISPLACED]
    assert not driven.slam.counters[SLIP]


@pytest.mark.parametrize("sensor", times(["bearing"], ["range", "bearing"]))
def test_G23_ranges_or_bearings_alone_raise_the_alarm_and_a_given_pose_ends_it(sensor):
    faulty, event_ns = carried(simulate("warehouse", seed=1, aisle_m=10.0, sensor=sensor), metres=8.0)
    until = faulty.stamps_ns <= event_ns + 15 * 10**9
    names = ("stamps_ns", "T_odom_base", "twist", "odom_covariance", "T_world_base")
    driven = Driven(replace(faulty, **{name: getattr(faulty, name)[until] for name in names}), event_ns)
    slam, odometry = driven.slam, list(measurements(faulty))
    assert 0.0 < driven.alarmed_s < 5.0  # and none in the drive before
    assert driven.moved_m < 0.05
    assert "do not determine the pose: give initialpose" in str(slam.displaced)
    assert slam.segments == [0]
    slam.process(InitialPose((0.0, 0.0, 0.0), tuple((0.01 * np.eye(3)).ravel().tolist())))
    for m in [m for m in odometry if m.stamp_ns > faulty.stamps_ns[until][-1]][:20]:
        slam.process(m)
    assert slam.displaced is None
    assert "then a segment began" in str(slam.alarms[0])


@pytest.mark.parametrize("rate", times([0.05], [0.05, 0.2]))
def test_G23_wrong_identities_are_no_displacement(recording, rate):
    fault = Fault.named("wrong_ids", rate=rate)
    faulty = faulty_recording(recording, [fault], seed=3)[0] if rate else recording
    driven = Driven(faulty, 0)
    assert driven.slam.segments == [0]
    assert driven.slam.counters[DISPLACED] == 0
    assert rate > 0.1 or not driven.slam.alarms


@pytest.mark.parametrize("away_m, sigma_m", times([(3.0, 0.05)], [(3.0, 0.05), (48.0, 0.5), (1e6, 0.5)]))
def test_G24_a_wrong_pose_that_somebody_gives_is_found_out_by_the_landmarks(recording, away_m, sigma_m):
    event_ns = int(recording.stamps_ns[int(0.7 * len(recording.stamps_ns))])
    covariance = tuple(np.diag([sigma_m**2, sigma_m**2, 0.0025]).ravel().tolist())
    driven = Driven(recording, event_ns, InitialPose((away_m, 0.0, 0.0), covariance))
    slam = driven.slam
    (given,) = slam.graph.edges_of("initialpose").tolist()
    assert slam.ledger.verdict_of(given) is Verdict.REJECTED
    assert errors(slam, recording).max() < 0.5
    assert driven.moved_m < 0.05


def test_G24_a_true_pose_that_somebody_gives_is_believed(recording):
    event_ns = int(recording.stamps_ns[int(0.7 * len(recording.stamps_ns))])
    true = (tuple(recording.T_world_base[k]) for k in (0, np.searchsorted(recording.stamps_ns, event_ns)))
    said = InitialPose(se2.between(*true), tuple((0.01 * np.eye(3)).ravel().tolist()))
    slam = Driven(recording, event_ns, said).slam
    assert slam.ledger.verdict_of(int(slam.graph.edges_of("initialpose")[0])) is Verdict.ACCEPTED
    assert not slam.alarms
    assert errors(slam, recording).max() < 0.5


def test_a_map_that_is_taken_up_has_the_segment_and_a_recovered_run_its_alarms(recording, tmp_path):
    """Also one that was cut off, and has no summary; one of an older version has them in its summary alone."""
    faulty, _ = carried(recording)
    slam, summary = record_run(tmp_path / "run", Config(), [*measurements(faulty), Control("end")], [])
    (told,) = summary["displacements"]
    assert told["segment"] == slam.alarms[0].segment
    state = map_of(tmp_path / "run", [])
    assert state.segments == slam.segments
    again = GraphSlam(Config(), start=state)
    assert np.abs((again.trajectory() - slam.trajectory())[:, :2]).max() < 0.05  # solved anew, all of it
    shutil.copytree(tmp_path / "run", tmp_path / "cut")
    (tmp_path / "cut" / "run.json").unlink()
    for name in ("run", "cut"):
        assert recover(tmp_path / name, tmp_path / f"{name} again")["displacements"] == [told]
        assert complete(tmp_path / name)["displacements"] == [told]
    assert recover(tmp_path / "run again", tmp_path / "third")["displacements"] == [told]


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
    assert slam.segments == [0]
    assert "taken back: later sightings contradict it" in str(slam.alarms[0])
    edges = slam.graph.edges_of("odometry").tolist()
    reasons = {Reason(int(slam.ledger.reason.values[edge])) for edge in edges}
    assert reasons == {Reason.NONE, Reason.REVOKED}
    assert errors(slam, recording).max() < 0.5


def turned_unseen(turned, begin_s=25.0, end_s=50.0):
    """A drive whose odometry turns by an angle while nothing is seen, and that says more noise than it had so far."""
    drive, chain, seen = imperfect_drive(Faults(), seconds=60.0), None, []
    for m in drive:
        since_s = (m.stamp_ns - START_NS) * 1e-9
        if isinstance(m, Odometry):
            before, T_odom_base = chain or (m.T_odom_base, m.T_odom_base)
            x, y, angle = se2.log(se2.between(before, m.T_odom_base))
            extra = turned * 0.05 / (end_s - begin_s) if begin_s < since_s <= end_s else 0.0
            chain = m.T_odom_base, se2.compose(T_odom_base, se2.exp((x, y, angle + extra)))
            seen.append(replace(m, T_odom_base=tuple(map(float, chain[1]))))
        elif not begin_s < since_s < end_s:
            wide = (replace(s, covariance=tuple(9.0 * c for c in s.covariance)) for s in m.sightings)
            seen.append(replace(m, sightings=tuple(wide)))
    return seen


def test_drift_that_the_stated_noise_explains_is_no_displacement_though_odometry_was_better_so_far():
    """Else an alarm without another pose begins, which nothing ends: all that is seen from then on is held back."""
    noise = {
        "odometry.translation_density": 0.05,
        "odometry.rotation_density": 0.05,
        "robust.noise_scale": "configured",
    }
    slam = driven(turned_unseen(0.9), {**noise, "odometry.lateral_density": 0.03})
    assert slam.backend.decisions.gate_scale < 0.2 * slam.backend.decisions.stated_scale
    assert not slam.alarms
    assert not slam.ledger.outside_count


def test_an_alarm_ends_where_the_clock_jumps_back():
    """What was decided then is no alarm of the next drive: it would hold condensing back until the old time returns."""
    slam = GraphSlam(Config())
    detector = slam._kidnaps
    detector.alarms.append(Alarm(100 * 10**9, 12, segment=3, distance_m=5.0))
    detector.begin_segment(7, 5 * 10**9)
    assert detector.now is None
    assert detector.is_quiet
    assert detector.alarms[-1].ended_ns == 100 * 10**9
