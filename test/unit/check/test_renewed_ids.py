"""Ids that are new from some time on are found where the landmarks lie where others were."""

import numpy as np
from rows import each

from graph_slam_ros.check.renewed_ids import check_renewed
from graph_slam_ros.check.sightings import SightingColumns

NS = 1_000_000_000
RNG = np.random.default_rng(3)
TREES = RNG.uniform(0.0, 40.0, (30, 2))


def sightings(drive):
    """Sightings of (time [s], id, place), and where each puts its landmark."""
    seen = sorted(drive, key=lambda one: one[0])
    names = tuple(sorted({name for _, name, _ in seen}))
    number = np.array([names.index(name) for _, name, _ in seen])
    points = np.array([(*at, 0.0) for *_, at in seen])
    points[:, :2] += RNG.normal(0.0, 0.03, (len(seen), 2))
    stamp_ns, count = np.array([round(t * NS) for t, *_ in seen]), len(seen)
    nowhere, T = np.full(count, np.nan), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    seen_by = stamp_ns, np.arange(count), names, number, points, nowhere, nowhere, np.full(count, 0.03)
    columns = ("detections", "/tags", *seen_by)
    return SightingColumns(*columns, "base_link", T), points


def lap(begin_s, name, trees=TREES):
    """All landmarks one after the other, six sightings of each within two seconds."""
    return [
        (begin_s + 3.0 * k + j / 3.0, name.format(k), at) for k, at in enumerate(map(tuple, trees)) for j in range(6)
    ]


@each("wrong", [0, 2])
def test_a_detector_that_begins_anew_is_found_though_some_ids_are_wrong(wrong):
    drive = lap(1000.0, "a{}") + lap(1100.0, "b{}") + [(1150.0, f"a{k}", TREES[k]) for k in range(wrong)]
    s, points = sightings(drive)
    (found,) = check_renewed(s, points, np.array([1000 * NS, 1200 * NS]), 2)
    assert (found.code, found.severity, found.topic) == ("ids_renewed", "warning", "/tags")
    assert 1100 * NS <= found.first_ns <= 1103 * NS
    assert found.value >= 28


def renewed(drive):
    s, points = sightings(drive)
    return list(check_renewed(s, points, np.array([900 * NS, 2000 * NS]), 2))


ROWS = np.array([(2.0 * k, 3.0 * row) for row in range(6) for k in range(15)])
HALF = lap(1000.0, "a{}", ROWS[:45]) + lap(1140.0, "b{}", ROWS[45:])


@each("drift_m", [0.0, 0.7])
@each("every_s", [25.0, 100.0, 200.0])
def test_a_detector_that_begins_anew_again_and_again_is_found(every_s, drift_m):
    """On new ground in the first half, and there again in the second."""
    later = ROWS + np.array([drift_m, 0.0])
    laps = HALF + lap(1280.0, "a{}", later[:45]) + lap(1420.0, "b{}", later[45:])
    (found,) = renewed([(t, f"{name}, {t // every_s}", at) for t, name, at in laps])
    assert (found.code, found.severity) == ("ids_renewed", "warning")
    assert 1180 * NS <= found.first_ns <= 1290 * NS
    assert 80 <= found.value <= found.count <= 160


def test_a_way_out_and_back_past_its_landmarks_has_the_same_ids_but_for_a_few():
    back = lap(1280.0, "b{}", ROWS[45:][::-1]) + lap(1420.0, "a{}", ROWS[:45][::-1])
    back = [(t, name if k % 20 else f"{name} wrong", at) for k, (t, name, at) in enumerate(back)]
    for end_s in (1280.0, 1285.0, 1300.0, 1420.0, 1600.0):
        assert renewed([one for one in HALF + back if one[0] < end_s]) == []


@each(
    "drive",
    [
        lap(1000.0, "a{}"),
        lap(1000.0, "a{}") + lap(1100.0, "a{}"),
        lap(1000.0, "a{}") + lap(1100.0, "b{}", TREES + np.array([100.0, 0.0])),
        lap(1000.0, "a{}") + lap(1100.0, "b{}", RNG.uniform(0.0, 40.0, (30, 2))),
        lap(1000.0, "a{}", TREES[:3]) + lap(1100.0, "b{}", TREES[:3]),
    ],
)
def test_ids_that_are_new_because_the_landmarks_are_not_found(drive):
    s, points = sightings(drive)
    assert list(check_renewed(s, points, np.array([1000 * NS, 1200 * NS]), 2)) == []
