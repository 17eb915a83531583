"""The robot is elsewhere than odometry says: it slipped, was carried, or somebody gave a wrong pose."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import InitialPose
from graph_slam_ros.runs.restore import complete, map_of, record_run, recover
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.tools.simulation import measurements, simulate

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
    clean = errors(Driven(recording, 0).slam, recording)
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


@SOAKED
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


@SOAKED
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
    assert slam.segments == [0]
    assert "taken back: later sightings contradict it" in str(slam.alarms[0])
    edges = slam.graph.edges_of("odometry").tolist()
    reasons = {Reason(int(slam.ledger.reason.values[edge])) for edge in edges}
    assert reasons == {Reason.NONE, Reason.REVOKED}
    assert errors(slam, recording).max() < 0.5
