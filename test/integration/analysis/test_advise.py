"""``advise``: the sigma that it predicts is the one that comes out, and what it says of a run is so."""

import json

import numpy as np
import pytest
from advised import SimulatedRun
from reliability import tell, times

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import freeze, map_of
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.advise.advice import CLOSURE, KINDS, NEW, Advisor, stored_values
from graph_slam_ros.tools.advise.weakness import Weakness

S = 1_000_000_000
NOISY = {"sigma_speed_m_s": 0.2, "sigma_turn_rad_s": 0.2}
WORLDS = [
    ("manhattan", {"poses": 40, "blocks": 2} | NOISY),
    ("warehouse", {"aisles": 2, "aisle_m": 5.0}),
    ("flight", {"laps": 1, "length_m": 12.0, "width_m": 12.0}),
]
MORE = [
    ("manhattan", {"poses": 60, "blocks": 3, "sensor": "range_bearing"} | NOISY),
    ("manhattan", {"poses": 60, "blocks": 3, "sensor": "bearing"}),
    ("manhattan", {"poses": 60, "blocks": 3, "sensor": "range"}),
    ("warehouse", {"aisles": 3, "sensor": "range_bearing"}),
    ("flight", {"laps": 2, "sensor": "bearing"}),
    ("flight", {"laps": 1, "sensor": "position", "beacons": 10}),
]


def test_the_predicted_sigma_is_within_a_fifth_of_what_comes_out_in_95_of_100(tmp_path):
    """The measurement is made truly, with its noise, and everything is solved again."""
    ratios, kinds = [], set()
    for seed in range(times(1, 6)):
        for k, (world, options) in enumerate(times(WORLDS, WORLDS + MORE)):
            simulated = SimulatedRun(tmp_path / f"{seed}_{k}", world, seed, **options)
            for kind, _, _, predicted, real in simulated.comparisons(np.random.default_rng(seed), times(1, 2)):
                ratios.append(predicted / real)
                kinds.add(kind)
    off = np.maximum(ratios, 1.0 / np.array(ratios)) - 1.0
    tell("advise", predictions=len(off), within=int((off < 0.2).sum()), worst={"off by": round(float(off.max()), 3)})
    assert kinds == set(KINDS)
    assert len(off) > 20
    assert (off < 0.2).mean() >= 0.95


def corridor(folder, landmarks=True, length_m=60.0, start=None):
    """A robot drives east; landmarks stand at the beginning and at the end, none for 40 m between."""
    config = Config.from_mapping({"map.localize": start is not None})
    recorder = RunRecorder(folder, config, start=start)
    slam = GraphSlam(config, sink=recorder.sink, start=start)
    spots = {"start": (4.0, 2.0), "near": (8.0, -2.0), "late": (52.0, 2.0), "end": (58.0, -2.0)}
    for k in range(int(10 * length_m) + 1):
        x = 0.1 * k
        slam.process(Odometry((100 + k) * S // 10, (x, 0.0, 0.0), source="odom"))
        if landmarks and k % 5 == 0:
            seen = [
                Sighting(name, "position", (spot[0] - x, spot[1]), (0.01, 0.0, 0.0, 0.01))
                for name, spot in spots.items()
                if np.hypot(spot[0] - x, spot[1]) < 5.0 and spot[0] > x
            ]
            if seen:
                slam.process(Sightings((100 + k) * S // 10, "tags", tuple(seen)))
    slam.process(Control("end"))
    recorder.record(slam, slam.process(Control("optimize")))
    recorder.save(slam)
    recorder.close()
    return slam


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corridor") / "run"
    corridor(folder)
    return folder


def test_a_way_without_landmarks_is_named_with_its_length_and_stamps(straight, told):
    weakness = Weakness(SavedGraph(straight, []))
    unseen = weakness.longest_unseen()
    assert 38.0 < unseen.length_m < 42.0
    assert unseen.begins_m == pytest.approx(7.5, abs=1.0)
    assert unseen.stamps_ns[0] == pytest.approx(10 * S + unseen.begins_m * S, abs=S)
    code, out, err = told("advise", straight)
    assert (code, err) == (0, "")
    (line,) = [one for one in out.splitlines() if one.startswith("  no landmark seen for")]
    first, last = unseen.keyframes
    assert f"no landmark seen for {unseen.length_m:.1f} m (keyframes {first} to {last}, " in line
    assert "the anchor at the first keyframe" in out
    assert out.splitlines()[-1].startswith("next: ")


def test_a_survey_of_what_is_weakest_helps_it_most_and_leaves_what_was_surveyed(straight, told):
    code, out, _ = told("advise", straight, "--json", "--survey-sigma", "0.05", "--count", "3")
    assert code == 0
    told_of = json.loads(out)
    landmark = next(one for one in told_of["weakest"] if one["what"] == "landmark")
    assert landmark["advice"][0]["kind"] == "survey"
    assert landmark["advice"][0]["about"].startswith("survey landmark end")
    assert landmark["advice"][0]["predicted"] == pytest.approx(0.05, rel=0.01)
    best = told_of["best_for_path"]
    assert best["path_m"] <= min(advice["path_m"] for one in told_of["weakest"] for advice in one["advice"])
    for one in told_of["weakest"]:
        predicted = [advice["predicted"] for advice in one["advice"]]
        assert predicted == sorted(predicted)
        assert all(sigma < one["sigma"] for sigma in predicted)
        assert all(advice["path_m"] <= advice["path_now_m"] for advice in one["advice"])


def test_a_prediction_is_that_of_the_whole_inverse(straight):
    """Each kind's best, a new tag with its vertex among the others."""
    run = SavedGraph(straight, [])
    advisor, graph = Advisor(Weakness(run)), run.graph
    dofs = [graph.kind_of(v).dof for v in range(graph.vertex_count)]
    first, before = np.cumsum([0, *dofs]), run.solver.information_matrix()
    for kind in KINDS:
        addition = min(advisor.additions([kind]), key=lambda one: advisor.predict(one)[0].sum(), default=None)
        if addition is None:
            assert kind == CLOSURE, "it drives straight on"
            continue
        information = np.zeros((len(before) + len(addition.value),) * 2)
        information[: len(before), : len(before)] = before
        for edge in addition.edges:
            x, at = stored_values(graph, run.solver.values, edge, addition.value)
            a = edge.share**0.5 * edge.noise.sqrt_information @ edge.type.linearize(x, at, edge.measured[None])[1][0]
            begins = [len(before) if v == NEW else int(first[v]) for v in edge.vertices]
            columns = [b + k for b, dof in zip(begins, edge.type.dofs, strict=True) for k in range(dof)]
            information[np.ix_(columns, columns)] += a.T @ a
        covariance = np.linalg.inv(information)
        predicted, _ = advisor.predict(addition)
        assert predicted[0] < advisor.weakest[0].direction.sigma
        for one, sigma in zip(advisor.weakest, predicted, strict=True):
            at = slice(first[one.vertex], first[one.vertex] + dofs[one.vertex])
            real = float(np.sqrt(one.functional @ covariance[at, at] @ one.functional))
            assert sigma == pytest.approx(real, rel=1e-6), kind


def test_a_run_without_landmarks_or_of_one_keyframe_says_so(tmp_path, told):
    corridor(tmp_path / "run", landmarks=False, length_m=5.0)
    code, out, err = told("advise", tmp_path / "run")
    assert (code, err) == (0, "")
    assert "0 landmarks" in out
    assert "nothing that was tried helps by 2 % or more: the run has no landmark" in out
    assert "no landmark seen; sigma up to" in out
    corridor(tmp_path / "one", landmarks=False, length_m=0.0)
    code, out, err = told("advise", tmp_path / "one")
    assert (code, err) == (0, "")
    assert "1 keyframes, 0 landmarks" in out and "weak stretches: none" in out


def test_of_a_drive_in_a_frozen_map_the_drive_is_advised_on(straight, tmp_path, told):
    freeze(straight, tmp_path / "site")
    code, out, err = told("advise", tmp_path / "site")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "all keyframes are of a frozen map" in err, "nothing of it alone is estimated"
    corridor(tmp_path / "run", start=map_of(tmp_path / "site", []))
    run = SavedGraph(tmp_path / "run", [])
    weakest = [*Weakness(run).weakest()]
    assert [one.what for one in weakest] == ["position", "heading"], "the landmarks are held"
    assert all(one.vertex not in run.held for one in weakest)
    assert len(run.held) > 0
    code, out, err = told("advise", tmp_path / "run")
    assert (code, err) == (0, "")
    assert "a frozen map" in out.splitlines()[0] and "survey landmark" not in out
    assert Weakness(run).longest_unseen().keyframes[0] >= len(SavedGraph(straight, []).keyframes)


def test_what_cannot_be_advised_on_is_refused_in_one_line(straight, tmp_path, told):
    (bag := tmp_path / "drive.mcap").touch()
    for words, why in (
        ([tmp_path], "not a run: no config.yaml in it"),
        ([bag], "not a run: no config.yaml in it; graph_slam replay"),
        ([straight, "--survey-sigma", "1e-200"], "is not positive definite"),
    ):
        code, out, err = told("advise", *words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert why in err
    for words in (["--survey-sigma", "0"], ["--count", "0"]):
        assert told("advise", straight, *words)[0] == 2
