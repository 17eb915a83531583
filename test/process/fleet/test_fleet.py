"""A fleet on real workers: processes of this machine, and those of a scheduler over TCP, with faults."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("distributed", reason="the extra fleet is not installed")

from distributed import Client
from reliability import times

from graph_slam_ros import cli
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet import replay as engine
from graph_slam_ros.tools.fleet.job import Job, run_job
from graph_slam_ros.tools.fleet.replay import Fleet, connected, jobs_of, replay_all, run_isolated, run_jobs
from graph_slam_ros.tools.fleet.store import Store

COUNT, STOPS = times((2, 1), (12, 10))
HASHED = ("graph.g2o", "ledger.csv", "path.tum", "landmarks.csv", "map.mcap")


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Recordings in a folder, of which one is damaged, and the bytes of the results of a serial run, by name."""
    (folder := tmp_path_factory.mktemp("fleet") / "drives").mkdir()
    found = {}
    for seed in range(1, COUNT + 1):
        name, out = f"{seed}.mcap", folder.with_name("serial") / str(seed)
        sensor = "range_bearing" if seed == 2 else "position"  # whose topic is that of no usual input
        words = ["simulate", "pythonrobotics", "--seed", str(seed), "--set", f"sensor={sensor}"]
        assert cli.main([*words, "--out", str(folder / name)]) == 0
        assert cli.main(["replay", str(folder / name), "--out", str(out)]) == 0
        found[name] = contents(out)
    (folder / "damaged.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    return folder, found


@pytest.fixture(scope="module")
def drives(serial):
    return serial[0]


def contents(run):
    """What is the same wherever a recording was replayed."""
    return {name: (run / name).read_bytes() for name in HASHED}


def wait_for(what):
    until = time.monotonic() + 60.0
    while not what():
        assert time.monotonic() < until, what
        time.sleep(0.05)


def check(out, rows, serial, *, whole=True):
    """No result is wrong, and who has none says why; ``whole``: each that is not damaged has one."""
    done = {row["recording"]: contents(out / "jobs" / row["key"] / "run") for row in rows if row["state"] == "done"}
    assert done == {name: serial[1][name] for name in done}
    assert all(row["reason"] for row in rows if row["state"] != "done")
    if whole:
        assert set(done) == set(serial[1])
        assert [row["recording"] for row in rows if row["state"] == "failed"] == ["damaged.mcap"]


def test_stopped_by_a_signal_it_goes_on_where_it_was_and_a_second_time_there_is_nothing_to_do(
    drives, serial, tmp_path, told
):
    out = tmp_path / "out"
    options = ("--out", out, "--truth", "{path}", "--workers", 2, "--report")
    command = [sys.executable, "-m", "graph_slam_ros.cli", "fleet", "replay", drives, *options]
    for stop in range(STOPS):
        with subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True) as process:
            if stop:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(random.Random(stop).uniform(2.0, 6.0))
                process.kill()
                continue
            wait_for(lambda: list(out.glob("jobs/*/row.json")))
            with pytest.raises(GraphSlamError, match="another fleet writes into it"):
                replay_all(Fleet([str(drives)], out), workers=1)
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=60)[1]
            assert process.returncode in (130, 3), said
    there = len(list(out.glob("jobs/*/row.json")))
    code, _, said = told("fleet", "replay", drives, *options)
    assert code == 3
    assert "failed: damaged.mcap (defaults):" in said
    assert "Traceback" not in said
    stamps = {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")}
    rows = [json.loads(file.read_text()) for file in stamps]
    check(out, rows, serial)
    assert not list(out.glob("jobs/.*")), "nothing half-written is left"
    assert there <= len(rows) == COUNT + 1
    for row in rows:
        if row["state"] == "done":
            assert 0.0 < row["rmse_m"] < 0.5
            assert row["nees"] > 0.0 and row["cpu_s"] > 0.0
            assert len(row["errors_m"]) == 40
            assert f"{row['key']}/report.html" in (out / "index.html").read_text()
    inputs = {row["recording"]: row.get("inputs") for row in rows}
    assert inputs["2.mcap"] == "odom ranges", "as info suggests where no topic is usual"
    assert f"of them {COUNT + 1} were there" in told("fleet", "replay", drives, *options)[1]
    assert {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")} == stamps
    assert told("fleet", "compare", out, out, "--fail", "rmse>1.02x")[0] == 0


@contextlib.contextmanager
def scheduler(folder):
    """A Dask scheduler's address and what starts a worker of it, as processes on the loopback."""
    file, begun = folder / "scheduler.json", []
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2"}

    def start(name, *options):
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--scheduler-file", str(file)]
        command += ["--no-dashboard", "--host", "127.0.0.1", *options]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
        begun.append(subprocess.Popen(command, env=environment, **quiet))

    try:
        start("scheduler", "--port", "0")
        wait_for(file.exists)
        worker = "worker", "--nthreads", "1", "--local-directory", str(folder)
        yield json.loads(file.read_text())["address"], lambda: start(*worker)
    finally:
        for process in reversed(begun):
            process.terminate()
        for process in begun:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
            process.wait()


def test_over_tcp_a_worker_that_is_killed_changes_nothing(drives, serial, tmp_path):
    out = tmp_path / "out"
    with scheduler(tmp_path) as (address, start_worker):
        with pytest.raises(GraphSlamError, match="has no worker"), connected(address, 0):
            pass
        for _ in range(2):
            start_worker()
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            pids = client.run(os.getpid)
            jobs, most = [Job(f"{k}", "", f"{k}", "", {}, "", "", 10.0, 0, with_report=False) for k in range(9)], 0
            for _ in run_jobs(client, jobs, lambda job: {"key": job.key}):
                most = max(most, *map(len, client.processing().values()))
        assert most <= 1, "a worker has no job but the one that it runs"

        def kill_at_work():
            wait_for(lambda: list(out.glob("jobs/.*")))
            os.kill(next(iter(pids.values())), signal.SIGKILL)

        killer = threading.Thread(target=kill_at_work)
        killer.start()
        rows, _ = replay_all(Fleet([str(drives)], out), address)
        killer.join()
    check(out, rows, serial)


def job(drives, out, **options):
    """The job of the first recording alone."""
    Store(out, new=True)
    (one,) = jobs_of(Fleet([str(drives / "1.mcap")], out, **options))
    return one


def test_a_job_beyond_its_limits_or_without_its_truth_is_a_row_that_says_so(drives, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "MOST_ATTEMPTS", 1)
    slow = run_isolated(job(drives, tmp_path / "out", limit_s=0.05))
    assert slow["state"] == "failed" and "limit of time" in slow["reason"]
    assert slow["retry"], "the next command runs it again"
    large = run_isolated(job(drives, tmp_path / "large", memory=2**20))
    assert "out of memory: more than 1 MiB (--memory)" in large["reason"]
    row = run_job(job(drives, tmp_path / "true", truth="{folder}/{stem}.tum"))
    assert row["state"] == "incomplete"
    assert "not compared with the truth" in row["reason"] and "1.tum" in row["reason"]
    assert (tmp_path / "true/jobs" / row["key"] / "run/path.tum").is_file()


def test_a_full_disk_is_named_and_with_room_the_same_job_is_done(drives, serial, tmp_path):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "none", tmp_path], check=False).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        one = job(drives, tmp_path / "out")
        full = run_job(one)
        assert full["state"] == "failed" and full["retry"]
        assert "No space left on device" in full["reason"]
        subprocess.run(["mount", "-o", "remount,size=20m", tmp_path], check=True)
        row = run_job(one)
        assert row["state"] == "done"
        check(tmp_path / "out", [row], serial, whole=False)
    finally:
        subprocess.run(["umount", "--lazy", tmp_path], check=False)


def test_mistakes_are_refused_in_one_line(drives, tmp_path, told, monkeypatch):
    monkeypatch.setattr(engine, "Client", lambda at, **options: Client(at, **options | {"timeout": "1s"}))
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
        code, _, said = told("fleet", *arguments)
        assert code == 2, said
        assert says in said
        assert len(said.splitlines()) == 1
    assert not (tmp_path / "o").exists(), "nothing was begun"
    with pytest.raises(GraphSlamError, match="no Dask scheduler answers"), connected("tcp://127.0.0.1:9", 0):
        pass
