"""Odometry that is silent, begins anew, stands still, or has a clock that is set back, while the robot drives on."""

import numpy as np
import pytest

from graph_slam_ros.config.config import Config
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.outcome import shortcomings
from graph_slam_ros.runs.tables import account, summarize
from graph_slam_ros.slam import Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.frontend.ingest_gate import IngestGate

TAGS = {f"{x} {y}": (float(x), float(y)) for x in range(-8, 30, 4) for y in (-3, 3, 7, 13)}
RATE, SPEED, STRAIGHT, RADIUS = 20, 1.2, 20.0, 5.0
BEGINS, SECONDS = 4.0, 19.0


def truth(second):
    """A lap of two straights and two half circles."""
    half = np.pi * RADIUS
    _, way = divmod(SPEED * second, 2.0 * (STRAIGHT + half))
    back, way = divmod(way, STRAIGHT + half)
    at = (min(way, STRAIGHT), 0.0, 0.0)
    if way > STRAIGHT:
        turned = (way - STRAIGHT) / RADIUS
        at = (STRAIGHT + RADIUS * np.sin(turned), RADIUS * (1.0 - np.cos(turned)), turned)
    return se2.compose((STRAIGHT, 2.0 * RADIUS, np.pi), at) if back else at


def driven(fault, lasts_s, most=99):
    """The pipeline after a drive with a fault of odometry, and the errors of its newest pose since the fault began."""
    slam, errors, rng = GraphSlam(Config()), [], np.random.default_rng(0)
    gate = IngestGate(slam.counters)
    odometry, last = se2.IDENTITY, truth(0.0)
    for k in range(round(SECONDS * RATE)):
        second = k / RATE
        is_on, now = BEGINS <= second < BEGINS + lasts_s, truth(second)
        step = np.array(se2.between(last, now)) * (1.01, 1.0, 1.0) + rng.normal(0.0, (5e-4, 2e-4, 5e-4))
        last = now
        if fault in ("anew", "anew by compass") and is_on:
            odometry = (0.0, 0.0, odometry[2] + step[2] if fault == "anew by compass" else 0.0)
        elif not (fault == "frozen" and is_on):
            odometry = se2.compose(odometry, tuple(step))
        stamp_ns = round(1e12 + 1e9 * (second - (lasts_s if fault == "set back" and second >= BEGINS else 0.0)))
        is_silent = is_on and fault not in ("frozen", "set back")
        measured = [] if is_silent else [Odometry(stamp_ns, tuple(map(float, odometry)))]
        seen = [(name, np.array(se2.act(se2.inverse(now), at))) for name, at in TAGS.items()]
        seen = [(name, p + rng.normal(0.0, 0.03, 2)) for name, p in seen if p[0] > 0.3 and np.linalg.norm(p) < 9.0]
        sightings = tuple(Sighting(name, "position", p, 9e-4 * np.eye(2)) for name, p in seen[:most])
        for m in (*measured, Sightings(stamp_ns, "camera", sightings)):
            passage = gate.admit([m], "segment")
            for one in (*passage.events, *passage.measured):
                slam.process(one)
        if not is_silent and second >= BEGINS:
            errors.append(np.linalg.norm(np.array(se2.compose(slam.view.T_map_odom, odometry))[:2] - now[:2]))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    return slam, np.array(errors)


@pytest.mark.parametrize(
    ("fault", "lasts_s", "most", "worst_m", "segments", "counted"),
    [
        ("silent", 8.0, 99, 0.3, 1, ("camera", "odometry_gap")),
        ("frozen", 4.0, 99, 1.0, 1, ("odometry", "frozen")),
        ("frozen", 4.0, 1, 6.0, 1, ("odometry", "frozen")),  # one landmark in view
        ("set back", 0.507, 99, 0.3, 2, ("odometry", "late")),
    ],
)
def test_the_drive_goes_on_and_what_was_wrong_is_counted(fault, lasts_s, most, worst_m, segments, counted):
    slam, errors = driven(fault, lasts_s, most)
    assert errors.max() < worst_m
    assert (len(slam.view.segments), slam.counters[counted] > 1) == (segments, True)
    summary = summarize(slam) | account(slam, slam.counters)
    assert any("stood still" in line for line in shortcomings(summary)) == (fault == "frozen")


def test_odometry_that_begins_anew_after_a_silence_ties_nothing_of_it_to_the_last_place():
    for slam, errors in (driven("anew", 3.0), driven("anew by compass", 3.0)):
        assert np.count_nonzero(errors > 1.0) < RATE, "it is found again within a second"
        assert (slam.counters["camera", "odometry_gap"] > 10, slam.counters["odometry", "reset_to_zero"]) == (True, 1)
        before = slam.view.keyframes.stamps_ns < 1e12 + 1e9 * BEGINS
        there = np.array([truth(one) for one in 1e-9 * (slam.view.keyframes.stamps_ns[before] - 1e12)])[:, :2]
        assert np.linalg.norm(slam.view.trajectory()[before, :2] - there, axis=1).max() < 0.3
