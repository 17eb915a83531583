"""Settings, recordings and the folder of a fleet."""

import shlex

import pytest
import yaml
from places import ROOT

pytest.importorskip("distributed", reason="the extra fleet is not installed")

from graph_slam_ros.cli.parser import parser
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.compare import EXCEEDED, GAINED, LOST, ONLY_NEW, compare, markdown, parse_limit
from graph_slam_ros.tools.fleet.page import write_page
from graph_slam_ros.tools.fleet.recordings import find_sources, local_copy
from graph_slam_ros.tools.fleet.replay import settings_of, truth_of
from graph_slam_ros.tools.fleet.store import job_key, write_table


def test_settings_are_the_product_of_files_and_values(tmp_path):
    (tmp_path / "a.yaml").write_text("keyframes:\n  min_distance_m: 0.3\n")
    (tmp_path / "b.yaml").write_text("keyframes:\n  min_distance_m: 0.4\n")
    choices = ["robust.noise_scale=configured,estimated"]
    found = settings_of([tmp_path / "a.yaml", tmp_path / "b.yaml"], choices)
    assert list(found) == [
        f"{file} robust.noise_scale={scale}" for file in "ab" for scale in ("configured", "estimated")
    ]
    assert found["b robust.noise_scale=estimated"]["keyframes.min_distance_m"] == 0.4
    assert list(settings_of([], [])) == ["defaults"]


def test_the_name_of_a_job_depends_on_all_that_its_result_depends_on(tmp_path):
    truth = tmp_path / "truth.tum"
    truth.write_text("0 0 0 0 0 0 0 1\n")
    told = ("f", 1, ""), ("g", 1, ""), ("f", 2, ""), ("f", 1, str(truth)), ("f", 1, f"{truth}:/topic")
    assert len({job_key(name, {"a": value}, of) for name, value, of in told}) == 5


def test_recordings_are_found_in_folders_and_stores_the_largest_first(tmp_path):
    import fsspec

    (tmp_path / "split").mkdir()
    for name, size in (("a.mcap", 10), ("split/metadata.yaml", 5), ("split/x_0.mcap", 20), ("notes.txt", 99)):
        (tmp_path / name).write_bytes(b"x" * size)
    memory = fsspec.filesystem("memory")
    memory.pipe("/drives/b.mcap", b"x" * 15)
    found = find_sources([str(tmp_path), "memory://drives"])
    assert [(one.name, one.size) for one in found] == [("split", 25), ("b.mcap", 15), ("a.mcap", 10)]
    copy = local_copy(found[1].url, tmp_path)
    assert copy.read_bytes() == memory.cat("/drives/b.mcap")
    before = found[2].identity
    (tmp_path / "a.mcap").write_bytes(b"y" * 10)
    assert find_sources([str(tmp_path / "a.mcap")])[0].identity != before
    assert truth_of("{folder}/truth/{stem}.tum", found[2]) == f"{tmp_path}/truth/a.tum"
    with pytest.raises(GraphSlamError, match=r"knows \{path\}"):
        truth_of("{name}.tum", found[0])
    memory.rm("/drives", recursive=True)


def test_what_has_no_recording_is_named_and_equal_names_are_told_apart_by_their_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    for where in (f"{tmp_path}/nothing", f"{tmp_path}/empty", "unknown://x"):
        with pytest.raises(GraphSlamError, match=where):
            find_sources([where])
    for folder in ("mon", "tue"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "drive.mcap").write_bytes(b"x")
    assert {one.name for one in find_sources([str(tmp_path)])} == {"mon/drive.mcap", "tue/drive.mcap"}


def rows(factor=1.0, failed=(), count=8):
    out = []
    for k in range(count):
        row = {"key": f"{k}", "recording": f"r{k}", "setting": "defaults", "state": "done", "reason": ""}
        row |= {"rmse_m": (0.1 + 0.01 * k) * factor * (1.0 + 0.01 * (-1) ** k), "cpu_s": 1.0 + k}
        if k in failed:
            row = {**row, "state": "failed", "reason": "gone", "rmse_m": None}
        out.append(row)
    return out


def tables(folder, old, new):
    for name, content in (("old", old), ("new", new)):
        (folder / name).mkdir()
        write_table(folder / name, content)
    return folder / "old", folder / "new"


def test_a_regression_exceeds_its_limit_and_chance_does_not(tmp_path):
    limits = [parse_limit("rmse>1.02x"), parse_limit("cpu>1.5x"), parse_limit("rmse_m>0.2")]
    worse = compare(*tables(tmp_path, rows(), rows(1.1)), limits)
    assert [line.split(":")[0] for line in worse.notes[EXCEEDED]] == ["rmse>1.02x"]
    change = {one.metric: one for one in worse.changes}["rmse_m"]
    assert change.ratio == pytest.approx(1.1)
    assert change.verdict == "worse"
    by_chance = rows()
    for k, row in enumerate(by_chance):
        row["rmse_m"] *= 1.5 if k == 0 else 0.98 if k % 2 else 1.02
    (tmp_path / "b").mkdir()
    same = compare(*tables(tmp_path / "b", rows(), by_chance), limits)
    change = {one.metric: one for one in same.changes}["rmse_m"]
    assert change.ratio > 1.02
    assert change.interval[0] < 1.0
    assert change.verdict == "same"
    assert not same.notes[EXCEEDED]
    assert change.worst == ("r0", pytest.approx(1.5))


def test_a_recording_that_fails_now_is_named_whatever_the_limits(tmp_path):
    done = compare(*tables(tmp_path, rows(failed=(2,)), rows(failed=(5,), count=9)))
    assert done.notes[LOST] == ["r5: gone"]
    assert done.notes[GAINED] == ["r2"]
    assert done.notes[ONLY_NEW] == ["r8"]
    assert "**Failed now, and not before**" in markdown(done)


def test_a_limit_that_is_none_or_on_what_nobody_measured_is_refused(tmp_path):
    for text in ("rmse", "rmse<1", "rmse>x", "rmse>1.0y"):
        with pytest.raises(GraphSlamError, match="is not METRIC>NUMBER"):
            parse_limit(text)
    with pytest.raises(GraphSlamError, match="no recording has nees"):
        compare(*tables(tmp_path, rows(), rows()), [parse_limit("nees>1.1x")])


def test_hostile_names_are_text_on_the_page(tmp_path):
    hostile = rows(count=2)
    hostile[0] |= {"recording": "<script>alert(1)</script>|`x`", "state": "failed", "reason": "<b>'\"</b>"}
    page = write_page(tmp_path, hostile).read_text()
    assert "<script>" not in page
    assert "<b>" not in page
    assert page.index("&lt;script&gt;") < page.index("r1<"), "failed ones are first"


def test_the_example_of_a_workflow_has_commands_that_are_there():
    example = yaml.safe_load((ROOT / "docs/examples/fleet.yml").read_text())
    (job,) = example["jobs"].values()
    lines = [step["run"] for step in job["steps"] if step.get("run", "").startswith("graph_slam ")]
    commands = [parser().parse_args(shlex.split(line.partition("||")[0].partition(" > ")[0])[1:]) for line in lines]
    replayed, compared = commands
    assert replayed.truth == "{path}:/ground_truth"
    assert compared.new == replayed.out
    assert [parse_limit(text).metric for text in compared.fail] == ["rmse_m", "cpu_s"]
