"""The contents of a report: the sentences are those of ``explain``, the columns come back as they were."""

import base64
import io
import shutil
import zlib

import numpy as np
import pytest
from faulty import faulty_run
from pages import drive
from PIL import Image

from graph_slam_ros import cli
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.runs.folder import BEGUN
from graph_slam_ros.tools.report import page, places, verdict
from graph_slam_ros.tools.report.contents import read_contents
from graph_slam_ros.tools.report.packing import UNKNOWN


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))[1]


@pytest.fixture(scope="module")
def saved(run):
    return SavedGraph(run, [])


@pytest.fixture(scope="module")
def made(run):
    return read_contents(run)


def unpacked(packing, one):
    """A column as the page reads it."""
    block = zlib.decompress(base64.b64decode(packing.block()))
    part = block[one["at"] : one["at"] + one["bytes"]]
    if one["packed"] == "s":
        return part.decode().split("\0") if one["count"] else []
    dtype = np.dtype({"f4": "<f4", "f8": "<f8", "i4": "<i4", "u1": "u1"}[one["packed"]])
    values = np.frombuffer(part, np.uint8).reshape(dtype.itemsize, -1).T.copy().view(dtype).ravel()
    if one["step"] == 1.0:
        return values
    values = np.cumsum(values, dtype=float) if one.get("sum") else np.where(values == UNKNOWN, np.nan, values)
    return values * one["step"]


def test_the_sentences_on_top_say_what_is_out_and_what_to_do(made, run, saved):
    state, *_, size, judged = made.data["sentences"]
    out = [e for e in SavedGraph(run, []).entries if not e.is_in]
    assert state.startswith("Do not rely on this map yet: ") or state.startswith("Use this map with care: ")
    jumped = verdict.verdict(run, {}, saved, None, [], (7, 0.8))
    assert "map -> odom jumped by up to 0.80 m, at keyframe 7." in jumped
    assert "keyframes" in size and judged.startswith(f"{len(out)} of ")
    tables = made.data["tables"]
    assert tables["input_columns"][:2] == ["messages received", "measurements used"]
    assert all(len(row) == len(tables["input_columns"]) + 4 for row in tables["inputs"])


def test_a_run_of_odometry_alone_has_a_report(tmp_path, told):
    bag, run = tmp_path / "drive.mcap", tmp_path / "run"
    assert cli.main(["simulate", "manhattan", "--out", str(bag), "--poses", "60", "--set", "landmarks=false"]) == 0
    assert cli.main(["replay", str(bag), "--out", str(run), "--set", "inputs.names=odom"]) == 3
    assert "NaN" not in (run / "run.json").read_text()
    code, out, _ = told("report", run)
    assert code == 0
    assert out.startswith("Do not rely on this map yet: this is odometry alone")
    assert "graph_slam check" in out.partition("\n")[0], "the verdict has its reason, and what to do"
    assert (run / "report.html").stat().st_size > 10_000
    page = run / "report.html"
    made = page.read_bytes()
    for there, code in ((made, 0), (made.replace(b"odometry", b"0dometry", 1), 2), (b"mine", 2)):
        page.write_bytes(there)
        assert cli.main(["report", str(run)]) == code, "an own page is replaced, one that somebody has changed is not"
        assert code == 0 or page.read_bytes() == there
    (tmp_path / "other.html").write_bytes(made)
    assert cli.main(["report", str(run), "--out", str(tmp_path / "other.html")]) == 2, "of a run at another place"


def test_nees_is_that_of_evaluate(run):
    truth = run.parent / "drive.mcap"
    made = read_contents(run, str(truth))
    at, values = (unpacked(made.packing, one) for one in made.data["nees"]["values"])
    expected = evaluate(run, truth).consistency.poses
    assert (len(values), float(np.mean(values))) == (expected.n, pytest.approx(expected.mean, rel=1e-5))
    low, high = made.data["nees"]["band"]
    assert np.mean((values >= low) & (values <= high)) == pytest.approx(expected.inside)
    assert at.min() >= 1
    assert made.data["scores"] == str(evaluate(run, truth)).splitlines()


def test_a_floor_plan_lies_where_its_file_says_and_is_drawn_upright(tmp_path):
    """A quarter turn about the lower left corner: it goes up and to the left from there, its first column below."""
    pixels = np.full((20, 40), 255, np.uint8)
    pixels[:, 0] = 0
    Image.fromarray(pixels).save(tmp_path / "hall.png")
    for turn, expected, size in ((0.0, [-3.0, 2.0, 20.0, 10.0], (40, 20)), (np.pi / 2, [-13.0, 2.0, 10.0, 20.0], None)):
        (tmp_path / "map.yaml").write_text(f"image: hall.png\nresolution: 0.5\norigin: [-3.0, 2.0, {turn}]\n")
        plan = places.floor_plan(tmp_path / "map.yaml")
        picture = Image.open(io.BytesIO(base64.b64decode(plan["url"].partition(",")[2])))
        assert [plan[k] for k in ("x", "y", "width", "height")] == pytest.approx(expected, abs=0.6 if turn else 0.0)
        assert size is None or picture.size == size
    drawn = np.array(picture.convert("LA"))
    dark = np.argwhere((drawn[..., 0] < 100) & (drawn[..., 1] > 200))
    assert len(dark) >= 15 and dark[:, 0].min() >= picture.height - 3


def test_what_is_of_another_place_or_drive_is_doubted(run, tmp_path):
    """A plan of elsewhere, a run that shares no landmark, a truth of another drive: no other advice is given."""
    Image.new("L", (40, 20), 255).save(tmp_path / "hall.png")
    (tmp_path / "map.yaml").write_text("image: hall.png\nresolution: 0.5\norigin: [500.0, 2.0, 0.0]\n")
    other = drive(tmp_path / "other", ["elsewhere", "nowhere"])
    rng, stamps = np.random.default_rng(1), np.loadtxt(run / "path.tum")[:, 0]
    wrong = np.column_stack([stamps, *rng.normal(scale=30.0, size=(2, len(stamps))), *[0 * stamps] * 4, 1 + 0 * stamps])
    np.savetxt(tmp_path / "wrong.tum", wrong, fmt="%.9f")
    found = read_contents(run, str(tmp_path / "wrong.tum"), other, tmp_path / "map.yaml")
    plan, truth, compared = found.data["beware"]
    assert "443 of 443 keyframes are outside of the floor plan" in plan
    assert "no landmark is in both maps" in compared
    assert "check that the truth is of this robot and this drive" in truth
    said = " ".join(found.data["sentences"])
    assert "check that the truth" in said
    assert "covariances are too small" not in said


def test_a_run_that_is_still_written_shows_its_map_so_far(run, tmp_path):
    live = drive(tmp_path / "live", ["a", "b"])
    before = read_contents(live)
    (live / "run.json").write_bytes(BEGUN)
    for file in live.iterdir():
        if file.suffix in (".csv", ".tum", ".g2o"):
            file.unlink()
    made = read_contents(live)
    (live / "run.json").write_text('{"ended": true, "is_incomplete": true}')
    assert "ended before its last results were written" in read_contents(live).data["sentences"][0]
    assert "still being written" in made.data["sentences"][0]
    assert "20 keyframes and 2 landmarks" in " ".join(made.data["sentences"])
    for name in ("odometry", "estimate"):
        columns = [[unpacked(one.packing, of) for of in one.data["map"]["paths"][name]] for one in (before, made)]
        np.testing.assert_allclose(columns[1], columns[0], atol=2e-3)
    names, points = (made.data["map"]["landmarks"][key] for key in ("names", "points"))
    assert sorted(unpacked(made.packing, names)) == ["a", "b"]
    assert np.isfinite([unpacked(made.packing, column) for column in points]).all()


def test_a_damaged_run_shows_what_can_be_read_and_says_what_cannot(run, tmp_path, told):
    broken = shutil.copytree(run, tmp_path / "broken")
    (broken / "landmarks.csv").write_text("nonsense\n1\n")
    (broken / "map.mcap").write_bytes((broken / "map.mcap").read_bytes()[:-2000])
    code, out, err = told("report", broken, "--out", tmp_path / "broken.html")
    assert (code, "lost: " in err) == (3, True)
    assert "a part of the run is lost: " in out.partition("\n")[0]


def test_what_cannot_be_a_report_is_refused(run, tmp_path, told):
    html = tmp_path / "a.html"
    for words, why in (
        ((tmp_path / "none",), "there is nothing of that name"),
        ((run / "map.mcap",), "but a file: graph_slam replay"),
        ((run.parent,), f"in it there are runs: {run}"),
        ((run, "--out", tmp_path / "a.txt"), "a report is a .html file"),
        ((run, "--out", html, "--topic", "/x"), "no use for --topic"),
        ((run, "--out", html, "--truth", tmp_path / "none"), "none"),
        ((run, "--out", html, "--plan", run / "config.yaml"), "not a map.yaml"),
    ):
        code, out, err = told("report", *words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert why in err
    assert not html.exists()


def test_without_plotly_the_command_that_installs_it_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setattr(page.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(GraphSlamError, match=r"pip install 'graph_slam_ros\[report\]'"):
        page.plotly()
