"""Ids that are new from some time on are found where the landmarks lie where others were."""

import numpy as np
import pytest

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


@pytest.mark.parametrize("wrong", [0, 2])
def test_a_detector_that_begins_anew_is_found_though_some_ids_are_wrong(wrong):
    drive = lap(1000.0, "a{}") + lap(1100.0, "b{}") + [(1150.0, f"a{k}", TREES[k]) for k in range(wrong)]
    s, points = sightings(drive)
    (found,) = check_renewed(s, points, np.array([1000 * NS, 1200 * NS]), 2)
    assert (found.code, found.severity, found.topic) == ("ids_renewed", "warning", "/tags")
    assert 1100 * NS <= found.first_ns <= 1103 * NS
    assert found.value >= 28


@pytest.mark.parametrize(
    "drive",
    [
        lap(1000.0, "a{}"),
        lap(1000.0, "a{}") + lap(1100.0, "a{}"),
        lap(1000.0, "a{}") + lap(1100.0, "b{}", TREES + np.array([100.0, 0.0])),
        lap(1000.0, "a{}") + lap(1100.0, "b{}", RNG.uniform(0.0, 40.0, (30, 2))),
        lap(1000.0, "a{}", TREES[:3]) + lap(1100.0, "b{}", TREES[:3]),
    ],
    ids=["one lap", "two laps", "new ground", "others among them", "few"],
)
def test_ids_that_are_new_because_the_landmarks_are_not_found(drive):
    s, points = sightings(drive)
    assert list(check_renewed(s, points, np.array([1000 * NS, 1200 * NS]), 2)) == []
