"""Landmarks that vanish, move or come back, in the pipeline: laps around a small hall, with ids and without."""

import json

import numpy as np
import pytest

from graph_slam_ros.analysis.explain import explain_edge
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.config.config import Config
from graph_slam_ros.lie import se2
from graph_slam_ros.maps.edit import edit_run
from graph_slam_ros.maps.merge import merge
from graph_slam_ros.runs.restore import record_run, restored
from graph_slam_ros.slam import Control, GraphSlam, Odometry, Sighting, Sightings

LAP, RADIUS_M = 24, 6.0
AROUND = [(2.0 * np.pi * k / 16, 3.5 if k % 2 == 0 else 8.5) for k in range(16)]
MARKS = {f"m{k}": (r * np.sin(a), RADIUS_M - r * np.cos(a)) for k, (a, r) in enumerate(AROUND)}
LATER = {"m1": None, "m6": None, "m3": (9.0, 6.0), "m10": (-7.5, 10.0)}
LATE = {"n1": (-6.5, -1.0), "n2": (5.0, 12.5)}


def measurements(laps, changed=0, seed=0, chance=0.9, wide=1.2, start=0):
    """Laps in a circle; from one lap on some landmarks are gone, elsewhere or new.

    Parameters
    ----------
    chance : with which a landmark in view is seen, for a whole pass
    wide : half of the field of view
    """
    rng, odometry, before = np.random.default_rng(seed), se2.IDENTITY, None
    hidden = {}
    for k in range(start, start + laps * LAP):
        angle, stamp_ns = 2.0 * np.pi * k / LAP, (1000 + k) * 10**9
        truth = (RADIUS_M * np.sin(angle), RADIUS_M - RADIUS_M * np.cos(angle), angle)
        if before is not None:
            step = np.array(se2.between(before, truth)) * [1.005, 1.0, 1.0]
            odometry = se2.compose(odometry, tuple(step + rng.normal(0.0, [0.01, 0.01, 0.003])))
        before = truth
        yield Odometry(stamp_ns, tuple(map(float, odometry)))
        is_later = bool(changed) and k >= changed * LAP
        marks = MARKS | (LATER | LATE if is_later else {})
        seen = []
        for name, at in marks.items():
            if at is None:
                continue
            point = np.array(se2.act(se2.inverse(truth), at), dtype=float)
            if np.linalg.norm(point) > 4.5 or abs(np.arctan2(point[1], point[0])) > wide:
                hidden.pop(name, None)
            elif not hidden.setdefault(name, rng.random() > chance):
                noisy = point + rng.normal(0.0, 0.03, 2)
                seen.append(Sighting(name, "position", tuple(noisy.tolist()), (9e-4, 0.0, 0.0, 9e-4)))
        if seen:
            yield Sightings(stamp_ns, "camera", tuple(seen))
    yield Control("end")


def config(**values):
    return Config.from_mapping({"keyframes.min_distance_m": 0.5, "landmarks.retire": True} | values)


def driven(some, slam=None, **values):
    slam = slam or GraphSlam(config(**values))
    for m in some:
        slam.process(m)
    return slam


def what(slam, kind):
    return {one.name for one in slam.landmark_events if one.what == kind}


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """The run of a hall that changes, and its pipeline."""
    folder = tmp_path_factory.mktemp("changed") / "run"
    return folder, record_run(folder, config(), measurements(34, changed=14), [])[0]


def test_what_is_gone_is_retired_what_moved_is_at_its_new_place_and_a_second_run_and_its_map_know_the_same(changed):
    folder, slam = changed
    assert what(slam, "retired") == {"m1", "m6"}
    assert what(slam, "moved") == {"m3", "m10"}
    assert {name for name, mark in slam.landmarks.items() if mark.retired_ns} == {"m1", "m6", "m3#1", "m10#1"}
    for name, at in (LATER | LATE | {"m3#1": MARKS["m3"], "m10#1": MARKS["m10"], "m5": MARKS["m5"]}).items():
        if at is not None:
            assert slam.solver.estimate([slam.landmarks[name].vertex])[0] == pytest.approx(at, abs=0.2)
    set_aside = [change for change in slam.ledger.history if change.reason.name == "MOVED"]
    ends = {slam.graph.edge(one.edge).vertices[1] for one in set_aside}
    assert set() < ends <= {slam.landmarks["m3#1"].vertex, slam.landmarks["m10#1"].vertex}
    again = restored(folder, [])
    assert "m3#1" in (folder / "landmarks.csv").read_text()
    assert again.landmark_passes(0) == slam.landmark_passes(0)
    retired = [{name: mark.retired_ns for name, mark in one.landmarks.items()} for one in (slam, again)]
    assert retired[0] == retired[1]
    events = json.loads((folder / "run.json").read_text())["landmark_events"]
    assert events == list(map(str, slam.landmark_events))
    text = "\n".join(explain_edge(SavedGraph(folder, []), "landmark:m3#1"))
    assert "landmark m3 moved from" in text
    assert "landmark moved" in text


def test_without_the_parameter_nothing_is_retired():
    slam = driven(measurements(20, changed=8), **{"landmarks.retire": False})
    assert not slam.landmark_events
    assert "m3#1" not in slam.landmarks


@pytest.mark.parametrize(("chance", "wide"), [(0.5, 1.2), (0.9, 0.4)])
def test_occlusion_and_a_narrow_view_retire_nothing(chance, wide):
    slam = driven(measurements(30, chance=chance, wide=wide, seed=4))
    assert not slam.landmark_events


def test_a_landmark_that_was_hidden_for_long_comes_back():
    def hidden():
        for m in measurements(34):
            at = m.stamp_ns // 10**9 - 1000 if isinstance(m, Sightings) else 0
            if 12 * LAP <= at < 28 * LAP:
                kept = tuple(one for one in m.sightings if one.id != "m4")
                m = Sightings(m.stamp_ns, m.topic, kept)
            yield m

    slam = driven(hidden())
    assert [(one.what, one.name) for one in slam.landmark_events] == [("retired", "m4"), ("returned", "m4")]
    assert not slam.landmarks["m4"].retired_ns


def test_a_blind_sensor_retires_nothing():
    blind_ns = (1000 + 12 * LAP) * 10**9
    slam = driven(m for m in measurements(24) if not (isinstance(m, Sightings) and m.stamp_ns > blind_ns))
    assert not slam.landmark_events


def test_a_surveyed_landmark_is_reported_and_stays():
    rows = [f"{name},{x},{y},0.05" for name, (x, y) in MARKS.items() if name in ("m1", "m3", "m8")]
    survey = "\n".join(["id,x,y,sigma", *rows])
    slam = driven(measurements(34, changed=14), **{"landmarks.surveyed": survey})
    assert what(slam, "missing") == {"m1"}
    assert what(slam, "elsewhere") == {"m3"}
    text = next(str(one) for one in slam.landmark_events if one.name == "m3")
    assert "write m3,8.9" in text or "write m3,9.0" in text
    assert not slam.landmarks["m3"].retired_ns


def test_merge_keeps_what_is_retired_and_never_takes_two_old_places_for_one(changed, tmp_path):
    record_run(tmp_path / "b", config(), measurements(34, changed=14, seed=1), [])
    merge(changed[0], tmp_path / "b", tmp_path / "both")
    marks = restored(tmp_path / "both", []).landmarks
    assert {name for name, mark in marks.items() if mark.retired_ns} == {"m1", "m6", "m3#1", "m10#1", "m3#2", "m10#2"}
    assert "retired_ns" in (tmp_path / "both" / "landmarks.csv").read_text()


def test_a_map_that_is_moved_forgets_from_where_landmarks_were_seen(tmp_path):
    record_run(tmp_path / "run", config(), measurements(4), [])
    assert restored(tmp_path / "run", []).landmark_passes(0)
    by = {"name": "turn", "who": "a", "when": "2026-11-23T10:00:00Z", "why": "test", "do": "move_map"}
    edit_run(tmp_path / "run", [by | {"pose": [1.0, 2.0, 1.5], "sigma_m": 0.1, "sigma_rad": 0.1}], tmp_path / "turned")
    slam = restored(tmp_path / "turned", [])
    assert slam.landmark_passes(0) == []
    driven(measurements(2, start=4 * LAP), slam)
    assert not slam.landmark_events
