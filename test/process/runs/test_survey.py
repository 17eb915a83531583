"""Surveyed landmarks and a start pose: the run lies in the frame of the floor plan, not where odometry began."""

import json

import numpy as np
import pytest
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.config.config import with_survey
from graph_slam_ros.errors import ConfigError, FormatError, GraphSlamError
from graph_slam_ros.graph import POINT_PRIOR, R2, R3
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.folder import run_config
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import measurements, simulate, write_bag

END = (Control("end"), Control("optimize"))
T_PLAN_WORLD = (12.0, -5.0, 2.0)
SIGMA_M = 0.02
SMALL = {"aisles": 2, "laps": 1, "aisle_m": 6.0}


def table(rows, header="id,x,y,sigma"):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


def plan_of(recording, names=None):
    """The survey of a world's landmarks, in the frame of the floor plan."""
    names = names or list(recording.landmarks)
    return table([(name, *se2.act(T_PLAN_WORLD, recording.landmarks[name][:2]), SIGMA_M) for name in names])


def driven(recording, **settings):
    slam = GraphSlam(Config.from_mapping({key.replace("__", "."): value for key, value in settings.items()}))
    for m in (*measurements(recording), *END):
        slam.process(m)
    return slam


def errors(view, recording):
    """Of position [m] and heading [rad] of every keyframe, in the floor plan's frame: nothing is aligned."""
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns)
    truth = np.stack(se2.compose(T_PLAN_WORLD, tuple(recording.T_world_base[at].T)), axis=-1)
    off = view.trajectory() - truth
    return np.hypot(off[:, 0], off[:, 1]), np.abs(se2.wrap(off[:, 2]))


def start_of(recording, error=(0.0, 0.0, 0.0)):
    at = se2.compose(T_PLAN_WORLD, tuple(recording.T_world_base[0].tolist()))
    return " ".join(str(a + e) for a, e in zip(at, error, strict=True))


@each("sensor", ["position", "bearing", "range"])
def test_a_warehouse_lies_on_its_floor_plan_whatever_is_seen_of_the_surveyed_tags(sensor):
    recording = simulate("warehouse", 4, **SMALL, sensor=sensor)
    rough = start_of(recording, (0.3, -0.2, 0.1))
    text = plan_of(recording)
    slam = driven(recording, landmarks__surveyed=text, anchor__pose=rough, anchor__sigma_m=0.5, anchor__sigma_rad=0.3)
    metres, radians = errors(slam.view, recording)
    assert metres[0] < 0.1
    assert metres.max() < 0.2
    assert radians.max() < (0.1 if sensor == "range" else 0.04), "a range says nothing of the heading"
    assert slam.view.report.classes["surveyed"].edges == len(slam.view.landmarks) > 5
    assert not slam.view.waiting


@pytest.mark.parametrize(
    ("sensor", "anchor"), [("position", {"anchor__sigma_m": 1e3, "anchor__sigma_rad": 3.0}), ("range_bearing", {})]
)
def test_without_a_start_pose_the_map_turns_into_the_plan_by_what_is_seen(sensor, anchor):
    recording = simulate("warehouse", 4, **SMALL, sensor=sensor)
    slam = driven(recording, landmarks__surveyed=plan_of(recording), **anchor)
    assert slam.view.ledger.outside_count == 0, "true sightings are not refused"
    metres, radians = errors(slam.view, recording)
    assert metres.max() < 0.15
    assert radians.max() < 0.03


def pipeline(**settings):
    base = {"ordering.window_s": 0.0, "landmarks.added_sigma_m": 0.0}
    return GraphSlam(Config.from_mapping(base | {key.replace("__", "."): value for key, value in settings.items()}))


def test_a_surveyed_point_has_a_prior_of_its_own_from_when_it_is_first_seen():
    held = {"anchor__sigma_m": 1e-3, "anchor__sigma_rad": 1e-3}
    slam = pipeline(landmarks__surveyed=table([("a", 2, 1, 0.5), ("never seen", 9, 9, 0.5)]), **held)
    slam.process(Odometry(0, se2.IDENTITY))
    assert POINT_PRIOR[R2] not in slam.view.graph.tables
    for topic in ("tags", "more tags"):
        slam.process(Sightings(0, topic, (Sighting("a", "position", (2.2, 1.0), (0.25, 0, 0, 0.25)),)))
    priors = slam.view.graph.tables[POINT_PRIOR[R2]]
    assert priors.measured.values.tolist() == [[2.0, 1.0]]
    assert priors.sqrt_information.values[0] == pytest.approx(2.0 * np.eye(2))
    slam.process(Control("optimize"))
    assert list(slam.view.landmarks) == ["a"]
    summary = summarize(slam)
    assert summary["survey_unseen"] == ["never seen"]
    assert "because it was not seen, or too little: never seen" in " ".join("\n".join(outcome.text(summary)).split())
    # two sightings at 2.2 and the survey at 2.0, all alike
    (place,) = slam.view.solver.estimate([slam.view.landmarks["a"].vertex])
    assert place == pytest.approx([2.0 + 0.4 / 3, 1.0], abs=1e-3)


def test_in_space_start_pose_and_survey_have_all_their_axes():
    slam = pipeline(
        world__dimensions=3, anchor__pose="1 2 3 0.1 0.2 0.3", landmarks__surveyed=table([("a", 4, 5, 6, 1)], SPACE)
    )
    slam.process(Odometry(0, se3.IDENTITY))
    q = so3.compose(so3.compose(so3.exp((0, 0, 0.3)), so3.exp((0, 0.2, 0))), so3.exp((0.1, 0, 0)))
    assert slam.view.trajectory()[0] == pytest.approx([1, 2, 3, *q])
    slam.process(Sightings(0, "tags", (Sighting("a", "position", (1, 0, 0), tuple(np.eye(3).ravel())),)))
    assert slam.view.graph.tables[POINT_PRIOR[R3]].measured.values.tolist() == [[4.0, 5.0, 6.0]]
    flat = pipeline(world__dimensions=3, anchor__pose="1 2 0.3")
    flat.process(Odometry(0, se3.IDENTITY))
    assert flat.view.trajectory()[0] == pytest.approx([1, 2, 0, *so3.exp((0, 0, 0.3))])


SPACE = "id,x,y,z,sigma"


def test_a_file_is_read_at_the_border_and_named_where_it_is_wrong(tmp_path):
    file = tmp_path / "plan.csv"
    config = Config.from_mapping({"landmarks.surveyed_file": str(file)})
    with pytest.raises(FormatError, match="no such file"):
        with_survey(config)
    with pytest.raises(ConfigError, match="has not been read"):
        GraphSlam(config)
    file.write_text("\ufeff" + table([("a", 1, 2, 0.1)]), encoding="utf-8")
    assert with_survey(config).survey["a"].position == (1.0, 2.0)
    with pytest.raises(ConfigError, match=r"anchor\.pose: '1 2' is not 3 numbers"):
        Config.from_mapping({"anchor.pose": "1 2"})
    for text, said in ((table([("a", 1, 2, -1)]), "line 2: sigma -1 is not above 0"), ("", "no landmark in it")):
        file.write_text(text)
        with pytest.raises(ConfigError) as told:
            with_survey(config)
        assert str(told.value).startswith(f"{file}: {said}")


def test_a_run_keeps_the_survey_it_was_made_with_and_repeats_without_the_file(tmp_path, capsys):
    recording = simulate("warehouse", 4, **SMALL)
    bag, plan = tmp_path / "drive.mcap", tmp_path / "plan.csv"
    write_bag(recording, bag)
    plan.write_text(plan_of(recording))
    words = [f"landmarks.surveyed_file={plan}", f"anchor.pose={start_of(recording)}", "anchor.sigma_m=0.5"]
    given = [word for one in words for word in ("--set", one)]
    assert main(["replay", str(bag), "--out", str(tmp_path / "run"), *given]) == 0
    plan.unlink()
    assert run_config(tmp_path / "run").landmarks.surveyed == plan_of(recording)
    again = replay(tmp_path / "run", tmp_path / "again")
    assert again.summary["classes"]["surveyed"]["edges"] == len(again.slam.view.landmarks)
    for name in ("graph.g2o", "path.tum", "landmarks.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    assert json.loads((tmp_path / "run" / "run.json").read_text())["landmarks"] == len(again.slam.view.landmarks)
    capsys.readouterr()
    assert main(["optimize", str(tmp_path / "run" / "graph.g2o"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["chi2_initial"] == pytest.approx(again.summary["chi2"], rel=1e-6)
    with pytest.raises(GraphSlamError, match=f"{plan}: no such file"):
        replay(bag, tmp_path / "none", Config.from_mapping({"landmarks.surveyed_file": str(plan)}))
    assert not (tmp_path / "none" / "run.json").exists()
