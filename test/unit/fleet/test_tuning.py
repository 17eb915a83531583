"""The search for parameters and what it says of them, on scores that are known in closed form."""

import math

import numpy as np
import pytest

pytest.importorskip("optuna", reason="the extra fleet is not installed")

from graph_slam_ros.config import Config
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.tools.fleet.compare import change_of
from graph_slam_ros.tools.fleet.fit import fit_about
from graph_slam_ros.tools.fleet.search import Range, Search, ranges_of, score
from graph_slam_ros.tools.fleet.tune import Tuned, TunedParameter, _found, _proof
from graph_slam_ros.tools.fleet.tuned import as_yaml

TRUE = {"a.density": 0.05, "b.sigma": 0.3}
RANGES = [Range("a.density", 0.15, 0.0, math.inf), Range("b.sigma", 0.06, 0.0, 1e9), Range("c.flat", 1.0, 0.0, 9.0)]


class Drawn:
    """The likelihood of the sigmas of normal numbers, drawn for each recording; and of a parameter without effect."""

    is_likelihood = True

    def __init__(self, recordings=6, numbers=200):
        rng = np.random.default_rng(1)
        self.squares = {name: (sigma * rng.standard_normal((recordings, numbers))) ** 2 for name, sigma in TRUE.items()}
        self.calls = 0

    def scores(self, points, recordings):
        self.calls += len(points) * len(recordings)
        return [[sum(self._nats(p[n], self.squares[n][r]) for n in TRUE if n in p) for r in recordings] for p in points]

    @staticmethod
    def _nats(sigma, squares):
        return float(np.sum(squares / (2.0 * sigma**2) + math.log(sigma)))


def search(folder, trials, runs, seed=0, **about):
    return Search(folder, RANGES, {"of": "test"} | about, range(6), seed).run(trials, runs.scores)


def test_what_is_a_factor_off_is_found_and_what_is_flat_is_named(tmp_path):
    runs = Drawn()
    best = search(tmp_path, 12, runs)
    fit = fit_about(RANGES, best, runs, range(6))
    found = {one.name: _found(one, fit) for one in RANGES}
    assert [found[one.name].state for one in RANGES] == ["changed", "changed", "undetermined"]
    for name, true in TRUE.items():
        best = math.sqrt(runs.squares[name].mean())
        assert found[name].value == pytest.approx(best, rel=0.03)
        assert found[name].value == pytest.approx(true, rel=0.2)
        assert found[name].sigma == pytest.approx((2.0 * runs.squares[name].size) ** -0.5, rel=1.0)
    assert found["c.flat"].value == 1.0


def test_from_far_away_it_goes_downhill():
    runs = Drawn()
    fit = fit_about(RANGES[:2], {"a.density": 0.004, "b.sigma": 4.0}, runs, range(6))
    assert fit.values() == pytest.approx({n: math.sqrt(runs.squares[n].mean()) for n in TRUE}, rel=0.03)


def test_each_of_a_few_recordings_is_judged_by_the_others():
    runs = Drawn(recordings=3, numbers=20)
    fit = fit_about(RANGES[:2], TRUE, runs, range(3))
    others = math.sqrt(runs.squares["b.sigma"][1:].mean())
    assert fit.values(without=0)["b.sigma"] == pytest.approx(others, rel=0.05)
    assert fit.values(without=0) != fit.values()


def test_a_search_that_is_stopped_goes_on_as_if_it_was_not(tmp_path):
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
    whole, stopped = Drawn(), Drawn()
    best = search(tmp_path / "whole", 14, whole)

    def until(calls):
        def scores(points, recordings):
            if stopped.calls > calls:
                raise KeyboardInterrupt
            return stopped.scores(points, recordings)

        return scores

    for calls in (20, 50):
        with pytest.raises(KeyboardInterrupt):
            Search(tmp_path / "stopped", RANGES, {"of": "test"}, range(6), 0).run(14, until(calls))
    assert search(tmp_path / "stopped", 14, stopped) == best
    assert search(tmp_path / "stopped", 14, stopped) == best, "nothing is left to do"
    with pytest.raises(GraphSlamError, match="has a study with another of: choose another --out"):
        search(tmp_path / "stopped", 14, stopped, of="something else")


def test_a_trial_that_is_clearly_worse_ends_before_the_last_recording(tmp_path):
    runs = Drawn()
    study = Search(tmp_path, RANGES, {}, range(6), 0)
    study.run(16, runs.scores)
    assert 0 < study.counts["pruned"] < 16
    assert runs.calls < 16 * 6


def test_no_trial_that_finishes_is_an_error(tmp_path):
    with pytest.raises(GraphSlamError, match="no trial finished"):
        Search(tmp_path, RANGES, {}, range(6), 0).run(3, lambda points, some: [[math.inf] * len(some)] * len(points))


def test_patterns_name_numbers_above_zero():
    configured = dict(flatten(Config().as_mapping()))
    found, others = ranges_of(["odometry.*_density", "landmarks.added*"], configured)
    assert [one.name for one in found][-1] == "landmarks.added_sigma_m"
    assert found[0].value == 0.02
    assert (found[0].low, found[0].high) == pytest.approx((0.004, 0.1))
    assert others == []
    assert "odometry.noise" in ranges_of(["odometry.*"], configured)[1]
    for pattern, says in (
        ("odometry.densty", "no parameter has this name"),
        ("odometry.noise", "is 'twist': only a number above 0"),
        ("landmarks.size_sigma_m", "is 0.0: only a number above 0"),
    ):
        with pytest.raises(GraphSlamError, match=says):
            ranges_of([pattern], configured)


def test_scores_are_best_where_errors_are_as_expected():
    base = {"state": "done", "rmse_m": 0.2, "nees": 3.0, "held_out_nats": 10.0, "held_out_sightings": 100}
    base |= {"chi2_per_residual.odometry": 1.0, "chi2_per_residual.landmarks": 1.0}
    assert score("rmse", base, base, 3) == score("nees", base, base, 3) == score("chi2", base, base, 3) == 0.0
    assert score("rmse", base | {"rmse_m": 0.1}, base, 3) == pytest.approx(-math.log(2.0))
    assert score("nees", base | {"nees": 6.0}, base, 3) == pytest.approx(score("nees", base | {"nees": 1.5}, base, 3))
    fewer = score("likelihood", base | {"held_out_sightings": 90}, base, 3)
    assert fewer > score("likelihood", base, base, 3) + 50.0, "what is not in the map is not predicted"
    assert score("likelihood", {"state": "failed"}, base, 3) == math.inf
    assert score("nees", base | {"nees": None}, base, 3) == math.inf


def tuned(ratio, proof="held out"):
    rows = {("d", ""): {"objective": 1.0, "rmse_m": 0.2}}, {("d", ""): {"objective": ratio, "rmse_m": 0.1}}
    found = [
        TunedParameter("odometry.rotation_density", 0.15, 0.05, 0.05, 0.05, "changed"),
        TunedParameter("landmarks.added_sigma_m", 0.05, 0.05, 0.1, 0.052, "same"),
        TunedParameter("odometry.lateral_density", 0.005, 0.005, 0.9, math.nan, "undetermined"),
        TunedParameter("odometry.tilt_density", 0.02, 0.02, math.inf, math.nan, "unused"),
    ]
    changes = [change_of(metric, [("d", "")], *rows) for metric in ("objective", "rmse_m")]
    counts = {"trials": 24, "pruned": 3, "runs": 99}
    return Tuned(found, [], "likelihood", proof, changes, ["a", "b"], ["d"], [], counts)


def test_the_file_has_what_changes_and_says_why_the_rest_does_not(tmp_path):
    file = tmp_path / "tuned.yaml"
    file.write_text(as_yaml(tuned(0.8)))
    assert dict(flatten(read_parameters(file))) == {"odometry.rotation_density": 0.05}
    text = file.read_text()
    assert "was 0.15; 95 % interval 0.0453 to 0.0551" in text
    assert "a left-out sighting is 1.250 times as likely" in text
    assert "rmse_m 0.2 to 0.1, 0.500 times" in text
    assert "landmarks.added_sigma_m: left at 0.05: 95 % interval 0.0427 to 0.0633" in text
    assert (
        "odometry.lateral_density: left at 0.005: these recordings do not determine it (95 % interval: a factor of"
        in text
    )
    assert "odometry.tilt_density: left at 0.02: it changes no result" in text
    assert "nothing can be held out" in as_yaml(tuned(0.8, "none"))


def test_values_that_are_worse_on_what_was_left_out_are_not_written():
    assert tuned(0.8).settings == {"odometry.rotation_density": 0.05}
    assert tuned(1.2).settings == {}


def test_without_a_recording_to_spare_nothing_is_proved():
    assert _proof(None, {}, [], None) == ("none", [])
