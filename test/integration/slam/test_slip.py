"""Wheels slip: odometry tells a longer way than was driven, for some seconds."""

from dataclasses import replace

import numpy as np
import pytest
from reliability import tell, times

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.runs.restore import map_of, record_run
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.slam.slip_review import Slip
from graph_slam_ros.tools.simulation import Fault, faulty_recording, measurements, simulate

LONG = times(False, True)
SOAKED = pytest.mark.skipif(not LONG, reason="only in make soak")
SLIP = ("odometry", "slip")
TAKEN_BACK = ("odometry", "slip_taken_back")


def world(seed, **options):
    return simulate("warehouse", seed=seed, **({"aisle_m": 10.0, "aisles": 2} | options))


def slipping(recording, at=0.7, seconds=10.0, loss=0.3):
    """A recording in which so much of the way is lost for so long, and the stamp at which that begins."""
    count = len(recording.stamps_ns)
    lasting = seconds * 1e9 / float(recording.stamps_ns[-1] - recording.stamps_ns[0])
    fault = Fault.named("slip", at=at, lasting=lasting, factor=1.0 / (1.0 - loss))
    return faulty_recording(recording, [fault], seed=1)[0], int(recording.stamps_ns[round(at * (count - 1))])


def errors(slam, recording):
    """Distances of all keyframes from the truth, in the frame of the first pose."""
    first = se2.compose(tuple(recording.T_odom_base[0]), se2.inverse(tuple(recording.T_world_base[0])))
    at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns, side="right") - 1
    true = np.array([se2.compose(first, tuple(pose)) for pose in recording.T_world_base[at]])
    return np.linalg.norm((slam.trajectory() - true)[:, :2], axis=1)


def driven(recording, until_ns=None, slam=None):
    slam = slam or GraphSlam(Config())
    for m in measurements(recording):
        if until_ns is not None and m.stamp_ns > until_ns:
            return slam
        slam.process(m)
    slam.process(Control("end"))
    return slam


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("seed", times([1], range(1, 21)))
def test_a_slip_is_found_ends_and_leaves_the_map_as_good_as_without(seed, tmp_path):
    clean = world(seed, **({"aisle_m": 40.0, "aisles": 3} if LONG else {}))
    seconds = 20.0 if LONG else 10.0
    recording, begin_ns = slipping(clean, seconds=seconds)
    slam, summary = record_run(tmp_path / "run", Config(), [*measurements(recording), Control("end")], [])
    slips = [one for one in slam.alarms if isinstance(one, Slip)]
    assert slam.alarms[0].began_ns >= begin_ns - 10**9
    assert slips
    assert {one.kind for one in slips} == {"translation"}
    assert (slips[0].decided_ns - begin_ns) * 1e-9 < 5.0
    assert slam.displaced is None  # it has ended
    assert slam.segments == [0]
    assert (slips[-1].ended_ns - begin_ns) * 1e-9 < seconds + 5.0
    without = driven(clean)
    assert not without.alarms
    after_ns = begin_ns + (seconds + 5.0) * 1e9
    for is_part in (lambda stamps_ns: stamps_ns > after_ns, lambda stamps_ns: stamps_ns <= begin_ns):
        good, found = (rms(errors(one, clean)[is_part(one.keyframes.stamps_ns)]) for one in (without, slam))
        assert found < 1.2 * good + 0.05
    assert_replaced(slam, slips, tmp_path)
    assert [one["text"] for one in summary["displacements"]] == [str(one) for one in slam.alarms]
    edges = sum(one.edges for one in slips)
    slam.process(Control("optimize"))
    assert sum(one.edges for one in slam.alarms) == edges, "nor is it taken back when everything is solved"
    assert slam.counters[TAKEN_BACK] == 0


def assert_replaced(slam, slips, tmp_path):
    """The ledger has each edge of the stretch and that in its place, and a map that is read has the same."""
    edges, ledger, graph = slam.graph.edges_of("odometry"), slam.ledger, slam.graph
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
    again = map_of(tmp_path / "run", [])
    assert again.ledger.reason.values.tolist() == ledger.reason.values.tolist()


def followed(recording, clean, begin_ns):
    """A drive, its errors before a stamp at each later stamp until odometry is doubted, and when it is [s]."""
    slam, before, told_s = GraphSlam(Config()), {}, None
    for m in measurements(recording):
        slam.process(m)
        if told_s is None and begin_ns < m.stamp_ns < begin_ns + 6 * 10**9:
            before[m.stamp_ns] = errors(slam, clean)[slam.keyframes.stamps_ns <= begin_ns]
            told_s = (m.stamp_ns - begin_ns) * 1e-9 if slam.displaced else None
    slam.process(Control("end"))
    return slam, before, told_s


@SOAKED
@pytest.mark.parametrize("seed", times([1], range(1, 21)))
def test_slip_and_carried_are_told_apart_within_five_seconds(seed):
    """Closures move the path before by up to 0.6 m, in the clean drive, too: so the two are compared."""
    clean = world(seed, aisle_m=40.0, aisles=3)
    slid, begin_ns = slipping(clean, seconds=20.0)
    lifted, _ = faulty_recording(clean, [Fault.named("carried", at=0.7, distance_m=30.0)], seed=1)
    without, good, _ = followed(clean, clean, begin_ns)
    for kind, recording in (("slip", slid), ("carried", lifted)):
        slam, found, told_s = followed(recording, clean, begin_ns)
        assert told_s < 5.0
        both = [(found[stamp_ns], good[stamp_ns]) for stamp_ns in sorted(found.keys() & good.keys())]
        bend_m = max(rms(one) - rms(other) for one, other in both)
        bend_most_m = max(float(np.max(one - other)) for one, other in both)
        after = [rms(errors(one, clean)[one.keyframes.stamps_ns > begin_ns + 25 * 10**9]) for one in (slam, without)]
        worst = {"told_s": told_s, "bend_m": bend_m, "bend_most_m": bend_most_m, "after": after[0] / after[1]}
        tell(f"{kind} of 20 s", drives=1, worst=worst)
        counted = slam.counters[SLIP] > 0, slam.counters["odometry", "displaced"] > 0
        assert counted == (kind == "slip", kind == "carried")
        assert bend_m < 0.05
        assert bend_most_m < 0.15
        assert after[0] < (1.5 if kind == "slip" else 1.2) * after[1] + 0.05


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
    stamps, rng = recording.stamps_ns, np.random.default_rng(2)
    begin_ns = int(stamps[int(0.75 * len(stamps))])
    names = sorted(recording.landmarks)

    def spoiled(one):
        if not begin_ns <= one.stamp_ns < begin_ns + 5 * 10**9:
            return one
        wrong = [replace(s, id=names[rng.integers(len(names))]) if rng.random() < 0.5 else s for s in one.sightings]
        return replace(one, sightings=tuple({s.id: s for s in wrong}.values()))

    slam = driven(replace(moved, seen=tuple(map(spoiled, moved.seen))))
    assert slam.counters[SLIP] == 0
    assert slam.segments == [0]


def doubt(slam, links, now_ns, **ended):
    """Put a slip into a pipeline where none was."""
    slip = Slip("translation", links[0].stamps_ns[0], now_ns, 20.0, 2, **ended)
    detector = slam._kidnaps._slips
    detector.slips.append(slip)
    detector._replace(links, slip, len(slam.keyframes) - 1)


def test_a_slip_that_was_none_is_taken_back_and_leaves_no_trace():
    """By what is seen next, or where it has ended when everything is solved."""
    recording = world(3, laps=1)
    half = int(recording.stamps_ns[len(recording.stamps_ns) // 2])
    plain, doubted, ended = (GraphSlam(Config()) for _ in range(3))
    detector, links = doubted._kidnaps._slips, None
    for m in measurements(recording):
        for slam in (plain, doubted, ended):
            slam.process(m)
        if links is None and isinstance(m, Odometry) and m.stamp_ns > half:
            links = list(detector._links)[-3:]
            doubt(doubted, links, m.stamp_ns)
            assert "odometry in doubt since" in str(doubted.displaced)
            assert all(detector.active(link.own) == link.edge != link.own for link in links)
            doubt(ended, list(ended._kidnaps._slips._links)[-5:], m.stamp_ns, ended_ns=m.stamp_ns + 1)
        if links is not None and doubted.displaced is None:
            break
    edges = doubted.graph.edges_of("odometry")
    reasons = doubted.ledger.reason.values[edges]
    own = set(edges[reasons != Reason.REVOKED].tolist())
    assert {detector.active(edge) for edge in edges.tolist()[-20:]} <= own
    assert ended.counters[TAKEN_BACK] == 0
    for slam in (plain, doubted, ended):
        slam.process(Control("optimize"))
        slam.solver.optimize(slam.solver.settings.until_still())
    assert "taken back: all measurements together agree with odometry" in str(ended.alarms[0])
    for slam, count in ((doubted, 3), (ended, 5)):
        assert slam.counters[TAKEN_BACK] == 1
        (slip,) = slam.alarms
        assert (slip.edges, "taken back" in str(slip)) == (0, True)
        assert np.abs(plain.trajectory() - slam.trajectory()).max() < 1e-6
        reasons = slam.ledger.reason.values[slam.graph.edges_of("odometry")].tolist()
        assert set(reasons) == {Reason.NONE, Reason.REVOKED}
        assert reasons.count(Reason.REVOKED) >= count
