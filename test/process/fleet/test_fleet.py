"""A fleet on real workers: processes of this machine, and those of a scheduler over TCP, with faults."""

import json
import os
import signal
import subprocess
import sys
import threading

import pytest

pytest.importorskip("distributed", reason="the extra fleet is not installed")

import fleet_nodes
from distributed import Client
from fleet_nodes import contents, scheduler, wait_for

from graph_slam_ros import cli
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet import engine, isolation
from graph_slam_ros.tools.fleet.engine import connected, run_jobs
from graph_slam_ros.tools.fleet.isolation import run_isolated
from graph_slam_ros.tools.fleet.job import Job, run_job
from graph_slam_ros.tools.fleet.replay import Fleet, jobs_of, replay_all
from graph_slam_ros.tools.fleet.store import Store


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Bytes of the results of each of two recordings, replayed one by one; a third one is damaged."""
    folder = tmp_path_factory.mktemp("fleet") / "drives"
    folder.mkdir()
    return folder, fleet_nodes.drives(folder, 2, b"\x89MCAP0\r\n" + bytes(100))


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


def job(drives, out, **options):
    """The job of the first recording alone."""
    Store(out, new=True)
    (one,) = jobs_of(Fleet([str(drives / "1.mcap")], out, **options))
    return one


def test_one_command_replays_all_and_the_second_time_nothing(drives, serial, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--out", out, "--truth", "{path}", "--workers", 2)
    code, _, said = here(capsys, "replay", drives, *options)
    assert code == 3
    assert "failed: damaged0.mcap (defaults):" in said
    assert "Traceback" not in said
    rows = [json.loads(file.read_text()) for file in out.glob("jobs/*/row.json")]
    assert equal_to_serial(out, rows, serial) == 2
    for row in rows:
        if row["state"] == "done":
            assert 0.0 < row["rmse_m"] < 0.5
            assert row["nees"] > 0.0 and row["cpu_s"] > 0.0
            assert len(row["errors_m"]) == 40
    inputs = {row["recording"]: row.get("inputs") for row in rows}
    assert inputs["2.mcap"] == "odom ranges", "as info suggests where no topic is usual"
    stamps = {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")}
    assert "of them 3 were there" in here(capsys, "replay", drives, *options)[1]
    assert {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")} == stamps
    _, shown, _ = here(capsys, "replay", drives / "1.mcap", *options, "--report")
    assert "of them 0 were there" in shown, "it lacked its report"
    (report,) = out.glob("jobs/*/report.html")
    assert str(report.relative_to(out)) in (out / "index.html").read_text()
    assert here(capsys, "compare", out, out, "--fail", "rmse>1.02x")[0] == 0


def test_over_tcp_a_worker_that_is_killed_changes_nothing(drives, serial, tmp_path):
    out = tmp_path / "out"
    with scheduler(tmp_path, 0) as (address, start_worker):
        with pytest.raises(GraphSlamError, match="has no worker"), connected(address, 0):
            pass
        for _ in range(2):
            start_worker()
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            pids = client.run(os.getpid)
            jobs, most = [Job(f"{k}", "", f"{k}", "", {}, "", "", 10.0, 0, with_report=False) for k in range(9)], 0
            for _ in run_jobs(client, jobs, lambda items, _: items, lambda job: {"key": job.key}):
                most = max(most, *map(len, client.processing().values()))
        assert most <= 1, "a worker has no job but the one that it runs"
        victim = next(iter(pids.values()))

        def kill_at_work():
            wait_for(lambda: list(out.glob("jobs/.*")))
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_at_work)
        killer.start()
        rows, _ = replay_all(Fleet([str(drives)], out), address)
        killer.join()
    assert equal_to_serial(out, rows, serial) == 2
    assert [row["recording"] for row in rows if row["state"] == "failed"] == ["damaged0.mcap"]


def test_a_job_beyond_its_limits_is_a_row_and_the_process_of_the_next_is_new(drives, serial, tmp_path, monkeypatch):
    monkeypatch.setattr(isolation, "MOST_ATTEMPTS", 1)
    slow = run_isolated(job(drives, tmp_path / "out", limit_s=0.05))
    assert slow["state"] == "failed" and "limit of time" in slow["reason"]
    assert slow["retry"], "the next command runs it again"
    large = run_isolated(job(drives, tmp_path / "large", memory=2**20))
    assert "out of memory: more than 1 MiB (--memory)" in large["reason"]
    rows, reused = replay_all(Fleet([str(drives / "1.mcap")], tmp_path / "out"), workers=1)
    assert ([row["state"] for row in rows], reused) == (["done"], 0)


def test_without_its_truth_a_run_is_kept_and_says_so(drives, tmp_path):
    row = run_job(job(drives, tmp_path / "out", truth="{folder}/{stem}.tum"))
    assert row["state"] == "incomplete"
    assert "not compared with the truth" in row["reason"] and "1.tum" in row["reason"]
    assert (tmp_path / "out/jobs" / row["key"] / "run/path.tum").is_file()


def test_stopped_by_a_signal_it_goes_on_where_it_was(drives, serial, tmp_path):
    out = tmp_path / "out"
    options = ["replay", str(drives), "--out", str(out), "--workers", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "graph_slam_ros.cli", "fleet", *options], stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: list(out.glob("jobs/*/row.json")))
    with pytest.raises(GraphSlamError, match="another fleet writes into it"):
        replay_all(Fleet([str(drives)], out), workers=1)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    there = len(list(out.glob("jobs/*/row.json")))
    assert process.returncode in (130, 3), said
    rows, reused = replay_all(Fleet([str(drives)], out), workers=1)
    assert reused >= there - 1
    assert equal_to_serial(out, rows, serial) == 2
    assert not list(out.glob("jobs/.*")), "nothing half-written is left"


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr(engine, "Client", lambda at, **options: Client(at, **options | {"timeout": "1s"}))
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(GraphSlamError, match="no Dask scheduler answers"), connected(address, 0):
            pass


def test_a_full_disk_is_named_and_with_room_the_same_job_is_done(drives, serial, tmp_path):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "none", tmp_path], check=False).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        one = job(drives, tmp_path / "out")
        full = run_job(one)
        assert full["state"] == "failed" and full["retry"]
        assert "No space left on device" in full["reason"]
        subprocess.run(["mount", "-o", "remount,size=20m", tmp_path], check=True)
        assert equal_to_serial(tmp_path / "out", [run_job(one)], serial) == 1
    finally:
        subprocess.run(["umount", "--lazy", tmp_path], check=False)


def test_mistakes_are_refused_in_one_line(drives, tmp_path, capsys):
    out = ("--out", tmp_path / "o")
    for arguments, says in (
        (("replay", tmp_path / "none", *out), "no such file"),
        (("replay", drives, *out, "--set", "keyframes.x=1"), "unknown parameter"),
        (("replay", drives, *out, "--truth", "{bag}.tum"), "knows {path}, {folder} and {stem}"),
        (("replay", drives, *out, "--scheduler", "tcp://x:1", "--workers", 2), "no use for --workers"),
        (("replay", drives, "--out", "s3://bucket/out"), "writes into a folder that all its machines see"),
        (("replay", drives, "--out", drives), "not the folder of a fleet"),
        (("compare", drives, drives), "no table.parquet"),
    ):
        code, _, said = here(capsys, *arguments)
        assert code == 2, said
        assert says in said
        assert len(said.splitlines()) == 1
    assert not (tmp_path / "o").exists(), "nothing was begun"
