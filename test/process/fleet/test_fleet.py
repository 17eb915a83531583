"""A fleet on real workers: processes of this machine, and those of a scheduler over TCP, with faults."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra fleet is not installed")

import fleet_nodes
from distributed import Client
from fleet_nodes import contents, scheduler, wait_for

from graph_slam_ros import cli
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet import engine
from graph_slam_ros.tools.fleet.engine import Workers, connected, run_jobs
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.replay import Fleet, replay_all


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Bytes of the results of each of three recordings, replayed one by one; a fourth one is damaged."""
    folder = tmp_path_factory.mktemp("fleet") / "drives"
    folder.mkdir()
    return folder, fleet_nodes.drives(folder, 3, b"\x89MCAP0\r\n" + bytes(100))


@pytest.fixture(scope="module")
def drives(serial):
    return serial[0]


def equal_to_serial(out, rows, serial):
    for row in rows:
        if row["state"] == "done":
            assert contents(out / "jobs" / row["key"] / "run") == serial[1][row["recording"]], row
    return sum(row["state"] == "done" for row in rows)


def here(capsys, *arguments):
    """Run the command in this process: exit code, and both outputs."""
    capsys.readouterr()
    code = cli.main(["fleet", *map(str, arguments)])
    return code, *capsys.readouterr()


def fleet(*arguments):
    command = [sys.executable, "-m", "graph_slam_ros.cli", "fleet", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_one_command_replays_all_and_the_second_time_nothing(drives, serial, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--out", out, "--truth", "{path}", "--workers", 2)
    done = fleet("replay", drives, *options)
    assert done.returncode == 3, done
    assert "failed: damaged0.mcap (defaults):" in done.stderr
    assert "Traceback" not in done.stderr
    rows = [json.loads(file.read_text()) for file in out.glob("jobs/*/row.json")]
    assert equal_to_serial(out, rows, serial) == 3
    for row in rows:
        if row["state"] == "done":
            assert 0.0 < row["rmse_m"] < 0.3
            assert row["nees"] > 0.0
            assert row["cpu_s"] > 0.0
            assert len(row["errors_m"]) == 40
    stamps = {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")}
    again = fleet("replay", drives, *options, "--report")
    page = (out / "index.html").read_text()
    assert all(f"jobs/{row['key']}/report.html" in page for row in rows if row["state"] == "done")
    assert len(list(out.glob("jobs/*/report.html"))) == 3
    assert "of them 4 were there" in again.stdout
    assert {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")} == stamps
    _, shown, said = here(capsys, "table", out, "--where", "state = 'done'", "--order", "rmse_m DESC")
    assert shown.count(".mcap") == 3
    assert not said
    assert here(capsys, "compare", out, out, "--fail", "rmse>1.02x")[0] == 0


def test_a_job_takes_the_inputs_that_info_suggests_where_no_topic_is_usual(tmp_path):
    """As ``replay`` does: without them it would be odometry alone."""
    drive, run, out = tmp_path / "drive.mcap", tmp_path / "run", tmp_path / "out"
    world = ("--set", "aisles=2", "--set", "laps=1", "--set", "aisle_m=4.0", "--set", "sensor=range_bearing")
    assert cli.main(["simulate", "warehouse", *world, "--out", str(drive)]) == 0
    assert cli.main(["replay", str(drive), "--out", str(run)]) == 0
    (row,) = replay_all(Fleet([str(drive)], out), Workers(count=1)).rows
    assert (row["state"], row["reason"]) == ("done", "")
    assert row["inputs"] == "odom ranges"
    assert contents(out / "jobs" / row["key"] / "run") == contents(run)


def test_over_tcp_a_worker_that_is_killed_changes_nothing(drives, serial, tmp_path):
    out = tmp_path / "out"
    with scheduler(tmp_path, 2) as address:
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            pids = client.run(os.getpid)
        victim = next(iter(pids.values()))

        def kill_at_work():
            wait_for(lambda: list(out.glob("attempts/*.1")))
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_at_work)
        killer.start()
        done = replay_all(Fleet([str(drives)], out), Workers(address))
        killer.join()
    assert equal_to_serial(out, done.rows, serial) == 3
    assert [row["recording"] for row in done.rows if row["state"] == "failed"] == ["damaged0.mcap"]
    assert all(row["attempts"] <= 3 for row in done.rows)


def test_a_job_beyond_its_limits_is_a_row_and_the_others_are_done(drives, tmp_path):
    one = str(drives / "1.mcap")
    slow = replay_all(Fleet([one], tmp_path / "slow", limit_s=0.05), Workers(count=1))
    assert [row["state"] for row in slow.rows] == ["failed"]
    assert "limit of time" in slow.rows[0]["reason"]
    large = replay_all(Fleet([one], tmp_path / "large", memory=2**20), Workers(count=1))
    assert "out of memory: more than 1 MiB (--memory)" in large.rows[0]["reason"]
    again = replay_all(Fleet([one], tmp_path / "slow", limit_s=60.0), Workers(count=1))
    assert [row["state"] for row in again.rows] == ["done"], "a machine that failed is not the end of it"


def test_without_its_truth_a_run_is_kept_and_says_so(drives, tmp_path):
    truth = "{folder}/{stem}.tum"
    done = replay_all(Fleet([str(drives / "1.mcap")], tmp_path / "out", truth=truth), Workers(count=1))
    (row,) = done.rows
    assert row["state"] == "incomplete"
    assert "not compared with the truth" in row["reason"]
    assert "1.tum" in row["reason"]
    assert (tmp_path / "out/jobs" / row["key"] / "run/path.tum").is_file()


def test_stopped_by_a_signal_it_goes_on_where_it_was(drives, serial, tmp_path):
    out = tmp_path / "out"
    options = ["replay", str(drives), "--out", str(out), "--workers", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "graph_slam_ros.cli", "fleet", *options], stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: list(out.glob("jobs/*/row.json")))
    with pytest.raises(GraphSlamError, match="another fleet writes into it"):
        replay_all(Fleet([str(drives)], out), Workers(count=1))
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    there = len(list(out.glob("jobs/*/row.json")))
    assert process.returncode in (130, 3), said
    done = replay_all(Fleet([str(drives)], out), Workers(count=1))
    assert done.reused >= there - 1
    assert equal_to_serial(out, done.rows, serial) == 3
    assert not list(out.glob("jobs/.*")), "nothing half-written is left"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_does_not_answer_is_named(address, monkeypatch):
    monkeypatch.setattr(engine, "Client", lambda at, **options: Client(at, **options | {"timeout": "1s"}))
    with pytest.raises(GraphSlamError, match="no Dask scheduler answers"), connected(Workers(address)):
        pass


def test_a_scheduler_without_workers_is_named(tmp_path):
    with scheduler(tmp_path, 0) as address:
        refused = pytest.raises(GraphSlamError, match="has no worker")
        with refused, connected(Workers(address)):
            pass


def test_a_full_disk_is_named_and_with_room_the_same_command_goes_on(drives, serial, tmp_path):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", tmp_path], check=False).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        full = fleet("replay", drives / "1.mcap", "--out", tmp_path / "out", "--workers", 1)
        assert full.returncode in (2, 3), full
        assert "No space left on device" in full.stderr
        assert "Traceback" not in full.stderr
        subprocess.run(["mount", "-o", "remount,size=20m", tmp_path], check=True)
        done = replay_all(Fleet([str(drives / "1.mcap")], tmp_path / "out"), Workers(count=1))
        assert equal_to_serial(tmp_path / "out", done.rows, serial) == 1
    finally:
        subprocess.run(["umount", "--lazy", tmp_path], check=False)


def test_a_copy_of_a_recording_is_named(drives, tmp_path):
    (tmp_path / "same.mcap").write_bytes((drives / "damaged0.mcap").read_bytes())
    both = (drives / "damaged0.mcap", tmp_path / "same.mcap")
    done = fleet("replay", *both, "--out", tmp_path / "out", "--workers", 1)
    assert "not replayed: same.mcap: a copy of damaged0.mcap, which has the row" in done.stderr
    assert "runs              1 " in done.stdout


def test_a_worker_has_no_job_but_the_one_that_it_runs():
    jobs = [Job(f"{k}", "", f"{k}", "", {}, "", "", 10.0, 0, with_report=False) for k in range(9)]
    with connected(Workers(count=2)) as client:
        most = 0
        for row in run_jobs(client, jobs, lambda items, _: items, lambda job: {"key": job.key}):
            most = max(most, *map(len, client.processing().values()))
            assert row["key"] in {job.key for job in jobs}
    assert most <= 1


def test_mistakes_are_refused_in_one_line(drives, tmp_path, capsys):
    for arguments, says in (
        (("replay", tmp_path / "none", "--out", tmp_path / "o"), "no such file"),
        (("replay", drives, "--out", tmp_path / "o", "--set", "keyframes.x=1"), "unknown parameter"),
        (("replay", drives, "--out", tmp_path / "o", "--truth", "{bag}.tum"), "knows {path}, {folder} and {stem}"),
        (
            ("replay", drives, "--out", tmp_path / "o", "--scheduler", "tcp://x:1", "--workers", 2),
            "no use for --workers",
        ),
        (("replay", drives, "--out", "s3://bucket/out"), "writes into a folder that all its machines see"),
        (("table", drives), "not the folder of a fleet"),
        (("compare", drives, drives), "no table.parquet"),
    ):
        code, _, said = here(capsys, *arguments)
        assert code == 2, said
        assert says in said
        assert len(said.splitlines()) == 1
    assert not Path(tmp_path / "o").exists(), "nothing was begun"
